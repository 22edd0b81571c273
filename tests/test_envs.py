"""The engine and its three faces: equal to Gymnasium's envs, to each other, and clean in
trouble.
"""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

mujoco_batch = pytest.importorskip("mujoco.batch")

from sb3_gcr import GCRPPO  # noqa: E402
from sb3_gcr.envs import BatchedVecEnv  # noqa: E402
from sb3_gcr.envs.engine import Engine  # noqa: E402
from sb3_gcr.envs.single import TaskEnv  # noqa: E402
from sb3_gcr.envs.tasks.catalogue import TASKS, make_task  # noqa: E402
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS  # noqa: E402

PLANAR = ["HalfCheetah", "Hopper", "Swimmer", "Walker2d"]
PLANAR_OBJECTIVES = {"energy": 2, "baseh": 3, "lean": 2, "knee": 3}
ALL_OBJECTIVES = {
    "HumanoidMO": {"energy": 2, "gait": 1, "baseh": 3, "armsp": 2},
    "HopperMO": PLANAR_OBJECTIVES,
    "Walker2dMO": PLANAR_OBJECTIVES,
    "HalfCheetahMO": PLANAR_OBJECTIVES,
}
RUN = "sb3_gcr/HumanoidRun-v0"


def batched(
    name: str, n_envs: int, seed: int | None = 0, n_threads: int = 2, **kwargs: Any
) -> BatchedVecEnv:
    return make_vec_env(  # type: ignore[return-value]
        f"sb3_gcr/{name}-v0",
        n_envs,
        seed=seed,
        vec_env_cls=BatchedVecEnv,  # type: ignore[arg-type]
        vec_env_kwargs={"n_threads": n_threads},
        **kwargs,
    )


def random_actions(space: gym.spaces.Box, n: int, steps: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [
        rng.uniform(space.low, space.high, (n, *space.shape)).astype(space.dtype)
        for _ in range(steps)
    ]


def steps_alike(
    ours: BatchedVecEnv, theirs: VecEnv, n_steps: int, terms: Callable[[dict[str, Any]], Any]
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Step both with the same random actions; everything must be equal. The infos of finished
    episodes, ours and theirs.
    """
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    ended = []
    for actions in random_actions(ours.action_space, ours.num_envs, n_steps):  # type: ignore[arg-type]
        observations, rewards, dones, infos = ours.step(actions)
        expected = theirs.step(actions)
        np.testing.assert_array_equal(observations, expected[0])
        np.testing.assert_array_equal(rewards, expected[1])
        np.testing.assert_array_equal(dones, expected[2])
        np.testing.assert_array_equal(ours.reward_components, [terms(info) for info in expected[3]])
        for index in np.flatnonzero(dones):
            np.testing.assert_array_equal(
                infos[index]["terminal_observation"], expected[3][index]["terminal_observation"]
            )
            assert infos[index]["TimeLimit.truncated"] == expected[3][index]["TimeLimit.truncated"]
            ended.append((infos[index], expected[3][index]))
    return ended


@pytest.mark.parametrize("name", PLANAR)
def test_planar_tasks_are_gymnasiums_bit_for_bit(name: str) -> None:
    """Observations, terms, rewards and ends over 3000 steps of ten robots, with resets."""
    ours = batched(name, 10, env_kwargs={"max_episode_steps": 120})
    theirs = make_vec_env(f"{name}-v5", 10, seed=0, env_kwargs={"max_episode_steps": 120})
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    terms = list(GYMNASIUM_ENVS[f"{name}-v5"]["components"])
    ended = steps_alike(ours, theirs, 300, lambda info: [info[key] for key in terms])
    assert len(ended) >= 20


@pytest.mark.parametrize("name", list(TASKS))
@pytest.mark.parametrize("n_threads", [1, 2])
def test_batched_and_serial_are_equal_step_by_step(name: str, n_threads: int) -> None:
    kwargs = {**ALL_OBJECTIVES.get(name, {}), "max_episode_steps": 50}
    many = batched(name, 5, n_threads=n_threads, env_kwargs=kwargs)
    one_by_one = make_vec_env(f"sb3_gcr/{name}-v0", 5, seed=0, env_kwargs=kwargs)
    assert isinstance(one_by_one, DummyVecEnv)
    ended = steps_alike(many, one_by_one, 120, lambda info: info["reward_components"])
    assert len(ended) >= 10
    for info, serial in ended:
        for key in many.reward_spec.return_keys:
            assert info[key] == serial[key]
        assert info["episode"]["r"] == pytest.approx(serial["episode"]["r"], abs=1e-4)
        assert info["episode"]["l"] == serial["episode"]["l"]


@pytest.mark.parametrize("name", list(TASKS))
def test_gymnasiums_vector_env_is_the_sync_one(name: str) -> None:
    kwargs = {**ALL_OBJECTIVES.get(name, {}), "max_episode_steps": 30}
    ours = gym.make_vec(f"sb3_gcr/{name}-v0", 3, **kwargs)
    theirs = gym.make_vec(
        f"sb3_gcr/{name}-v0",
        3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP},
        **kwargs,
    )
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    np.testing.assert_array_equal(ours.reset(seed=3)[0], theirs.reset(seed=3)[0])
    for actions in random_actions(ours.action_space, 1, 70):  # type: ignore[arg-type]
        result, expected = ours.step(actions[0]), theirs.step(actions[0])
        for index in range(4):
            np.testing.assert_array_equal(result[index], expected[index])
        if (result[2] | result[3]).any():
            np.testing.assert_array_equal(result[4]["_final_obs"], expected[4]["_final_obs"])
            for index in np.flatnonzero(result[4]["_final_obs"]):
                np.testing.assert_array_equal(
                    result[4]["final_obs"][index], expected[4]["final_obs"][index]
                )
                np.testing.assert_array_equal(
                    result[4]["final_info"]["reward_components"][index],
                    expected[4]["final_info"]["reward_components"][index],
                )
    with pytest.raises(
        ValueError, match="Parameter `seed` must be an integer or have 3 entries, found 2"
    ):
        ours.reset(seed=[1, 2])
    ours.close()
    theirs.close()


@pytest.mark.parametrize("name", list(TASKS))
def test_env_passes_the_checks_of_gymnasium_and_sb3(
    name: str, recwarn: pytest.WarningsRecorder
) -> None:
    env = gym.make(f"sb3_gcr/{name}-v0", **ALL_OBJECTIVES.get(name, {}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.filters", [])  # some say that unbounded observations are unusual
        check_gymnasium_env(env.unwrapped, skip_render_check=True)
        check_sb3_env(env, skip_render_check=True)
    assert env.metadata["render_fps"] == round(1 / env.unwrapped.task.dt)  # type: ignore[attr-defined]


def test_env_can_be_copied_and_pickled() -> None:
    env = gym.make("sb3_gcr/HumanoidMO-v0", armsp=1)
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        np.testing.assert_array_equal(twin.reset(seed=1)[0], env.reset(seed=1)[0])
        assert twin.unwrapped.reward_spec == env.unwrapped.reward_spec  # type: ignore[attr-defined]


def test_wrappers_of_sb3_work_on_top() -> None:
    with pytest.warns(UserWarning, match="already wrapped with a `Monitor`"):
        env = VecFrameStack(VecNormalize(VecMonitor(batched("HumanoidRun", 4))), 2)
    model = GCRPPO(
        "MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, policy_kwargs={"net_arch": [16]}
    ).learn(512)
    assert model.n_components == 7
    returns = np.mean(model.ep_component_buffer, axis=0)
    assert returns[1] == pytest.approx(
        2 * np.mean([episode["l"] for episode in model.ep_info_buffer]), rel=1e-6
    )  # type: ignore[union-attr]


def test_terminal_observation_is_no_view() -> None:
    env = batched("HumanoidRun", 2, env_kwargs={"max_episode_steps": 3})
    env.reset()
    actions = np.zeros((2, 17), dtype=np.float32)
    for _ in range(3):
        observations, _, dones, infos = env.step(actions)
    assert dones.all()
    kept, saved = infos[0]["terminal_observation"], infos[0]["terminal_observation"].copy()
    first = observations.copy()
    for _ in range(5):
        env.step(actions)
    np.testing.assert_array_equal(kept, saved)
    np.testing.assert_array_equal(observations, first)


def test_monitor_is_taken_over(tmp_path: Path) -> None:
    keywords = ("r_progress", "r_alive")
    env = batched(
        "HumanoidRun", 8, monitor_dir=str(tmp_path), monitor_kwargs={"info_keywords": keywords}
    )
    assert env.env_is_wrapped(Monitor) == [True] * 8
    env.reset()
    for actions in random_actions(env.action_space, 8, 100):  # type: ignore[arg-type]
        env.step(actions)
    env.close()
    episodes = load_results(str(tmp_path))
    assert len(episodes) >= 8
    np.testing.assert_allclose(episodes["r_alive"], 2 * episodes["l"])
    assert [path.name for path in tmp_path.iterdir()] == ["0.monitor.csv"]


def test_other_wrappers_and_envs_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="so the wrapper ClipAction would never run"):
        batched("HumanoidRun", 2, wrapper_class=gym.wrappers.ClipAction)
    with pytest.raises(
        ValueError, match=r"BatchedVecEnv needs a task of sb3_gcr, .* found PendulumEnv\."
    ):
        make_vec_env("Pendulum-v1", 2, vec_env_cls=BatchedVecEnv)  # type: ignore[arg-type]
    with pytest.raises(
        ValueError, match="Parameter `env_fns` must contain at least one function, found none"
    ):
        BatchedVecEnv([])
    with pytest.raises(
        ValueError, match="Parameter `n_threads` must be at least 1, or None for all CPUs, found 0"
    ):
        batched("HumanoidRun", 2, n_threads=0)
    with pytest.raises(ValueError, match="Parameter `n_simulations` must be at least 1, found 0"):
        Engine(make_task("Hopper"), 0)
    with pytest.raises(
        ValueError, match=r"Parameter `task` must be one of \['HumanoidRun', .* found 'Fly'"
    ):
        make_task("Fly")
    with pytest.raises(
        ValueError,
        match=r"Parameter `render_mode` must be one of \['human', 'rgb_array'\] or None, found 'x'",
    ):
        TaskEnv("HumanoidRun", render_mode="x")


def test_simulations_share_one_task() -> None:
    env = batched("HumanoidRun", 3)
    assert env.get_attr("render_mode", [0, 2]) == ["rgb_array"] * 2
    assert len(set(map(id, env.get_attr("task")))) == 1
    with pytest.raises(ValueError, match="Parameter `indices` must be None or all 3 simulations"):
        env.set_attr("speed", 2, indices=[1])
    with pytest.raises(ValueError, match="Parameter `indices` must be None or all 3 simulations"):
        env.env_method("close", indices=0)


def test_a_diverged_simulation_ends_its_own_episode_only() -> None:
    env, twin = (
        batched("HumanoidMO", 4, env_kwargs={"baseh": 3}),
        batched("HumanoidMO", 4, env_kwargs={"baseh": 3}),
    )
    env.reset()
    twin.reset()
    for step, actions in enumerate(random_actions(env.action_space, 4, 6)):  # type: ignore[arg-type]
        if step == 4:
            env.engine.rows.qvel[2, 7] = np.nan
        observations, rewards, dones, infos = env.step(actions)
        expected = twin.step(actions)
        others = [0, 1, 3]
        np.testing.assert_array_equal(observations[others], expected[0][others])
        np.testing.assert_array_equal(rewards[others], expected[1][others])
        if step == 4:
            assert dones.tolist() == [False, False, True, False]
            assert infos[2]["diverged"]
            assert not infos[2]["TimeLimit.truncated"]
            assert not env.reward_components[2].any()
            np.testing.assert_array_equal(infos[2]["terminal_observation"], last[2])  # noqa: F821
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
        last = observations  # noqa: F841
    assert env.n_diverged == 1


def test_steps_that_cannot_be_made_are_refused() -> None:
    env = batched("Hopper", 3)
    actions = np.zeros((3, 3), dtype=np.float32)
    with pytest.raises(
        RuntimeError,
        match="BatchedVecEnv must be reset before a step, and cannot step after `close`",
    ):
        env.step(actions)
    env.reset()
    with pytest.raises(
        ValueError, match=r"Parameter `actions` must have shape \(3, 3\), found \(3,\)"
    ):
        env.step(actions[0])
    env.close()
    with pytest.raises(RuntimeError, match="cannot step after `close`"):
        env.step(actions)


def test_actions_that_are_no_numbers_end_their_episode() -> None:
    env = batched("HumanoidRun", 3)
    env.reset()
    actions = np.zeros((3, 17), dtype=np.float32)
    actions[1, 4] = np.nan
    observations, rewards, dones, infos = env.step(actions)
    assert dones.tolist() == [False, True, False]
    assert infos[1]["diverged"]
    assert np.isfinite(observations).all()
    assert np.isfinite(rewards).all()
    assert np.isfinite(env.step(np.zeros_like(actions))[0]).all()


def test_divergence_is_logged() -> None:
    env = batched("HumanoidRun", 4)
    model = GCRPPO("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=1)
    env.engine.n_diverged = 3
    logged = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Logger,
            "dump",
            lambda self, step=0: logged.append(self.name_to_value["rollout/n_diverged"]),
        )
        model.learn(64)
    assert logged == [3]


def test_an_error_in_one_simulation_leaves_the_others_their_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env, twin = batched("Hopper", 3), batched("Hopper", 3)
    env.reset()
    twin.reset()
    step = env.engine.batch.step

    def failing(**kwargs: Any) -> None:
        step(ids=[0, 2], **kwargs)
        raise mujoco_batch.SimulationError(np.array([1]), "stack overflow", 3)

    monkeypatch.setattr(type(env.engine.batch), "step", lambda self, **kwargs: failing(**kwargs))
    actions = np.full((3, 3), 0.5, dtype=np.float32)
    with pytest.warns(UserWarning, match=r"stack overflow Their episodes end here\."):
        observations, _, dones, _ = env.step(actions)
    monkeypatch.undo()
    assert dones.tolist() == [False, True, False]
    np.testing.assert_array_equal(observations[[0, 2]], twin.step(actions)[0][[0, 2]])


def test_closing_leaves_no_thread() -> None:
    code = (
        "import os, numpy as np; from sb3_gcr.envs import BatchedVecEnv\n"
        "from stable_baselines3.common.env_util import make_vec_env\n"
        "threads = lambda: len(os.listdir('/proc/self/task'))\n"
        f"make = lambda: make_vec_env('{RUN}', 8, vec_env_cls=BatchedVecEnv, "
        f"vec_env_kwargs={{'n_threads': 3}})\n"
        "make().close(); before = threads()\n"
        "env = make(); env.reset(); env.step(np.zeros((8, 17))); during = threads(); env.close(); "
        "env.close()\n"
        "print(during - before, threads() - before)"
    )
    if not Path("/proc/self/task").exists():
        pytest.skip("needs /proc")
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert result.stdout.split() == ["2", "0"]
