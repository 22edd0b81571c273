"""What a user of the package writes; mypy's strict mode accepts it. It is checked, not run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gcr import (
    GCRPPO,
    RESOLVERS,
    MlpPolicy,
    RewardDecomposition,
    RewardSpec,
    evaluate_components,
    latest_checkpoint,
)


class Robot(GCRPPO):
    """A subclass keeps its type through `learn`, `load` and `warm_start`."""

    def greet(self) -> str:
        return f"{self.n_components} components: {', '.join(self.reward_spec.names)}"


class StopWhenTired(BaseCallback):
    def _on_step(self) -> bool:
        assert isinstance(self.model, GCRPPO)
        return self.model.num_timesteps < 1000


def halve_regularisers(
    gramian: NDArray[np.float64],
    levels: NDArray[np.integer[Any]],
    rng: np.random.Generator,
    factor: float = 0.5,
) -> NDArray[np.float64]:
    return np.where(levels > 0, factor, 1.0)


def make_env(n_envs: int = 2) -> VecEnv:
    env = make_vec_env("HalfCheetah-v5", n_envs=n_envs, wrapper_class=RewardDecomposition)
    return VecNormalize(env)


def train(folder: Path, schedule: Callable[[float], float]) -> Robot:
    checkpoint: Path | None = latest_checkpoint(folder)
    model = Robot(
        MlpPolicy,
        make_env(),
        schedule,
        resolver=halve_regularisers,
        resolver_kwargs={"factor": 0.1},
    )
    if checkpoint is not None:
        model = Robot.load(checkpoint, env=make_env())
    model = model.learn(2000, callback=[StopWhenTired(), CheckpointCallback(100, str(folder))])
    model.save(folder / "model")
    return model


def finish(folder: Path) -> dict[str, int]:
    spec = RewardSpec.from_dict({"run": "task", "effort": "regulariser", "noise": 2})
    safe = GCRPPO.load(
        str(folder / "model"), env=make_env(), device="cpu", weights_only=True, resolver="sum"
    )
    model = Robot.warm_start(folder / "model", make_env(), ent_coef=0.01)
    report: str | None = model.warm_start_report
    greeting: str = model.greet()
    evaluate_components(safe, make_env(), n_eval_episodes=2)
    assert report is not None
    assert greeting
    assert "gcr" in RESOLVERS
    return spec.to_dict()
