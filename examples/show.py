"""Evaluate trained models of rl-zoo3's log folders beside random actions, and draw their learning
curves and a strip of frames.

``python examples/show.py logs/gcrppo/sb3_gcr-HumanoidRun-v0_1 logs/ppo/sb3_gcr-HumanoidRun-v0_1
--out humanoid``
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import matplotlib as mpl
import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gcr import GCRPPO, evaluate_components
from sb3_gcr.envs import BatchedVecEnv

mpl.use("Agg")
import matplotlib.pyplot as plt

#: Curves of both arms.
REACH = [
    ("return", "r", 0.0),
    ("position, fine-grained, of 1.2", "r_end_effector_position_tracking_fine_grained", 0.0),
]
#: What the curves show, by task: label, column of Monitor's file, and what one unit of it is per
#: step.
CURVES = {
    "HumanoidRun": [("episode length [steps]", "l", 0.0), ("speed [m/s]", "r_progress", 0.5)],
    "ThrowingMO": [
        ("throwing, of 4.1", "r_throwing", 0.0),
        ("stability, of 0.5", "r_stability", 0.0),
    ],
    "Quadcopter": [
        ("return", "r", 0.0),
        ("distance_to_goal, of 150", "r_distance_to_goal", 0.0),
    ],
    "ReachFranka": REACH,
    "ReachUR10": REACH,
    "LocoManipG1": [
        ("return", "r", 0.0),
        ("episode length [steps]", "l", 0.0),
        ("left hand fine-grained, of 28", "r_left_ee_pos_tracking_fine_grained", 0.0),
    ],
}
#: The algorithms by the folder of their runs.
ALGORITHMS: dict[str, type[PPO]] = {"ppo": PPO, "gcrppo": GCRPPO}
#: Episodes over which the curves are averaged.
WINDOW = 500


class RandomActions:
    """A policy that draws its actions evenly from the action space.

    :param env: the env
    """

    def __init__(self, env: VecEnv):
        self._space, self._n_envs = env.action_space, env.num_envs
        self._space.seed(0)

    def predict(self, observation: Any, *_: Any, **__: Any) -> tuple[NDArray[Any], None]:
        """Actions of all envs, and no state.

        :param observation: not used
        """
        return np.array([self._space.sample() for _ in range(self._n_envs)]), None


class Run:
    """A trained model in a log folder of rl-zoo3.

    :param folder: such as ``logs/gcrppo/sb3_gcr-HumanoidRun-v0_1``
    """

    def __init__(self, folder: Path):
        if not folder.is_dir():
            raise FileNotFoundError(
                f"Parameter `folders` must be log folders of rl-zoo3, found none at {folder}."
            )
        self.folder = folder
        self.name = folder.name.rsplit("_", 1)[0]
        self.env_id = self.name.replace("sb3_gcr-", "sb3_gcr/", 1)
        self.task = self.env_id.removeprefix("sb3_gcr/").removesuffix("-v0")
        arguments = yaml.unsafe_load(
            (folder / self.name / "args.yml").read_text()
        )  # written on this machine
        self.seed = int(dict(arguments)["seed"])
        self.algo = folder.parent.name
        self.label = f"{self.algo}, seed {self.seed}"

    def curve(self, column: str, per_step: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Steps and a running mean.

        :param column: of Monitor's file
        :param per_step: if not 0, the column is divided by the episode's length and multiplied by
            this
        """
        episodes: pd.DataFrame = load_results(str(self.folder))
        values = episodes[column]
        if per_step:
            values = (
                per_step * values.rolling(WINDOW, 1).sum() / episodes["l"].rolling(WINDOW, 1).sum()
            )
        else:
            values = values.rolling(WINDOW, 1).mean()
        return episodes["l"].cumsum().to_numpy(), values.to_numpy()

    def load(self, n_envs: int) -> tuple[PPO, VecNormalize]:
        """The model and an env to evaluate it in.

        :param n_envs: robots
        """
        env = make_vec_env(self.env_id, n_envs, seed=1000 + self.seed, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
        normalized = VecNormalize.load(str(self.folder / self.name / "vecnormalize.pkl"), env)
        normalized.training = normalized.norm_reward = False
        model = ALGORITHMS[self.algo].load(
            self.folder / f"{self.name}.zip", env=normalized, device="cpu"
        )
        return model, normalized

    def evaluate(self, n_episodes: int) -> str:
        """One line of a table: return, length, speed where there is one, the return of each term.

        :param n_episodes: deterministic episodes
        """
        model, env = self.load(n_episodes)
        returns, line = episodes(model, env, n_episodes)
        random_returns, random_line = episodes(RandomActions(env), env, n_episodes)
        env.close()
        gain = (np.mean(returns) - np.mean(random_returns)) / np.std(random_returns)
        return (
            f"{self.label} | {line}\n"
            f"random actions | {random_line}\n"
            f"above them by {gain:.1f} of their standard deviations"
        )

    def frames(self, n_frames: int, every: int, first: int) -> NDArray[np.uint8]:
        """Frames of one deterministic episode, side by side.

        :param n_frames: how many
        :param every: control steps between two
        :param first: control steps before the first
        """
        model, env = self.load(1)
        observation: Any = env.reset()
        shown = []
        for step in range(first + every * (n_frames - 1) + 1):
            if step >= first and (step - first) % every == 0:
                picture = env.render()
                assert picture is not None
                shown.append(
                    picture[100:460, 140:-140]
                )  # the sky and the floor around the robot say nothing
            observation, *_ = env.step(model.predict(observation, deterministic=True)[0])
        env.close()
        return np.concatenate(shown, axis=1)


def episodes(model: PolicyPredictor, env: VecEnv, n_episodes: int) -> tuple[list[float], str]:
    """Returns, and cells of a table: return, length, speed where there is one, each term.

    :param model: the policy
    :param env: as many envs as episodes
    :param n_episodes: deterministic episodes
    """
    rewards, lengths, terms = evaluate_components(
        model, env, n_episodes, return_episode_rewards=True
    )  # type: ignore[misc]
    cells = [
        f"return {np.mean(rewards):.2f} ± {np.std(rewards):.2f}",
        f"{np.mean(lengths):.0f} steps",
    ]
    if "progress" in terms:
        cells.append(f"{np.sum(terms['progress']) / 2 / np.sum(lengths):.2f} m/s")
    cells += [f"{name} {np.mean(values):.3g}" for name, values in terms.items()]
    return rewards, " | ".join(cells)


def draw_curves(runs: list[Run], path: Path) -> None:
    """One panel per curve of the task, one line per run.

    :param runs: of one task
    :param path: picture to write
    """
    curves = CURVES[runs[0].task]
    figure, panels = plt.subplots(
        1, len(curves), figsize=(4.5 * len(curves), 3), layout="constrained"
    )
    for panel, (label, column, per_step) in zip(panels, curves, strict=True):
        for run in runs:
            steps, values = run.curve(column, per_step)
            panel.plot(steps / 1e6, values, label=run.label, linewidth=1)
        panel.set(xlabel="million steps", ylabel=label)
        panel.grid(alpha=0.3)
    panels[0].legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", help="log folders of one env")
    parser.add_argument("--out", type=Path, required=True, help="start of the pictures' names")
    parser.add_argument(
        "--episodes", type=int, default=64, help="of the evaluation (default: %(default)s)"
    )
    parser.add_argument(
        "--every",
        type=int,
        default=12,
        help="control steps between two frames (default: %(default)s)",
    )
    parser.add_argument(
        "--first",
        type=int,
        default=300,
        help="control step of the first frame (default: %(default)s)",
    )
    arguments = parser.parse_args()
    try:
        runs = [Run(folder) for folder in arguments.folders]
    except FileNotFoundError as error:
        parser.error(str(error))
    for run in runs:
        print(run.evaluate(arguments.episodes), flush=True)
    draw_curves(runs, Path(f"{arguments.out}_curves.png"))
    imageio.imwrite(
        f"{arguments.out}_frames.png", runs[0].frames(6, arguments.every, arguments.first)
    )


if __name__ == "__main__":
    main()
