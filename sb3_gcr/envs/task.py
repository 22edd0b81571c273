"""What a task is: a robot, what it observes, the terms of its reward, when it fails, and where it
starts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_gcr.rewards.spec import RewardSpec

Array = NDArray[Any]


class Rows:
    """The arrays of N simulations by name, one row per simulation: MuJoCo's fields and what the
    task remembers.

    :param arrays: arrays of shape (N, …)
    """

    def __init__(self, arrays: Mapping[str, Array]):
        self.__dict__.update(arrays)

    def __getattr__(self, name: str) -> Array:
        raise AttributeError(
            f"No array `{name}`: name it in the task's `fields` or `memory`, found "
            f"{sorted(self.__dict__)}."
        )

    def take(self, ids: Array) -> Rows:
        """Copies of some rows.

        :param ids: indices of simulations, shape (n,)
        """
        return Rows({name: array[ids] for name, array in self.__dict__.items()})


class Task(ABC):
    """One task for one robot, written on batched arrays; it knows neither threads nor SB3.

    Each control step the engine calls :meth:`act`, advances the physics by ``n_substeps``, and
    calls :meth:`measure`,
    :meth:`rewards`, :meth:`terminated` and :meth:`observe`.
    """

    #: The robot; its root is the first body, and its camera "track" follows it.
    model: mujoco.MjModel
    #: Physics steps per control step.
    n_substeps: int
    #: Names and levels of the K terms.
    reward_spec: RewardSpec
    observation_space: spaces.Box
    action_space: spaces.Box
    #: MjData fields that the task reads or writes; those that are no state are one physics step
    #: old.
    fields: tuple[str, ...] = ("qpos", "qvel", "ctrl")
    #: Shapes of the arrays per simulation that the task keeps between steps; zero at the start of
    #: an episode.
    memory: dict[str, tuple[int, ...]]

    @property
    def dt(self) -> float:
        """Duration of a control step [s]."""
        return float(self.model.opt.timestep * self.n_substeps)

    @abstractmethod
    def start(self, rng: np.random.Generator) -> dict[str, ArrayLike]:
        """Draw the start of one episode: values by field or memory name; what is not named keeps
        the model's default.

        :param rng: the generator of that simulation
        """

    @abstractmethod
    def act(self, s: Rows, actions: Array) -> None:
        """Write the controls, and remember what the terms need from before the step.

        :param s: all simulations
        :param actions: shape (N, n_actions), inside the action space
        """

    def measure(self, s: Rows) -> None:  # noqa: B027 a task without events has nothing to measure
        """Bring the memory up to date after the physics.

        :param s: all simulations
        """

    @abstractmethod
    def rewards(self, s: Rows) -> Sequence[Array]:
        """The K terms of the reward, each of shape (N,), in the order of ``reward_spec``.

        :param s: all simulations
        """

    @abstractmethod
    def terminated(self, s: Rows) -> NDArray[np.bool_]:
        """Whether the task has failed, or is done, shape (N,).

        :param s: all simulations
        """

    @abstractmethod
    def observe(self, s: Rows) -> Array:
        """The observations, shape (n, n_observations).

        :param s: some simulations
        """


def unbounded(size: int, dtype: type[np.floating[Any]] = np.float32) -> spaces.Box:
    """A space of ``size`` numbers without bounds.

    :param size: how many
    :param dtype: float32 or float64
    """
    return spaces.Box(-np.inf, np.inf, (size,), dtype)
