"""Reach: an arm brings its hand to a pose, and to another one every four seconds.

Terms, weights, ranges, control rate and time limit are those of the paper's tasks for the Franka
and the UR10; docs/tasks.md lists what differs.
"""

from __future__ import annotations

from importlib.resources import files
from typing import ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_gcr.envs.task import Array, Rows, Task, unbounded
from sb3_gcr.envs.tasks.geometry import angle_between, from_euler
from sb3_gcr.rewards.spec import RewardSpec

#: Physics steps of 1/120 s per control step: 30 Hz control.
N_SUBSTEPS = 4
#: Duration of a control step [s].
DT = 1 / 30
#: Control steps for which a goal stays, 4 s, and goals of an episode.
GOAL_STEPS, N_GOALS = 120, 3
#: An action of 1 moves a joint's target by this much from the default pose [rad]; actions go as far
#: as half a turn.
ACTION_SCALE, ACTION_BOUND = 0.5, 2 * np.pi
#: Where the goals are: bounds of x, y, z [m] and of the turn about the vertical [rad].
GOAL_POSITION = np.array([(0.35, 0.65), (-0.2, 0.2), (0.15, 0.5)])
GOAL_YAW = (-3.14, 3.14)
#: Weights per second of the two costs that ``WeightCurriculum`` raises.
WEIGHTS = {"action_rate": -1e-4, "joint_vel": -1e-4}


def end_effector_position_tracking(distance: Array) -> Array:
    """-d / 150: 0.2 per second and metre.

    :param distance: d, from the hand to the goal [m]
    """
    return -0.2 * DT * distance


def end_effector_position_tracking_fine_grained(distance: Array) -> Array:
    """(1 - tanh(d / 0.1 m)) / 300: 0.1 per second at the goal.

    :param distance: d, from the hand to the goal [m]
    """
    return 0.1 * DT * (1 - np.tanh(distance / 0.1))


def end_effector_orientation_tracking(angle: Array) -> Array:
    """-φ / 300: 0.1 per second and radian.

    :param angle: φ, of the turn from the hand to the goal [rad]
    """
    return -0.1 * DT * angle


def action_rate(actions: Array, actions_before: Array, weight: float) -> Array:
    """Its weight times the change: w Σ (a_t - a_{t-1})² / 30.

    :param actions: shape (N, n_joints)
    :param actions_before: of the step before, shape (N, n_joints)
    :param weight: w, per second
    """
    return weight * DT * np.square(actions - actions_before).sum(1)


def joint_vel(velocities: Array, weight: float) -> Array:
    """Its weight times the speeds: w Σ q̇² / 30.

    :param velocities: of the joints [rad/s], shape (N, n_joints)
    :param weight: w, per second
    """
    return weight * DT * np.square(velocities).sum(1)


class ReachTask(Task):
    """An arm on a stand; five terms.

    The goals of an episode are drawn at its start; a longer one sees them again.
    """

    n_substeps = N_SUBSTEPS
    fields = ("qpos", "qvel", "ctrl", "xpos", "xquat", "mocap_pos", "mocap_quat")

    #: Model file.
    name: ClassVar[str]
    #: Pitch of the goals: the hand's axis points down [rad].
    goal_pitch: ClassVar[float]
    #: By how much the default joint positions are multiplied at the start.
    start_scale: ClassVar[tuple[float, float]]

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(files("sb3_gcr.envs") / "assets" / self.name))
        tracking = "end_effector_position_tracking"
        self.reward_spec = RewardSpec.from_dict(
            {
                tracking: "task",
                f"{tracking}_fine_grained": "task",
                "end_effector_orientation_tracking": "task",
                "action_rate": "regulariser",
                "joint_vel": "regulariser",
            }
        )
        #: Weights per second of the two costs; may be changed between two steps.
        self.weights = dict(WEIGHTS)
        n_joints = self.model.nu
        self.action_space = spaces.Box(-ACTION_BOUND, ACTION_BOUND, (n_joints,), np.float32)
        self.observation_space = unbounded(3 * n_joints + 7)
        self.memory = {
            "actions": (n_joints,),
            "actions_before": (n_joints,),
            "goals": (N_GOALS, 7),
            "time_step": (),
        }
        self._default = self.model.key("default").qpos
        self._hand = self.model.body("hand").id

    def start(self, rng: np.random.Generator) -> dict[str, ArrayLike]:
        """Near the default pose, at rest, with the goals of the episode."""
        scale = rng.uniform(*self.start_scale, self.model.nq)
        qpos = np.clip(scale * self._default, *self.model.jnt_range.T)
        low, high = GOAL_POSITION.T
        position = rng.uniform(low, high, (N_GOALS, 3))
        yaw = rng.uniform(*GOAL_YAW, N_GOALS)
        attitude = from_euler(np.zeros(N_GOALS), np.full(N_GOALS, self.goal_pitch), yaw)
        goals = np.concatenate([position, attitude], axis=1)
        return {
            "qpos": qpos,
            "goals": goals,
            "mocap_pos": goals[:1, :3],
            "mocap_quat": goals[:1, 3:],
        }

    def act(self, s: Rows, actions: Array) -> None:
        """Targets of the joints' PD controllers, around the default pose."""
        s.actions_before[:] = s.actions
        s.actions[:] = actions
        s.ctrl[:] = self._default + ACTION_SCALE * actions
        goal = current_goal(s.goals, s.time_step)
        s.mocap_pos[:, 0] = goal[:, :3]  # for the picture
        s.mocap_quat[:, 0] = goal[:, 3:]

    def measure(self, s: Rows) -> None:
        """Count the step."""
        s.time_step[:] += 1

    def rewards(self, s: Rows) -> list[Array]:
        """The five terms of the paper, for the goal that the step was made for."""
        goal = current_goal(s.goals, s.time_step - 1)
        distance = np.linalg.norm(s.xpos[:, self._hand] - goal[:, :3], axis=1)
        return [
            end_effector_position_tracking(distance),
            end_effector_position_tracking_fine_grained(distance),
            end_effector_orientation_tracking(angle_between(s.xquat[:, self._hand], goal[:, 3:])),
            action_rate(s.actions, s.actions_before, self.weights["action_rate"]),
            joint_vel(s.qvel, self.weights["joint_vel"]),
        ]

    def terminated(self, s: Rows) -> NDArray[np.bool_]:
        """Never."""
        return np.zeros(len(s.qpos), dtype=bool)

    def observe(self, s: Rows) -> Array:
        """Joint positions from the default pose and velocities, goal (position, quaternion), last
        action.
        """
        goal = current_goal(s.goals, s.time_step)
        return np.concatenate(
            [s.qpos - self._default, s.qvel, goal, s.actions], axis=1, dtype=np.float32
        )


def current_goal(goals: Array, time_step: Array) -> Array:
    """The goal of a step: position [m] and quaternion w, x, y, z, shape (N, 7).

    :param goals: of the episode, shape (N, 3, 7)
    :param time_step: control steps since the start, shape (N,)
    """
    index = (time_step // GOAL_STEPS).astype(int) % N_GOALS
    return goals[np.arange(len(goals)), index]


class ReachFranka(ReachTask):
    """A Franka Panda, 7 joints, whose hand's z axis is to point down."""

    name = "franka.xml"
    goal_pitch = np.pi
    start_scale = (0.5, 1.5)


class ReachUR10(ReachTask):
    """A UR10, 6 joints, whose hand's x axis is to point down."""

    name = "ur10.xml"
    goal_pitch = np.pi / 2
    start_scale = (0.75, 1.25)
