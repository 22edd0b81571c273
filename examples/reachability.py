"""Show that every range of every objective can be reached: the table of docs/tasks.md, with a pose
or motion that pays.

Run ``python examples/reachability.py`` to print it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.task import Task
from sb3_gcr.envs.tasks import humanoid, planar_mo, throwing

Array = NDArray[Any]

#: Joints of a jump, and the sign of the left one where there are two.
JUMP_JOINTS = (("hip_y", 1), ("knee", 1), ("abdomen_y", 0), ("shoulder1", -1), ("shoulder2", -1))
#: Jumps of the humanoid: speed of the run-up [m/s], bent knees and torso at the start [°], and the
#: torques of JUMP_JOINTS in percent, one row each tenth of a second. Found by a random search.
JUMPS: tuple[dict[str, Any], ...] = (
    {
        "speed": 0,
        "knees": 69.1,
        "torso": 27.3,
        "torques": (
            (28, 100, 80, 76, -100),
            (-100, 73, 0, 18, 4),
            (-100, 8, -41, -34, -32),
            (-80, -74, 19, 100, 22),
            (100, -21, -69, 17, 3),
            (4, -40, 31, 3, 8),
            (-25, -33, -53, 36, 30),
        ),
    },
    {
        "speed": 2,
        "knees": 25.9,
        "torso": 15.0,
        "torques": (
            (64, -20, 31, 21, -99),
            (90, -20, 100, 8, 38),
            (50, -69, 39, -6, 76),
            (72, -30, 24, 2, -47),
            (82, -8, 4, -22, -38),
            (-22, 37, 100, -29, 22),
            (-33, -100, 37, -20, 19),
        ),
    },
    {
        "speed": 2,
        "knees": 71.2,
        "torso": 23.9,
        "torques": (
            (66, 12, 100, -3, -100),
            (96, 5, 44, -11, -21),
            (29, -69, 45, 25, -76),
            (-43, -39, 3, 22, -20),
            (-2, 25, -35, -51, 18),
            (-19, 32, -20, 100, 100),
            (-99, -21, -60, -67, 37),
        ),
    },
    {
        "speed": 2,
        "knees": 54.1,
        "torso": 32.6,
        "torques": (
            (84, 13, 96, 52, -55),
            (77, 2, 100, 36, 2),
            (99, -42, 100, 45, -69),
            (25, -58, -26, 72, -14),
            (30, 5, -60, -33, 5),
            (-44, -27, 23, 72, 71),
            (-69, 81, 13, -38, 15),
        ),
    },
)


#: Actions of hip, knee and ankle of each leg of a planar robot; the cheetah's are thigh, shin and
#: foot.
LEGS: dict[str, tuple[slice, ...]] = {
    "Walker2dMO": (slice(0, 3), slice(3, 6)),
    "HopperMO": (slice(0, 3),),
    "HalfCheetahMO": (slice(0, 3), slice(3, 6)),
}


@dataclass
class Motion:
    """A start and the actions that follow; after the last one, all are zero.

    :param what: in words
    :param qpos: positions at the start; None for those of the task
    :param qvel: velocities at the start; None for those of the task
    :param actions: shape (T, n_actions)
    """

    what: str
    qpos: Array | None
    qvel: Array | None
    actions: Array


def pays(task: Task, motions: list[Motion], n_steps: int) -> Array:
    """What each motion is paid by each term until the episode ends, shape (n_motions, K).

    :param task: the task
    :param motions: what to try
    :param n_steps: control steps
    """
    engine = Engine(task, len(motions))
    for index in range(len(motions)):
        engine.seed(index, 0)
    engine.reset(np.arange(len(motions)))
    for index, motion in enumerate(motions):
        if motion.qpos is not None:
            engine.rows.qpos[index], engine.rows.qvel[index] = motion.qpos, motion.qvel
    engine.batch.forward()
    actions = np.zeros((n_steps, len(motions), *task.action_space.shape))
    for index, motion in enumerate(motions):
        actions[: len(motion.actions), index] = motion.actions[:n_steps]
    paid = np.zeros((len(motions), len(task.reward_spec)))
    running = np.ones(len(motions), dtype=bool)
    for step_actions in actions:
        step = engine.step(step_actions.astype(np.float32))
        paid[running] += step.components[running]
        running &= ~step.terminated
    engine.close()
    return paid


def humanoid_motions() -> list[Motion]:
    """Arm poses, squats, swinging limbs, and jumps with and without a run-up."""
    model = humanoid.humanoid_model()
    data = mujoco.MjData(model)
    joints = {model.joint(index).name: index - 1 for index in range(1, model.njnt)}
    motors = {model.actuator(index).name: index for index in range(model.nu)}
    rng = np.random.default_rng(0)

    def standing(bend: float = 0.0, lean: float = 0.0) -> Array:
        """Knees bent by `bend`, hips so that the torso leans by `lean`, feet on the floor."""
        qpos = model.qpos0.copy()
        for side in ("right", "left"):
            qpos[7 + joints[f"{side}_hip_y"]] = -(bend / 2 + lean)
            qpos[7 + joints[f"{side}_knee"]] = -max(bend, np.deg2rad(2))
        qpos[3], qpos[5] = np.cos(lean / 2), np.sin(lean / 2)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        lowest = min(data.geom(foot).xpos[2] - model.geom(foot).size[0] for foot in humanoid.FEET)
        qpos[2] += 0.002 - lowest
        return qpos

    still = np.zeros(model.nv)
    motions = []
    low, high = model.jnt_range[1:].T
    arms = [index for name, index in joints.items() if "shoulder" in name or "elbow" in name]
    for _ in range(100):
        qpos = standing()
        qpos[7:][arms] = rng.uniform(low[arms], high[arms])
        motions.append(
            Motion("stand, arms at rest in a pose", qpos, still, np.zeros((0, model.nu)))
        )
    for degrees in range(0, 150, 5):
        motions.append(
            Motion(
                f"knees bent by {degrees}°",
                standing(np.deg2rad(degrees)),
                still,
                np.zeros((0, model.nu)),
            )
        )
    time = np.arange(30)[:, None] / 60
    for amplitude in np.arange(0.05, 1.01, 0.05):
        swing = amplitude * np.sin(2 * np.pi * (2 * time + rng.random(model.nu)))
        motions.append(
            Motion(
                f"stand, swing all joints at 2 Hz with {amplitude:.2f} of the torque",
                standing(),
                still,
                swing,
            )
        )
    for jump in JUMPS:
        actions = np.zeros((6 * len(jump["torques"]), model.nu))
        for step, torques in enumerate(jump["torques"]):
            for (joint, mirror), percent in zip(JUMP_JOINTS, torques, strict=True):
                for side, sign in (("right_", 1), ("left_", mirror)) if mirror else (("", 1),):
                    actions[6 * step : 6 * step + 6, motors[f"{side}{joint}"]] = (
                        sign * percent / 100
                    )
        run_up = still.copy()
        run_up[0] = jump["speed"]
        what = f"jump with a run-up of {jump['speed']} m/s" if jump["speed"] else "jump"
        what += f" from knees bent by {jump['knees']:.0f}° and torso by {jump['torso']:.0f}°"
        motions.append(
            Motion(
                what,
                standing(np.deg2rad(jump["knees"]), np.deg2rad(jump["torso"])),
                run_up,
                actions,
            )
        )
    return motions


def throwing_motions() -> list[Motion]:
    """Swinging joints, falling, and arms in many places, with the ball let go at many times."""
    model = throwing.ThrowingMO().model
    names = [model.actuator(index).name for index in throwing.ThrowingMO()._body]
    actions = {name.removesuffix("_joint"): index for index, name in enumerate(names)}
    rng = np.random.default_rng(0)
    time = np.arange(throwing.EPISODE_STEPS)[:, None] * throwing.DT

    def plan(open_after: float, **held: float) -> Array:
        """Hold some actions all the time, and open the hand after some seconds."""
        planned = np.zeros((throwing.EPISODE_STEPS, 24))
        for name, value in held.items():
            planned[:, actions[name]] = value
        planned[round(open_after / throwing.DT) :, -1] = -1
        return planned

    motions = []
    for amplitude in np.geomspace(0.05, 2, 10):
        swing = np.zeros((throwing.EPISODE_STEPS, 24))
        swing[:, :-1] = amplitude * np.sin(2 * np.pi * (2 * time + rng.random(23)))
        motions.append(
            Motion(f"swing all joints at 2 Hz by {amplitude / 2:.2f} rad", None, None, swing)
        )
    for seconds in np.arange(0, 1.2, 0.1):
        what = f"hold the first pose, open the hand after {seconds:.1f} s"
        motions.append(Motion(what, None, None, plan(seconds)))
        for lean in (-2, 2):
            both = {
                f"{side}_{joint}": lean
                for side in ("left", "right")
                for joint in ("ankle_pitch", "hip_pitch")
            }
            what = f"fall {'forward' if lean > 0 else 'back'}, open the hand after {seconds:.1f} s"
            motions.append(Motion(what, None, None, plan(seconds, **both)))
    for pitch in range(-5, 6, 2):
        for elbow in (-2, 0, 2):
            for spread in (-1, 2):
                arms = {"left_shoulder_pitch": pitch, "right_shoulder_pitch": pitch}
                arms |= {"left_elbow_pitch": elbow, "right_elbow_pitch": elbow}
                arms |= {"left_shoulder_roll": spread, "right_shoulder_roll": -spread}
                what = (
                    f"arms to shoulder pitch {pitch / 2:+.1f}, roll {spread / 2:+.1f}, elbow "
                    f"{elbow / 2:+.1f} rad, "
                )
                motions.append(
                    Motion(what + "open the hand after 0.3 s", None, None, plan(0.3, **arms))
                )
    return motions


def planar_motions(name: str) -> list[Motion]:
    """From the start of an episode: torques that stay, swinging joints, a walker on one leg, and a
    cheetah that sits.

    :param name: a key of ``LEGS``
    """
    legs = LEGS[name]
    n_actions = 3 * len(legs)
    n_steps = one_second(PLANAR[name]())
    rng = np.random.default_rng(0)

    def hold(*torques: tuple[float, ...]) -> Array:
        """The same torques of hip, knee and ankle in each step, for each leg."""
        actions = np.zeros((n_steps, n_actions))
        for leg, torque in zip(legs, torques, strict=True):
            actions[:, leg] = torque
        return actions

    motions = []
    for torque in product((-1, 0, 0.3, 1), repeat=3):
        hip, knee, ankle = (round(100 * part) for part in torque)
        what = f"hip at {hip} %, knee at {knee} %, ankle at {ankle} % of the torque"
        motions.append(Motion(what, None, None, hold(*[torque] * len(legs))))
    time = np.linspace(0, 1, n_steps, endpoint=False)[:, None]
    for amplitude, frequency in product((0.1, 0.2, 0.3, 0.5, 0.7, 1), (1, 2, 3, 4)):
        swing = amplitude * np.sin(2 * np.pi * (frequency * time + rng.random(n_actions)))
        what = f"swing all joints at {frequency} Hz with {100 * amplitude:.0f} % of the torque"
        motions.append(Motion(what, None, None, swing))
    if name == "Walker2dMO":
        for lifted, standing in product((0, 1), repeat=2):
            actions = hold((1, -1, lifted), (1, 1, standing))
            what = f"stand on one leg, ankles at {100 * standing} % and {100 * lifted} %"
            motions.append(Motion(what, None, None, actions))
    if name == "HalfCheetahMO":
        actions = hold((1, 1, 1), (0, 1, 1))
        motions.append(Motion("sit on the rear leg, front leg stretched", None, None, actions))
    return motions


def one_second(task: Task) -> int:
    """Control steps in a second.

    :param task: any
    """
    return round(1 / task.dt)


PLANAR: dict[str, type[planar_mo.PlanarMO]] = {
    "Walker2dMO": planar_mo.Walker2dMO,
    "HopperMO": planar_mo.HopperMO,
    "HalfCheetahMO": planar_mo.HalfCheetahMO,
}
UNITS = {"energy": "W", "gait": "m", "baseh": "m", "armsp": "m"}
UNITS |= {"ballrel": "s", "bodymo": "m/s", "lftarm": "m", "rgtarm": "m"}
UNITS |= {"lean": "rad", "knee": "rad"}


@dataclass
class Trial:
    """What is tried on a task.

    :param make: the task, with an index for each objective
    :param ranges: all ranges by objective
    :param motions: what to try
    :param n_steps: control steps
    """

    make: Callable[..., Task]
    ranges: planar_mo.Ranges
    motions: list[Motion]
    n_steps: int


def trial(task: str) -> Trial:
    """What is tried on a task.

    :param task: "HumanoidMO", "ThrowingMO", or a key of ``PLANAR``
    """
    if task == "HumanoidMO":
        return Trial(humanoid.HumanoidMO, humanoid.RANGES, humanoid_motions(), 90)
    if task == "ThrowingMO":
        n_steps = throwing.EPISODE_STEPS
        return Trial(throwing.ThrowingMO, throwing.RANGES, throwing_motions(), n_steps)
    make = PLANAR[task]
    return Trial(make, make.all_ranges, planar_motions(task), one_second(make()))


def table(task: str) -> list[tuple[str, str, float, str]]:
    """Objective, range, pay and motion for each range of a task.

    :param task: "HumanoidMO", "ThrowingMO", or a key of ``PLANAR``
    """
    tried = trial(task)
    found = []
    for index in range(5):
        built = tried.make(**dict.fromkeys(tried.ranges, index))
        paid = pays(built, tried.motions, tried.n_steps)
        for name, bounds in tried.ranges.items():
            column = paid[:, built.reward_spec.names.index(f"{name}_range")]
            best = int(np.argmax(column))
            low, high = bounds[index]
            found.append(
                (
                    name,
                    f"{low:g} to {high:g} {UNITS[name]}",
                    float(column[best]),
                    tried.motions[best].what,
                )
            )
    return sorted(found, key=lambda row: list(tried.ranges).index(row[0]))


if __name__ == "__main__":
    for task_name in ("HumanoidMO", "ThrowingMO", *PLANAR):
        print(f"\n{task_name}\n\n| objective | range | paid | by |\n|---|---|---|---|")
        for objective, bounds, pay, what in table(task_name):
            print(f"| `{objective}` | {bounds} | {pay:.3g} | {what} |")
