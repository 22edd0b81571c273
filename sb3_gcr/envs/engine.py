"""The engine: N simulations of a task on MuJoCo's thread pool; it knows no reward term."""

from __future__ import annotations

import os
import warnings
from typing import Any, NamedTuple

import mujoco
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from sb3_gcr.envs.task import Array, Rows, Task

try:
    from mujoco.batch import Batch, SimulationError
except ImportError as error:
    raise ImportError(
        "The envs of sb3_gcr need MuJoCo 4.0 or newer (Python 3.11 or newer), "
        f"found {mujoco.__version__}: pip install -U 'mujoco>=4'"
    ) from error

#: Warnings after which MuJoCo puts a simulation back to its defaults, or drops its controls.
_DIVERGED = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_{name}"))
    for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
]


def _usable_cpus() -> int:
    """CPUs that this process may use: fewer than the machine has, in a container or under
    taskset.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Step(NamedTuple):
    """What one control step of all simulations gave; the arrays are the caller's.

    :param observations: shape (N, …), those that the step ended in
    :param components: the terms of the reward, shape (N, K)
    :param terminated: shape (N,)
    :param truncated: whether the time is up, shape (N,)
    :param diverged: simulations that MuJoCo gave up, shape (N,); they are terminated, with the
        observation of the step before and no reward
    """

    observations: Array
    components: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    diverged: NDArray[np.bool_]


class Engine:
    """Steps N simulations of a task and keeps the statistics of their episodes; resets are left to
    the caller.

    Each simulation has its own generator, so that a run with the same seeds gives the same numbers
    at any N and any number of threads.

    :param task: the task
    :param n_simulations: N ≥ 1
    :param n_threads: threads that step them; None for all CPUs that this process may use
    :param max_episode_steps: control steps until truncation; None for no limit
    :raises ValueError: for a number that is not positive
    """

    def __init__(
        self,
        task: Task,
        n_simulations: int,
        n_threads: int | None = None,
        max_episode_steps: int | None = None,
    ):
        if n_simulations < 1:
            raise ValueError(
                f"Parameter `n_simulations` must be at least 1, found {n_simulations}."
            )
        if n_threads is not None and n_threads < 1:
            raise ValueError(
                "Parameter `n_threads` must be at least 1, or None for all CPUs, found "
                f"{n_threads}."
            )
        self.task = task
        self.max_episode_steps = max_episode_steps
        self.batch = Batch(
            task.model, n_simulations, min(n_threads or _usable_cpus(), n_simulations)
        )
        self.rows = Rows(
            {name: self.batch.bind(name) for name in {"qpos", "qvel", *task.fields}}
            | {name: np.zeros((n_simulations, *shape)) for name, shape in task.memory.items()}
        )
        self.generators = [seeding.np_random()[0] for _ in range(n_simulations)]
        self.returns = np.zeros((n_simulations, len(task.reward_spec)))
        self.lengths = np.zeros(n_simulations, dtype=int)
        #: Simulations that diverged so far.
        self.n_diverged = 0
        self._observations: Array = np.zeros(
            (n_simulations, *task.observation_space.shape), task.observation_space.dtype
        )

    def __len__(self) -> int:
        return self.batch.nsim

    def close(self) -> None:
        """End the threads."""
        self.__dict__.pop("batch", None)
        self.__dict__.pop("rows", None)

    def seed(self, index: int, seed: int | None) -> None:
        """Give a simulation a new generator, from Gymnasium's ``seeding``.

        :param index: which simulation
        :param seed: None for a random one
        """
        self.generators[index] = seeding.np_random(seed)[0]

    def reset(self, ids: Array) -> Array:
        """Start new episodes.

        :param ids: indices of the simulations, shape (n,)
        :return: their first observations, shape (n, …)
        """
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        for name in self.task.memory:
            getattr(self.rows, name)[ids] = 0
        for index in ids:
            for name, value in self.task.start(self.generators[index]).items():
                getattr(self.rows, name)[index] = value
        self.batch.forward(ids)
        self.returns[ids] = 0
        self.lengths[ids] = 0
        observations = self.task.observe(self.rows.take(ids))
        self._observations[ids] = observations
        return observations

    def step(self, actions: Array) -> Step:
        """Advance all simulations by one control step.

        :param actions: shape (N, n_actions)
        """
        self.task.act(self.rows, actions)
        diverged = self._advance()
        self.task.measure(self.rows)
        components = np.stack(self.task.rewards(self.rows), axis=1, dtype=np.float64)
        terminated = self.task.terminated(self.rows)
        observations = self.task.observe(self.rows)
        if diverged.any():
            components[diverged] = 0
            terminated = terminated | diverged
            observations[diverged] = self._observations[diverged]
            self.n_diverged += int(diverged.sum())
        self._observations[:] = observations
        self.returns += components
        self.lengths += 1
        over = self.lengths >= (self.max_episode_steps or np.inf)
        return Step(observations, components, terminated, over, diverged)

    def _advance(self) -> NDArray[np.bool_]:
        """Step the physics; which simulations diverged, shape (N,)."""
        failed: Any = []
        try:
            self.batch.step(nstep=self.task.n_substeps)
        except SimulationError as error:  # the others have been stepped
            if len(error.ids) == len(self):
                raise
            warnings.warn(f"{error} Their episodes end here.", stacklevel=3)
            failed = error.ids
        diverged = (self.batch.warning[:, _DIVERGED, 1] > 0).any(
            1
        )  # (last info, count since the reset)
        diverged |= ~np.isfinite(self.rows.qpos.sum(1) + self.rows.qvel.sum(1))
        diverged[failed] = True
        return diverged
