"""``sb3-gcr-zoo conflicts``: which terms of a reward really conflict in a trained agent."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_gcr.conflicts.measuring import measure_conflicts
from sb3_gcr.conflicts.result import Conflicts
from sb3_gcr.rewards.gymnasium_envs import GYMNASIUM_ENVS

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

#: What the command writes into the folder of the agent.
TABLE_FILE = "measured_conflicts.csv"
PICTURE_FILE = "measured_conflicts.png"
_WRAPPER = "sb3_gcr.RewardDecomposition"


def run(program: str, arguments: Sequence[str]) -> str:
    """Measure, write a table and a picture, and return what there is to say.

    :param program: its name, for the help
    :param arguments: of the command line
    """
    parser = _parser(program)
    options = parser.parse_args(arguments)
    try:
        folder, found = _measure(options)
    except (AssertionError, ImportError, ValueError) as error:  # rl-zoo3 asserts that files exist
        parser.error(str(error))
    found.to_frame().to_csv(folder / TABLE_FILE, index=False)
    found.figure().savefig(folder / PICTURE_FILE, dpi=120)
    sentences = "\n".join(found.sentences()) or "No pair of terms conflicts for certain."
    return f"{found.table()}\n{sentences}\n{folder / TABLE_FILE}\n{folder / PICTURE_FILE}\n"


def _parser(program: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        program,
        allow_abbrev=False,
        description=(
            "Measure which terms of a reward really conflict in a trained agent: cosines between "
            "policy gradients of independent rollouts, which share no noise, and how certain they "
            f"are. Writes {TABLE_FILE} and {PICTURE_FILE} into the agent's folder."
        ),
    )
    parser.add_argument("--algo", choices=["gcrppo", "ppo"], default="gcrppo")
    parser.add_argument("--env", required=True, help="id of the env")
    parser.add_argument("-f", "--folder", default="logs", help="log folder (default: logs)")
    parser.add_argument(
        "--exp-id", type=int, default=0, help="experiment (default: 0, the latest; -1: no folder)"
    )
    parser.add_argument("--load-best", action="store_true", help="the best model, not the last")
    parser.add_argument("--load-checkpoint", type=int, help="that of so many steps")
    parser.add_argument("--load-last-checkpoint", action="store_true")
    parser.add_argument("--n-rollouts", type=int, default=24, help="at least 3 (default: 24)")
    parser.add_argument("--n-envs", type=int, help="(default: as many as in training)")
    parser.add_argument("--seed", type=int, default=0, help="(default: 0)")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--no-progress", action="store_true", help="show no progress bar")
    return parser


def _measure(options: argparse.Namespace) -> tuple[Path, Conflicts]:
    """The agent's folder, and what is found."""
    from huggingface_sb3 import EnvironmentName  # type: ignore[import-untyped]
    from rl_zoo3 import ALGOS
    from rl_zoo3.utils import get_model_path

    _, path, folder = get_model_path(
        options.exp_id,
        options.folder,
        options.algo,
        EnvironmentName(options.env),
        options.load_best,
        options.load_checkpoint,
        options.load_last_checkpoint,
    )
    env = _make_env(options, Path(folder) / EnvironmentName(options.env))
    try:
        model: Any = ALGOS[options.algo].load(path, device=options.device)
        found = measure_conflicts(
            model, env, options.n_rollouts, options.seed, progress_bar=not options.no_progress
        )
    finally:
        env.close()
    return Path(folder), found


def _make_env(options: argparse.Namespace, settings: Path) -> VecEnv:
    """The env that an agent has learned on, its reward taken apart.

    :param options: of the command
    :param settings: folder with what rl-zoo3 has saved of the training
    """
    import yaml
    from rl_zoo3 import exp_manager, utils
    from stable_baselines3.common.vec_env import unwrap_vec_normalize

    saved, statistics = utils.get_saved_hyperparams(str(settings), norm_reward=True)
    env_kwargs = saved.pop("env_kwargs", None) or {}
    given = settings / "args.yml"
    if given.is_file():  # rl-zoo3's own file, with tags of Python
        env_kwargs = yaml.load(given.read_text(), Loader=yaml.UnsafeLoader)["env_kwargs"] or {}
    if options.env in GYMNASIUM_ENVS:
        saved["env_wrapper"] = _with_decomposition(saved.get("env_wrapper"))
    env: VecEnv = utils.create_test_env(
        options.env,
        n_envs=options.n_envs or saved.get("n_envs", 1),
        stats_path=statistics,
        seed=options.seed,
        should_render=False,
        hyperparams=saved,
        env_kwargs=env_kwargs,
        vec_env_cls=exp_manager.ExperimentManager.default_vec_env_cls,
    )
    normaliser = unwrap_vec_normalize(env)
    if normaliser is not None:  # the value heads are in the units of training
        normaliser.norm_reward = saved["normalize_kwargs"].get("norm_reward", True)
    return env


def _with_decomposition(wrappers: Any) -> list[Any]:
    """rl-zoo3's setting ``env_wrapper``, with the wrapper that takes a reward apart."""
    listed = wrappers if isinstance(wrappers, list) else [wrappers] if wrappers else []
    return listed if _WRAPPER in str(listed) else [*listed, _WRAPPER]
