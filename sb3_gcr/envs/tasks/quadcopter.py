"""Quadcopter: fly to a point and stay there, with a thrust and three torques.

Terms, weights, ranges, control rate, time limit and failure are those of the paper's task;
docs/tasks.md lists what differs.
"""

from __future__ import annotations

from importlib.resources import files

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_gcr.envs.task import Array, Rows, Task, unbounded
from sb3_gcr.envs.tasks.geometry import into_frame, projected_gravity
from sb3_gcr.rewards.spec import RewardSpec

#: Physics steps of 10 ms per control step: 50 Hz control.
N_SUBSTEPS = 2
#: Duration of a control step [s].
DT = 0.02
#: Largest thrust, in units of the weight, and largest torque about each axis [N m].
THRUST_TO_WEIGHT, LARGEST_TORQUE = 1.9, 0.01
#: Where the goal is drawn: as far as this from the start along x and y, and how high [m].
GOAL_XY, GOAL_Z = (-2.0, 2.0), (0.5, 1.5)
#: Heights between which it must stay [m].
LOWEST, HIGHEST = 0.1, 2.0


def lin_vel(velocity: Array) -> Array:
    """-0.001 s²/m² Σ v²: 0.05 per second.

    :param velocity: of the body [m/s], shape (N, 3)
    """
    return -0.05 * DT * np.square(velocity).sum(1)


def ang_vel(velocity: Array) -> Array:
    """-0.0002 s²/rad² Σ ω²: 0.01 per second.

    :param velocity: angular, of the body [rad/s], shape (N, 3)
    """
    return -0.01 * DT * np.square(velocity).sum(1)


def distance_to_goal(distance: Array) -> Array:
    """0.3 (1 - tanh(d / 0.8 m)): 15 per second at the goal.

    :param distance: d, to the goal [m]
    """
    return 15 * DT * (1 - np.tanh(distance / 0.8))


class Quadcopter(Task):
    """A quadcopter of 28 g flies to a point within 2 m and stays there; three terms."""

    n_substeps = N_SUBSTEPS
    fields = ("qpos", "qvel", "ctrl", "mocap_pos")

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(
            str(files("sb3_gcr.envs") / "assets/quadcopter.xml")
        )
        self.reward_spec = RewardSpec.from_dict(
            {"lin_vel": "regulariser", "ang_vel": "regulariser", "distance_to_goal": "task"}
        )
        self.action_space = spaces.Box(-1, 1, (4,), np.float32)
        self.observation_space = unbounded(12)
        self.memory = {"goal": (3,)}
        weight = self.model.body("quadcopter").mass[0] * -self.model.opt.gravity[2]
        self._largest_thrust = THRUST_TO_WEIGHT * weight

    def start(self, rng: np.random.Generator) -> dict[str, ArrayLike]:
        """At rest, half a metre above the ground, with a goal."""
        goal = np.append(rng.uniform(*GOAL_XY, 2), rng.uniform(*GOAL_Z))
        return {"goal": goal, "mocap_pos": goal[None]}

    def act(self, s: Rows, actions: Array) -> None:
        """The first action is the thrust, from none at -1 to the largest at 1; the others are the
        torques.
        """
        s.ctrl[:, 0] = self._largest_thrust * (actions[:, 0] + 1) / 2
        s.ctrl[:, 1:] = LARGEST_TORQUE * actions[:, 1:]

    def rewards(self, s: Rows) -> list[Array]:
        """The three terms of the paper."""
        return [
            lin_vel(s.qvel[:, :3]),
            ang_vel(s.qvel[:, 3:]),
            distance_to_goal(np.linalg.norm(s.goal - s.qpos[:, :3], axis=1)),
        ]

    def terminated(self, s: Rows) -> NDArray[np.bool_]:
        """Below 0.1 m or above 2 m."""
        height = s.qpos[:, 2]
        return (height < LOWEST) | (height > HIGHEST)

    def observe(self, s: Rows) -> Array:
        """Velocity, angular velocity, direction of gravity and goal, in the body's frame."""
        quaternion = s.qpos[:, 3:7]
        return np.concatenate(
            [
                into_frame(quaternion, s.qvel[:, :3]),
                s.qvel[:, 3:],
                projected_gravity(quaternion),
                into_frame(quaternion, s.goal - s.qpos[:, :3]),
            ],
            axis=1,
            dtype=np.float32,
        )
