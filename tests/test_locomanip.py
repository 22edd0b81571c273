"""The terms of LocoManip against numbers worked out by hand, its commands, and its G1."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco.batch")

from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.tasks import geometry, locomanip
from sb3_gcr.envs.tasks import locomanip_terms as terms
from sb3_gcr.envs.tasks.catalogue import TASKS

STILL = np.zeros((1, 22), np.float32)
WALK = np.array([[0.4, 0.3, 0.5]])
STAND = np.zeros((1, 3))


def started(n: int = 1) -> Engine:
    engine = Engine(locomanip.LocoManipG1(), n)
    for index in range(n):
        engine.seed(index, index)
    engine.reset(np.arange(n))
    return engine


def at(*rows: float) -> np.ndarray:
    return np.array([rows], dtype=float)


def test_names_are_those_of_the_paper_in_its_order() -> None:
    """Nine tasks, of which six are the hands'."""
    spec = locomanip.LocoManipG1().reward_spec
    assert len(spec) == 26
    assert spec.levels.count(0) == 9
    assert spec.names[:3] == ("termination_penalty", "track_lin_vel_xy_exp", "track_ang_vel_z_exp")
    assert spec.names[19] == "joint_vel_hip_yaw"
    assert spec.names[20:] == (
        "left_ee_pos_tracking",
        "left_ee_pos_tracking_fine_grained",
        "left_end_effector_orientation_tracking",
        "right_ee_pos_tracking",
        "right_ee_pos_tracking_fine_grained",
        "right_end_effector_orientation_tracking",
    )


def test_velocity_is_paid_by_its_error() -> None:
    """An error of 0.25 m²/s², or rad²/s², leaves 1/e."""
    np.testing.assert_allclose(terms.track_lin_vel_xy_exp(WALK, at(0.4, 0.3)), [0.02])
    np.testing.assert_allclose(terms.track_lin_vel_xy_exp(WALK, at(0.1, -0.1)), [0.02 / np.e])
    np.testing.assert_allclose(terms.track_ang_vel_z_exp(WALK, np.array([1.0])), [0.02 / np.e])


def test_falling_costs_2_once() -> None:
    np.testing.assert_allclose(terms.termination_penalty(np.array([True, False])), [-2, 0])


def test_steps_are_paid_on_one_leg_only() -> None:
    """0.25 per second and second: the shorter of the two times, at most 0.8 s."""
    assert terms.feet_air_time(WALK, at(0.4, 0), at(0, 0.6))[0] == pytest.approx(0.002)
    assert terms.feet_air_time(WALK, at(2, 0), at(0, 3))[0] == pytest.approx(0.004)
    assert terms.feet_air_time(WALK, at(0, 0), at(0.4, 0.6))[0] == 0
    assert terms.feet_air_time(WALK, at(0.4, 0.6), at(0, 0))[0] == 0
    assert terms.feet_air_time(STAND, at(0.4, 0), at(0, 0.6))[0] == 0


def test_feet_slide_on_the_ground_only() -> None:
    velocities = np.array([[[0.3, 0.4], [5.0, 0]]])
    np.testing.assert_allclose(terms.feet_slide(velocities, np.array([[True, False]])), [-0.0025])


def test_costs_of_effort_by_hand() -> None:
    np.testing.assert_allclose(terms.dof_torques_l2(at(30, 40)), [-5e-5])
    np.testing.assert_allclose(terms.dof_acc_l2(at(300, 400)), [-1e-3])
    np.testing.assert_allclose(terms.action_rate_l2(at(1, 2), at(0, -1)), [-1.6e-3])
    np.testing.assert_allclose(terms.joint_vel_hip_yaw(at(3, -4)), [-5e-4])


def test_costs_of_the_pelvis_by_hand() -> None:
    np.testing.assert_allclose(terms.flat_orientation_l2(at(0.6, 0, -0.8)), [-0.21 * 0.36])
    np.testing.assert_allclose(terms.lin_vel_z_l2(np.array([-0.5])), [-0.01])
    np.testing.assert_allclose(terms.ang_vel_xy_l2(at(3, 4)), [-0.05])


def test_costs_of_the_pose_by_hand() -> None:
    deviations = at(0.5, 0.25)
    np.testing.assert_allclose(terms.joint_deviation_hip_roll(deviations), [-1.5e-3])
    np.testing.assert_allclose(terms.joint_deviation_hip_yaw(deviations), [-3e-3])
    np.testing.assert_allclose(terms.joint_deviation_knee(deviations), [-3e-3])
    np.testing.assert_allclose(terms.joint_deviation_feet(deviations), [-1.5e-3])
    np.testing.assert_allclose(terms.dof_pos_limits(deviations), [-0.015])
    np.testing.assert_allclose(terms.stand_still(STAND, deviations), [-6e-3])
    np.testing.assert_allclose(terms.stand_still(WALK, deviations), [0])


def test_contacts_by_hand() -> None:
    np.testing.assert_allclose(terms.no_jumps(np.array([[0, 0], [0, 0.1]])), [-0.01, 0])
    np.testing.assert_allclose(terms.undesired_contacts(np.array([[True, True]])), [-0.004])


def test_hands_by_hand() -> None:
    """tanh(ln 3) = 0.8."""
    distance = np.array([0, 0.05 * np.log(3), 1.0])
    np.testing.assert_allclose(terms.ee_pos_tracking(distance), -0.04 * distance)
    np.testing.assert_allclose(
        terms.ee_pos_tracking_fine_grained(distance), [0.04, 0.008, 0], atol=1e-12
    )
    np.testing.assert_allclose(terms.end_effector_orientation_tracking(np.array([0.5])), [-2e-3])


def test_body_is_the_g1_without_ball() -> None:
    task = locomanip.LocoManipG1()
    model = task.model
    assert (model.nq, model.nv, model.nu, model.nmocap) == (29, 28, 22, 2)
    assert float(model.body("pelvis").subtreemass[0]) == pytest.approx(32.239, abs=1e-3)
    names = [model.actuator(index).name for index in range(22)]
    assert names == [model.joint(index + 1).name for index in range(22)]
    assert all("hip" in name or "knee" in name or "ankle" in name for name in names[task._legs])
    by_name = dict(zip(names, task._default, strict=True))
    assert by_name["left_knee_joint"] == 0.42
    assert by_name["right_ankle_pitch_joint"] == -0.17
    assert by_name["left_shoulder_roll_joint"] == pytest.approx(0.4)
    assert by_name["right_shoulder_roll_joint"] == pytest.approx(-0.4)
    ankle = model.actuator("left_ankle_roll_joint")
    assert ankle.gainprm[0] == -ankle.biasprm[1] == 150
    assert ankle.forcerange.tolist() == [-40, 40]
    assert TASKS["LocoManipG1"][1] * task.dt == pytest.approx(14)


def test_it_stands_by_itself_and_is_seen_to_stand() -> None:
    engine = started(2)
    for _ in range(100):
        step = engine.step(np.repeat(STILL, 2, 0))
    rows = engine.rows
    assert not step.terminated.any()
    assert (rows.contact_time > 1).all()
    assert not rows.air_time.any()
    np.testing.assert_allclose(rows.sensordata[:, engine.task._foot_velocities], 0, atol=0.02)  # type: ignore[attr-defined]


def test_feet_in_the_air_are_timed() -> None:
    engine = started()
    engine.rows.qpos[0, 2] += 0.3
    for _ in range(5):
        step = engine.step(STILL)
    names = engine.task.reward_spec.names
    np.testing.assert_allclose(engine.rows.air_time[0], 0.1)
    assert step.components[0, names.index("no_jumps")] == pytest.approx(-0.01)


@pytest.mark.parametrize(("tilt", "falls"), [(0.69, False), (0.71, True)])
def test_it_has_fallen_when_it_leans(tilt: float, falls: bool) -> None:
    engine = started()
    engine.rows.qpos[0, 3:7] = geometry.from_euler(*np.array([0.0, tilt, 1.0]))
    assert engine.task.terminated(engine.rows)[0] == falls


def test_torso_on_the_ground_is_a_fall() -> None:
    engine = started()
    engine.rows.qpos[0, 2] = 0.3
    engine.rows.qpos[0, 7 + 3] = engine.rows.qpos[0, 7 + 9] = 2.4  # knees
    engine.rows.qpos[0, 7] = engine.rows.qpos[0, 7 + 6] = -1.2  # hips
    for _ in range(60):
        step = engine.step(STILL)
        if step.terminated[0]:
            break
    assert step.terminated[0]
    assert step.components[0, 0] == -2


def test_command_turns_towards_the_heading() -> None:
    """Half of the angle a second, at most 1 rad/s; nothing while it is to stand."""
    engine = started()
    rows, task = engine.rows, engine.task
    rows.qpos[0, 3:7] = geometry.from_euler(*np.array([0.0, 0, 1.0]))
    rows.velocities[0, 0] = [0.5, -0.25, 1.8, 0]
    np.testing.assert_allclose(task.command(rows), [[0.5, -0.25, 0.4]])  # type: ignore[attr-defined]
    rows.velocities[0, 0, 2] = -1.9  # 2.9 rad to the right
    np.testing.assert_allclose(task.command(rows), [[0.5, -0.25, -1]])  # type: ignore[attr-defined]
    rows.velocities[0, 0, 3] = 1
    np.testing.assert_allclose(task.command(rows), [[0, 0, 0]])  # type: ignore[attr-defined]


def test_commands_last_as_long_as_they_should() -> None:
    task = locomanip.LocoManipG1()
    starts = [task.start(np.random.default_rng(seed)) for seed in range(200)]
    for name, low, high in (("velocities_until", 150, 400), ("poses_until", 50, 150)):
        until = np.array([start[name] for start in starts])
        durations = np.diff(until, prepend=0, axis=-1)
        assert durations.min() == low
        assert durations.max() == high
        assert until[..., -1].min() >= 700  # one is there in every step of 14 s
    velocities = np.concatenate([start["velocities"] for start in starts])
    np.testing.assert_allclose(np.abs(velocities).max(0), [0.8, 0.5, np.pi, 1], rtol=0.01)
    assert velocities[:, 3].mean() == pytest.approx(0.1, abs=0.04)


def test_a_command_changes_at_its_step() -> None:
    commands = np.arange(6.0).reshape(2, 3, 1)
    until = np.array([[10, 20, 30], [5, 15, 16]])
    for step, expected in ((0, [0, 3]), (9, [0, 4]), (10, [1, 4]), (16, [1, 5]), (99, [2, 5])):
        found = locomanip.current(commands, until, np.full(2, step))
        np.testing.assert_array_equal(found[:, 0], expected)


def test_hands_are_paid_at_the_pose_of_a_reachable_goal() -> None:
    """The joints that a goal was drawn with bring the palm to it, on both sides; each is seen from
    the pelvis.
    """
    engine = started()
    rows, task = engine.rows, engine.task
    rows.qpos[0, 3:7] = geometry.from_euler(*np.array([0.2, -0.1, 2.0]))
    arms = np.array(task._arms).reshape(2, 5)  # type: ignore[attr-defined]
    joints = np.array([-0.6, 0.4, 0.2, 0.7, -0.3])
    rows.qpos[0, 7 + arms[0]] = joints
    rows.qpos[0, 7 + arms[1]] = joints * [1, -1, -1, 1, -1]
    engine.batch.forward(np.array([0]))
    pelvis, quaternion = rows.qpos[:, :3], rows.qpos[:, 3:7]
    palm = task.model.site("left_palm").id
    seen = geometry.into_frame(quaternion, rows.site_xpos[:, palm] - pelvis)[0]
    back = quaternion * [1, -1, -1, -1]
    attitude = geometry.compose(back, rows.xquat[:, task._hands[0]])[0]  # type: ignore[attr-defined]
    rows.poses[0, 0] = np.append(seen, attitude)
    # the mirror image: y of the position, x and z of the turn
    rows.poses[0, 1] = np.append(seen * [1, -1, 1], attitude * [1, -1, 1, -1])
    rows.time_step[:] = 1
    paid = np.array(task.rewards(rows))[20:, 0]
    np.testing.assert_allclose(paid, [0, 0.04, 0, 0, 0.04, 0], atol=1e-6)


def test_goals_lie_in_front_on_their_own_side() -> None:
    task = locomanip.LocoManipG1()
    poses = np.concatenate(
        [task.start(np.random.default_rng(seed))["poses"] for seed in range(100)], axis=1
    )
    np.testing.assert_allclose(
        poses[:, :, :3].mean(1), [[0.22, 0.25, 0.08], [0.22, -0.25, 0.08]], atol=0.02
    )
    assert (poses[0, :, 1] > -0.05).all()
    assert (poses[1, :, 1] < 0.05).all()
    np.testing.assert_allclose(np.linalg.norm(poses[:, :, 3:], axis=2), 1)


def test_observation_has_92_entries() -> None:
    engine = started(3)
    actions = np.linspace(-1, 1, 22, dtype=np.float32)[None].repeat(3, 0)
    seen = engine.step(actions).observations
    assert seen.shape == (3, 92)
    task, rows = engine.task, engine.rows
    np.testing.assert_allclose(seen[:, 9:12], task.command(rows), atol=1e-6)  # type: ignore[attr-defined]
    np.testing.assert_allclose(seen[:, 12:19], rows.poses[:, 0, 0], atol=1e-6)
    np.testing.assert_allclose(seen[:, 19:26], rows.poses[:, 1, 0], atol=1e-6)
    np.testing.assert_allclose(seen[:, 26:48], rows.qpos[:, 7:] - task._default, atol=1e-6)  # type: ignore[attr-defined]
    np.testing.assert_allclose(seen[:, 70:], actions)


def test_velocity_is_seen_from_above() -> None:
    engine = started()
    engine.rows.qpos[0, 3:7] = geometry.from_euler(*np.array([0.1, 0.3, np.pi / 2]))
    engine.rows.qvel[0, :3] = [1, 2, 3]
    np.testing.assert_allclose(engine.task.planar_velocity(engine.rows), [[2, -1]], atol=1e-12)  # type: ignore[attr-defined]


def test_goals_are_shown_where_they_are() -> None:
    engine = started()
    rows = engine.rows
    before = rows.qpos.copy()
    engine.step(STILL)
    expected = before[:, :3] + geometry.into_world(before[:, 3:7], rows.poses[:, 1, 0, :3])
    np.testing.assert_allclose(rows.mocap_pos[:, 1], expected)
