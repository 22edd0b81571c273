"""One total: the returns of the components sum to the return, whatever a callback or a wrapper
does.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecMonitor,
    VecNormalize,
)

from sb3_gcr import GCRPPO, RewardSpec
from sb3_gcr.rewards.layers import layers_of
from sb3_gcr.rewards.returns import find_ended, zero_on_reset

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 32, "n_epochs": 1, "seed": 0, "device": "cpu"}


class Counting(gym.Env[Any, Any]):
    """Pays (t, -1) in step t of an episode of 10, so that an episode pays 55 - 10."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)
    reward_spec = RewardSpec(("count", "cost"), (0, 1))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        info = {"reward_components": np.array([self.t, -1.0])}
        return np.zeros(1, np.float32), self.t - 1.0, self.t == 10, False, info


class Lives(gym.Wrapper[Any, Any, Any, Any]):
    """Reports the loss of a life as the end of an episode, every 4 steps, as SB3's EpisodicLife."""

    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        self.was_real = True

    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs) if self.was_real else (np.zeros(1, np.float32), {})

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.was_real = terminated or truncated
        is_lost = self.unwrapped.t % 4 == 0  # type: ignore[attr-defined]
        return observation, reward, terminated or is_lost, truncated, info


class Resets(BaseCallback):
    """Resets the envs in the middle of their episodes, in one of the ways that there are."""

    def __init__(self, way: str):
        super().__init__()
        self.way = way

    def _on_step(self) -> bool:
        if self.n_calls == 7:
            self._reset()
        return True

    def _on_rollout_end(self) -> None:
        self._reset()

    def _reset(self) -> None:
        if self.way == "reset":
            self.training_env.reset()
        elif self.way == "unwrapped":
            layers_of(self.training_env)[-1].reset()
        elif self.way == "one":
            self.training_env.env_method("reset", indices=[1])


class Means(BaseCallback):
    """Keeps what is logged."""

    def _on_training_start(self) -> None:
        self.logged: list[dict[str, Any]] = []
        record = self.logger.dump

        def dump(step: int = 0) -> None:
            self.logged.append(dict(self.logger.name_to_value))
            record(step)

        self.logger.dump = dump  # type: ignore[method-assign]

    def _on_step(self) -> bool:
        return True


def learn(algorithm: Any, env: VecEnv, callback: list[BaseCallback]) -> tuple[Any, dict[str, Any]]:
    means = Means()
    model = algorithm("MlpPolicy", env, **SMALL).learn(64, callback=[means, *callback])
    return model, means.logged[-1]


@pytest.mark.parametrize("way", ["none", "reset", "unwrapped", "one"])
@pytest.mark.parametrize("around", [lambda env: env, VecNormalize])
def test_returns_are_ppos_after_a_reset_in_a_callback(way: str, around: Any) -> None:
    expected, logged = (
        learn(
            algorithm,
            around(DummyVecEnv([lambda: Monitor(Counting())] * 2)),
            [Resets(way)],
        )[1]
        for algorithm in (PPO, GCRPPO)
    )
    assert logged["rollout/ep_rew_mean"] == expected["rollout/ep_rew_mean"] == 45
    assert logged["rollout/ep_rew/count"] == 55
    assert logged["rollout/ep_rew/cost"] == -10


def test_returns_with_worker_processes() -> None:
    env = SubprocVecEnv([lambda: Monitor(Counting())] * 2)
    _, logged = learn(GCRPPO, env, [Resets("reset")])
    env.close()
    assert logged["rollout/ep_rew/count"] == 55
    assert logged["rollout/ep_rew_mean"] == 45


def test_an_episode_ends_with_the_last_life() -> None:
    _, logged = learn(GCRPPO, DummyVecEnv([lambda: Lives(Monitor(Counting()))]), [])
    assert logged["rollout/ep_rew/count"] == 55
    assert logged["rollout/ep_rew_mean"] == 45


def test_without_a_monitor_an_episode_ends_with_each_life() -> None:
    model, _ = learn(GCRPPO, DummyVecEnv([lambda: Lives(Counting())]), [])
    returns = {tuple(row) for row in np.array(model.ep_component_buffer).tolist()}
    assert returns == {(10.0, -4.0), (26.0, -4.0), (19.0, -2.0)}


def test_the_mean_return_is_in_the_units_of_its_parts() -> None:
    """VecMonitor outside VecNormalize says normalised returns, the parts are in the env's units."""
    env = VecMonitor(VecNormalize(DummyVecEnv([Counting])))
    _, logged = learn(GCRPPO, env, [])
    assert logged["rollout/ep_rew_mean"] == 45
    assert logged["rollout/ep_rew/count"] + logged["rollout/ep_rew/cost"] == 45


def test_a_vec_env_is_as_it_was_after_a_callback() -> None:
    env = DummyVecEnv([Counting])
    running = np.ones((1, 2))
    before = dict(vars(env))
    with zero_on_reset(VecNormalize(env), running):
        env.env_method("close")
        assert running.sum() == 2
        env.reset()
    assert running.sum() == 0
    assert vars(env).keys() == before.keys()


def test_ends_without_infos() -> None:
    dones = np.array([False, True, True])
    assert find_ended(dones, [], True).tolist() == [1, 2]
    assert find_ended(dones, [{}, {}, {"episode": {}}], True).tolist() == [2]
    assert find_ended(dones, [{}, {}, {"episode": {}}], False).tolist() == [1, 2]
