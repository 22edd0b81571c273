"""Tasks with a reward of named terms, one simulation at a time or hundreds of them on a thread
pool.

Read ``task`` (what a task is), then one of them (``humanoid``), ``engine`` (who steps it), and the
three ways to use it: ``single`` (a Gymnasium env), ``batched`` (a VecEnv of Stable-Baselines3) and
``vector`` (a vector env of Gymnasium).
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import gymnasium as gym

from sb3_gcr.envs.hiding import HideObservations
from sb3_gcr.envs.tasks.catalogue import TASKS
from sb3_gcr.simulators.envpool_gym import register_pools

__all__ = ["HideObservations", "register_envs"]

_VEC_ENVS = {"BatchedVecEnv": "sb3_gcr.envs.batched", "EnvPoolVecEnv": "sb3_gcr.simulators.envpool"}


def register_envs() -> None:
    """Make the tasks known to Gymnasium as ``sb3_gcr/<name>-v0``; importing sb3_gcr does it."""
    for name, (_, max_episode_steps) in TASKS.items():
        env_id = f"sb3_gcr/{name}-v0"
        if env_id in gym.registry:
            continue
        gym.register(
            id=env_id,
            entry_point="sb3_gcr.envs.single:TaskEnv",
            vector_entry_point="sb3_gcr.envs.vector:TaskVectorEnv",
            max_episode_steps=max_episode_steps,
            kwargs={"task": name},
        )


def __getattr__(name: str) -> Any:
    """Import what needs MuJoCo 4.0 or EnvPool only when it is asked for."""
    if name not in _VEC_ENVS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(_VEC_ENVS[name]), name)
    # MuJoCo, where the library behind MUJOCO_GL is missing; a name lookup would swallow it
    except AttributeError as error:
        raise ImportError(f"{name} could not be imported: {error}") from error


register_envs()
register_pools()
