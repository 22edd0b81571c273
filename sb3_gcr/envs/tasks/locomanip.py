"""LocoManip: a Unitree G1 walks at a commanded velocity while both hands follow poses.

The 26 terms are those of the paper's task for the Digit, with its weights; docs/tasks.md lists what
differs on the G1.
"""

from __future__ import annotations

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

import sb3_gcr.envs.tasks.locomanip_terms as terms
from sb3_gcr.envs.task import Array, Rows, Task, unbounded
from sb3_gcr.envs.tasks.geometry import (
    angle_between,
    compose,
    from_euler,
    into_frame,
    into_world,
    projected_gravity,
    wrap,
    yaw_and_roll,
)
from sb3_gcr.envs.tasks.locomanip_model import (
    ARM,
    GOAL_JOINTS,
    LEG,
    MIRRORED,
    SIDES,
    locomanip_model,
)
from sb3_gcr.rewards.spec import RewardSpec

#: Physics steps of 5 ms per control step: 50 Hz control.
N_SUBSTEPS = 4
#: Duration of a control step [s].
DT = 0.02
#: An action of 1 moves a joint's target by this much from the default pose [rad]; actions go from
#: -5 to 5.
ACTION_SCALE, ACTION_BOUND = 0.5, 5.0
#: Height of the pelvis at the start, soles on the ground [m].
START_HEIGHT = 0.718
#: Tilt from which on the robot has fallen [rad].
FALLEN_TILT = 0.7
#: Bounds of the commanded velocity forward and to the left [m/s], and of the turn [rad/s].
VELOCITIES = np.array([(-0.8, 0.8), (-0.5, 0.5)])
LARGEST_TURN = 1.0
#: The turn is this many times the angle to the commanded heading [1/s].
HEADING_STIFFNESS = 0.5
#: Share of the commands that say: stand still.
STANDING = 0.1
#: For how many control steps a command stays: 3 to 8 s for the velocity, 1 to 3 s for a hand.
VELOCITY_STEPS, HAND_STEPS = (150, 400), (50, 150)
#: Commands that are enough for an episode of 14 s.
N_VELOCITIES, N_POSES = 5, 14


class LocoManipG1(Task):
    """A G1 with stiff waist and fingers walks, and brings its hands to poses; 26 terms.

    The commands of an episode are drawn at its start; the last ones stay in a longer one.
    """

    n_substeps = N_SUBSTEPS
    fields = (
        "qpos",
        "qvel",
        "ctrl",
        "qacc",
        "qfrc_actuator",
        "qfrc_damper",
        "xpos",
        "xquat",
        "site_xpos",
        "sensordata",
        "mocap_pos",
        "mocap_quat",
    )

    def __init__(self) -> None:
        self.model, self._default = locomanip_model()
        self._data = mujoco.MjData(self.model)
        self.reward_spec = RewardSpec.from_dict(terms.LEVELS)
        self._find_indices()
        n_joints = self.model.nu
        self.action_space = spaces.Box(-ACTION_BOUND, ACTION_BOUND, (n_joints,), np.float32)
        self.observation_space = unbounded(3 * 4 + 2 * 7 + 3 * n_joints)
        self.memory = {
            "actions": (n_joints,),
            "actions_before": (n_joints,),
            "time_step": (),
            # forward, left [m/s], heading [rad], whether to stand; the step at which each ends
            "velocities": (N_VELOCITIES, 4),
            "velocities_until": (N_VELOCITIES,),
            # position [m] and quaternion in the pelvis' frame, left and right
            "poses": (2, N_POSES, 7),
            "poses_until": (2, N_POSES),
            "command": (3,),
            "air_time": (2,),
            "contact_time": (2,),
        }

    def _find_indices(self) -> None:
        """Where joints, bodies and sensors are in MuJoCo's arrays."""
        model = self.model
        names = [model.actuator(index).name for index in range(model.nu)]

        def joints(*wanted: str) -> list[int]:
            return [names.index(f"{side}_{name}_joint") for side in SIDES for name in wanted]

        # a slice, because the sum over a copy of chosen columns depends on N in its last digit
        self._legs = slice(0, len(SIDES) * len(LEG))
        self._arms = joints(*ARM)
        self._hip_roll, self._hip_yaw, self._knee = (joints(name) for name in LEG[1:4])
        self._ankles = joints("ankle_pitch", "ankle_roll")
        self._limited = [*self._knee, *self._ankles]
        low, high = model.jnt_range[1:].T
        middle, half_range = (low + high) / 2, (high - low) / 2
        self._soft_low = middle - terms.SOFT_LIMIT * half_range
        self._soft_high = middle + terms.SOFT_LIMIT * half_range
        self._pelvis = model.body("pelvis").id
        self._hands = [model.body(f"{side}_elbow_roll_link").id for side in SIDES]
        self._palms = [model.site(f"{side}_palm").id for side in SIDES]

        def sensors(*wanted: str) -> list[int]:
            return [int(model.sensor(name).adr[0]) for name in wanted]

        self._trunk = sensors("touch_pelvis", "touch_torso_link", "touch_head")
        self._shins = sensors("touch_left_knee_link", "touch_right_knee_link")
        self._feet = sensors("touch_left_foot", "touch_right_foot")
        first = sensors("velocity_left_foot", "velocity_right_foot")
        self._foot_velocities = [[adr, adr + 1] for adr in first]

    def start(self, rng: np.random.Generator) -> dict[str, ArrayLike]:
        """The default pose in any direction, and the commands of the episode."""
        qpos = np.zeros(self.model.nq)
        qpos[2] = START_HEIGHT
        qpos[3:7] = from_euler(*np.array([0, 0, rng.uniform(-np.pi, np.pi)]))
        qpos[7:] = self._default
        velocities = np.zeros((N_VELOCITIES, 4))
        low, high = VELOCITIES.T
        velocities[:, :2] = rng.uniform(low, high, (N_VELOCITIES, 2))
        velocities[:, 2] = rng.uniform(-np.pi, np.pi, N_VELOCITIES)
        velocities[:, 3] = rng.uniform(size=N_VELOCITIES) < STANDING
        poses = self._draw_poses(rng)
        return {
            "qpos": qpos,
            "velocities": velocities,
            "velocities_until": rng.integers(*VELOCITY_STEPS, N_VELOCITIES, endpoint=True).cumsum(),
            "poses": poses,
            "poses_until": rng.integers(*HAND_STEPS, (2, N_POSES), endpoint=True).cumsum(1),
        }

    def _draw_poses(self, rng: np.random.Generator) -> Array:
        """Poses of the hands in the pelvis' frame at random joint positions, shape (2, …, 7)."""
        low, high = GOAL_JOINTS.T
        poses = np.zeros((2, N_POSES, 7))
        arms = 7 + np.array(self._arms).reshape(2, -1)
        self._data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        for index in range(N_POSES):
            self._data.qpos[arms[0]] = rng.uniform(low, high)
            self._data.qpos[arms[1]] = MIRRORED * rng.uniform(low, high)
            mujoco.mj_kinematics(self.model, self._data)
            poses[:, index, :3] = self._data.site_xpos[self._palms]
            poses[:, index, 3:] = self._data.xquat[self._hands]
        return poses

    def act(self, s: Rows, actions: Array) -> None:
        """Targets of the joints' PD controllers, around the default pose."""
        s.command[:] = self.command(s)
        s.actions_before[:] = s.actions
        s.actions[:] = actions
        s.ctrl[:] = self._default + ACTION_SCALE * actions
        quaternion = s.qpos[:, 3:7]
        for side, pose in enumerate(self.poses(s, s.time_step)):  # for the picture
            s.mocap_pos[:, side] = s.qpos[:, :3] + into_world(quaternion, pose[:, :3])
            s.mocap_quat[:, side] = compose(quaternion, pose[:, 3:])

    def measure(self, s: Rows) -> None:
        """Count the step, and how long each foot has been on the ground or in the air."""
        s.time_step[:] += 1
        grounded = s.sensordata[:, self._feet] > 0
        s.air_time[:] = np.where(grounded, 0, s.air_time + DT)
        s.contact_time[:] = np.where(grounded, s.contact_time + DT, 0)

    def rewards(self, s: Rows) -> list[Array]:
        """The 26 terms of the paper, for the commands that the step was made for."""
        return [*self._walking(s), *self._posture(s), *self._reaching(s)]

    def _walking(self, s: Rows) -> list[Array]:
        """From the fall to the pelvis' turn."""
        quaternion, joints = s.qpos[:, 3:7], s.qpos[:, 7:]
        deviation = np.abs(joints - self._default)
        turn = into_world(quaternion, s.qvel[:, 3:6])
        return [
            terms.termination_penalty(self.terminated(s)),
            terms.track_lin_vel_xy_exp(s.command, self.planar_velocity(s)),
            terms.track_ang_vel_z_exp(s.command, turn[:, 2]),
            terms.feet_air_time(s.command, s.air_time, s.contact_time),
            terms.feet_slide(s.sensordata[:, self._foot_velocities], s.contact_time > 0),
            terms.dof_torques_l2(s.qfrc_actuator[:, 6:] + s.qfrc_damper[:, 6:]),
            terms.dof_acc_l2(s.qacc[:, 6:]),
            terms.action_rate_l2(s.actions, s.actions_before),
            terms.flat_orientation_l2(projected_gravity(quaternion)),
            terms.stand_still(s.command, deviation[:, self._legs]),
            terms.lin_vel_z_l2(into_frame(quaternion, s.qvel[:, :3])[:, 2]),
            terms.ang_vel_xy_l2(s.qvel[:, 3:5]),
        ]

    def _posture(self, s: Rows) -> list[Array]:
        """From jumps to the speed of the hips."""
        joints = s.qpos[:, 7:]
        deviation = np.abs(joints - self._default)
        excess = np.maximum(self._soft_low - joints, 0) + np.maximum(joints - self._soft_high, 0)
        return [
            terms.no_jumps(s.contact_time),
            terms.dof_pos_limits(excess[:, self._limited]),
            terms.joint_deviation_hip_roll(deviation[:, self._hip_roll]),
            terms.joint_deviation_hip_yaw(deviation[:, self._hip_yaw]),
            terms.joint_deviation_knee(deviation[:, self._knee]),
            terms.joint_deviation_feet(deviation[:, self._ankles]),
            terms.undesired_contacts(s.sensordata[:, self._shins] > 0),
            terms.joint_vel_hip_yaw(s.qvel[:, 6:][:, self._hip_yaw]),
        ]

    def _reaching(self, s: Rows) -> list[Array]:
        """Three for each hand."""
        pelvis, quaternion = (
            s.xpos[:, self._pelvis],
            s.xquat[:, self._pelvis],
        )  # as old as the hands
        values = []
        for side, pose in enumerate(self.poses(s, s.time_step - 1)):
            hand = into_frame(quaternion, s.site_xpos[:, self._palms[side]] - pelvis)
            distance = np.linalg.norm(hand - pose[:, :3], axis=1)
            goal = compose(quaternion, pose[:, 3:])
            values += [
                terms.ee_pos_tracking(distance),
                terms.ee_pos_tracking_fine_grained(distance),
                terms.end_effector_orientation_tracking(
                    angle_between(s.xquat[:, self._hands[side]], goal)
                ),
            ]
        return values

    def terminated(self, s: Rows) -> NDArray[np.bool_]:
        """Tilted by more than 0.7 rad, or pelvis, torso or head on the ground."""
        is_tilted = -projected_gravity(s.qpos[:, 3:7])[:, 2] < np.cos(FALLEN_TILT)
        return is_tilted | (s.sensordata[:, self._trunk] > 0).any(1)

    def observe(self, s: Rows) -> Array:
        """Velocities, direction of gravity, commands, joints and last action; see docs/tasks.md."""
        quaternion = s.qpos[:, 3:7]
        return np.concatenate(
            [
                into_frame(quaternion, s.qvel[:, :3]),
                s.qvel[:, 3:6],
                projected_gravity(quaternion),
                self.command(s),
                *self.poses(s, s.time_step),
                s.qpos[:, 7:] - self._default,
                s.qvel[:, 6:],
                s.actions,
            ],
            axis=1,
            dtype=np.float32,
        )

    def command(self, s: Rows) -> Array:
        """Commanded velocity forward and to the left [m/s] and turn [rad/s], shape (N, 3)."""
        chosen = current(s.velocities, s.velocities_until, s.time_step)
        yaw, _ = yaw_and_roll(s.qpos[:, 3:7])
        turn = HEADING_STIFFNESS * wrap(chosen[:, 2] - yaw)
        turn = np.clip(turn, -LARGEST_TURN, LARGEST_TURN)
        return np.column_stack([chosen[:, :2], turn]) * (chosen[:, 3:] == 0)

    def poses(self, s: Rows, time_step: Array) -> list[Array]:
        """Commanded pose of each hand in the pelvis' frame: position [m], quaternion; (N, 7)."""
        return [
            current(s.poses[:, side], s.poses_until[:, side], time_step)
            for side in range(len(SIDES))
        ]

    def planar_velocity(self, s: Rows) -> Array:
        """Velocity of the pelvis forward and to the left, seen from above [m/s], shape (N, 2)."""
        yaw, _ = yaw_and_roll(s.qpos[:, 3:7])
        cosine, sine = np.cos(yaw), np.sin(yaw)
        x, y = s.qvel[:, 0], s.qvel[:, 1]
        return np.column_stack([cosine * x + sine * y, cosine * y - sine * x])


def current(commands: Array, until: Array, time_step: Array) -> Array:
    """The command of a step, shape (N, …); the last one stays.

    :param commands: of the episode, shape (N, n, …)
    :param until: the step at which each ends, shape (N, n)
    :param time_step: control steps since the start, shape (N,)
    """
    index = (time_step[:, None] >= until[:, :-1]).sum(1)
    return commands[np.arange(len(commands)), index]
