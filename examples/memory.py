"""Who can balance a double pendulum without seeing velocities: RecurrentGCRPPO and GCRPPO, the
curves of ``docs/recurrent.md``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from matplotlib.figure import Figure
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO, RewardDecomposition
from sb3_gcr.envs import HideObservations
from sb3_gcr.recurrent import RecurrentGCRPPO

ENV = "InvertedDoublePendulum-v5"
#: The velocities of the cart and both poles, and the force that keeps the cart on its rail.
HIDDEN = (5, 6, 7, 8)
DATA = Path(__file__).parents[1] / "docs/data/memory.json"
PICTURE = Path(__file__).parents[1] / "docs/images/memory.png"
SETTINGS: dict[str, Any] = {
    "n_steps": 128,
    "batch_size": 512,
    "learning_rate": 1e-3,
    "device": "cpu",
}
#: By label: class, policy, what its networks are.
ALGORITHMS: dict[str, tuple[Any, str, dict[str, Any]]] = {
    "RecurrentGCRPPO": (
        RecurrentGCRPPO,
        "MlpLstmPolicy",
        {"lstm_hidden_size": 64, "net_arch": [64]},
    ),
    "GCRPPO": (GCRPPO, "MlpPolicy", {}),
}
COLOURS = {"RecurrentGCRPPO": "#1f6fb4", "GCRPPO": "#d9730d"}


def make_env() -> gym.Env[Any, Any]:
    """The double pendulum without velocities, its reward in three terms."""
    return RewardDecomposition(HideObservations(gym.make(ENV), HIDDEN))


class Curve(BaseCallback):
    """Mean return of each term over the last 100 episodes, after every rollout."""

    def __init__(self) -> None:
        super().__init__()
        self.points: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        means = np.mean(model.ep_component_buffer, axis=0).round(1).tolist()
        point = dict(zip(model.reward_spec.names, means, strict=True))
        self.points.append({"timesteps": self.num_timesteps, **point})


def train(label: str, seed: int, timesteps: int) -> dict[str, Any]:
    """One run, as its curve."""
    algorithm, policy, networks = ALGORITHMS[label]
    env = VecNormalize(make_vec_env(make_env, 16, seed=seed))
    curve = Curve()
    model = algorithm(policy, env, policy_kwargs=networks, seed=seed, **SETTINGS)
    model.learn(timesteps, callback=curve)
    env.close()
    return {"algorithm": label, "seed": seed, "points": curve.points[::4]}


def draw(runs: list[dict[str, Any]]) -> Figure:
    """The return over training, a line for each run."""
    figure = Figure(figsize=(6.5, 3.6), layout="constrained")
    axis = figure.subplots()
    seen: set[str] = set()
    for run in runs:
        label = run["algorithm"]
        returns = [
            sum(value for name, value in point.items() if name != "timesteps")
            for point in run["points"]
        ]
        steps = [point["timesteps"] for point in run["points"]]
        axis.plot(steps, returns, color=COLOURS[label], label=None if label in seen else label)
        seen.add(label)
    axis.set_yscale("log")
    axis.set_xlabel("env steps")
    axis.set_ylabel("return of an episode")
    axis.legend(frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def main() -> None:
    """Train all, write their curves after each run, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--timesteps", type=int, default=300_000)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--picture", type=Path, default=PICTURE)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    runs: list[dict[str, Any]] = []
    for seed in range(arguments.seeds):
        for label in ALGORITHMS:
            runs.append(train(label, seed, arguments.timesteps))
            last = {name: round(value, 1) for name, value in runs[-1]["points"][-1].items()}
            print(label, "seed", seed, last, flush=True)
            arguments.data.parent.mkdir(parents=True, exist_ok=True)
            arguments.data.write_text(json.dumps({"env": ENV, "hidden": HIDDEN, "runs": runs}))
            draw(runs).savefig(arguments.picture, dpi=150)


if __name__ == "__main__":
    main()
