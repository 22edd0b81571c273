"""Humanoid-MO: run towards a point far away and, if wanted, keep power, strides, pelvis and hands
in chosen ranges.

The base task is that of the paper (its reward, control rate, time limit and fall), on Gymnasium's
humanoid.
"""

from __future__ import annotations

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_gcr.envs.task import Array, Rows, Task, unbounded
from sb3_gcr.envs.tasks.geometry import into_frame, wrap, yaw_and_roll
from sb3_gcr.envs.tasks.ranges import choose_ranges, inside
from sb3_gcr.rewards.spec import RewardSpec

#: Physics step [s] and steps per control step: 60 Hz control.
TIMESTEP, N_SUBSTEPS = 1 / 240, 4
#: Where to run to [m], seen from the start.
TARGET = np.array([1000.0, 0.0])
#: Height of the torso at the start, and below which the robot has fallen [m].
START_HEIGHT, FALLEN_HEIGHT = 1.3, 0.8
#: Noise of the first joint positions [rad] and velocities [rad/s].
NOISE = 0.01
#: Part of the actuators' range that an action of ±1 uses, as in Gymnasium's env.
ACTION_SCALE = 0.4
#: Geoms of the model.
FEET, HANDS = ("right_foot", "left_foot"), ("right_hand", "left_hand")
#: Force at a foot from which on it stands on the ground [N].
CONTACT_FORCE = 1.0
#: Ranges of the four objectives, lower bound included, upper bound excluded.
RANGES: dict[str, tuple[tuple[float, float], ...]] = {
    "energy": ((25, 50), (50, 100), (100, 200), (200, 400), (400, 800)),  # mechanical power [W]
    "gait": ((0.0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.0)),  # stride [m]
    "baseh": (
        (0.40, 0.55),
        (0.55, 0.70),
        (0.70, 0.82),
        (0.82, 0.95),
        (0.95, 1.20),
    ),  # height of the pelvis [m]
    "armsp": (
        (0.0, 0.2),
        (0.2, 0.4),
        (0.4, 0.6),
        (0.6, 0.8),
        (0.8, 1.0),
    ),  # distance from hand to pelvis [m]
}


def progress(distance_before: Array, distance: Array) -> Array:
    """120/s times the way made towards the target in this step, which is twice the speed towards it
    in m/s.

    :param distance_before: to the target before the step [m]
    :param distance: after the step [m]
    """
    return 120 * (distance_before - distance)


def alive(height: Array) -> Array:
    """2 in every step.

    :param height: of the torso [m]
    """
    return np.full(len(height), 2.0)


def upright(up: Array) -> Array:
    """0.1 while the torso leans less than 21.6° (up > 0.93).

    :param up: vertical part of the torso's unit vector up
    """
    return 0.1 * (up > 0.93)


def move_to_target(heading: Array) -> Array:
    """0.5 while the torso faces the target within 37° (heading > 0.8), and in proportion to its
    heading otherwise.

    :param heading: part of the torso's unit vector forward that points at the target
    """
    return np.where(heading > 0.8, 0.5, 0.5 * heading / 0.8)


def action_l2(actions: Array) -> Array:
    """-0.01 Σ a².

    :param actions: in [-1, 1], shape (N, 17)
    """
    return -0.01 * np.square(actions).sum(1)


def energy(actions: Array, velocities: Array) -> Array:
    """-0.005 s/rad Σ abs(a q̇).

    :param actions: in [-1, 1], shape (N, 17)
    :param velocities: of the joints [rad/s], shape (N, 17)
    """
    return -0.005 * np.abs(actions * velocities).sum(1)


def joint_pos_limits(scaled_positions: Array) -> Array:
    """-1 for each joint in the uppermost hundredth of its range.

    :param scaled_positions: of the joints, ±1 at their limits, shape (N, 17)
    """
    return -1.0 * (scaled_positions > 0.98).sum(1)


def energy_range(power: Array, bounds: tuple[float, float]) -> Array:
    """5 while the mechanical power is in range.

    :param power: Σ abs(τ q̇) over the joints [W]
    :param bounds: lower one included, upper one excluded [W]
    """
    return 5.0 * inside(power, bounds)


def gait_range(strides: Array, air_times: Array, bounds: tuple[float, float]) -> Array:
    """250/s times the time in the air of each foot that touches down now with a stride in range.

    :param strides: between the last two touchdowns of each foot, NaN unless it touches down now
        [m], shape (N, 2)
    :param air_times: how long each foot was in the air [s], shape (N, 2)
    :param bounds: lower one included, upper one excluded [m]
    """
    return 250 * (air_times * inside(strides, bounds)).sum(1)


def baseh_range(height: Array, bounds: tuple[float, float]) -> Array:
    """5 while the pelvis is in range.

    :param height: of the pelvis [m]
    :param bounds: lower one included, upper one excluded [m]
    """
    return 5.0 * inside(height, bounds)


def armsp_range(distances: Array, bounds: tuple[float, float]) -> Array:
    """2.5 for each hand in range.

    :param distances: from each hand to the pelvis [m], shape (N, 2)
    :param bounds: lower one included, upper one excluded [m]
    """
    return 2.5 * inside(distances, bounds).sum(1)


class HumanoidRun(Task):
    """Gymnasium's humanoid runs towards a point 1000 m ahead; seven terms, with the paper's weights
    and levels.

    :param regulariser_weight: multiplies the three regularisers
    """

    n_substeps = N_SUBSTEPS

    def __init__(self, regulariser_weight: float = 1.0) -> None:
        self.regulariser_weight = regulariser_weight
        self.model = humanoid_model()
        self.reward_spec = RewardSpec.from_dict(
            {
                "progress": "task",
                "alive": "task",
                "upright": "task",
                "move_to_target": "task",
                "action_l2": "regulariser",
                "energy": "regulariser",
                "joint_pos_limits": "regulariser",
            }
        )
        n_joints = self.model.nu
        self.action_space = spaces.Box(-1, 1, (n_joints,), np.float32)
        self.observation_space = unbounded(12 + 3 * n_joints)
        self.memory = {"actions": (n_joints,), "distance_before": ()}
        self._middle = self.model.jnt_range[1:].mean(1)
        self._half_range = np.ptp(self.model.jnt_range[1:], axis=1) / 2
        # Actions are in the order of the actuators, positions in that of the joints.
        self._joint_of_action = self.model.actuator_trnid[:, 0] - 1

    def start(self, rng: np.random.Generator) -> dict[str, ArrayLike]:
        """Standing, with a little noise in the joints."""
        qpos = self.model.qpos0.copy()
        qpos[2] = START_HEIGHT
        qpos[7:] += rng.uniform(-NOISE, NOISE, self.model.nu)
        qvel = np.zeros(self.model.nv)
        qvel[6:] = rng.uniform(-NOISE, NOISE, self.model.nu)
        return {"qpos": qpos, "qvel": qvel}

    def act(self, s: Rows, actions: Array) -> None:
        """Actions are torques in units of 40 % of the actuators' strength."""
        s.actions[:] = actions
        s.ctrl[:] = ACTION_SCALE * actions
        s.distance_before[:] = distance_to_target(s.qpos)

    def rewards(self, s: Rows) -> list[Array]:
        """The seven terms of the paper."""
        up, heading = torso_projections(s.qpos)
        return [
            progress(s.distance_before, distance_to_target(s.qpos)),
            alive(s.qpos[:, 2]),
            upright(up),
            move_to_target(heading),
            self.regulariser_weight * action_l2(s.actions),
            self.regulariser_weight * energy(s.actions, self.actuated_velocities(s)),
            self.regulariser_weight * joint_pos_limits(self._scaled(s)),
        ]

    def terminated(self, s: Rows) -> NDArray[np.bool_]:
        """Torso below 0.8 m."""
        return s.qpos[:, 2] < FALLEN_HEIGHT

    def observe(self, s: Rows) -> Array:
        """Torso height, velocities in the torso's frame, attitude, joint positions and velocities,
        last action.
        """
        height, quaternion = s.qpos[:, 2:3], s.qpos[:, 3:7]
        up, heading = torso_projections(s.qpos)
        yaw, roll = yaw_and_roll(quaternion)
        to_target = TARGET - s.qpos[:, :2]
        angle = wrap(np.arctan2(to_target[:, 1], to_target[:, 0]) - yaw)
        return np.concatenate(
            [
                height,
                into_frame(quaternion, s.qvel[:, :3]),
                0.25 * s.qvel[:, 3:6],
                np.stack([yaw, roll, angle, up, heading], axis=1),
                self._scaled(s),
                0.1 * s.qvel[:, 6:],
                s.actions,
            ],
            axis=1,
            dtype=np.float32,
        )

    def actuated_velocities(self, s: Rows) -> Array:
        """Joint velocities in the order of the actions [rad/s], shape (N, 17)."""
        return s.qvel[:, 6:][:, self._joint_of_action]

    def _scaled(self, s: Rows) -> Array:
        """Joint positions, ±1 at their limits."""
        return (s.qpos[:, 7:] - self._middle) / self._half_range


class HumanoidMO(HumanoidRun):
    """HumanoidRun with up to four objectives that pay inside a range; None leaves an objective out.

    With ``energy`` given, the base term of that name is left out, because the two contradict each
    other.

    :param energy: index of the range of the mechanical power, 0 to 4
    :param gait: index of the range of the stride
    :param baseh: index of the range of the pelvis' height
    :param armsp: index of the range of the distance from hands to pelvis
    :raises ValueError: for an index that is not there
    """

    def __init__(
        self,
        energy: int | None = None,
        gait: int | None = None,
        baseh: int | None = None,
        armsp: int | None = None,
    ):
        super().__init__()
        chosen = {"energy": energy, "gait": gait, "baseh": baseh, "armsp": armsp}
        self.ranges = choose_ranges(RANGES, chosen)
        base = {name: level for name, level in self.reward_spec if name not in self.ranges}
        self._kept = [index for index, name in enumerate(self.reward_spec.names) if name in base]
        self.reward_spec = RewardSpec.from_dict(
            {**base, **{f"{name}_range": "task" for name in self.ranges}}
        )
        self.fields = (*self.fields, "xpos", "geom_xpos", "sensordata")
        feet = len(FEET)
        self.memory |= {
            "grounded": (feet,),
            "air_time": (feet,),
            "has_stepped": (feet,),
            "step_xy": (feet, 2),
        }
        self.memory |= {"strides": (feet,), "last_air_time": (feet,)}
        self._pelvis = self.model.body("pelvis").id
        self._feet, self._hands = (
            [self.model.geom(name).id for name in names] for names in (FEET, HANDS)
        )
        self._gear = self.model.actuator_gear[:, 0]

    def measure(self, s: Rows) -> None:
        """Watch the feet: strides and times in the air, at touchdown."""
        grounded = s.sensordata > CONTACT_FORCE
        landed = grounded & (s.grounded == 0)
        feet = s.geom_xpos[:, self._feet, :2]
        stride = np.linalg.norm(feet - s.step_xy, axis=2)
        s.strides[:] = np.where(landed & (s.has_stepped > 0), stride, np.nan)
        s.last_air_time[:] = s.air_time
        s.step_xy[landed] = feet[landed]
        s.has_stepped[landed] = 1
        s.air_time[:] = np.where(grounded, 0, s.air_time + self.dt)
        s.grounded[:] = grounded

    def rewards(self, s: Rows) -> list[Array]:
        """The terms of HumanoidRun, then the chosen objectives."""
        base = super().rewards(s)
        terms = {
            "energy": lambda bounds: energy_range(self.power(s), bounds),
            "gait": lambda bounds: gait_range(s.strides, s.last_air_time, bounds),
            "baseh": lambda bounds: baseh_range(s.xpos[:, self._pelvis, 2], bounds),
            "armsp": lambda bounds: armsp_range(self.hand_distances(s), bounds),
        }
        return [base[index] for index in self._kept] + [
            terms[name](bounds) for name, bounds in self.ranges.items()
        ]

    def power(self, s: Rows) -> Array:
        """Mechanical power Σ abs(τ q̇) [W], shape (N,)."""
        return np.abs(self._gear * s.ctrl * self.actuated_velocities(s)).sum(1)

    def hand_distances(self, s: Rows) -> Array:
        """From each hand to the pelvis [m], shape (N, 2)."""
        return np.linalg.norm(s.geom_xpos[:, self._hands] - s.xpos[:, None, self._pelvis], axis=2)


def humanoid_model() -> mujoco.MjModel:
    """Gymnasium's humanoid with an implicit integrator, and a touch sensor around each foot."""
    spec = mujoco.MjSpec.from_file(
        str(Path(gymnasium.__file__).parent / "envs/mujoco/assets/humanoid.xml")
    )
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.timestep = TIMESTEP
    spec.geom("floor").size = [0, 0, 0.125]  # drawn without an end, in squares of 1 m
    floor = spec.material("MatPlane")
    floor.texuniform, floor.texrepeat = True, [0.5, 0.5]
    for name in FEET:
        foot = spec.geom(name)
        foot.parent.add_site(name=name, pos=foot.pos, size=[1.1 * foot.size[0], 0, 0], group=4)
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name
        )
    return spec.compile()


def distance_to_target(qpos: Array) -> Array:
    """Horizontal distance from the torso to the target [m], shape (N,).

    :param qpos: shape (N, 24)
    """
    return np.hypot(TARGET[0] - qpos[:, 0], TARGET[1] - qpos[:, 1])


def torso_projections(qpos: Array) -> tuple[Array, Array]:
    """Vertical part of the torso's unit vector up, and the part of its unit vector forward towards
    the target, each (N,).

    :param qpos: shape (N, 24)
    """
    w, x, y, z = qpos[:, 3:7].T
    to_target = TARGET - qpos[:, :2]
    forward_x, forward_y = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z)
    heading = (forward_x * to_target[:, 0] + forward_y * to_target[:, 1]) / distance_to_target(qpos)
    return 1 - 2 * (x * x + y * y), heading
