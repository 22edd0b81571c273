"""rl-zoo3's commands for GCRPPO: ``python -m sb3_gcr.zoo train --algo gcrppo --env Humanoid-v5``.

rl-zoo3 does the work. Added here: the algorithm, where its hyperparameters are, its search space,
Monitor's columns for the terms of our envs, ``--vec-env batch``, and ``tune_entropy``.
"""

from __future__ import annotations

import argparse
import functools
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from sb3_gcr import GCRPPO, envs
from sb3_gcr.simulators.envpool_gym import pool_of
from sb3_gcr.zoo.components import show_components
from sb3_gcr.zoo.conflicts import run as run_conflicts

if TYPE_CHECKING:
    import optuna
    from rl_zoo3.exp_manager import ExperimentManager
    from stable_baselines3.common.vec_env import VecEnv

#: Where rl-zoo3 has each command; None for a module that is a script.
COMMANDS: dict[str, tuple[str, str | None]] = {
    "train": ("rl_zoo3.train", "train"),
    "enjoy": ("rl_zoo3.enjoy", "enjoy"),
    "record_video": ("rl_zoo3.record_video", None),
    "record_training": ("rl_zoo3.record_training", None),
    "plot_train": ("rl_zoo3.plots", "plot_train"),
    "plot_from_file": ("rl_zoo3.plots", "plot_from_file"),
    "all_plots": ("rl_zoo3.plots", "all_plots"),
}
#: Our algorithms, and those whose settings of rl-zoo3 they take where we have none.
INHERITED = {"gcrppo": "ppo", "gcrppo_lstm": "ppo_lstm"}
#: The paper's search: values of the entropy coefficient, and the seeds of each.
ENTROPY_GRID: dict[str, Sequence[Any]] = {
    "ent_coef": np.geomspace(1e-4, 0.03, 10).tolist(),
    "seed": [0, 1, 2],
}

_PROGRAM = "sb3-gcr-zoo"
_DESCRIPTION = (
    "Train, tune, play and record with rl-zoo3. The commands are rl-zoo3's, with all their "
    "options, but for tune_entropy, components and conflicts."
)
_EPILOG = (
    f"`{_PROGRAM} COMMAND --help` lists the options of a command. `--vec-env batch`, for all but "
    "the plots, is added to them: "
    "it steps all simulations of an env of sb3_gcr on one thread pool."
)


def register() -> None:
    """Make GCRPPO and RecurrentGCRPPO known to rl-zoo3 as ``gcrppo`` and ``gcrppo_lstm``; its
    commands then find our hyperparameters, too.

    Call it before ``rl_zoo3.train.train()`` in a script of your own, or in a ``custom_envs.py``,
    which rl-zoo3 imports.

    :raises ImportError: if rl-zoo3 is not installed
    """
    try:
        from rl_zoo3 import ALGOS, exp_manager, hyperparams_opt
    except ImportError as error:
        raise ImportError(
            f"{_PROGRAM} needs rl-zoo3: pip install 'sb3_gcr[zoo]' ({error})"
        ) from error
    from sb3_gcr.recurrent import RecurrentGCRPPO  # rl-zoo3 brings sb3-contrib

    ALGOS["gcrppo"] = GCRPPO
    ALGOS["gcrppo_lstm"] = RecurrentGCRPPO
    for algo in INHERITED:
        hyperparams_opt.HYPERPARAMS_SAMPLER[algo] = _sample
        hyperparams_opt.HYPERPARAMS_CONVERTER[algo] = hyperparams_opt.convert_onpolicy_params
    if not hasattr(
        exp_manager, "ExperimentManager"
    ):  # rl_zoo3.record_video imports custom_envs.py before that class is there
        return
    for name in ("exp_manager", "train", "enjoy"):
        if f"rl_zoo3.{name}" in sys.modules:
            sys.modules[f"rl_zoo3.{name}"].ExperimentManager = _managers()[0]  # type: ignore[attr-defined]


def hyperparameter_file(algo: str, env_id: str) -> str | None:
    """Our file of hyperparameters for an algorithm and an env, None where we have none.

    :param algo: "gcrppo", "gcrppo_lstm" or "ppo"; for others we have none
    :param env_id: id of the env
    """
    import yaml

    path = files("sb3_gcr.hyperparams") / f"{algo}.yml"
    return str(path) if path.is_file() and env_id in yaml.safe_load(path.read_text()) else None


def _sample(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """The search space of ``train -optimize``: PPO's, and the resolver."""
    from rl_zoo3.hyperparams_opt import sample_ppo_params

    resolver = trial.suggest_categorical("resolver", ["gcr", "guaranteed"])
    return {**sample_ppo_params(trial, n_actions, n_envs, additional_args), "resolver": resolver}


@functools.cache
def _managers() -> tuple[type[ExperimentManager], type[ExperimentManager]]:
    """rl-zoo3's manager of experiments for ``train`` and for ``tune_entropy``; a function, because
    rl-zoo3 is optional.
    """
    import optuna
    from rl_zoo3 import ALGOS, exp_manager
    from stable_baselines3.common.utils import set_random_seed

    class ZooManager(exp_manager.ExperimentManager):
        """Finds our hyperparameters, and lets Monitor write the return of each term of our envs."""

        def __init__(
            self, args: argparse.Namespace, algo: str, env_id: str, *others: Any, **kwargs: Any
        ):
            super().__init__(args, algo, env_id, *others, **kwargs)
            if not kwargs.get("config"):
                theirs = Path(self.config).with_name(f"{INHERITED.get(algo, algo)}.yml")
                self.config = hyperparameter_file(algo, env_id) or str(theirs)

        def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
            given, env_id = self.monitor_kwargs, self.env_name.gym_id
            if gym.spec(env_id).namespace in ("sb3_gcr", "envpool"):
                env = gym.make(env_id, **(self.eval_env_kwargs if eval_env else self.env_kwargs))
                self.monitor_kwargs = {
                    "info_keywords": env.get_wrapper_attr("reward_spec").return_keys,
                    **given,
                }
                env.close()
            try:
                return super().create_envs(n_envs, eval_env, no_log)
            finally:
                self.monitor_kwargs = given

    class EntropyManager(ZooManager):
        """Gives each entropy coefficient of the grid several seeds and half the budget."""

        def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
            is_given = self.n_timesteps > 0
            result = super()._preprocess_hyperparams(hyperparams)
            self.n_timesteps = self.n_timesteps if is_given else self.n_timesteps // 2
            return result

        def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
            return optuna.samplers.GridSampler(ENTROPY_GRID)

        def objective(self, trial: optuna.Trial) -> float:
            self.study, algorithm = trial.study, ALGOS[self.algo]
            if self.study.sampler.is_exhausted(self.study):  # type: ignore[union-attr]
                self.study.stop()
                raise optuna.TrialPruned
            values, seeds = ENTROPY_GRID["ent_coef"], ENTROPY_GRID["seed"]
            chosen = {"ent_coef": trial.suggest_float("ent_coef", values[0], values[-1], log=True)}
            self.seed = trial.suggest_int("seed", seeds[0], seeds[-1])
            set_random_seed(self.seed)
            seeded = {self.algo: lambda **kwargs: algorithm(**{**kwargs, "seed": self.seed})}
            with (
                _set(exp_manager, "HYPERPARAMS_SAMPLER", {self.algo: lambda *_: chosen}),
                _set(exp_manager, "ALGOS", seeded),
            ):
                return super().objective(trial)

        def hyperparameters_optimization(self) -> None:
            super().hyperparameters_optimization()
            sys.stdout.write(_entropy_table(self.study))

    return ZooManager, EntropyManager


def _entropy_table(study: optuna.Study) -> str:
    """The mean return of each entropy coefficient, and the best of those that have all seeds."""
    returns: dict[float, dict[int, float]] = {value: {} for value in ENTROPY_GRID["ent_coef"]}
    for trial in study.trials:
        if trial.state.name == "COMPLETE" and trial.value is not None:
            returns[trial.params["ent_coef"]][trial.params["seed"]] = trial.value
    means = {value: sum(found.values()) / len(found) for value, found in returns.items() if found}
    lines = ["  ent_coef        return  seeds"]
    lines += [
        f"{value:10.6f}  {mean:12.2f}  {len(returns[value]):5}" for value, mean in means.items()
    ]
    whole = [value for value in means if len(returns[value]) == len(ENTROPY_GRID["seed"])]
    if whole:
        lines.append(f"Best entropy coefficient: {max(whole, key=means.__getitem__):.6f}")
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command of rl-zoo3, ``tune_entropy``, ``components`` or ``conflicts``.

    :param argv: the command and its options; None takes those of the command line
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(_PROGRAM, description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("command", choices=[*COMMANDS, "tune_entropy", "components", "conflicts"])
    command = parser.parse_args(arguments[:1]).command
    options = arguments[1:]
    if command == "components":  # needs no rl-zoo3
        show_components(f"{_PROGRAM} components", options)
        return
    try:
        register()
    except ImportError as error:
        parser.exit(2, f"{error}\n")
    with ExitStack() as changes:
        changes.enter_context(_set(sys, "argv", [f"{_PROGRAM} {command}"]))
        if command == "tune_entropy":
            changes.enter_context(
                _set(import_module("rl_zoo3.train"), "ExperimentManager", _managers()[1])
            )
            command, options = "train", _entropy_arguments(options)
        given = options
        if "plot" not in command:
            options = _take_vec_env(options, changes)
        if command == "conflicts":
            sys.stdout.write(run_conflicts(f"{_PROGRAM} {command}", options))
            return
        if command == "record_training" and not {"-h", "--help"} & set(options):
            if shutil.which("ffmpeg") is None:
                parser.exit(
                    2,
                    f"{_PROGRAM} {command} needs the program ffmpeg; on Debian and Ubuntu: apt "
                    "install ffmpeg\n",
                )
            call = functools.partial(
                _call_us, subprocess.call, ["--vec-env", "batch"] if options != given else []
            )
            changes.enter_context(_set(subprocess, "call", call))
        sys.argv += options
        module, function = COMMANDS[command]
        if function is None:
            runpy.run_module(module, run_name="__main__")
        else:
            getattr(import_module(module), function)()


def _take_vec_env(options: list[str], changes: ExitStack) -> list[str]:
    """Take ``--vec-env batch`` off, because rl-zoo3's parsers refuse it, and let rl-zoo3 use that
    class.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--vec-env", choices=["dummy", "subproc", "batch"])
    found, rest = parser.parse_known_args(options)
    if found.vec_env != "batch":
        return options
    parser.add_argument("--env", default="CartPole-v1")  # rl-zoo3's default
    env_id = parser.parse_known_args(options)[0].env
    if not env_id.startswith(("sb3_gcr/", "envpool/")):
        parser.error(
            "--vec-env batch needs an env of sb3_gcr or EnvPool, such as 'sb3_gcr/HumanoidRun-v0' "
            "or 'envpool/Humanoid-v5', "
            f"found {env_id!r}"
        )
    import rl_zoo3.utils

    make: Any = envs.BatchedVecEnv if env_id.startswith("sb3_gcr/") else pool_of
    changes.enter_context(
        _set(_managers()[0], "default_vec_env_cls", staticmethod(make))
    )  # a function is no method there
    create = functools.partial(rl_zoo3.utils.create_test_env, vec_env_cls=make)
    changes.enter_context(
        _set(rl_zoo3.utils, "create_test_env", create)
    )  # record_video names no class
    return rest


def _call_us(call: Callable[[list[str]], int], vec_env: list[str], command: list[str]) -> int:
    """Start this program where record_training starts ``python -m rl_zoo3.record_video``, which
    does not know GCRPPO.
    """
    return call([sys.executable, "-m", "sb3_gcr.zoo", "record_video", *vec_env, *command[3:]])


def _entropy_arguments(arguments: list[str]) -> list[str]:
    """What ``rl_zoo3.train`` needs to search the entropy coefficient."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False,
        description=(
            "Search the entropy coefficient as the paper does: 10 values from 1e-4 to 0.03, 3 "
            "seeds each, half the budget. Several machines can take part: start the same command "
            "on each."
        ),
        epilog=(
            f"All other options are those of `{_PROGRAM} train`; with `-n` the budget of each run "
            "is as given."
        ),
    )
    parser.add_argument("--algo", required=True, help="one study per algorithm")
    parser.add_argument("--env", required=True, help="and per env")
    parser.add_argument(
        "-f", "--log-folder", default="logs", help="where the report goes (default: logs)"
    )
    parser.add_argument(
        "--storage",
        help="of Optuna: a .log file or a database (default: entropy.log in the log folder)",
    )
    parser.add_argument("--study-name", help="(default: entropy-ALGO-ENV)")
    parser.add_argument(
        "--n-jobs", type=int, choices=[1], help="1: start the command several times instead"
    )
    options, rest = parser.parse_known_args(arguments)
    storage = options.storage or str(Path(options.log_folder) / "entropy.log")
    study = options.study_name or f"entropy-{options.algo}-{options.env}"
    return [
        *("-optimize", "--algo", options.algo, "--env", options.env, "-f", options.log_folder),
        *(
            "--storage",
            storage,
            "--study-name",
            study,
            "--pruner",
            "none",
            "--n-evaluations",
            "1",
            "--eval-episodes",
            "20",
        ),
        *rest,
    ]


@contextmanager
def _set(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Set an attribute for a while."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


if __name__ == "__main__":
    main()
