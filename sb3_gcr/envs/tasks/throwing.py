"""Throwing-MO: a Unitree G1 throws a ball at a point and, if wanted, does so in a chosen manner.

Control rate, time limit, command and the six base terms are those of the paper; docs/tasks.md lists
what differs.
"""

from __future__ import annotations

from importlib.resources import files

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_gcr.envs.task import Array, Rows, Task, unbounded
from sb3_gcr.envs.tasks.geometry import into_frame, yaw_and_roll
from sb3_gcr.envs.tasks.ranges import choose_ranges, inside
from sb3_gcr.rewards.spec import RewardSpec

#: Physics steps of 5 ms per control step: 50 Hz control; control steps per episode: 2 s.
N_SUBSTEPS, EPISODE_STEPS = 4, 100
#: Duration of a control step [s].
DT = 0.02
#: An action of 1 moves a joint's target by this much from the default pose [rad]; actions go from
#: -5 to 5.
ACTION_SCALE, ACTION_BOUND = 0.5, 5.0
#: Height of the pelvis at the start [m].
START_HEIGHT = 0.74
#: Noise of the first joint positions, and more of it in the arms [rad].
JOINT_NOISE, ARM_NOISE = 0.05, 0.3
#: Where the right fingers' joints are when the hand is closed [rad]; open, and at the left, they
#: are at 0.
CLOSED_FINGERS = {
    "one": -0.525,
    "two": -0.915,
    "three": 1.05,
    "four": 1.83,
    "five": 1.05,
    "six": 1.83,
}
#: The hand lets the ball go once its fingers have opened by this share of the way.
LET_GO = 0.5
#: Height at which a flying ball has landed [m], and points looked at on its way.
LANDED_HEIGHT, N_POINTS = 0.03, 100
GRAVITY = 9.81
#: Ranges of the six objectives, lower bound included, upper bound excluded.
RANGES: dict[str, tuple[tuple[float, float], ...]] = {
    "energy": ((25, 50), (50, 100), (100, 200), (200, 400), (400, 800)),  # mechanical power [W]
    "baseh": (
        (0.45, 0.50),
        (0.50, 0.55),
        (0.55, 0.60),
        (0.60, 0.65),
        (0.65, 0.70),
    ),  # height of the pelvis [m]
    "ballrel": ((0.0, 0.3), (0.3, 0.6), (0.6, 0.9), (0.9, 1.2), (1.2, 1.5)),  # time of release [s]
    "bodymo": (
        (0.0, 0.25),
        (0.25, 0.5),
        (0.5, 1.0),
        (1.0, 1.5),
        (1.5, 2.0),
    ),  # speed of the torso at release [m/s]
    "lftarm": (
        (0.4, 0.6),
        (0.6, 0.8),
        (0.8, 1.0),
        (1.0, 1.2),
        (1.2, 1.4),
    ),  # height of the left palm at release [m]
    "rgtarm": (
        (0.3, 0.5),
        (0.5, 0.7),
        (0.7, 0.9),
        (0.9, 1.1),
        (1.1, 1.3),
    ),  # height of the right palm at release [m]
}


def throwing(miss: Array) -> Array:
    """4.1 times what is left of 1 after the miss, once, when the ball is let go.

    :param miss: smallest distance between ball and target on the ball's way, over the target's
        distance; NaN unless let go now
    """
    return np.where(np.isnan(miss), 0, 4.1 * np.maximum(0, 1 - miss))


def roll(angle: Array) -> Array:
    """-0.0086 σ(10 (ρ - 0.3)) (1 - exp(-(ρ - 0.1) / 0.1)), with ρ the size of the pelvis' roll; a
    little above 0 below 0.1.

    :param angle: roll of the pelvis [rad]
    """
    size = np.abs(angle)
    return -0.43 * DT / (1 + np.exp(-10 * (size - 0.3))) * (1 - np.exp(-(size - 0.1) / 0.1))


def stability(height: Array, has_collided: Array, is_late: Array) -> Array:
    """0.005 while the robot stands above 0.38 m, touches the ground with its feet only, and still
    can, or did, throw.

    :param height: of the pelvis [m]
    :param has_collided: whether anything but a foot has just touched the ground
    :param is_late: whether the time is up with the ball in the hand
    """
    return 0.25 * DT * ~((height <= 0.38) | has_collided | is_late)


def action_rate_l2(actions: Array, actions_before: Array) -> Array:
    """-2e-5 Σ (a_t - a_{t-1})².

    :param actions: shape (N, 24)
    :param actions_before: of the step before, shape (N, 24)
    """
    return -1e-3 * DT * np.square(actions - actions_before).sum(1)


def dof_torques_l2(torques: Array) -> Array:
    """-5e-8 Σ τ².

    :param torques: of all joints [N m], shape (N, 37)
    """
    return -2.5e-6 * DT * np.square(torques).sum(1)


def dof_acc_l2(accelerations: Array) -> Array:
    """-5e-10 Σ q̈².

    :param accelerations: of all joints [rad/s²], shape (N, 37)
    """
    return -2.5e-8 * DT * np.square(accelerations).sum(1)


def paid_each_step(values: Array, bounds: tuple[float, float]) -> Array:
    """0.02 while a value is in range.

    :param values: shape (N,)
    :param bounds: lower one included, upper one excluded
    """
    return DT * inside(values, bounds)


def paid_at_release(values: Array, bounds: tuple[float, float], is_released: Array) -> Array:
    """1, once, if a value is in range when the ball is let go.

    :param values: shape (N,)
    :param bounds: lower one included, upper one excluded
    :param is_released: whether it is let go now
    """
    return 1.0 * (inside(values, bounds) & is_released)


def closest_approach(ball: Array, velocity: Array, target: Array) -> tuple[Array, Array]:
    """Smallest distance to the target [m] and the time until then [s] of a ball that flies freely
    until it lands, each (n,).

    :param ball: position [m], shape (n, 3)
    :param velocity: [m/s], shape (n, 3)
    :param target: position [m], shape (n, 3)
    """
    height, rise = np.maximum(ball[:, 2] - LANDED_HEIGHT, 0), velocity[:, 2]
    flight = (rise + np.sqrt(rise * rise + 2 * GRAVITY * height)) / GRAVITY
    times = np.linspace(0, 1, N_POINTS)[:, None] * flight  # (points, n)
    x, y = (ball[:, axis] - target[:, axis] + velocity[:, axis] * times for axis in (0, 1))
    z = ball[:, 2] - target[:, 2] + rise * times - GRAVITY / 2 * times * times
    squares = x * x + y * y + z * z
    nearest = squares.argmin(0), np.arange(len(ball))
    return np.sqrt(squares[nearest]), times[nearest]


class ThrowingMO(Task):
    """The G1 throws a ball at a point on a half sphere around it; six terms, and up to six
    objectives that pay inside a range.

    :param max_distance: targets are drawn between 1 m and this distance, at most 5 m; may be
        changed between episodes
    :param energy: index of the range of the mechanical power, 0 to 4, or None
    :param baseh: index of the range of the pelvis' height
    :param ballrel: index of the range of the time of release
    :param bodymo: index of the range of the torso's speed at release
    :param lftarm: index of the range of the left palm's height at release
    :param rgtarm: index of the range of the right palm's height at release
    :raises ValueError: for an index that is not there, or a distance out of bounds
    """

    n_substeps = N_SUBSTEPS
    fields = (
        "qpos",
        "qvel",
        "ctrl",
        "eq_active",
        "mocap_pos",
        "qacc",
        "qfrc_actuator",
        "qfrc_damper",
        "site_xpos",
        "sensordata",
    )

    def __init__(
        self,
        max_distance: float = 1.0,
        energy: int | None = None,
        baseh: int | None = None,
        ballrel: int | None = None,
        bodymo: int | None = None,
        lftarm: int | None = None,
        rgtarm: int | None = None,
    ):
        self.max_distance = max_distance
        chosen = {
            "energy": energy,
            "baseh": baseh,
            "ballrel": ballrel,
            "bodymo": bodymo,
            "lftarm": lftarm,
            "rgtarm": rgtarm,
        }
        self.ranges = choose_ranges(RANGES, chosen)
        self.reward_spec = RewardSpec.from_dict(
            {"throwing": "task", "roll": "task", "stability": "task"}
            | dict.fromkeys(("action_rate_l2", "dof_torques_l2", "dof_acc_l2"), "regulariser")
            | {f"{name}_range": "task" for name in self.ranges}
        )
        self.model = mujoco.MjModel.from_xml_path(str(files("sb3_gcr.envs") / "assets/g1.xml"))
        self._data = mujoco.MjData(self.model)
        self._find_indices()
        self.action_space = spaces.Box(
            -ACTION_BOUND, ACTION_BOUND, (len(self._body) + 1,), np.float32
        )
        self.observation_space = unbounded(86)
        n_touches = len(self._touches)
        self.memory = {
            "actions": self.action_space.shape,
            "actions_before": self.action_space.shape,
            "target": (3,),
        }
        self.memory |= {
            "has_thrown": (),
            "releases": (),
            "touched": (n_touches,),
            "collided": (),
            "time_step": (),
        }

    @property
    def max_distance(self) -> float:
        """Largest distance of a target [m]."""
        return self._max_distance

    @max_distance.setter
    def max_distance(self, value: float) -> None:
        if not 1 <= value <= 5:
            raise ValueError(
                f"Parameter `max_distance` must be between 1 and 5 m, found {value!r}."
            )
        self._max_distance = float(value)

    def _find_indices(self) -> None:
        """Where joints, fingers, ball and sensors are in MuJoCo's arrays."""
        model = self.model
        names = [model.actuator(index).name for index in range(model.nu)]
        is_finger = np.array([name.split("_")[1] in ("zero", *CLOSED_FINGERS) for name in names])
        self._default = model.key("default").qpos
        self._joints = slice(7, 7 + model.nu)
        self._body = np.flatnonzero(~is_finger)
        self._arms = [
            index for index in self._body if "shoulder" in names[index] or "elbow" in names[index]
        ]
        self._fingers = [names.index(f"right_{finger}_joint") for finger in CLOSED_FINGERS]
        self._closed = np.array(list(CLOSED_FINGERS.values()))
        self._left_palm, self._right_palm = (
            model.site(f"{side}_palm").id for side in ("left", "right")
        )
        self._ball = slice(7 + model.nu, 10 + model.nu)
        self._ball_velocity = slice(6 + model.nu, 9 + model.nu)
        sensors = [model.sensor(index).name for index in range(model.nsensor)]
        self._touches = [index for index, name in enumerate(sensors) if name.startswith("touch_")]
        fingers_and_palms = ("palm", *(f"{finger}_link" for finger in ("zero", *CLOSED_FINGERS)))
        self._is_hand = np.array(
            [sensors[index].endswith(fingers_and_palms) for index in self._touches]
        )

    def start(self, rng: np.random.Generator) -> dict[str, ArrayLike]:
        """The default pose with noise, the ball in the closed right hand, and a target."""
        qpos = self._default.copy()
        qpos[2] = START_HEIGHT
        joints = qpos[self._joints]
        joints[self._fingers] = self._closed
        joints[self._arms] += rng.uniform(-ARM_NOISE, ARM_NOISE, len(self._arms))
        joints += rng.uniform(-JOINT_NOISE, JOINT_NOISE, len(joints))
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        qpos[self._ball] = self._data.site("right_grip").xpos
        distance, cosine, azimuth = (
            rng.uniform(1, self.max_distance),
            rng.uniform(0, 1),
            rng.uniform(0, 2 * np.pi),
        )
        sine = np.sqrt(1 - cosine**2)
        target = distance * np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
        return {"qpos": qpos, "target": target, "mocap_pos": target[None]}

    def act(self, s: Rows, actions: Array) -> None:
        """Targets of the body's joints, and one number that closes the right hand, or opens it
        below 0.
        """
        s.actions_before[:] = s.actions
        s.actions[:] = actions
        s.ctrl[:] = 0
        s.ctrl[:, self._body] = (
            self._default[self._joints][self._body] + ACTION_SCALE * actions[:, :-1]
        )
        s.ctrl[:, self._fingers] = self._closed * (actions[:, -1:] >= 0)

    def measure(self, s: Rows) -> None:
        """Let the ball go if the hand is open, and notice new contacts."""
        s.time_step[:] += 1
        closure = (s.qpos[:, self._joints][:, self._fingers] / self._closed).sum(1) / len(
            self._closed
        )
        s.releases[:] = (closure < 1 - LET_GO) & (s.has_thrown == 0)
        s.has_thrown[:] += s.releases
        s.eq_active[:, 0] = s.has_thrown == 0
        touched = s.sensordata[:, self._touches] > 0
        counts = ~self._is_hand | (s.has_thrown > 0)[:, None]
        s.collided[:] = (touched & (s.touched == 0) & counts).any(1)
        s.touched[:] = touched

    def rewards(self, s: Rows) -> list[Array]:
        """The six terms of the paper, then the chosen objectives."""
        is_released = s.releases > 0
        miss = np.full(len(s.qpos), np.nan)
        miss[is_released], _ = self.foresee(s.take(is_released))
        is_late = (s.time_step >= EPISODE_STEPS) & (s.has_thrown == 0)
        terms = {
            "energy": lambda bounds: paid_each_step(self.power(s), bounds),
            "baseh": lambda bounds: paid_each_step(s.qpos[:, 2], bounds),
            "ballrel": lambda bounds: paid_at_release(DT * s.time_step, bounds, is_released),
            "bodymo": lambda bounds: paid_at_release(
                np.linalg.norm(s.qvel[:, :3], axis=1), bounds, is_released
            ),
            "lftarm": lambda bounds: paid_at_release(
                s.site_xpos[:, self._left_palm, 2], bounds, is_released
            ),
            "rgtarm": lambda bounds: paid_at_release(
                s.site_xpos[:, self._right_palm, 2], bounds, is_released
            ),
        }
        return [
            throwing(miss),
            roll(yaw_and_roll(s.qpos[:, 3:7])[1]),
            stability(s.qpos[:, 2], s.collided > 0, is_late),
            action_rate_l2(s.actions, s.actions_before),
            dof_torques_l2(self.torques(s)),
            dof_acc_l2(s.qacc[:, 6 : 6 + self.model.nu]),
            *(terms[name](bounds) for name, bounds in self.ranges.items()),
        ]

    def terminated(self, s: Rows) -> NDArray[np.bool_]:
        """Never: a robot that has fallen can still throw, and is not saved the costs of having
        fallen.
        """
        return np.zeros(len(s.qpos), dtype=bool)

    def observe(self, s: Rows) -> Array:
        """Attitude, target, joints, last action, and where the ball would go if it were let go now;
        see docs/tasks.md.
        """
        quaternion = s.qpos[:, 3:7]
        down = np.zeros((len(s.qpos), 3))
        down[:, 2] = -1
        joints = (s.qpos[:, self._joints] - self._default[self._joints])[:, self._body]
        miss, time = self.foresee(s)
        return np.concatenate(
            [
                s.qvel[:, 3:6],
                into_frame(quaternion, down),
                yaw_and_roll(quaternion)[1][:, None],
                into_frame(quaternion, s.target - s.qpos[:, :3]),
                joints,
                s.qvel[:, 6 : 6 + self.model.nu][:, self._body],
                s.actions,
                np.stack([s.has_thrown == 0, np.maximum(0, 1 - miss), time], axis=1),
                into_frame(quaternion, s.qvel[:, self._ball_velocity]),
            ],
            axis=1,
            dtype=np.float32,
        )

    def foresee(self, s: Rows) -> tuple[Array, Array]:
        """The miss if the ball flew freely from now on, over the target's distance, and the time
        until then [s], each (n,).
        """
        distance, time = closest_approach(
            s.qpos[:, self._ball], s.qvel[:, self._ball_velocity], s.target
        )
        return distance / np.linalg.norm(s.target, axis=1), time

    def torques(self, s: Rows) -> Array:
        """Torques of the PD controllers [N m], shape (N, 37); the model has their damping in the
        joints.
        """
        joints = slice(6, 6 + self.model.nu)
        return s.qfrc_actuator[:, joints] + s.qfrc_damper[:, joints]

    def power(self, s: Rows) -> Array:
        """Mechanical power Σ abs(τ q̇) of the body's joints [W], shape (N,)."""
        return np.abs(self.torques(s)[:, self._body] * s.qvel[:, 6 + self._body]).sum(1)
