"""Gymnasium's Hopper, Walker2d, HalfCheetah and Swimmer v5, number for number, on many
simulations.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_gcr.envs.task import Array, Rows, Task, unbounded
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS
from sb3_gcr.rewards.spec import RewardSpec

ASSETS = Path(gymnasium.__file__).parent / "envs/mujoco/assets"


def reward_forward(x: Array, x_before: Array, dt: float) -> Array:
    """Speed along x [m/s].

    :param x: position after the step [m]
    :param x_before: position before the step [m]
    :param dt: control step [s]
    """
    return (x - x_before) / dt


def reward_ctrl(actions: Array, weight: float) -> Array:
    """Minus the weighted sum of the squared actions; in float32, as the actions are.

    :param actions: shape (N, n_actions)
    :param weight: of the cost
    """
    return -(weight * np.square(actions).sum(1))


class PlanarTask(Task):
    """A robot of Gymnasium that moves along x."""

    #: Gymnasium's env, which names the terms.
    env_id: ClassVar[str]
    #: Model file, physics steps per control step, and weight of the control cost.
    name: ClassVar[str]
    n_substeps: int
    ctrl_cost_weight: ClassVar[float]
    #: Largest noise of the first positions and velocities.
    noise: ClassVar[float]
    #: How many of the first positions are not observed.
    n_hidden: ClassVar[int] = 1

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(ASSETS / self.name))
        self.reward_spec = RewardSpec.from_dict(GYMNASIUM_ENVS[self.env_id]["components"])
        low, high = self.model.actuator_ctrlrange.astype(np.float32).T
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        self.observation_space = unbounded(
            self.model.nq - self.n_hidden + self.model.nv, np.float64
        )
        self.memory = {"x_before": ()}

    def start(self, rng: np.random.Generator) -> dict[str, ArrayLike]:
        """Noise around the model's pose, from the same draws as in Gymnasium."""
        return {
            "qpos": self.model.qpos0 + rng.uniform(-self.noise, self.noise, self.model.nq),
            "qvel": rng.uniform(-self.noise, self.noise, self.model.nv),
        }

    def act(self, s: Rows, actions: Array) -> None:
        """Torques are the actions."""
        s.x_before[:] = s.qpos[:, 0]
        s.ctrl[:] = actions

    def rewards(self, s: Rows) -> list[Array]:
        """Speed minus the cost of the actions."""
        return [
            reward_forward(s.qpos[:, 0], s.x_before, self.dt),
            reward_ctrl(s.ctrl.astype(np.float32), self.ctrl_cost_weight),
        ]

    def terminated(self, s: Rows) -> NDArray[np.bool_]:
        """Never."""
        return np.zeros(len(s.qpos), dtype=bool)

    def observe(self, s: Rows) -> Array:
        """Positions but the first ones, and velocities."""
        return np.concatenate([s.qpos[:, self.n_hidden :], s.qvel], axis=1)


class HalfCheetah(PlanarTask):
    """HalfCheetah-v5: run, with small actions."""

    env_id = "HalfCheetah-v5"
    name, n_substeps, ctrl_cost_weight, noise = "half_cheetah.xml", 5, 0.1, 0.1

    def start(self, rng: np.random.Generator) -> dict[str, ArrayLike]:
        """Uniform positions, normal velocities."""
        return {
            "qpos": self.model.qpos0 + rng.uniform(-self.noise, self.noise, self.model.nq),
            "qvel": self.noise * rng.standard_normal(self.model.nv),
        }


class Swimmer(PlanarTask):
    """Swimmer-v5: swim, with small actions."""

    env_id = "Swimmer-v5"
    name, n_substeps, ctrl_cost_weight, noise, n_hidden = "swimmer.xml", 4, 1e-4, 0.1, 2


class LeggedTask(PlanarTask):
    """A robot that may fall: it is paid for staying up, and its velocities are observed between
    ±10.
    """

    z_range: ClassVar[tuple[float, float]]
    angle_range: ClassVar[tuple[float, float]]
    ctrl_cost_weight = 1e-3
    n_substeps = 4
    noise = 5e-3

    def rewards(self, s: Rows) -> list[Array]:
        """Speed, 1 while healthy, cost of the actions."""
        forward, ctrl = super().rewards(s)
        return [forward, self._is_healthy(s).astype(np.float64), ctrl]

    def terminated(self, s: Rows) -> NDArray[np.bool_]:
        """Fallen."""
        return ~self._is_healthy(s)

    def observe(self, s: Rows) -> Array:
        """Positions but x, and clipped velocities."""
        return np.concatenate([s.qpos[:, 1:], np.clip(s.qvel, -10, 10)], axis=1)

    def _is_healthy(self, s: Rows) -> NDArray[np.bool_]:
        z, angle = s.qpos[:, 1], s.qpos[:, 2]
        upright = (self.z_range[0] < z) & (z < self.z_range[1])
        return upright & (self.angle_range[0] < angle) & (angle < self.angle_range[1])


class Walker2d(LeggedTask):
    """Walker2d-v5: walk without falling, with small actions."""

    env_id = "Walker2d-v5"
    name, z_range, angle_range = "walker2d_v5.xml", (0.8, 2.0), (-1.0, 1.0)


class Hopper(LeggedTask):
    """Hopper-v5: hop without falling, with small actions."""

    env_id = "Hopper-v5"
    name, z_range, angle_range = "hopper.xml", (0.7, np.inf), (-0.2, 0.2)

    def _is_healthy(self, s: Rows) -> NDArray[np.bool_]:
        state = np.concatenate([s.qpos[:, 2:], s.qvel], axis=1)
        return super()._is_healthy(s) & (np.abs(state) < 100).all(1)
