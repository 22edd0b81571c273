"""Simulators made by others, as VecEnvs of Stable-Baselines3 with reward components."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_VEC_ENVS = {
    "EnvPoolVecEnv": "sb3_gcr.simulators.envpool",
    "ManagerVecEnv": "sb3_gcr.simulators.managers",
}


def __getattr__(name: str) -> Any:
    """Import a VecEnv only when it is asked for."""
    if name not in _VEC_ENVS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_VEC_ENVS[name]), name)
