"""The terms of the Reach tasks against numbers worked out by hand, and the arms against their
Denavit-Hartenberg parameters.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

pytest.importorskip("mujoco.batch")

from sb3_gcr import GCRPPO
from sb3_gcr.envs import BatchedVecEnv
from sb3_gcr.envs.curriculum import WeightCurriculum
from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.tasks import geometry, reach
from sb3_gcr.envs.tasks.catalogue import TASKS, make_task

ARMS = ("ReachFranka", "ReachUR10")
#: a, d and α of each joint, from the manufacturers' data sheets.
PANDA = [
    (0, 0.333, 0),
    (0, 0, -np.pi / 2),
    (0, 0.316, np.pi / 2),
    (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0, 0, np.pi / 2),
    (0.088, 0, np.pi / 2),
]
UR10 = [
    (0, 0.1273, np.pi / 2),
    (-0.612, 0, 0),
    (-0.5723, 0, 0),
    (0, 0.163941, np.pi / 2),
    (0, 0.1157, -np.pi / 2),
    (0, 0.0922, 0),
]


def turn(axis: str, angle: float) -> np.ndarray:
    """A homogeneous matrix of a turn."""
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(4)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[first, second], matrix[second, first] = -np.sin(angle), np.sin(angle)
    return matrix


def shift(x: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3], matrix[2, 3] = x, z
    return matrix


def panda_hand(angles: np.ndarray) -> np.ndarray:
    """Craig's convention; the hand is turned by -45° at the flange, 0.107 m away."""
    pose = np.eye(4)
    for (a, d, alpha), angle in zip(PANDA, angles, strict=True):
        pose = pose @ turn("x", alpha) @ shift(a, 0) @ turn("z", angle) @ shift(0, d)
    return pose @ shift(0, 0.107) @ turn("z", -np.pi / 4)


def ur10_hand(angles: np.ndarray) -> np.ndarray:
    """The classic convention, on a base that is turned by 180°; x is the tool's axis."""
    pose = turn("z", np.pi)
    for (a, d, alpha), angle in zip(UR10, angles, strict=True):
        pose = pose @ turn("z", angle) @ shift(a, d) @ turn("x", alpha)
    return pose @ turn("y", -np.pi / 2)


def started(name: str, n: int = 1) -> Engine:
    engine = Engine(make_task(name), n)
    for index in range(n):
        engine.seed(index, index)
    engine.reset(np.arange(n))
    return engine


@pytest.mark.parametrize(
    ("name", "kinematics"), [("ReachFranka", panda_hand), ("ReachUR10", ur10_hand)]
)
def test_hand_is_where_the_dh_parameters_put_it(name: str, kinematics: Any) -> None:
    model = make_task(name).model
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(50):
        data.qpos[:] = rng.uniform(*model.jnt_range.T)
        mujoco.mj_kinematics(model, data)
        expected = kinematics(data.qpos)
        np.testing.assert_allclose(data.body("hand").xpos, expected[:3, 3], atol=1e-9)
        np.testing.assert_allclose(
            data.body("hand").xmat.reshape(3, 3), expected[:3, :3], atol=1e-9
        )


@pytest.mark.parametrize(
    ("name", "mass", "stiffness", "damping", "forces"),
    [
        ("ReachFranka", 16.823, 80, 4, [87] * 4 + [12] * 3),
        ("ReachUR10", 28.435, 800, 40, [87] * 6),
    ],
)
def test_arm_has_the_masses_and_gains_of_the_source(
    name: str, mass: float, stiffness: float, damping: float, forces: list[float]
) -> None:
    model = make_task(name).model
    assert model.body_mass.sum() == pytest.approx(mass)
    np.testing.assert_array_equal(model.actuator_gainprm[:, 0], stiffness)
    np.testing.assert_array_equal(np.asarray(model.dof_damping).ravel(), damping)
    np.testing.assert_array_equal(model.actuator_forcerange[:, 1], forces)
    assert not model.geom_contype.any()


def test_tracking_terms_by_hand() -> None:
    """tanh(ln 3) = 0.8; all are per second, a step is 1/30 s."""
    distance = np.array([0, 0.1 * np.log(3), 1.5])
    np.testing.assert_allclose(
        reach.end_effector_position_tracking(distance), [0, -0.02 * np.log(3) / 30, -0.01]
    )
    np.testing.assert_allclose(
        reach.end_effector_position_tracking_fine_grained(distance),
        [0.1 / 30, 0.02 / 30, 0],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        reach.end_effector_orientation_tracking(np.array([0, 3.0])), [0, -0.01]
    )


def test_costs_by_hand() -> None:
    actions, before = np.array([[1.0, 2, -2]]), np.array([[0.0, 2, 1]])
    np.testing.assert_allclose(reach.action_rate(actions, before, -0.3), [-0.1])
    np.testing.assert_allclose(reach.joint_vel(np.array([[3.0, 0, -4]]), -0.006), [-0.005])


@pytest.mark.parametrize("name", ARMS)
def test_levels_and_weights_are_those_of_the_paper(name: str) -> None:
    task = make_task(name)
    assert task.reward_spec.levels == (0, 0, 0, 1, 1)
    assert task.weights == {"action_rate": -1e-4, "joint_vel": -1e-4}  # type: ignore[attr-defined]
    assert TASKS[name][1] * task.dt == pytest.approx(12)


def test_tasks_do_not_share_their_weights() -> None:
    first, second = make_task("ReachFranka"), make_task("ReachFranka")
    first.weights["joint_vel"] = -1.0  # type: ignore[attr-defined]
    assert second.weights["joint_vel"] == -1e-4  # type: ignore[attr-defined]


@pytest.mark.parametrize(("name", "column"), [("ReachFranka", 2), ("ReachUR10", 0)])
def test_goals_are_in_the_box_and_the_hand_points_down(name: str, column: int) -> None:
    task = make_task(name)
    goals = np.concatenate(
        [task.start(np.random.default_rng(seed))["goals"] for seed in range(200)]
    )
    low, high = goals[:, :3].min(0), goals[:, :3].max(0)
    np.testing.assert_allclose(low, [0.35, -0.2, 0.15], atol=0.01)
    np.testing.assert_allclose(high, [0.65, 0.2, 0.5], atol=0.01)
    axes = np.zeros(9)
    for goal in goals:
        mujoco.mju_quat2Mat(axes, goal[3:])
        np.testing.assert_allclose(axes.reshape(3, 3)[:, column], [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_every_corner_of_the_goals_can_be_reached(name: str) -> None:
    """Inverse kinematics from some starts brings the hand within 1.7 mm and 0.1° of each."""
    task = make_task(name)
    model, data = task.model, mujoco.MjData(task.model)
    hand = model.body("hand").id
    corners = np.array(np.meshgrid(*reach.GOAL_POSITION)).reshape(3, -1).T
    rng = np.random.default_rng(0)
    jacobian = np.zeros((6, model.nv))
    for corner in corners:
        goal = geometry.from_euler(*np.array([0, task.goal_pitch, rng.uniform(-2, 2)]))  # type: ignore[attr-defined]
        best = np.inf
        for _ in range(30):
            data.qpos[:] = np.clip(
                task._default + rng.normal(0, 0.7, model.nq),
                *model.jnt_range.T,  # type: ignore[attr-defined]
            )
            for _ in range(60):
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                error = np.zeros(6)
                error[:3] = corner - data.xpos[hand]
                inverse, difference = np.zeros(4), np.zeros(4)
                mujoco.mju_negQuat(inverse, data.xquat[hand])
                mujoco.mju_mulQuat(difference, goal, inverse)
                mujoco.mju_quat2Vel(error[3:], difference, 1)
                mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], hand)
                step = np.linalg.solve(jacobian @ jacobian.T + 1e-4 * np.eye(6), error)
                data.qpos[:] = np.clip(data.qpos + jacobian.T @ step, *model.jnt_range.T)
            best = min(best, np.abs(error).max())
            if best < 1e-3:
                break
        assert best < 1.7e-3, corner


@pytest.mark.parametrize("name", ARMS)
def test_hand_at_the_goal_is_paid_in_full(name: str) -> None:
    engine = started(name)
    rows, task = engine.rows, engine.task
    rows.goals[0, 0] = np.append(rows.xpos[0, task._hand], -rows.xquat[0, task._hand])  # type: ignore[attr-defined]
    rows.time_step[:] = 1
    terms = np.array(task.rewards(rows))[:, 0]
    np.testing.assert_allclose(terms, [0, 0.1 / 30, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_goal_changes_every_four_seconds(name: str) -> None:
    """A step is paid for the goal that was observed before it."""
    engine = started(name)
    n_joints = engine.task.model.nu
    still = np.zeros((1, n_joints), dtype=np.float32)
    goals = engine.rows.goals[0].copy()
    seen = []
    for _ in range(360):
        step = engine.step(still)
        seen.append(step.observations[0, 2 * n_joints : 2 * n_joints + 7])
    np.testing.assert_allclose(seen[118], goals[0], atol=1e-6)
    np.testing.assert_allclose(seen[119], goals[1], atol=1e-6)
    np.testing.assert_allclose(seen[238], goals[1], atol=1e-6)
    np.testing.assert_allclose(seen[239], goals[2], atol=1e-6)
    np.testing.assert_allclose(seen[359], goals[0], atol=1e-6)
    rows = engine.rows
    np.testing.assert_allclose(rows.mocap_pos[0, 0], goals[2, :3])
    distance = np.linalg.norm(rows.xpos[0, engine.task._hand] - goals[2, :3])  # type: ignore[attr-defined]
    np.testing.assert_allclose(step.components[0, 0], -0.2 * distance / 30)


def test_actions_move_the_targets_around_the_default_pose() -> None:
    engine = started("ReachUR10")
    engine.step(np.full((1, 6), 0.5, np.float32))
    np.testing.assert_allclose(
        engine.rows.ctrl[0], [0.25, -1.462, 1.962, 0.25, 0.25, 0.25], atol=1e-6
    )


def test_starts_are_inside_the_limits() -> None:
    task = make_task("ReachFranka")
    starts = np.array([task.start(np.random.default_rng(seed))["qpos"] for seed in range(100)])
    low, high = task.model.jnt_range.T
    assert (starts >= low).all()
    assert (starts <= high).all()
    assert np.ptp(starts[:, 1]) > 0.5


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, BatchedVecEnv])
def test_curriculum_raises_the_costs_once(vec_env_cls: type[VecEnv]) -> None:
    env = make_vec_env("sb3_gcr/ReachUR10-v0", 2, vec_env_cls=vec_env_cls)  # type: ignore[arg-type]
    model = GCRPPO(
        "MlpPolicy", env, n_steps=20, batch_size=40, n_epochs=1, policy_kwargs={"net_arch": [8]}
    )
    seen = []

    class Spy(WeightCurriculum):
        def _on_rollout_end(self) -> None:
            super()._on_rollout_end()
            seen.extend(dict(task.weights) for task in self.training_env.get_attr("task"))

    model.learn(80, callback=Spy(start=25, joint_vel=-0.002))
    assert seen[:2] == [{"action_rate": -1e-4, "joint_vel": -1e-4}] * 2
    assert seen[2:] == [{"action_rate": -0.005, "joint_vel": -0.002}] * 2
    assert model.logger.name_to_value["curriculum/joint_vel"] in (0, -0.002)  # dumped or not


def test_curriculum_refuses_what_it_cannot_do() -> None:
    with pytest.raises(ValueError, match="Parameter `start` must not be negative, found -1"):
        WeightCurriculum(start=-1)
    model = GCRPPO("MlpPolicy", "sb3_gcr/Quadcopter-v0", n_steps=64, batch_size=64)
    message = "WeightCurriculum needs the env 'sb3_gcr/ReachFranka-v0' or 'sb3_gcr/ReachUR10-v0'"
    with pytest.raises(ValueError, match=message):
        model.learn(64, callback=WeightCurriculum())


def test_quaternions_against_mujocos() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.normal(size=(20, 4)) for _ in range(2))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    vectors = rng.normal(size=(20, 3))
    product, rotated, turned = np.zeros(4), np.zeros(3), np.zeros(3)
    for index in range(20):
        mujoco.mju_mulQuat(product, first[index], second[index])
        np.testing.assert_allclose(geometry.compose(first, second)[index], product)
        mujoco.mju_rotVecQuat(rotated, vectors[index], first[index])
        np.testing.assert_allclose(geometry.into_world(first, vectors)[index], rotated)
        mujoco.mju_subQuat(turned, second[index], first[index])
        np.testing.assert_allclose(
            geometry.angle_between(first, second)[index], np.linalg.norm(turned)
        )
    down = geometry.into_frame(first, np.tile([0.0, 0, -1], (20, 1)))
    np.testing.assert_allclose(geometry.projected_gravity(first), down)


def test_small_and_opposite_turns_keep_their_digits() -> None:
    one = np.array([[1.0, 0, 0, 0]])
    small = np.array([[np.cos(5e-9), np.sin(5e-9), 0, 0]])
    np.testing.assert_allclose(geometry.angle_between(one, -small), [1e-8], rtol=1e-6)
    np.testing.assert_allclose(geometry.angle_between(one, np.array([[0, 0, 1.0, 0]])), [np.pi])


def test_euler_angles_turn_about_fixed_axes() -> None:
    """First about x, then about y, then about z."""
    expected = (turn("z", 0.3) @ turn("y", -0.7) @ turn("x", 1.1))[:3, :3]
    quaternion = geometry.from_euler(*np.array([1.1, -0.7, 0.3]))
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    np.testing.assert_allclose(matrix.reshape(3, 3), expected)
