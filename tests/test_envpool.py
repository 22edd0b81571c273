"""EnvPool's envs as a VecEnv: components, ends of episodes, seeds, threads, and the words of every
error.
"""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_gcr import GCRPPO
from sb3_gcr.rewards.reading import ComponentReader
from sb3_gcr.rewards.sums import SUM_TOLERANCE, find_fault
from sb3_gcr.simulators.envpool import ENVPOOL_ENVS, EnvPoolVecEnv
from sb3_gcr.simulators.envpool_gym import pool_of

envpool = pytest.importorskip("envpool")

IDS = sorted(ENVPOOL_ENVS)
CLIPPED = {
    "BarkourJoystick-v1",
    "BerkeleyHumanoidJoystickFlatTerrain-v1",
    "BerkeleyHumanoidJoystickRoughTerrain-v1",
    "Go1Footstand-v1",
    "Go1Getup-v1",
    "Go1Handstand-v1",
    "Go1JoystickFlatTerrain-v1",
    "Go1JoystickRoughTerrain-v1",
    "H1JoystickGaitTracking-v1",
    "Op3Joystick-v1",
    "SpotFlatTerrainJoystick-v1",
    "SpotGetup-v1",
    "T1JoystickFlatTerrain-v1",
    "T1JoystickRoughTerrain-v1",
}


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def actions_of(env: VecEnv, steps: int, size: float = 1.0) -> NDArray[Any]:
    """Random actions of shape (T, N, A), the same for every env with these spaces."""
    space = env.action_space
    draw = np.random.default_rng(0).uniform(
        size * space.low, size * space.high, (steps, env.num_envs, *space.shape)
    )  # type: ignore[attr-defined]
    return draw.astype(np.float32)


def rows(observations: Any) -> NDArray[Any]:
    """Observations as an array of shape (N, D)."""
    if isinstance(observations, dict):
        return np.concatenate([observations[key] for key in sorted(observations)], axis=-1)
    return observations


def spy(env: EnvPoolVecEnv, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What EnvPool returns to the adapter, copied; steps only."""
    seen: list[Any] = []
    receive = env._pool.recv

    def recv(reset: bool = False, return_info: bool = True) -> Any:
        result = receive(reset, return_info)
        if not reset:
            seen.append(
                (
                    result[1].copy(),
                    {key: np.array(result[4][key]) for key in result[4] if key != "players"},
                )
            )
        return result

    monkeypatch.setattr(env._pool, "recv", recv)
    return seen


@pytest.mark.parametrize("env_id", IDS)
def test_terms_of_the_table_sum_to_the_reward(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = EnvPoolVecEnv(env_id, 2, num_threads=1)
    assert env.reset_infos == [{}, {}]
    assert rows(env.reset()).shape[0] == 2
    assert env.action_space.dtype == np.float32
    seen = spy(env, monkeypatch)
    names = set(env.reward_spec.names)
    assert names <= set(ENVPOOL_ENVS[env_id])
    for action in actions_of(env, 60):
        observations, rewards, dones, infos = env.step(action)
        raw, info = seen[-1]
        components = env.reward_components
        assert components.shape == (2, len(env.reward_spec))
        assert find_fault(components, rewards, env.reward_spec, 1e-5) is None
        assert rewards.dtype == np.float32
        if env_id in CLIPPED:
            np.testing.assert_allclose(np.maximum(rewards, 0), raw, atol=1e-7)
            np.testing.assert_array_equal(rewards[raw > 0], raw[raw > 0])
        else:
            np.testing.assert_array_equal(rewards, raw)
        others = {key for key in info if key.startswith("reward_")} - names
        if not env_id.startswith("Panda"):  # what the table leaves out is 0
            assert not any(info[key].any() for key in others)
        assert [bool(info) for info in infos] == list(dones)
    assert env.observation_space.contains(
        {key: value[0] for key, value in observations.items()}
        if isinstance(observations, dict)
        else observations[0]
    )
    env.close()


def test_clipped_rewards_are_paid_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step whose terms sum to less than 0 is one that EnvPool pays 0."""
    env = EnvPoolVecEnv("Go1JoystickFlatTerrain-v1", 1, num_threads=1)
    env.reset()
    seen = spy(env, monkeypatch)
    paid = np.array([env.step(action)[1][0] for action in actions_of(env, 30)])
    given = np.array([raw[0] for raw, _ in seen])
    assert (paid < 0).any()
    np.testing.assert_array_equal(given[paid < 0], 0)
    dt = env._pool.config["ctrl_dt"]
    sums = [sum(info[key][0] for key in info if key.startswith("reward_")) * dt for _, info in seen]
    np.testing.assert_allclose(paid, sums, rtol=1e-5)
    env.close()


def test_success_of_the_hand_is_not_times_the_time_step(monkeypatch: pytest.MonkeyPatch) -> None:
    env = EnvPoolVecEnv(
        "LeapCubeReorient-v1", 1, num_threads=1, success_threshold=3.2, success_reward=7.0
    )
    env.reset()
    seen = spy(env, monkeypatch)
    rewards = env.step(actions_of(env, 1)[0])[1]
    assert env.reward_components[0, env.reward_spec.names.index("reward_success")] == 7.0
    assert rewards[0] == seen[0][0] == pytest.approx(env.reward_components.sum())
    env.close()


def test_weights_in_the_settings_choose_the_terms() -> None:
    assert "reward_torques" not in EnvPoolVecEnv("G1JoystickFlatTerrain-v1", 1).reward_spec.names
    assert (
        "reward_torques"
        in EnvPoolVecEnv("G1JoystickFlatTerrain-v1", 1, torques_scale=-1e-5).reward_spec.names
    )
    assert (
        "reward_success"
        not in EnvPoolVecEnv("LeapCubeReorient-v1", 1, success_reward=0.0).reward_spec.names
    )
    aliased = EnvPoolVecEnv("MuJoCoPlayground/PandaPickCube-v1", 1)
    assert list(aliased.reward_spec) == list(EnvPoolVecEnv("PandaPickCube-v1", 1).reward_spec)
    np.testing.assert_allclose(aliased._factors, [4, 8, 0.25, 0.3])


def test_residual_takes_the_rest_of_the_reward(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reward that is no sum of its terms, and a level of its own for the rest."""
    components = {"reward_dist": "task", "reward_near": 2}
    env = EnvPoolVecEnv("Pusher-v4", 2, num_threads=1, components=components, residual={"rest": 1})
    assert env.reward_spec.to_dict() == {"reward_dist": 0, "reward_near": 2, "rest": 1}
    env.reset()
    seen = spy(env, monkeypatch)
    rewards = env.step(actions_of(env, 1)[0])[1]
    np.testing.assert_array_equal(rewards, seen[0][0])
    np.testing.assert_allclose(env.reward_components.sum(1), rewards, rtol=1e-6)
    np.testing.assert_array_equal(env.reward_components[:, 0], seen[0][1]["reward_dist"])
    assert (
        EnvPoolVecEnv("Pusher-v4", 2, components=components, residual="rest").reward_spec.to_dict()[
            "rest"
        ]
        == 0
    )
    env.close()


def test_episodes_are_those_of_a_pool_without_our_resets() -> None:
    """Until the first end of each env, and the start that follows it, EnvPool's own stepping shows
    the same.
    """
    env = EnvPoolVecEnv("Humanoid-v5", 4, num_threads=2, seed=7)
    pool = envpool.make("Humanoid-v5", "gymnasium", num_envs=4, num_threads=2, seed=7)
    previous: Any = env.reset()
    np.testing.assert_array_equal(previous, pool.reset()[0])
    running, just_ended = np.ones(4, bool), np.zeros(4, bool)
    for step, action in enumerate(actions_of(env, 60), start=1):
        observations, _, dones, infos = env.step(action)
        expected, _, terminated, truncated, _ = pool.step(action)
        np.testing.assert_array_equal(expected[just_ended], previous[just_ended])
        just_ended = running & (terminated | truncated)
        np.testing.assert_array_equal(dones[running], just_ended[running])
        for index in np.flatnonzero(just_ended):
            np.testing.assert_array_equal(infos[index]["terminal_observation"], expected[index])
            assert infos[index]["TimeLimit.truncated"] is False
            assert infos[index]["episode"]["l"] == step
        running &= ~just_ended
        np.testing.assert_array_equal(observations[running], expected[running])
        previous = observations
    assert not running.any()
    env.close()


@pytest.mark.parametrize("env_id", ["Humanoid-v5", "Go1JoystickFlatTerrain-v1"])
def test_time_limits_and_statistics(env_id: str) -> None:
    """Every step is counted once, what an end returns stays as it was, and its sums are those of
    the steps.
    """
    env = EnvPoolVecEnv(env_id, 3, num_threads=1, max_episode_steps=20)
    assert env.env_is_wrapped(Monitor, indices=[0, 2]) == [True, True]
    assert env.env_is_wrapped(VecMonitor) == [False] * 3  # type: ignore[arg-type]
    env.reset()
    lengths, returns = np.zeros(3, int), np.zeros((3, len(env.reward_spec)))
    kept: list[tuple[Any, Any]] = []
    kinds = set()
    for step, action in enumerate(actions_of(env, 70)):
        if step == 45:
            env.reset()
            lengths[:], returns[:] = 0, 0
        observations, _, dones, infos = env.step(action)
        kept.append((rows(observations), rows(observations).copy()))
        lengths += 1
        returns += env.reward_components
        for index in np.flatnonzero(dones):
            info, episode = infos[index], infos[index]["episode"]
            kept.append(
                (rows(info["terminal_observation"]), rows(info["terminal_observation"]).copy())
            )
            assert not np.array_equal(rows(info["terminal_observation"]), rows(observations)[index])
            assert episode["l"] == info["elapsed_step"] == lengths[index]
            assert episode["r"] == pytest.approx(returns[index].sum(), abs=1e-4)
            assert [episode[f"r_{name}"] for name in env.reward_spec.names] == pytest.approx(
                returns[index], abs=1e-5
            )
            assert isinstance(episode["r"], float)
            kinds.add((info["TimeLimit.truncated"], bool(lengths[index] == 20)))
        lengths[dones], returns[dones] = 0, 0
    assert (True, True) in kinds
    assert (True, False) not in kinds
    for value, copy in kept:
        np.testing.assert_array_equal(value, copy)
    env.close()


def test_a_fall_in_the_last_step_of_the_limit_is_no_truncation() -> None:
    """EnvPool itself says that it is one."""

    def first_end(**settings: Any) -> tuple[int, bool]:
        env = EnvPoolVecEnv("Humanoid-v5", 1, num_threads=1, seed=3, **settings)
        env.reset()
        for step, action in enumerate(actions_of(env, 100), start=1):
            _, _, dones, infos = env.step(action)
            if dones[0]:
                env.close()
                return step, infos[0]["TimeLimit.truncated"]
        raise AssertionError("no end")

    fall, truncated = first_end()
    assert not truncated
    assert first_end(max_episode_steps=fall) == (fall, False)
    assert first_end(max_episode_steps=fall - 1) == (fall - 1, True)


def test_seeds() -> None:
    env = EnvPoolVecEnv("Reacher-v5", 3, num_threads=1, seed=5)
    first = env.reset()
    again = env.reset()
    assert not np.array_equal(first, again)
    assert list(env.seed(5)) == [5, 6, 7]
    np.testing.assert_array_equal(env.reset(), first)
    np.testing.assert_array_equal(env.reset(), again)
    other = EnvPoolVecEnv("Reacher-v5", 3, num_threads=1, seed=6)
    np.testing.assert_array_equal(other.reset()[:2], first[1:])
    np.random.seed(0)
    drawn = [EnvPoolVecEnv("Reacher-v5", 1, num_threads=1, seed=None).reset() for _ in range(2)]
    assert not np.array_equal(*drawn)
    env.close()
    other.close()


@pytest.mark.parametrize(
    ("env_id", "policy"),
    [("Humanoid-v5", "MlpPolicy"), ("Go1JoystickRoughTerrain-v1", "MultiInputPolicy")],
)
def test_gcrppo_trains(env_id: str, policy: str) -> None:
    env = EnvPoolVecEnv(env_id, 4, num_threads=1, max_episode_steps=15)
    model = GCRPPO(
        policy,
        env,
        n_steps=16,
        batch_size=32,
        n_epochs=2,
        seed=1,
        policy_kwargs={"net_arch": [8]},
        device="cpu",
    )
    model.set_logger(configure(None, []))
    logged: list[dict[str, float]] = []
    model.logger.dump = lambda step=0: logged.append(dict(model.logger.name_to_value))  # type: ignore[method-assign]
    model.learn(2 * 4 * 16)
    assert model.reward_spec == env.reward_spec
    returns = [logged[-1][f"rollout/ep_rew/{name}"] for name in env.reward_spec.names]
    assert sum(returns) == pytest.approx(logged[-1]["rollout/ep_rew_mean"], rel=1e-4, abs=1e-4)
    assert logged[-1]["rollout/ep_len_mean"] <= 15
    mean, _ = evaluate_policy(model, env, n_eval_episodes=4)
    assert np.isfinite(mean)
    env.close()


@pytest.mark.parametrize("wrapper", [VecNormalize, VecMonitor, VecFrameStack])
def test_wrappers_on_top(wrapper: Any) -> None:
    pool = EnvPoolVecEnv("Ant-v5", 2, num_threads=1, max_episode_steps=5)
    if wrapper is VecMonitor:
        with pytest.warns(UserWarning, match="already wrapped with a `Monitor`"):
            env: VecEnv = VecMonitor(pool)
    else:
        env = wrapper(pool, **({"n_stack": 3} if wrapper is VecFrameStack else {}))
    env.reset()
    reader = ComponentReader(env, pool.reward_spec)
    for step, action in enumerate(actions_of(env, 12, size=0.1), start=1):
        observations, rewards, dones, infos = env.step(action)
        components, original = reader.read(rewards, infos, step)
        np.testing.assert_array_equal(original, pool.reward_components)
        assert find_fault(components, rewards, pool.reward_spec, SUM_TOLERANCE) is None
        assert dones.all() == (step % 5 == 0)
        for info in (info for info, done in zip(infos, dones, strict=True) if done):
            assert info["terminal_observation"].shape == observations[0].shape
            assert info["TimeLimit.truncated"] is True
            assert info["episode"]["l"] == 5
    env.close()


def test_no_thread_is_left() -> None:
    code = """
import os, numpy as np
from sb3_gcr.simulators.envpool import EnvPoolVecEnv
env = EnvPoolVecEnv("HalfCheetah-v5", 4, num_threads=2)
before = len(os.listdir("/proc/self/task"))
for _ in range(2):
    env.reset()
    env.step(np.zeros((4, 6)))
    assert len(os.listdir("/proc/self/task")) > before
    env.close()
    env.close()
    assert len(os.listdir("/proc/self/task")) == before
env.reset()
env.step_async(np.zeros((4, 6)))
env.reset()
env.step_async(np.zeros((4, 6)))
env.close()
assert len(os.listdir("/proc/self/task")) == before
"""
    if not sys.platform.startswith("linux"):
        pytest.skip("threads are counted in /proc")
    subprocess.run([sys.executable, "-c", code], check=True)


def test_imports_without_envpool(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "envpool", None)
    message = "EnvPoolVecEnv needs EnvPool (Python 3.11 or newer): pip install 'sb3_gcr[envpool]'"
    with pytest.raises(ImportError, match=exactly(message)):
        EnvPoolVecEnv("Ant-v5", 1)


PUSHER = "['reward_ctrl', 'reward_dist', 'reward_near']"
SETTINGS = sorted(
    set(envpool.make_spec("Pusher-v5").config._asdict())
    - {
        "num_envs",
        "batch_size",
        "num_threads",
        "max_num_players",
        "seed",
        "env_seed",
        "gym_reset_return_info",
    }
)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"num_envs": 0}, ValueError, "Parameter `num_envs` must be an integer ≥ 1, found 0."),
        (
            {"num_envs": True},
            ValueError,
            "Parameter `num_envs` must be an integer ≥ 1, found True.",
        ),
        (
            {"num_threads": 1.5},
            ValueError,
            "Parameter `num_threads` must be an integer ≥ 1, found 1.5.",
        ),
        (
            {"max_episode_steps": 0},
            ValueError,
            "Parameter `max_episode_steps` must be an integer ≥ 1, found 0.",
        ),
        ({"seed": -1}, ValueError, "Parameter `seed` must be None or an integer ≥ 0, found -1."),
        ({"seed": 0.5}, ValueError, "Parameter `seed` must be None or an integer ≥ 0, found 0.5."),
        (
            {"env_id": "Ant-v9"},
            ValueError,
            "Parameter `env_id` must be an id of EnvPool, found 'Ant-v9': valid choices are "
            f"{IDS}, "
            "and with `components` others of `envpool.list_all_envs()`.",
        ),
        (
            {"env_id": "Hopper-v5"},
            ValueError,
            "Parameter `env_id` must be an env that reports the terms of its reward, found "
            "'Hopper-v5': "
            f"valid choices are {IDS}.",
        ),
        (
            {"env_id": "Reacher-v4"},
            ValueError,
            "Parameter `components` must be given for 'Reacher-v4': levels are known only for "
            f"{IDS}. "
            "The terms in its info are ['reward_ctrl', 'reward_dist'].",
        ),
        (
            {"components": {"reward_speed": "task"}},
            ValueError,
            "Parameter `components` must name keys of the info, found 'reward_speed': valid "
            f"choices are {PUSHER}.",
        ),
        (
            {"components": ["reward_near"]},
            TypeError,
            "Parameter `components` must map names to levels, found ['reward_near'].",
        ),
        (
            {"components": {}},
            ValueError,
            "Parameter `names` must name at least one reward component, found none.",
        ),
        (
            {"components": {"reward_dist": "boss"}},
            ValueError,
            "Unknown level 'boss' of reward component 'reward_dist': valid choices are "
            "['regulariser', 'regularizer', 'task'] and integers from 0 (highest priority) on.",
        ),
        (
            {"residual": 3},
            ValueError,
            "Parameter `residual` must be a name or {name: level}, found 3.",
        ),
        (
            {"batch_size": 1},
            TypeError,
            f"'Pusher-v5' has no setting `batch_size`: valid choices are {SETTINGS}.",
        ),
        (
            {"ctrl_cost_weight": "high"},
            TypeError,
            "EnvPool's settings of 'Pusher-v5' must have the types of their defaults, found "
            "{'ctrl_cost_weight': 'high'}.",
        ),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], error: Any, message: str) -> None:
    with pytest.raises(error, match=exactly(message)):
        EnvPoolVecEnv(**{"env_id": "Pusher-v5", "num_envs": 1, **arguments})


def test_misuse() -> None:
    env = EnvPoolVecEnv("Pusher-v5", 2, num_threads=1)
    with pytest.raises(RuntimeError, match=exactly("EnvPoolVecEnv must be reset before a step.")):
        env.step(np.zeros((2, 7)))
    env.reset()
    with pytest.raises(RuntimeError, match=exactly("`step_wait` must follow `step_async`.")):
        env.step_wait()
    with pytest.raises(
        ValueError, match=exactly("Parameter `actions` must have shape (2, 7), found (7,).")
    ):
        env.step(np.zeros(7))
    env.step_async(np.zeros((2, 7)))
    env.reset()  # gives the pending step up
    assert not any(env.step(np.zeros((2, 7)))[2])
    with pytest.raises(AttributeError):
        env.get_attr("spec")
    assert env.get_attr("env_id", indices=0) == ["Pusher-v5"]
    message = (
        "EnvPool's envs take their settings at construction: EnvPoolVecEnv(..., "
        "ctrl_cost_weight=...)."
    )
    with pytest.raises(NotImplementedError, match=exactly(message)):
        env.set_attr("ctrl_cost_weight", 1.0)
    with pytest.raises(
        NotImplementedError,
        match=exactly("EnvPool's envs have no Python methods, found a call of 'jump'."),
    ):
        env.env_method("jump")
    env.close()


def test_gymnasium_ids_make_one_env_with_the_same_numbers() -> None:
    """Observations, rewards, terms and ends of one env are those of the pool, over several
    episodes.
    """
    env = gym.make("envpool/Humanoid-v5")
    pool = EnvPoolVecEnv("Humanoid-v5", 1, 1, seed=5)
    first, rows = env.reset(seed=5)[0], pool.reset()
    rng, n_ended = np.random.default_rng(0), 0
    for _ in range(100):
        np.testing.assert_array_equal(first, rows[0])
        action = rng.uniform(-0.4, 0.4, 17).astype(np.float32)
        first, reward, terminated, truncated, info = env.step(action)
        rows, rewards, dones, infos = pool.step(action[None])
        assert reward == rewards[0]
        assert (terminated or truncated) == dones[0]
        np.testing.assert_array_equal(info["reward_components"], pool.reward_components[0])
        if dones[0]:
            np.testing.assert_array_equal(first, infos[0]["terminal_observation"])
            assert info["r_reward_quadctrl"] == pytest.approx(
                infos[0]["r_reward_quadctrl"], abs=1e-5
            )
            first, rows = env.reset(seed=n_ended)[0], (pool.seed(n_ended), pool.reset())[1]
            n_ended += 1
    assert n_ended >= 2
    env.close()
    pool.close()


@pytest.mark.filterwarnings("ignore:.*render_mode")  # make_vec_env asks for pictures
def test_pool_of_refuses_what_it_would_lose() -> None:
    with pytest.raises(ValueError, match="so the wrapper ClipAction would never run"):
        make_vec_env(
            "envpool/Ant-v5", 2, wrapper_class=gym.wrappers.ClipAction, vec_env_cls=pool_of
        )  # type: ignore[arg-type]
    with pytest.raises(
        ValueError,
        match=r"needs an env of EnvPool, such as 'envpool/Humanoid-v5', found PendulumEnv\.",
    ):
        make_vec_env("Pendulum-v1", 2, vec_env_cls=pool_of)  # type: ignore[arg-type]
    with pytest.raises(
        ValueError, match="Parameter `seed` must be None or an integer ≥ 0, found -3"
    ):
        EnvPoolVecEnv("Ant-v5", 2).seed(-3)
