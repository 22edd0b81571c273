"""The terms of Throwing-MO against numbers worked out by hand, its ball, its targets and its
observation.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

pytest.importorskip("mujoco.batch")

from sb3_gcr import GCRPPO
from sb3_gcr.envs import BatchedVecEnv
from sb3_gcr.envs.curriculum import DistanceCurriculum
from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.tasks import throwing
from sb3_gcr.envs.tasks.catalogue import TASKS

OBJECTIVES = ("energy", "baseh", "ballrel", "bodymo", "lftarm", "rgtarm")
HOLD, OPEN = np.zeros((1, 24), np.float32), np.zeros((1, 24), np.float32)
OPEN[0, -1] = -1


def at(*rows: float) -> np.ndarray:
    return np.array(rows, dtype=float)


def test_throwing_pays_once_for_what_is_left_of_1() -> None:
    np.testing.assert_allclose(throwing.throwing(at(0, 0.25, 1, 3, np.nan)), [4.1, 3.075, 0, 0, 0])


def test_roll_is_free_below_a_tenth() -> None:
    """0.43 * 0.02 * 0.5 * (1 - e^-2) at 0.3 rad; both signs alike."""
    expected = -0.0086 * 0.5 * (1 - np.exp(-2))
    np.testing.assert_allclose(
        throwing.roll(at(0.1, 0.3, -0.3)), [0, expected, expected], atol=1e-15
    )
    assert throwing.roll(at(0.0))[0] > 0


def test_stability_pays_a_standing_robot() -> None:
    yes, no = np.array([True]), np.array([False])
    assert throwing.stability(at(0.6), no, no)[0] == pytest.approx(0.005)
    assert throwing.stability(at(0.38), no, no)[0] == 0
    assert throwing.stability(at(0.6), yes, no)[0] == 0
    assert throwing.stability(at(0.6), no, yes)[0] == 0


def test_regularisers_grow_with_the_square() -> None:
    np.testing.assert_allclose(
        throwing.action_rate_l2(np.array([[1.0, 2]]), np.array([[0.0, -1]])), [-2e-4]
    )
    np.testing.assert_allclose(throwing.dof_torques_l2(np.array([[30.0, 40]])), [-1.25e-4])
    np.testing.assert_allclose(throwing.dof_acc_l2(np.array([[300.0, 400]])), [-1.25e-4])


def test_objectives_pay_each_step_or_at_release() -> None:
    np.testing.assert_allclose(
        throwing.paid_each_step(at(0.49, 0.5, 0.55), (0.5, 0.55)), [0, 0.02, 0]
    )
    released = np.array([True, False, True])
    np.testing.assert_allclose(
        throwing.paid_at_release(at(0.5, 0.5, 0.6), (0.5, 0.55), released), [1, 0, 0]
    )


def test_ranges_do_not_overlap() -> None:
    assert tuple(throwing.RANGES) == OBJECTIVES
    for ranges in throwing.RANGES.values():
        bounds = np.array(ranges).ravel()
        assert len(ranges) == 5
        assert (np.diff(bounds) >= 0).all()


def test_closest_approach_of_a_ball_that_is_dropped_and_of_one_that_hits() -> None:
    """Dropped from 1.03 m it lands after √(2/g); thrown level at 2 m/s it is 0.5 s later 1 m away
    and 1.226 m lower.
    """
    ball = np.array([[0.0, 0, 1.03], [0, 0, 2.0]])
    velocity = np.array([[0.0, 0, 0], [2, 0, 0]])
    target = np.array([[0.3, 0, 0.03], [1.0, 0, 2 - 9.81 / 8]])
    distance, time = throwing.closest_approach(ball, velocity, target)
    np.testing.assert_allclose(distance, [0.3, 0], atol=0.01)
    np.testing.assert_allclose(time, [np.sqrt(2 / 9.81), 0.5], atol=0.01)
    lying = throwing.closest_approach(
        np.array([[1.0, 1, 0.02]]), np.array([[3.0, 0, 0]]), np.array([[1.0, 1, 0.52]])
    )
    np.testing.assert_allclose([lying[0][0], lying[1][0]], [0.5, 0])


def test_ball_stays_in_the_closed_hand_and_flies_from_the_open_one() -> None:
    task = throwing.ThrowingMO(ballrel=0)
    engine = Engine(task, 1)
    engine.seed(0, 0)
    engine.reset(np.array([0]))
    for _ in range(20):
        held = engine.step(HOLD)
    rows = engine.rows
    palm = rows.site_xpos[0, task._right_palm]
    assert np.linalg.norm(rows.qpos[0, task._ball] - palm) < 0.16
    assert held.components[0, 0] == 0
    assert held.observations[0, 80] == 1
    thrown = [engine.step(OPEN) for _ in range(40)]
    paid = np.array([step.components[0, 0] for step in thrown])
    assert (paid > 0).sum() == 1
    assert rows.has_thrown[0] == 1
    assert thrown[-1].observations[0, 80] == 0
    assert rows.qpos[0, task._ball][2] < 0.1
    expected = thrown[int(paid.argmax()) - 1].observations[
        0, 81
    ]  # the score foreseen one step before
    assert paid.max() / 4.1 == pytest.approx(expected, abs=0.1)


def test_ball_opened_at_once_is_let_go_within_the_first_range() -> None:
    task = throwing.ThrowingMO(ballrel=0)
    engine = Engine(task, 1)
    engine.seed(0, 0)
    engine.reset(np.array([0]))
    column = task.reward_spec.names.index("ballrel_range")
    assert sum(engine.step(OPEN).components[0, column] for _ in range(15)) == 1


def test_not_throwing_costs_the_last_step_only() -> None:
    """Stability is lost at the end of the time where the ball is still held."""
    task = throwing.ThrowingMO()
    engine = Engine(task, 1)
    engine.seed(0, 0)
    engine.reset(np.array([0]))
    engine.rows.time_step[:] = throwing.EPISODE_STEPS - 2
    stable = [engine.step(HOLD).components[0, 2] for _ in range(2)]
    np.testing.assert_allclose(stable, [0.005, 0])


def test_targets_lie_on_the_half_sphere() -> None:
    task = throwing.ThrowingMO(max_distance=3)
    starts = [task.start(np.random.default_rng(seed)) for seed in range(300)]
    targets = np.array([start["target"] for start in starts])
    distances = np.linalg.norm(targets, axis=1)
    assert (distances >= 1).all()
    assert (distances <= 3).all()
    assert distances.max() > 2.8
    assert (targets[:, 2] >= 0).all()
    task.max_distance = 1
    np.testing.assert_allclose(np.linalg.norm(task.start(np.random.default_rng(0))["target"]), 1)
    with pytest.raises(
        ValueError, match="Parameter `max_distance` must be between 1 and 5 m, found 7"
    ):
        task.max_distance = 7


def test_observation_has_86_entries() -> None:
    task = throwing.ThrowingMO()
    engine = Engine(task, 2)
    first = engine.reset(np.arange(2))
    assert first.shape == (2, 86)
    np.testing.assert_allclose(first[:, 3:7], [[0, 0, -1, 0]] * 2, atol=1e-6)
    target = engine.rows.target - [0, 0, throwing.START_HEIGHT]
    np.testing.assert_allclose(first[:, 7:10], target, atol=1e-6)
    actions = np.linspace(-1, 1, 24, dtype=np.float32)[None].repeat(2, 0)
    np.testing.assert_allclose(engine.step(actions).observations[:, 56:80], actions)


def test_all_joints_are_found() -> None:
    task = throwing.ThrowingMO()
    assert len(task._body) == 23
    assert len(task._arms) == 10
    assert len(task._fingers) == 6
    assert task._is_hand.sum() == 14
    assert len(task._touches) == 31


def test_time_limit_is_that_of_the_env() -> None:
    assert TASKS["ThrowingMO"][1] == throwing.EPISODE_STEPS


def test_wrong_range_is_refused() -> None:
    with pytest.raises(
        ValueError,
        match=(
            r"Parameter `rgtarm` must be None or the index of one of \{0: \(0.3, 0.5\), .* found "
            r"5"
        ),
    ):
        throwing.ThrowingMO(rgtarm=5)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv, BatchedVecEnv])
def test_curriculum_moves_the_target_away(vec_env_cls: type[VecEnv], tmp_path: Path) -> None:
    """The envs are where the log says, in other processes too."""
    env_id = "sb3_gcr:sb3_gcr/ThrowingMO-v0"  # a worker imports the package by itself
    env = make_vec_env(env_id, 2, vec_env_cls=vec_env_cls)  # type: ignore[arg-type]
    never, always = (
        DistanceCurriculum(throwing=5),
        DistanceCurriculum(0.3, 1.5, throwing=-9, stability=-9),
    )
    model = GCRPPO(
        "MlpPolicy", env, n_steps=101, batch_size=101, n_epochs=1, policy_kwargs={"net_arch": [8]}
    )
    model.learn(202, callback=never)
    assert {task.max_distance for task in env.get_attr("task")} == {1}
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(3 * 202, callback=always)
    model.logger.close()
    assert {task.max_distance for task in env.get_attr("task")} == {1.5}
    with (tmp_path / "progress.csv").open() as file:
        logged = [row["curriculum/max_distance"] for row in csv.DictReader(file)]
    assert logged[-1] == "1.5"
    env.close()


def test_curriculum_refuses_what_it_cannot_do() -> None:
    with pytest.raises(ValueError, match="Parameter `limit` must be between 1 and 5 m, found 9"):
        DistanceCurriculum(limit=9)
    with pytest.raises(ValueError, match="Parameter `increment` must be above 0, found 0"):
        DistanceCurriculum(increment=0)
    model = GCRPPO("MlpPolicy", "CartPole-v1", n_steps=64, batch_size=64)
    with pytest.raises(
        ValueError,
        match="DistanceCurriculum needs the env 'sb3_gcr/ThrowingMO-v0', found one without targets",
    ):
        model.learn(64, callback=DistanceCurriculum())
    model = GCRPPO("MlpPolicy", "sb3_gcr/HumanoidRun-v0", n_steps=64, batch_size=64)
    with pytest.raises(ValueError, match="found one without targets"):
        model.learn(64, callback=DistanceCurriculum())
