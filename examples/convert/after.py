"""After: GCRPPO on the env of ``before.py``, with its six terms by name."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_gcr import GCRPPO, RewardDecomposition, evaluate_components

DT = 0.1  # s, of one step
Vector = NDArray[np.float32]
LEVELS = {
    "progress": "task",
    "arrival": "task",
    "clearance": "task",
    "effort": "regulariser",
    "spin": "regulariser",
    "smoothness": "regulariser",
}


class Rover(gym.Env[Vector, Vector]):
    """A rover with two wheels drives to the origin, around a rock at (1, 0)."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (6,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Put it 2 to 3 m away, facing anywhere."""
        super().reset(seed=seed)
        angle, self.heading = self.np_random.uniform(-np.pi, np.pi, 2)
        away = self.np_random.uniform(2, 3)
        self.position = away * np.array([np.cos(angle), np.sin(angle)])
        self.last_action = np.zeros(2, np.float32)
        self.time = 0.0
        return self.observe(), {}

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Drive for 0.1 s with action[0] m/s and action[1] * 2 rad/s."""
        distance = float(np.linalg.norm(self.position))
        forward = np.array([np.cos(self.heading), np.sin(self.heading)])
        self.position = self.position + DT * action[0] * forward
        self.heading += DT * 2 * action[1]
        self.time += DT
        new_distance = float(np.linalg.norm(self.position))
        to_rock = float(np.linalg.norm(self.position - [1, 0]))
        has_arrived = new_distance < 0.2

        terms = {
            "progress": 5 * (distance - new_distance),
            "arrival": 10.0 * has_arrived,
            "clearance": -max(0.0, 0.5 - to_rock),
            "effort": -0.02 * action[0] ** 2,
            "spin": -0.02 * action[1] ** 2,
            "smoothness": -0.05 * np.sum((action - self.last_action) ** 2),
        }
        reward = sum(terms.values())

        self.last_action = action
        return self.observe(), float(reward), has_arrived, self.time > 15, {"terms": terms}

    def observe(self) -> Vector:
        """Goal and rock as the rover sees them, and its last action."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        rotation = np.array([[cos, sin], [-sin, cos]])
        goal = rotation @ -self.position
        rock = rotation @ ([1, 0] - self.position)
        return np.concatenate([goal, rock, self.last_action]).astype(np.float32)


def rover() -> gym.Env[Vector, Vector]:
    """The env with its terms named."""
    return RewardDecomposition(Rover(), LEVELS, under="terms")


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, keep the best, save, load, evaluate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--timesteps", type=int, default=100_000)
    parser.add_argument("--n-envs", type=int, default=4)
    parser.add_argument("--folder", type=Path, default=Path("logs/after"))
    given = parser.parse_args(arguments)

    env = VecNormalize(make_vec_env(rover, given.n_envs, seed=0, vec_env_cls=SubprocVecEnv))
    eval_env = VecNormalize(make_vec_env(rover, 1, seed=1), training=False, norm_reward=False)
    callback = EvalCallback(
        eval_env, best_model_save_path=str(given.folder), eval_freq=2000, verbose=0
    )
    model = GCRPPO("MlpPolicy", env, n_steps=256, ent_coef=0.001, seed=0, device="cpu")
    model.learn(given.timesteps, callback=callback)
    model.save(given.folder / "model")
    env.close()

    loaded_env = VecNormalize(make_vec_env(rover, 1, seed=2))
    model = GCRPPO.load(given.folder / "model", env=loaded_env, device="cpu")
    loaded_env.training = False
    mean, std, terms, _ = evaluate_components(model, loaded_env, 10)  # type: ignore[misc]
    print(f"return {mean:.2f} ± {std:.2f}")
    print(terms)


if __name__ == "__main__":
    main()
