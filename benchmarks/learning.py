"""Rows of a whole iteration: ``learn()`` on Humanoid-v5, env steps per second."""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from benchmarks.measuring import Case, Contestant, timed
from benchmarks.rollouts import SEED
from sb3_gcr import GCRPPO, RewardDecomposition

ENV_ID = "Humanoid-v5"
N_ENVS, N_STEPS = 8, 256


def learning(
    label: str, algorithm: Any, wrapper: type[gym.Wrapper[Any, Any, Any, Any]] | None = None
) -> Contestant:
    """Rollout and update of SB3's default sizes, envs stepped one after the other by a
    ``DummyVecEnv``.
    """
    env = make_vec_env(ENV_ID, N_ENVS, seed=SEED, wrapper_class=wrapper)
    model = algorithm("MlpPolicy", env, n_steps=N_STEPS, seed=SEED, device="cpu")
    model.set_logger(configure(None, []))
    steps = N_ENVS * N_STEPS
    run = partial(model.learn, steps, reset_num_timesteps=False)
    return Contestant(label, timed(run, calls=steps))


def sbx_learning() -> Contestant:
    """The same with ``sbx.PPO``, which is imported when it is needed, because it is optional."""
    return learning("sbx.PPO", importlib.import_module("sbx").PPO)


def cases() -> list[Case]:
    """All rows of this group."""
    ppo = partial(learning, "PPO", PPO)
    gcrppo = partial(learning, "GCRPPO K=4", GCRPPO, RewardDecomposition)
    setting = f"{ENV_ID}, {N_ENVS} envs"
    return [
        Case("learn", setting, gcrppo, ppo, unit="steps/s"),
        Case("learn", setting, sbx_learning, ppo, unit="steps/s", needs=("sbx",)),
        Case("learn", setting, gcrppo, sbx_learning, unit="steps/s", needs=("sbx",)),
    ]
