"""The G1 of LocoManip: that of ThrowingMO with stiff waist and fingers, without ball."""

from __future__ import annotations

from importlib.resources import files

import mujoco
import numpy as np

from sb3_gcr.envs.task import Array

SIDES = ("left", "right")
LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow_pitch", "elbow_roll")
#: Joint positions of the left arm at which the hand's goals lie [rad], in the order of ARM; the
#: right arm's are mirrored. Their middle is the arms' default pose.
GOAL_JOINTS = np.array([(-0.9, 0.3), (0.1, 0.7), (-0.4, 0.4), (0.0, 1.1), (-0.5, 0.5)])
#: Which of them change their sign on the right.
MIRRORED = np.array([1, -1, -1, 1, -1])
#: Pitch of the ankles in the default pose [rad]; with the G1's own, -0.23, the arms in front of it
#: make it fall.
ANKLE_PITCH = -0.17
#: Gains of the ankles' servos: those of the hips [N m/rad], [N m s/rad]; the robot's torque [N m].
ANKLE_STIFFNESS, ANKLE_DAMPING, ANKLE_TORQUE = 150.0, 5.0, 40.0
#: Bodies whose contact with the floor is felt, beside the feet.
FELT = ("pelvis", "torso_link", "head", "left_knee_link", "right_knee_link")
#: Colours of the axes of a goal, and half of their length and width [m].
AXES = np.array([(0.9, 0.1, 0.1, 0.8), (0.1, 0.7, 0.1, 0.8), (0.1, 0.2, 0.9, 0.8)])
AXIS_LENGTH, AXIS_WIDTH = 0.04, 0.004


def locomanip_model() -> tuple[mujoco.MjModel, Array]:
    """The model, and the default positions of its 22 joints [rad]."""
    spec = mujoco.MjSpec.from_file(str(files("sb3_gcr.envs") / "assets/g1.xml"))
    moving = {f"{side}_{name}_joint" for side in SIDES for name in LEG + ARM}
    default = _default_positions(spec, moving)
    _stiffen(spec, moving)
    _strengthen_ankles(spec)
    _feel(spec)
    for side in SIDES:
        _add_goal(spec, f"{side}_goal")
    return spec.compile(), default


def _default_positions(spec: mujoco.MjSpec, moving: set[str]) -> Array:
    """Those of the keyframe for the legs, but for the ankles, and the middle of the goals for the
    arms; in the order of the actuators.
    """
    model = spec.compile()
    qpos = model.key("default").qpos
    names = [model.actuator(index).name for index in range(model.nu)]
    names = [name for name in names if name in moving]
    default = np.array([qpos[model.joint(name).qposadr[0]] for name in names])
    default[["ankle_pitch" in name for name in names]] = ANKLE_PITCH
    middle = GOAL_JOINTS.mean(1)
    default[-2 * len(ARM) :] = np.concatenate([middle, MIRRORED * middle])
    return default


def _stiffen(spec: mujoco.MjSpec, moving: set[str]) -> None:
    """Take the ball away, and all joints but those of legs and arms."""
    for element in [*spec.keys, *spec.equalities]:
        spec.delete(element)
    for actuator in list(spec.actuators):
        if actuator.name not in moving:
            spec.delete(actuator)
    for joint in list(spec.joints):
        if joint.name not in moving and joint.name != "floating_base_joint":
            spec.delete(joint)
    for name in ("ball", "target"):
        spec.delete(spec.body(name))


def _strengthen_ankles(spec: mujoco.MjSpec) -> None:
    """Let the ankles carry the robot: with 20 N m/rad it falls at once, whatever it wants."""
    for joint in spec.joints:
        if "ankle" in joint.name:
            joint.damping[0] = ANKLE_DAMPING
    for actuator in spec.actuators:
        if "ankle" in actuator.name:
            actuator.gainprm[0] = ANKLE_STIFFNESS
            actuator.biasprm[1] = -ANKLE_STIFFNESS
            actuator.forcerange = [-ANKLE_TORQUE, ANKLE_TORQUE]


def _feel(spec: mujoco.MjSpec) -> None:
    """Keep the sensors of ``FELT``, and add contact and velocity of each foot."""
    contact = spec.sensor("touch_pelvis")
    for side in SIDES:
        spec.add_sensor(
            name=f"touch_{side}_foot",
            objname=f"{side}_ankle_roll_link",
            type=contact.type,
            objtype=contact.objtype,
            intprm=contact.intprm,
            datatype=contact.datatype,
            needstage=contact.needstage,
        )
        spec.add_sensor(
            name=f"velocity_{side}_foot",
            objname=f"{side}_ankle_roll_link",
            type=mujoco.mjtSensor.mjSENS_FRAMELINVEL,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,
        )
    for sensor in list(spec.sensors):
        is_foot = sensor.name.endswith("_foot")
        if not is_foot and sensor.name.removeprefix("touch_") not in FELT:
            spec.delete(sensor)


def _add_goal(spec: mujoco.MjSpec, name: str) -> None:
    """Three coloured axes that show where a hand has to go."""
    goal = spec.worldbody.add_body(name=name, mocap=True)
    for axis, colour in enumerate(AXES):
        size = np.full(3, AXIS_WIDTH)
        size[axis] = AXIS_LENGTH
        goal.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=AXIS_LENGTH * np.eye(3)[axis],
            size=size,
            rgba=colour,
            contype=0,
            conaffinity=0,
        )
