"""Planar-MO: Gymnasium's Walker2d, Hopper and HalfCheetah that, if wanted, keep power, height, lean
and knees in chosen ranges.

Physics, observation, base terms, start and fall are those of :mod:`sb3_gcr.envs.tasks.planar`.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sb3_gcr.envs.task import Array, Rows
from sb3_gcr.envs.tasks.geometry import wrap
from sb3_gcr.envs.tasks.planar import HalfCheetah, Hopper, PlanarTask, Walker2d
from sb3_gcr.envs.tasks.ranges import choose_ranges, inside
from sb3_gcr.rewards.spec import RewardSpec

#: What an objective pays for a step inside its range.
PAY = 2.0
#: Ranges by objective, lower bound included, upper bound excluded. Power [W], height of the torso
#: [m], lean of the torso, forward is positive [rad], and angle of the knees [rad].
Ranges = dict[str, tuple[tuple[float, float], ...]]
#: Falls at 0.8 m and at ±1 rad. A knee is straight at 0 and bends to -2.6 rad.
WALKER_RANGES: Ranges = {
    "energy": ((0, 20), (20, 60), (60, 150), (150, 300), (300, 600)),
    "baseh": ((0.80, 0.95), (0.95, 1.05), (1.05, 1.15), (1.15, 1.25), (1.25, 1.40)),
    "lean": ((-0.8, -0.4), (-0.4, -0.15), (-0.15, 0.15), (0.15, 0.4), (0.4, 0.8)),
    "knee": ((-2.5, -1.6), (-1.6, -1.2), (-1.2, -0.8), (-0.8, -0.4), (-0.4, 0.0)),
}
#: Falls at 0.7 m and at ±0.2 rad. Its knee is like the walker's.
HOPPER_RANGES: Ranges = {
    "energy": ((0, 10), (10, 40), (40, 120), (120, 300), (300, 800)),
    "baseh": ((0.70, 0.85), (0.85, 1.00), (1.00, 1.15), (1.15, 1.30), (1.30, 1.45)),
    "lean": ((-0.20, -0.12), (-0.12, -0.04), (-0.04, 0.04), (0.04, 0.12), (0.12, 0.20)),
    "knee": ((-1.6, -1.2), (-1.2, -0.8), (-0.8, -0.5), (-0.5, -0.2), (-0.2, 0.0)),
}
#: Never falls; stands at 0.57 m. Springs hold its knees (the shins' joints) near 0.
CHEETAH_RANGES: Ranges = {
    "energy": ((0, 50), (50, 200), (200, 600), (600, 1500), (1500, 4000)),
    "baseh": ((0.15, 0.30), (0.30, 0.45), (0.45, 0.60), (0.60, 0.75), (0.75, 0.95)),
    "lean": ((-0.6, -0.3), (-0.3, -0.1), (-0.1, 0.1), (0.1, 0.3), (0.3, 0.6)),
    "knee": ((-0.7, -0.4), (-0.4, -0.15), (-0.15, 0.15), (0.15, 0.4), (0.4, 0.7)),
}


def energy_range(power: Array, bounds: tuple[float, float]) -> Array:
    """2 while the mechanical power is in range.

    :param power: Σ abs(τ q̇) over the motors [W], shape (N,)
    :param bounds: lower one included, upper one excluded [W]
    """
    return PAY * inside(power, bounds)


def baseh_range(height: Array, bounds: tuple[float, float]) -> Array:
    """2 while the torso's height is in range.

    :param height: of the torso's origin [m], shape (N,)
    :param bounds: lower one included, upper one excluded [m]
    """
    return PAY * inside(height, bounds)


def lean_range(lean: Array, bounds: tuple[float, float]) -> Array:
    """2 while the torso's lean is in range.

    :param lean: rotation of the torso, forward is positive [rad], shape (N,)
    :param bounds: lower one included, upper one excluded [rad]
    """
    return PAY * inside(lean, bounds)


def knee_range(angles: Array, bounds: tuple[float, float]) -> Array:
    """2 times the share of the knees in range.

    :param angles: of the knees [rad], shape (N, n_knees)
    :param bounds: lower one included, upper one excluded [rad]
    """
    return PAY * inside(angles, bounds).mean(1)


class PlanarMO(PlanarTask):
    """A planar robot with up to four objectives that pay inside a range; None leaves an objective
    out.

    All base terms stay, ``reward_ctrl`` beside ``energy`` too. The observation is not extended: it
    has height, lean, joint angles and velocities, and the policy's own actions are the torques.

    :param energy: index of the range of the mechanical power, 0 to 4
    :param baseh: index of the range of the torso's height
    :param lean: index of the range of the torso's lean
    :param knee: index of the range of the knees' angle
    :raises ValueError: for an index that is not there
    """

    #: All ranges by objective.
    all_ranges: ClassVar[Ranges]
    #: Joints that are knees.
    knees: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        energy: int | None = None,
        baseh: int | None = None,
        lean: int | None = None,
        knee: int | None = None,
    ) -> None:
        super().__init__()
        chosen = {"energy": energy, "baseh": baseh, "lean": lean, "knee": knee}
        self.ranges = choose_ranges(self.all_ranges, chosen)
        objectives = dict.fromkeys([f"{name}_range" for name in self.ranges], "task")
        self.reward_spec = RewardSpec.from_dict({**dict(self.reward_spec), **objectives})
        motors = self.model.actuator_trnid[:, 0]
        self._motor_dofs = self.model.jnt_dofadr[motors]
        self._gear = self.model.actuator_gear[:, 0]
        self._knees = [int(self.model.joint(name).qposadr[0]) for name in self.knees]
        # Height of the torso where the joint that lifts it is at 0.
        self._height_at_zero = self.model.body("torso").pos[2] - self.model.qpos0[1]

    def rewards(self, s: Rows) -> list[Array]:
        """The base terms, then the chosen objectives."""
        objectives = {
            "energy": lambda bounds: energy_range(self.power(s), bounds),
            "baseh": lambda bounds: baseh_range(self.height(s), bounds),
            "lean": lambda bounds: lean_range(self.lean(s), bounds),
            "knee": lambda bounds: knee_range(s.qpos[:, self._knees], bounds),
        }
        paid = [objectives[name](bounds) for name, bounds in self.ranges.items()]
        return super().rewards(s) + paid

    def power(self, s: Rows) -> Array:
        """Mechanical power of the motors at the end of the step, Σ abs(τ q̇) [W], shape (N,)."""
        return np.abs(self._gear * s.ctrl * s.qvel[:, self._motor_dofs]).sum(1)

    def height(self, s: Rows) -> Array:
        """Of the torso's origin above the ground [m], shape (N,)."""
        return self._height_at_zero + s.qpos[:, 1]

    def lean(self, s: Rows) -> Array:
        """Of the torso, forward is positive [rad], shape (N,)."""
        return s.qpos[:, 2]


class Walker2dMO(PlanarMO, Walker2d):
    """Walker2d-v5 with objectives."""

    all_ranges = WALKER_RANGES
    knees = ("leg_joint", "leg_left_joint")


class HopperMO(PlanarMO, Hopper):
    """Hopper-v5 with objectives."""

    all_ranges = HOPPER_RANGES
    knees = ("leg_joint",)


class HalfCheetahMO(PlanarMO, HalfCheetah):
    """HalfCheetah-v5 with objectives."""

    all_ranges = CHEETAH_RANGES
    knees = ("bshin", "fshin")

    def lean(self, s: Rows) -> Array:
        """Of the torso, nose down is positive, between -π and π after any number of somersaults
        [rad], shape (N,).
        """
        return wrap(super().lean(s))
