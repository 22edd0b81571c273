"""The robot of Throwing-MO: its numbers, and that it stands, falls, holds a ball and lets it go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sb3_gcr

pytest.importorskip("mujoco.batch")
mujoco = pytest.importorskip("mujoco")

PATH = Path(sb3_gcr.__file__).parent / "envs" / "assets" / "g1.xml"
MODEL = mujoco.MjModel.from_xml_path(str(PATH))
SUBSTEPS = 4

LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow_pitch", "elbow_roll")
FINGERS = ("zero", "one", "two", "three", "four", "five", "six")
JOINTS = [
    *(f"{side}_{name}_joint" for side in ("left", "right") for name in LEG),
    "torso_joint",
    *(f"{side}_{name}_joint" for side in ("left", "right") for name in ARM + FINGERS),
]


def start(keyframe: str = "default") -> Any:
    data = mujoco.MjData(MODEL)
    mujoco.mj_resetDataKeyframe(MODEL, data, MODEL.key(keyframe).id)
    mujoco.mj_forward(MODEL, data)
    return data


def simulate(data: Any, seconds: float) -> Any:
    mujoco.mj_step(MODEL, data, round(seconds / MODEL.opt.timestep))
    return data


def touched(data: Any) -> set[str]:
    names = {
        MODEL.sensor(index).name for index in range(MODEL.nsensor) if data.sensor(index).data[0] > 0
    }
    return {name.removeprefix("touch_") for name in names}


def is_robots(geom: int) -> bool:
    return bool(MODEL.body_rootid[MODEL.geom_bodyid[geom]] == MODEL.body("pelvis").id)


def grip_error(data: Any) -> float:
    return float(np.linalg.norm(data.site("ball").xpos - data.site("right_grip").xpos))


def test_it_has_a_robot_a_ball_and_a_target() -> None:
    assert (MODEL.nq, MODEL.nv, MODEL.nu, MODEL.nmocap) == (7 + 37 + 7, 6 + 37 + 6, 37, 1)
    assert MODEL.body("pelvis").subtreemass == pytest.approx(32.239, abs=0.001)
    assert MODEL.body("ball").mass == pytest.approx(0.085)
    assert MODEL.geom("ball").size[0] == 0.023
    assert MODEL.body("target").mocapid[0] == 0


def test_it_keeps_the_notice_of_whom_the_numbers_come_from() -> None:
    assert (
        'Copyright (c) 2016-2023 HangZhou YuShu TECHNOLOGY CO.,LTD. ("Unitree Robotics")'
        in PATH.read_text()
    )


def test_joints_and_actuators_have_the_same_names_in_the_same_order() -> None:
    assert [MODEL.joint(index).name for index in range(MODEL.njnt)] == [
        "floating_base_joint",
        *JOINTS,
        "ball_joint",
    ]
    assert [MODEL.actuator(index).name for index in range(MODEL.nu)] == JOINTS
    np.testing.assert_array_equal(MODEL.actuator_trnid[:, 0], np.arange(1, 38))


@pytest.mark.parametrize(
    ("name", "parent", "position", "mass", "inertia"),
    [
        ("pelvis", "world", (0, 0, 0.755), 2.86, (0.0079143, 0.0069837, 0.0059404)),
        (
            "left_hip_pitch_link",
            "pelvis",
            (0, 0.06445, -0.1027),
            1.299,
            (0.00138785, 0.000955478, 0.00086947),
        ),
        (
            "right_knee_link",
            "right_hip_yaw_link",
            (-0.078292, 0.0017335, -0.177225),
            2.252,
            (0.0127418, 0.0124382, 0.00192524),
        ),
        (
            "left_ankle_roll_link",
            "left_ankle_pitch_link",
            (0, 0, -0.017558),
            0.391,
            (0.00110394, 0.0010657, 0.000149255),
        ),
        ("torso_link", "pelvis", (0, 0, 0), 7.52036, (0.12848, 0.111753, 0.0350394)),
        (
            "right_elbow_roll_link",
            "right_elbow_pitch_link",
            (0.1, 0, 0),
            0.50826,
            (0.00239763, 0.00226639, 0.000285577),
        ),
        (
            "right_two_link",
            "right_one_link",
            (0, 0.0431, 0),
            0.0138584,
            (2.55338e-06, 2.04399e-06, 9.3995e-07),
        ),
    ],
)
def test_bodies_weigh_and_sit_where_the_source_says(
    name: str, parent: str, position: Any, mass: float, inertia: Any
) -> None:
    body = MODEL.body(name)
    assert MODEL.body(body.parentid[0]).name == parent
    np.testing.assert_allclose(body.pos, position)
    np.testing.assert_allclose(body.mass, mass)
    np.testing.assert_allclose(body.inertia, inertia)


@pytest.mark.parametrize(
    ("name", "limits", "armature", "stiffness", "damping", "effort"),
    [
        ("left_hip_pitch", (-2.35, 3.05), 0.01, 200, 5, 300),
        ("left_hip_roll", (-0.26, 2.53), 0.01, 150, 5, 300),
        ("right_hip_roll", (-2.53, 0.26), 0.01, 150, 5, 300),
        ("right_hip_yaw", (-2.75, 2.75), 0.01, 150, 5, 300),
        ("left_knee", (-0.33489, 2.5449), 0.01, 200, 5, 300),
        ("right_ankle_pitch", (-0.68, 0.73), 0.01, 20, 2, 20),
        ("left_ankle_roll", (-0.2618, 0.2618), 0.01, 20, 2, 20),
        ("torso", (-2.618, 2.618), 0.01, 200, 5, 300),
        ("right_shoulder_pitch", (-2.9671, 2.7925), 0.01, 40, 10, 300),
        ("right_shoulder_roll", (-2.2515, 1.5882), 0.01, 40, 10, 300),
        ("left_elbow_pitch", (-0.2268, 3.4208), 0.01, 40, 10, 300),
        ("left_elbow_roll", (-2.0943, 2.0943), 0.01, 40, 10, 300),
        ("left_zero", (-0.523598, 0.523598), 0.001, 40, 10, 300),
        ("left_one", (-1, 1.2), 0.001, 40, 10, 300),
        ("right_two", (-1.84, 0), 0.001, 40, 10, 300),
        ("right_five", (-0.3, 1.84), 0.001, 40, 10, 300),
        ("left_six", (-1.84, 0), 0.001, 40, 10, 300),
    ],
)
def test_a_joint_has_the_limits_of_the_source_and_the_gains_of_isaaclab(
    name: str,
    limits: tuple[float, float],
    armature: float,
    stiffness: float,
    damping: float,
    effort: float,
) -> None:
    joint, actuator = MODEL.joint(f"{name}_joint"), MODEL.actuator(f"{name}_joint")
    np.testing.assert_array_equal(joint.range, limits)
    assert joint.limited[0]
    assert (joint.armature[0], np.ravel(joint.damping)[0]) == (armature, damping)
    np.testing.assert_array_equal(actuator.gainprm[:1], stiffness)
    np.testing.assert_array_equal(actuator.biasprm[:3], (0, -stiffness, 0))
    np.testing.assert_array_equal(actuator.forcerange, (-effort, effort))
    assert not actuator.ctrllimited[0]


def test_left_and_right_mirror_each_other() -> None:
    across = np.array([1, -1, 1])
    for name in ["hip_pitch", *LEG[1:], *ARM, *FINGERS]:
        left, right = MODEL.body(f"left_{name}_link"), MODEL.body(f"right_{name}_link")
        np.testing.assert_allclose(left.pos * across, right.pos)
        np.testing.assert_allclose(left.ipos * across, right.ipos)
        np.testing.assert_allclose(left.inertia, right.inertia)
        n_geoms = left.geomnum[0]
        assert right.geomnum[0] == n_geoms
        of_left, of_right = (
            slice(body.geomadr[0], body.geomadr[0] + n_geoms) for body in (left, right)
        )
        np.testing.assert_allclose(
            MODEL.geom_pos[of_left] * across, MODEL.geom_pos[of_right], atol=1e-9
        )
        np.testing.assert_allclose(MODEL.geom_size[of_left], MODEL.geom_size[of_right])
        np.testing.assert_array_equal(MODEL.geom_contype[of_left], MODEL.geom_contype[of_right])
        limits = MODEL.joint(f"left_{name}_joint").range, MODEL.joint(f"right_{name}_joint").range
        is_pitch = MODEL.joint(f"left_{name}_joint").axis[1] == 1
        np.testing.assert_allclose(limits[0], limits[1] if is_pitch else -limits[1][::-1])


@pytest.mark.parametrize(
    ("keyframe", "pelvis", "hip", "sole"),
    [("default", 0.74, 0.637, 0.022), ("stand", 0.718, 0.615, 0)],
)
def test_it_stands_as_high_as_the_source(
    keyframe: str, pelvis: float, hip: float, sole: float
) -> None:
    data = start(keyframe)
    soles = [
        data.geom(geom).xpos[2] - MODEL.geom(geom).size[0]
        for geom in range(MODEL.ngeom)
        if "ankle_roll" in MODEL.body(MODEL.geom_bodyid[geom]).name and MODEL.geom_contype[geom]
    ]
    assert len(soles) == 8
    assert min(soles) == pytest.approx(sole, abs=2e-4)
    assert data.body("pelvis").xpos[2] == pytest.approx(pelvis, abs=5e-4)
    assert data.body("left_hip_pitch_link").xpos[2] == pytest.approx(hip, abs=5e-4)
    assert data.site("left_palm").xpos[2] == pytest.approx(
        0.638 - 0.74 + data.body("pelvis").xpos[2], abs=5e-4
    )


@pytest.mark.parametrize("keyframe", ["default", "stand"])
def test_keyframes_are_the_default_pose_and_ask_for_it(keyframe: str) -> None:
    pose = {name: 0.0 for name in JOINTS}
    for side, sign in (("left", 1), ("right", -1)):
        pose |= {
            f"{side}_hip_pitch_joint": -0.2,
            f"{side}_knee_joint": 0.42,
            f"{side}_ankle_pitch_joint": -0.23,
        }
        pose |= {f"{side}_shoulder_pitch_joint": 0.35, f"{side}_shoulder_roll_joint": 0.16 * sign}
        pose |= {
            f"{side}_elbow_pitch_joint": 0.87,
            f"{side}_one_joint": 1.0 * sign,
            f"{side}_two_joint": 0.52 * sign,
        }
    np.testing.assert_array_equal(MODEL.key(keyframe).qpos[7:44], list(pose.values()))
    np.testing.assert_array_equal(MODEL.key(keyframe).ctrl, list(pose.values()))


def test_nothing_but_the_floor_can_be_touched() -> None:
    floor = MODEL.geom("floor").id
    collides = (MODEL.geom_contype[:, None] & MODEL.geom_conaffinity) > 0
    collides |= collides.T
    collides[floor] = collides[:, floor] = False
    assert not collides.any()
    assert MODEL.geom("ball").contype[0]
    assert not MODEL.geom("target").contype[0]


def test_robot_slides_with_isaaclabs_friction() -> None:
    data = simulate(start(), 0.3)
    contacts = [contact for contact in data.contact if is_robots(contact.geom[1])]
    assert len(contacts) == 8
    assert {contact.friction[0] for contact in contacts} == {0.8}


def test_holding_the_default_pose_it_sinks_and_falls_within_two_seconds() -> None:
    data = simulate(start(), 0.5)
    assert 0.65 < data.qpos[2] < 0.72
    assert not touched(data)
    assert simulate(data, 1.5).qpos[2] < 0.2


def test_a_body_knows_whether_it_touches_the_floor() -> None:
    assert not touched(start("stand"))
    data = start()
    seen: set[str] = set()
    for _ in range(80):
        simulate(data, 0.025)
        mujoco.mj_forward(MODEL, data)
        geoms = {int(contact.geom[1]) for contact in data.contact if is_robots(contact.geom[1])}
        expected = {MODEL.body(MODEL.geom_bodyid[geom]).name for geom in geoms}
        expected = {name for name in expected if "ankle" not in name}
        for side in ("left", "right"):
            if (
                f"{side}_elbow_roll_link" in expected
                and MODEL.geom(f"{side}_forearm").id not in geoms
            ):
                expected.remove(f"{side}_elbow_roll_link")
            expected |= {f"{side}_palm"} if MODEL.geom(f"{side}_palm").id in geoms else set()
        expected |= {"head"} if MODEL.geom("head").id in geoms else set()
        assert touched(data) == expected
        seen |= expected
    assert len(seen) > 5


def test_every_body_that_can_touch_the_floor_and_is_no_foot_has_a_sensor() -> None:
    can_touch = {
        MODEL.body(MODEL.geom_bodyid[g]).name
        for g in range(MODEL.ngeom)
        if is_robots(g) and MODEL.geom_contype[g]
    }
    feet = {"left_ankle_roll_link", "right_ankle_roll_link"}
    sensors = {MODEL.sensor(index).name.removeprefix("touch_") for index in range(MODEL.nsensor)}
    assert sensors == can_touch - feet | {"head", "left_palm", "right_palm"}


@pytest.mark.parametrize("keyframe", ["default", "stand"])
def test_ball_starts_in_the_right_hand(keyframe: str) -> None:
    data = start(keyframe)
    assert grip_error(data) < 1e-4
    ball = data.body("ball").xpos
    assert np.linalg.norm(ball - data.site("right_palm").xpos) == pytest.approx(0.109, abs=1e-3)
    assert np.linalg.norm(ball - data.body("right_two_link").xpos) == pytest.approx(0.056, abs=1e-3)
    fingers = [data.body(f"right_{name}_link").xpos for name in ("two", "four", "six")]
    np.testing.assert_allclose(ball, np.mean(fingers, axis=0), atol=2e-4)


def test_grip_holds_the_ball_while_the_arm_swings_and_lets_it_go() -> None:
    data = start()
    shoulder = MODEL.actuator("right_shoulder_pitch_joint").id
    for _ in range(20):
        data.ctrl[shoulder] = -1.5 if data.time < 0.5 else 1.0
        simulate(data, 0.05)
        mujoco.mj_kinematics(MODEL, data)
        assert grip_error(data) < 0.002
    data.eq_active[MODEL.equality("grip").id] = 0
    height, rise = data.joint("ball_joint").qpos[2], data.joint("ball_joint").qvel[2]
    simulate(data, 0.1)
    assert grip_error(data) > 0.03
    assert data.joint("ball_joint").qpos[2] == pytest.approx(
        height + 0.1 * rise - 9.81 * 0.1**2 / 2, abs=0.005
    )


def test_random_actions_keep_it_finite() -> None:
    batch = pytest.importorskip("mujoco.batch").Batch(MODEL, 64, 2)
    rng = np.random.default_rng(0)
    batch.reset(keyframe=MODEL.key("default").id)
    for _ in range(50):
        batch.ctrl = MODEL.key("default").ctrl + rng.uniform(-0.5, 0.5, (64, MODEL.nu))
        batch.step(nstep=SUBSTEPS)
    assert not np.asarray(batch.warning).any()
    assert np.isfinite(batch.qpos).all()
    assert np.abs(batch.qvel[:, 6:43]).max() < 60
