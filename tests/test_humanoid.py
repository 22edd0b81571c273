"""The terms of Humanoid-MO against numbers worked out by hand, and its body against known facts."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco.batch")

from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.tasks import geometry, humanoid
from sb3_gcr.envs.tasks import ranges as objectives


def at(*rows: float) -> np.ndarray:
    return np.array(rows, dtype=float)


def test_progress_is_twice_the_speed() -> None:
    """1.5 m/s for 1/60 s."""
    np.testing.assert_allclose(humanoid.progress(at(1000.0), at(1000.0 - 1.5 / 60)), [3.0])


def test_alive_pays_2() -> None:
    assert humanoid.alive(at(0.1, 1.3)).tolist() == [2, 2]


def test_upright_pays_above_its_threshold_only() -> None:
    np.testing.assert_allclose(humanoid.upright(at(0.92, 0.93, 0.94, 1.0)), [0, 0, 0.1, 0.1])


def test_move_to_target_is_linear_up_to_its_threshold() -> None:
    np.testing.assert_allclose(
        humanoid.move_to_target(at(-0.8, 0, 0.4, 0.8, 0.9)), [-0.5, 0, 0.25, 0.5, 0.5]
    )


def test_costs_grow_with_actions_and_speed() -> None:
    actions = np.array([[1.0, -1.0, 0.5], [0, 0, 0]])
    np.testing.assert_allclose(humanoid.action_l2(actions), [-0.0225, 0])
    np.testing.assert_allclose(
        humanoid.energy(actions, np.array([[2.0, 4.0, -8.0], [9, 9, 9]])), [-0.05, 0]
    )


def test_joint_limits_count_the_upper_ones() -> None:
    assert humanoid.joint_pos_limits(
        np.array([[0.99, 1.2, 0.98, -1.0], [0, 0, 0, 0]])
    ).tolist() == [-2, 0]


def test_ranges_include_their_lower_bound_only() -> None:
    assert objectives.inside(at(0.5, 0.75, 1.0, np.nan), (0.5, 1.0)).tolist() == [
        True,
        True,
        False,
        False,
    ]
    assert humanoid.energy_range(at(99, 100, 199, 200), (100, 200)).tolist() == [0, 5, 5, 0]
    assert humanoid.baseh_range(at(0.55, 0.9), (0.55, 0.7)).tolist() == [5, 0]
    assert humanoid.armsp_range(
        np.array([[0.3, 0.3], [0.3, 0.5], [0.5, 0.5]]), (0.2, 0.4)
    ).tolist() == [5, 2.5, 0]


def test_stride_pays_for_the_time_in_the_air() -> None:
    strides = np.array([[0.6, np.nan], [0.6, 0.7], [1.2, 0.9]])
    air_times = np.array([[0.2, 0.4], [0.2, 0.4], [0.2, 0.4]])
    np.testing.assert_allclose(humanoid.gait_range(strides, air_times, (0.5, 1.0)), [50, 150, 100])


def test_ranges_do_not_overlap() -> None:
    for ranges in humanoid.RANGES.values():
        assert len(ranges) == 5
        bounds = np.array(ranges).ravel()
        assert (np.diff(bounds) >= 0).all()
        assert (bounds[1::2] > bounds[::2]).all()


def test_frames_and_angles() -> None:
    half = np.sqrt(0.5)
    quarter_turn_left = np.array([[half, 0, 0, half]])
    np.testing.assert_allclose(
        geometry.into_frame(quarter_turn_left, np.array([[0.0, 1, 2]])), [[1, 0, 2]], atol=1e-12
    )
    yaw, roll = geometry.yaw_and_roll(quarter_turn_left)
    np.testing.assert_allclose([yaw[0], roll[0]], [np.pi / 2, 0], atol=1e-12)
    yaw, roll = geometry.yaw_and_roll(np.array([[half, half, 0, 0]]))
    np.testing.assert_allclose([yaw[0], roll[0]], [0, np.pi / 2], atol=1e-12)
    qpos = np.zeros((2, 24))
    qpos[:, 3] = 1
    qpos[1, 3:7] = quarter_turn_left
    up, heading = humanoid.torso_projections(qpos)
    np.testing.assert_allclose(up, [1, 1], atol=1e-12)
    np.testing.assert_allclose(heading, [1, 0], atol=1e-12)
    np.testing.assert_allclose(
        geometry.wrap(at(3.5, -3.5, 0.1)), [3.5 - 2 * np.pi, 2 * np.pi - 3.5, 0.1]
    )


def test_body_is_gymnasiums_at_60_hz() -> None:
    task = humanoid.HumanoidRun()
    assert task.model.nu == 17
    assert task.dt == pytest.approx(1 / 60)
    assert float(task.model.body_mass.sum()) == pytest.approx(42.116, abs=1e-3)
    engine = Engine(task, 1)
    engine.seed(0, 0)
    observation = engine.reset(np.array([0]))[0]
    assert observation.shape == (63,)
    assert observation[0] == pytest.approx(1.3)
    np.testing.assert_allclose(observation[7:12], [0, 0, 0, 1, 1], atol=1e-6)
    names = [task.model.actuator(index).name for index in range(17)]
    joints = [task.model.joint(index + 1).name for index in task._joint_of_action]
    assert names == joints


def test_energy_objective_replaces_the_energy_term() -> None:
    levels = humanoid.HumanoidMO(energy=0, gait=1).reward_spec.to_dict()
    assert "energy" not in levels
    assert levels["energy_range"] == levels["gait_range"] == 0
    assert list(humanoid.HumanoidMO().reward_spec) == list(humanoid.HumanoidRun().reward_spec)


@pytest.mark.parametrize("index", [5, -1, 1.5, "2", True])
def test_wrong_range_is_refused(index: object) -> None:
    with pytest.raises(
        ValueError,
        match=r"Parameter `gait` must be None or the index of one of \{0: \(0.0, 0.2\), .* found",
    ):
        humanoid.HumanoidMO(gait=index)  # type: ignore[arg-type]


def test_feet_are_felt_and_strides_measured() -> None:
    """The robot lands at the start; a foot that is then carried 0.5 m through the air makes a
    stride of about that length.
    """
    task = humanoid.HumanoidMO(gait=2)
    engine = Engine(task, 1)
    engine.seed(0, 0)
    engine.reset(np.array([0]))
    still = np.zeros((1, 17), dtype=np.float32)
    for _ in range(12):
        engine.step(still)
    rows = engine.rows
    assert rows.has_stepped.all()
    assert rows.grounded.all()
    assert np.isnan(rows.strides).all()
    rows.qpos[0, 0] += 0.5
    rows.qpos[0, 2] += 0.05
    rows.qvel[0] = 0
    paid = [engine.step(still).components[0, -1] for _ in range(20)]
    assert max(paid) > 250 * 0.05
