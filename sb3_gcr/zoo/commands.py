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
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_gcr import GCRPPO, envs
from sb3_gcr.simulators.envpool_gym import pool_of
from sb3_gcr.zoo.components import show_components
from sb3_gcr.zoo.conflicts import run as run_conflicts
from sb3_gcr.zoo.hyperparameters import INHERITED
from sb3_gcr.zoo.patches import patched

if TYPE_CHECKING:
    import optuna

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
    # rl_zoo3.record_video imports custom_envs.py before that class is there.
    if not hasattr(exp_manager, "ExperimentManager"):
        return
    from sb3_gcr.zoo.managers import ZooManager

    for name in ("exp_manager", "train", "enjoy"):
        if f"rl_zoo3.{name}" in sys.modules:
            sys.modules[f"rl_zoo3.{name}"].ExperimentManager = ZooManager  # type: ignore[attr-defined]


def _sample(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """The search space of ``train -optimize``: PPO's, and the resolver."""
    from rl_zoo3.hyperparams_opt import sample_ppo_params

    resolver = trial.suggest_categorical("resolver", ["gcr", "guaranteed"])
    return {**sample_ppo_params(trial, n_actions, n_envs, additional_args), "resolver": resolver}


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
        changes.enter_context(patched(sys, "argv", [f"{_PROGRAM} {command}"]))
        if command == "tune_entropy":
            from sb3_gcr.zoo.entropy_search import EntropyManager, entropy_arguments

            changes.enter_context(
                patched(import_module("rl_zoo3.train"), "ExperimentManager", EntropyManager)
            )
            command, options = "train", entropy_arguments(_PROGRAM, options)
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
            changes.enter_context(patched(subprocess, "call", call))
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

    from sb3_gcr.zoo.managers import ZooManager

    make: Any = envs.BatchedVecEnv if env_id.startswith("sb3_gcr/") else pool_of
    # A function is no method there.
    changes.enter_context(patched(ZooManager, "default_vec_env_cls", staticmethod(make)))
    create = functools.partial(rl_zoo3.utils.create_test_env, vec_env_cls=make)
    # record_video names no class.
    changes.enter_context(patched(rl_zoo3.utils, "create_test_env", create))
    return rest


def _call_us(call: Callable[[list[str]], int], vec_env: list[str], command: list[str]) -> int:
    """Start this program where record_training starts ``python -m rl_zoo3.record_video``, which
    does not know GCRPPO.
    """
    return call([sys.executable, "-m", "sb3_gcr.zoo", "record_video", *vec_env, *command[3:]])


if __name__ == "__main__":
    main()
