"""The evaluation: one total, in the units of the place where the components are collected."""

from __future__ import annotations

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

from sb3_gcr import GCRPPO, RewardDecomposition, evaluate_components
from tests.envs import SPEC, BatchedEnv, Env
from tests.test_returns import Counting, Lives
from tests.training import SMALL, exactly


@pytest.fixture(scope="module")
def model() -> GCRPPO:
    return GCRPPO("MlpPolicy", Counting(), n_steps=8, batch_size=8, device="cpu")


def scaled(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return gym.wrappers.TransformReward(env, lambda reward: 0.01 * float(reward))


class CountingInInfo(Counting):
    """The same, to be collected."""

    def step(self, action: Any) -> Any:
        *others, info = super().step(action)
        count, cost = info["reward_components"]
        return *others, {"count": count, "cost": cost}


def collected() -> gym.Env[Any, Any]:
    return RewardDecomposition(CountingInInfo(), {"count": 0, "cost": 1})


@pytest.mark.parametrize(
    "make",
    [
        lambda: Monitor(Counting()),
        lambda: Counting(),
        lambda: VecNormalize(DummyVecEnv([lambda: Monitor(Counting())] * 3)),
        lambda: VecNormalize(DummyVecEnv([Counting] * 3)),
        lambda: VecMonitor(VecNormalize(VecNormalize(DummyVecEnv([Counting] * 3)))),
        lambda: Lives(Monitor(Counting())),
        lambda: scaled(collected()),
    ],
)
def test_an_episode_pays_55_and_costs_10(model: GCRPPO, make: Any) -> None:
    env = make()
    if isinstance(env, VecNormalize):
        env.training = False
    found = evaluate_components(model, env, 5, warn=False)
    assert found == (45, 0, {"count": 55, "cost": -10}, {"count": 0, "cost": 0})
    rewards, lengths, parts = evaluate_components(
        model, make(), 5, return_episode_rewards=True, warn=False
    )
    assert (rewards, lengths) == ([45] * 5, [10] * 5)
    assert parts == {"count": [55] * 5, "cost": [-10] * 5}


def test_the_parts_sum_to_the_total_whatever_the_env(model: GCRPPO) -> None:
    """Episodes of random length in several envs, of which some have fewer episodes to play."""
    model = GCRPPO("MlpPolicy", Env(), n_steps=8, batch_size=8, device="cpu")
    env: VecEnv = VecNormalize(DummyVecEnv([Env] * 3))
    env.seed(0)
    rewards, lengths, parts = evaluate_components(
        model, env, 7, return_episode_rewards=True, warn=False
    )
    assert len(rewards) == len(lengths) == 7
    assert list(parts) == list(SPEC.names)
    np.testing.assert_allclose(np.sum(list(parts.values()), axis=0), rewards, rtol=1e-12)


def test_the_callback_and_the_threshold_are_those_of_sb3(model: GCRPPO) -> None:
    seen: list[int] = []
    evaluate_components(
        model,
        DummyVecEnv([Counting] * 2),
        3,
        callback=lambda local, _: seen.append(local["i"]),
        warn=False,
    )
    assert (seen.count(0), seen.count(1)) == (10, 20)
    assert evaluate_components(model, Counting(), 1, reward_threshold=44, warn=False)
    with pytest.raises(AssertionError, match=r"^Mean reward below threshold: 45\.00 < 46\.00$"):
        evaluate_components(model, Counting(), 1, reward_threshold=46, warn=False)


def test_components_that_do_not_add_up_are_refused(model: GCRPPO) -> None:
    message = (
        "Env index 0 at timestep 1: The reward components must sum to the reward 0, found 0 "
        "(count=1, cost=-1)."
    )

    class Wrong(Counting):
        def step(self, action: Any) -> Any:
            observation, reward, *others = super().step(action)
            return observation, reward + 0.5, *others

    message = (
        "Env index 0 at timestep 1: The reward components must sum to the reward 0.5, found 0 "
        "(count=1, cost=-1). Name the missing terms, or collect the rest in a component of its own "
        'with `RewardDecomposition(residual="name")`.'
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        evaluate_components(model, Wrong(), 1, warn=False)


def test_a_simulator_with_an_array_of_components() -> None:
    model = GCRPPO("MlpPolicy", Env(), n_steps=8, batch_size=8, device="cpu")
    env = BatchedEnv()
    env.infos = [{}] * 4
    found = evaluate_components(model, VecNormalize(env), 5, warn=False)
    assert sum(found.component_means.values()) == pytest.approx(found.mean_reward, rel=1e-12)


def test_an_env_without_components(model: GCRPPO) -> None:
    message = (
        "Parameter `env` must report reward components, found none. Wrap it with "
        "`RewardDecomposition`."
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        evaluate_components(model, DummyVecEnv([lambda: Env(None)]), 1)


class BatchedEnvWithInfos(BatchedEnv):
    def __init__(self) -> None:
        super().__init__()
        self.infos = [{} for _ in range(4)]


def test_means_and_episodes_of_a_vec_env() -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL)
    env = make_vec_env(Env, 3, seed=1)
    result = evaluate_components(model, env, 7)
    assert list(result.component_means) == list(SPEC.names)
    assert sum(result.component_means.values()) == pytest.approx(result.mean_reward, rel=1e-5)
    rewards, lengths, components = evaluate_components(model, env, 7, return_episode_rewards=True)
    np.testing.assert_allclose(
        np.sum(list(components.values()), axis=0), rewards, rtol=1e-4, atol=1e-4
    )
    assert len(lengths) == 7
    batched = evaluate_components(model, BatchedEnvWithInfos(), 3, warn=False)
    assert np.isfinite(list(batched.component_means.values())).all()
    message = (
        "Parameter `env` must report reward components, found none. Wrap it with "
        "`RewardDecomposition`."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        evaluate_components(model, make_vec_env(lambda: Env(None), 1), 1)
