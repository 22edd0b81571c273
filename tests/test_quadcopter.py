"""The terms of Quadcopter against numbers worked out by hand, and its flight against free fall."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco.batch")

from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.tasks import quadcopter
from sb3_gcr.envs.tasks.catalogue import TASKS

#: The thrust that carries the weight: 1 of 1.9.
HOVER = 2 / 1.9 - 1


def flying(seed: int = 0) -> Engine:
    engine = Engine(quadcopter.Quadcopter(), 1)
    engine.seed(0, seed)
    engine.reset(np.array([0]))
    return engine


def fly(engine: Engine, *action: float, steps: int = 1) -> np.ndarray:
    for _ in range(steps):
        step = engine.step(np.array([action], dtype=np.float32))
    return step.components[0]


def test_costs_are_per_second_and_grow_with_the_square() -> None:
    """3² + 4² = 25, in 0.02 s."""
    velocity = np.array([[3.0, 0, -4], [0, 0, 0]])
    np.testing.assert_allclose(quadcopter.lin_vel(velocity), [-0.025, 0])
    np.testing.assert_allclose(quadcopter.ang_vel(velocity), [-0.005, 0])


def test_distance_pays_most_at_the_goal() -> None:
    """tanh(ln 3) = 0.8, so a fifth is left there."""
    distance = np.array([0, 0.8 * np.log(3), 1e3])
    np.testing.assert_allclose(quadcopter.distance_to_goal(distance), [0.3, 0.06, 0], atol=1e-12)


def test_levels_are_those_of_the_paper() -> None:
    assert quadcopter.Quadcopter().reward_spec.to_dict() == {
        "lin_vel": 1,
        "ang_vel": 1,
        "distance_to_goal": 0,
    }


def test_it_falls_freely_without_thrust_and_hovers_with_its_weight() -> None:
    engine = flying()
    fly(engine, -1, 0, 0, 0, steps=5)
    assert engine.rows.qpos[0, 2] == pytest.approx(0.5 - 9.81 * 0.1**2 / 2, abs=1e-6)
    engine = flying()
    fly(engine, HOVER, 0, 0, 0, steps=50)
    np.testing.assert_allclose(engine.rows.qpos[0, :3], [0, 0, 0.5], atol=1e-5)


def test_torques_turn_it_about_its_own_axes() -> None:
    """A tenth of 0.01 N m for 0.02 s on 29.3e-6 kg m² about the vertical."""
    engine = flying()
    fly(engine, HOVER, 0, 0, 0.1)
    np.testing.assert_allclose(
        engine.rows.qvel[0, 3:], [0, 0, 0.001 * 0.02 / 29.3e-6], rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize(
    ("height", "fails"), [(0.09, True), (0.11, False), (1.99, False), (2.01, True)]
)
def test_it_fails_near_the_ground_and_high_up(height: float, fails: bool) -> None:
    engine = flying()
    engine.rows.qpos[0, 2] = height
    assert engine.task.terminated(engine.rows)[0] == fails


def test_goals_are_where_the_paper_has_them() -> None:
    task = quadcopter.Quadcopter()
    goals = np.array([task.start(np.random.default_rng(seed))["goal"] for seed in range(300)])
    low, high = goals.min(0), goals.max(0)
    np.testing.assert_allclose(low, [-2, -2, 0.5], atol=0.05)
    np.testing.assert_allclose(high, [2, 2, 1.5], atol=0.05)
    assert (low >= [-2, -2, 0.5]).all()
    assert (high <= [2, 2, 1.5]).all()


def test_observation_is_seen_from_the_body() -> None:
    """Rolled by a quarter turn to its left, it has the ground on its left."""
    engine = flying()
    rows = engine.rows
    half = np.sqrt(0.5)
    rows.qpos[0] = [1, 2, 1, half, -half, 0, 0]  # a quarter turn to the left about x
    rows.qvel[0] = [0, 0, 3, 4, 5, 6]
    rows.goal[0] = [2, 2, 1]
    observation = engine.task.observe(rows)[0]
    np.testing.assert_allclose(observation, [0, -3, 0, 4, 5, 6, 0, 1, 0, 1, 0, 0], atol=1e-6)


def test_reward_is_paid_for_where_it_is() -> None:
    engine = flying()
    engine.rows.goal[0] = [0, 0, 0.5]
    paid = fly(engine, HOVER, 0, 0, 0)
    np.testing.assert_allclose(paid, [0, 0, 0.3], atol=1e-6)


def test_time_limit_is_ten_seconds() -> None:
    assert TASKS["Quadcopter"][1] * quadcopter.Quadcopter().dt == pytest.approx(10)
