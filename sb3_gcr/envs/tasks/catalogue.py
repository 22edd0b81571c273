"""The list of tasks."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_gcr.envs.task import Task

#: Where each task is, and its time limit in control steps.
TASKS: dict[str, tuple[str, int]] = {
    "HumanoidRun": ("sb3_gcr.envs.tasks.humanoid", 900),
    "HumanoidMO": ("sb3_gcr.envs.tasks.humanoid", 900),
    "ThrowingMO": ("sb3_gcr.envs.tasks.throwing", 100),
    "Quadcopter": ("sb3_gcr.envs.tasks.quadcopter", 500),
    "ReachFranka": ("sb3_gcr.envs.tasks.reach", 360),
    "ReachUR10": ("sb3_gcr.envs.tasks.reach", 360),
    "LocoManipG1": ("sb3_gcr.envs.tasks.locomanip", 700),
    "Hopper": ("sb3_gcr.envs.tasks.planar", 1000),
    "Walker2d": ("sb3_gcr.envs.tasks.planar", 1000),
    "HalfCheetah": ("sb3_gcr.envs.tasks.planar", 1000),
    "Swimmer": ("sb3_gcr.envs.tasks.planar", 1000),
    "HopperMO": ("sb3_gcr.envs.tasks.planar_mo", 1000),
    "Walker2dMO": ("sb3_gcr.envs.tasks.planar_mo", 1000),
    "HalfCheetahMO": ("sb3_gcr.envs.tasks.planar_mo", 1000),
}


def make_task(name: str, **kwargs: Any) -> Task:
    """Build a task.

    :param name: a key of ``TASKS``
    :param kwargs: arguments of the task
    :raises ValueError: for an unknown name
    """
    if name not in TASKS:
        raise ValueError(f"Parameter `task` must be one of {list(TASKS)}, found {name!r}.")
    task: Task = getattr(import_module(TASKS[name][0]), name)(**kwargs)
    return task
