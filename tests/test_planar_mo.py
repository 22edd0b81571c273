"""The objectives of the planar robots against numbers worked out by hand and against MuJoCo, and
their base terms against Gymnasium's.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

pytest.importorskip("mujoco.batch")

from sb3_gcr.envs import BatchedVecEnv
from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.task import Rows
from sb3_gcr.envs.tasks import planar_mo
from sb3_gcr.envs.tasks.planar_mo import HalfCheetahMO, HopperMO, PlanarMO, Walker2dMO
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS

TASKS = {"Walker2d": Walker2dMO, "Hopper": HopperMO, "HalfCheetah": HalfCheetahMO}
OBJECTIVES = ["energy", "baseh", "lean", "knee"]


def at(*rows: float) -> np.ndarray:
    return np.array(rows, dtype=float)


def still(task: PlanarMO) -> Rows:
    """One robot at zero, without speed or torque."""
    model = task.model
    fields = {"qpos": model.nq, "qvel": model.nv, "ctrl": model.nu}
    arrays = {name: np.zeros((1, size)) for name, size in fields.items()}
    return Rows({**arrays, "x_before": np.zeros(1)})


def test_a_range_pays_2_from_its_lower_bound_to_below_its_upper_one() -> None:
    assert planar_mo.energy_range(at(19.9, 20, 59.9, 60), (20, 60)).tolist() == [0, 2, 2, 0]
    assert planar_mo.energy_range(at(0), (0, 20)).tolist() == [2]
    assert planar_mo.baseh_range(at(0.94, 0.95, 1.04, 1.05), (0.95, 1.05)).tolist() == [0, 2, 2, 0]
    assert planar_mo.lean_range(at(-0.5, -0.4, -0.2, -0.15), (-0.4, -0.15)).tolist() == [0, 2, 2, 0]


def test_each_knee_has_its_share() -> None:
    both = np.array([[-1.2, -0.8], [-1.2, -1.0], [-1.21, -0.8], [-0.81, -1.0]])
    assert planar_mo.knee_range(both, (-1.2, -0.8)).tolist() == [1, 2, 0, 2]
    assert planar_mo.knee_range(at(-1.2, -0.8)[:, None], (-1.2, -0.8)).tolist() == [2, 0]


def test_no_number_is_in_no_range() -> None:
    assert planar_mo.lean_range(at(np.nan), (-1, 1)).tolist() == [0]
    assert planar_mo.knee_range(np.array([[np.nan, 0.0]]), (-1, 1)).tolist() == [1]


@pytest.mark.parametrize("task", TASKS.values())
def test_five_ranges_each_that_do_not_overlap(task: type[PlanarMO]) -> None:
    assert list(task.all_ranges) == OBJECTIVES
    for ranges in task.all_ranges.values():
        assert len(ranges) == 5
        bounds = np.array(ranges).ravel()
        assert (np.diff(bounds) >= 0).all()
        assert (bounds[1::2] > bounds[::2]).all()


def test_the_walkers_ranges() -> None:
    assert planar_mo.WALKER_RANGES["energy"][4] == (300, 600)
    assert planar_mo.WALKER_RANGES["baseh"][2] == (1.05, 1.15)
    assert planar_mo.WALKER_RANGES["lean"][0] == (-0.8, -0.4)
    assert planar_mo.WALKER_RANGES["knee"][1] == (-1.6, -1.2)


@pytest.mark.parametrize(
    ("task", "torques", "velocities", "watts"),
    [
        (Walker2dMO, (1, -0.5, 0, 0, 0, 0.25), (2, 4, 9, 9, 9, -8), 600),  # 100 N m each
        (HopperMO, (-1, 0.5, 0), (1.5, -2, 7), 500),  # 200 N m each
        (HalfCheetahMO, (1, 1, 1, 1, 1, 1), (1, -1, 1, -1, 1, -1), 480),  # 120, 90, 60 and half
    ],
)
def test_power_of_the_motors(
    task: type[PlanarMO], torques: list[float], velocities: list[float], watts: float
) -> None:
    """The root's speed does not count."""
    built = task()
    rows = still(built)
    rows.ctrl[0] = torques
    rows.qvel[0] = [5, 5, 5, *velocities]
    np.testing.assert_allclose(built.power(rows), [watts])


def test_heights_and_leans_by_hand() -> None:
    walker, cheetah = still(Walker2dMO()), still(HalfCheetahMO())
    walker.qpos[0, 1:3] = 1.1, -0.4
    cheetah.qpos[0, 1:3] = -0.13, 2 * np.pi + 0.2
    assert Walker2dMO().height(walker).tolist() == [1.1]
    assert Walker2dMO().lean(walker).tolist() == [-0.4]
    np.testing.assert_allclose(HalfCheetahMO().height(cheetah), [0.57])
    np.testing.assert_allclose(HalfCheetahMO().lean(cheetah), [0.2])


@pytest.mark.parametrize("task", TASKS.values())
def test_measures_are_mujocos(task: type[PlanarMO]) -> None:
    """Height and lean of the torso's body, torque times velocity in the joints' coordinates, and
    positions of the joints by name.
    """
    built = task()
    data = mujoco.MjData(built.model)
    rng = np.random.default_rng(0)
    rows = still(built)
    for _ in range(20):
        data.qpos[:] = rng.uniform(-1, 1, built.model.nq)
        data.qvel[:] = rng.uniform(-9, 9, built.model.nv)
        data.ctrl[:] = rng.uniform(-1, 1, built.model.nu)
        mujoco.mj_forward(built.model, data)
        rows.qpos[0], rows.qvel[0], rows.ctrl[0] = data.qpos, data.qvel, data.ctrl
        torso = data.body("torso")
        np.testing.assert_allclose(built.height(rows), [torso.xpos[2]], atol=1e-12)
        forward, up = torso.xmat[2], torso.xmat[8]  # of the torso's z axis
        np.testing.assert_allclose(built.lean(rows), [np.arctan2(forward, up)], atol=1e-12)
        power = np.abs(data.qfrc_actuator * data.qvel).sum()
        np.testing.assert_allclose(built.power(rows), [power])
        for index, (low, high) in enumerate(built.all_ranges["knee"]):
            knees = [float(data.joint(name).qpos[0]) for name in built.knees]
            paid = 2 * sum(low <= knee < high for knee in knees) / len(knees)
            assert task(knee=index).rewards(rows)[-1].tolist() == [paid]


def test_the_first_step_of_a_limp_hopper_by_hand() -> None:
    """It stands upright at 1.25 m with its knee nearly straight."""
    engine = Engine(HopperMO(energy=0, baseh=3, lean=2), 4)
    for index in range(4):
        engine.seed(index, index)
    engine.reset(np.arange(4))
    paid = engine.step(np.zeros((4, 3), dtype=np.float32)).components
    assert paid[:, -3:].tolist() == [[2, 2, 2]] * 4
    strong = engine.step(np.ones((4, 3), dtype=np.float32)).components
    assert strong[:, -3].tolist() == [0] * 4
    engine.close()


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("chosen", [{}, {"energy": 2, "baseh": 3, "lean": 2, "knee": 3}])
def test_base_task_is_gymnasiums_bit_for_bit(name: str, chosen: dict[str, int]) -> None:
    """Observations, base terms and ends over 3000 steps of ten robots, with resets."""
    limit = {"max_episode_steps": 120}
    ours = make_vec_env(
        f"sb3_gcr/{name}MO-v0",
        10,
        seed=0,
        vec_env_cls=BatchedVecEnv,
        env_kwargs={**limit, **chosen},
    )
    theirs = make_vec_env(f"{name}-v5", 10, seed=0, env_kwargs=limit)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    terms = list(GYMNASIUM_ENVS[f"{name}-v5"]["components"])
    assert list(ours.reward_spec.names) == [*terms, *[f"{key}_range" for key in chosen]]
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    n_ended = 0
    seen: set[float] = set()
    for _ in range(300):
        actions = rng.uniform(-1, 1, (10, *ours.action_space.shape)).astype(np.float32)
        observations, rewards, dones, _ = ours.step(actions)
        expected = theirs.step(actions)
        base = ours.reward_components[:, : len(terms)]
        np.testing.assert_array_equal(observations, expected[0])
        np.testing.assert_array_equal(base, [[info[key] for key in terms] for info in expected[3]])
        np.testing.assert_array_equal(dones, expected[2])
        paid = ours.reward_components[:, len(terms) :]
        np.testing.assert_allclose(rewards, expected[1] + paid.sum(1), rtol=1e-5, atol=1e-5)
        if not chosen:
            np.testing.assert_array_equal(rewards, expected[1])
        seen |= set(paid.ravel().tolist())
        n_ended += int(dones.sum())
    assert n_ended >= 20
    assert seen <= {0, 1, 2}
    assert not chosen or {0, 2} <= seen
    ours.close()
    theirs.close()


def test_levels() -> None:
    """Objectives are tasks; the cost of the actions stays beside the energy objective."""
    levels = Walker2dMO(energy=0, knee=4).reward_spec.to_dict()
    assert levels == {
        "reward_forward": 0,
        "reward_survive": 0,
        "reward_ctrl": 1,
        "energy_range": 0,
        "knee_range": 0,
    }
    assert HalfCheetahMO(lean=1).reward_spec.to_dict() == {
        "reward_forward": 0,
        "reward_ctrl": 1,
        "lean_range": 0,
    }


@pytest.mark.parametrize("index", [5, -1, 1.5, "2", True])
def test_wrong_range_is_refused(index: object) -> None:
    with pytest.raises(
        ValueError,
        match=r"^Parameter `baseh` must be None or the index of one of \{0: \(0.7, 0.85\), "
        r"1: \(0.85, 1.0\), 2: \(1.0, 1.15\), 3: \(1.15, 1.3\), 4: \(1.3, 1.45\)\}, found ",
    ):
        HopperMO(baseh=index)  # type: ignore[arg-type]
