"""Callbacks that make a task harder as the robot learns: a target further away, dearer costs."""

from __future__ import annotations

from collections import deque

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_gcr.rewards.layers import env_attributes


class WeightCurriculum(BaseCallback):
    """Raises the two costs of ReachFranka or ReachUR10, action_rate and joint_vel, once, after a
    number of steps.

    The weights are logged as ``curriculum/action_rate`` and ``curriculum/joint_vel``. The defaults
    are those of the authors' code.

    :param start: steps of each env after which the weights change
    :param action_rate: weight from then on, per second
    :param joint_vel: weight from then on, per second
    :param verbose: as in SB3
    """

    def __init__(
        self,
        start: int = 4500,
        action_rate: float = -0.005,
        joint_vel: float = -0.001,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if not start >= 0:
            raise ValueError(f"Parameter `start` must not be negative, found {start!r}.")
        self.start = start
        self.weights = {"action_rate": action_rate, "joint_vel": joint_vel}
        self.has_started = False

    def _on_training_start(self) -> None:
        tasks = self.training_env.get_attr("task") if self.training_env.has_attr("task") else [None]
        if not hasattr(tasks[0], "weights"):
            raise ValueError(
                "WeightCurriculum needs the env 'sb3_gcr/ReachFranka-v0' or "
                "'sb3_gcr/ReachUR10-v0', found one without weights."
            )

    def _on_step(self) -> bool:
        is_due = self.num_timesteps >= self.start * self.training_env.num_envs
        if is_due and not self.has_started:
            self.has_started = True
            for task in self.training_env.get_attr("task"):
                task.weights.update(self.weights)
        return True

    def _on_rollout_end(self) -> None:
        for name, weight in self.training_env.get_attr("task")[0].weights.items():
            self.logger.record(f"curriculum/{name}", weight)


class DistanceCurriculum(BaseCallback):
    """Raises ThrowingMO's ``max_distance`` after each rollout, once the robot throws and stands.

    It starts, for good, when the mean returns of the last 100 episodes exceed both thresholds. The
    distance is logged as ``curriculum/max_distance``.

    :param increment: by how much it raises the distance [m]
    :param limit: largest distance [m]
    :param throwing: threshold of the return of ``throwing``, at most 4.1
    :param stability: threshold of the return of ``stability``, at most 0.5
    :param verbose: as in SB3
    """

    def __init__(
        self,
        increment: float = 0.01,
        limit: float = 5.0,
        throwing: float = 1.0,
        stability: float = 0.44,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if not 1 <= limit <= 5:
            raise ValueError(f"Parameter `limit` must be between 1 and 5 m, found {limit!r}.")
        if not increment > 0:
            raise ValueError(f"Parameter `increment` must be above 0, found {increment!r}.")
        self.increment, self.limit = increment, limit
        self.thresholds = np.array([throwing, stability])
        self.has_started = False
        self._returns: deque[tuple[float, float]] = deque(maxlen=100)

    def _on_training_start(self) -> None:
        tasks = env_attributes(self.training_env, "task")
        can_move = env_attributes(self.training_env, "set_task")
        if not tasks or not hasattr(tasks[0], "max_distance") or not can_move:
            raise ValueError(
                "DistanceCurriculum needs the env 'sb3_gcr/ThrowingMO-v0', found one without "
                "targets."
            )

    def _on_step(self) -> bool:
        for index in np.flatnonzero(self.locals["dones"]):
            info = self.locals["infos"][index]
            self._returns.append((info["r_throwing"], info["r_stability"]))
        return True

    def _on_rollout_end(self) -> None:
        max_distance = self._max_distance()
        if self._returns and not self.has_started:
            self.has_started = bool((np.mean(self._returns, axis=0) > self.thresholds).all())
        if self.has_started:
            distance = min(self.limit, max_distance + self.increment)
            # `get_attr` gives copies where the envs are in other processes.
            self.training_env.env_method("set_task", max_distance=distance)
            max_distance = self._max_distance()
        self.logger.record("curriculum/max_distance", max_distance)

    def _max_distance(self) -> float:
        """That of the first env, as it is there."""
        distance: float = self.training_env.get_attr("task", indices=[0])[0].max_distance
        return distance
