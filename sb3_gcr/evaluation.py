"""Evaluate a policy and see what each reward component paid."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gcr.rewards.reading import ComponentReader, find_reward_spec


class ComponentEvaluation(NamedTuple):
    """Return per episode, and the part of each component in it, by name; the parts sum to it."""

    mean_reward: float
    std_reward: float
    component_means: dict[str, float]
    component_stds: dict[str, float]


def evaluate_components(
    model: PolicyPredictor,
    env: gym.Env[Any, Any] | VecEnv,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    render: bool = False,
    callback: Any = None,
    reward_threshold: float | None = None,
    return_episode_rewards: bool = False,
    warn: bool = True,
) -> ComponentEvaluation | tuple[list[float], list[int], dict[str, list[float]]]:
    """SB3's ``evaluate_policy`` with the undiscounted return of every component, in the units of
    the place where the components are collected; the return of an episode is their sum.

    Where the first few hundred steps show that a residual hides a mistake, a warning says so.

    :param model: anything with ``predict``
    :param env: an env or VecEnv that reports reward components
    :param n_eval_episodes: number of episodes
    :param deterministic: whether to take the policy's mode instead of a sample
    :param render: whether to render
    :param callback: called with ``locals(), globals()`` for every env after each step, as in SB3
    :param reward_threshold: raise if the mean return is not above it, as in SB3
    :param return_episode_rewards: return lists per episode instead of means
    :param warn: warn about a missing ``Monitor``
    :return: means and standard deviations; or returns and lengths per episode, and the returns of
        each component by name
    :raises ValueError: if the env reports no components, or wrong ones
    :raises AssertionError: if the mean return is not above ``reward_threshold``
    """
    venv = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
    spec = find_reward_spec(venv)
    if spec is None:
        raise ValueError(
            "Parameter `env` must report reward components, found none. Wrap it with "
            "`RewardDecomposition`."
        )
    reader = ComponentReader(venv, spec)
    episodes = _Episodes(reader, venv.num_envs)

    def collect(local_variables: dict[str, Any], global_variables: dict[str, Any]) -> None:
        episodes.add(local_variables)
        if callback is not None:
            callback(local_variables, global_variables)

    _, lengths = evaluate_policy(
        model,
        venv,
        n_eval_episodes=n_eval_episodes,
        deterministic=deterministic,
        render=render,
        callback=collect,
        return_episode_rewards=True,
        warn=warn,
    )
    reader.conclude()
    components = np.array(episodes.returns)
    rewards = components.sum(1)
    mean_reward = float(rewards.mean())
    if reward_threshold is not None and not mean_reward > reward_threshold:
        raise AssertionError(
            f"Mean reward below threshold: {mean_reward:.2f} < {reward_threshold:.2f}"
        )
    if return_episode_rewards:
        by_name = dict(zip(spec.names, components.T.tolist(), strict=True))
        return rewards.tolist(), lengths, by_name  # type: ignore[return-value]
    return ComponentEvaluation(
        mean_reward,
        float(rewards.std()),
        dict(zip(spec.names, components.mean(0).tolist(), strict=True)),
        dict(zip(spec.names, components.std(0).tolist(), strict=True)),
    )


class _Episodes:
    """Adds up the components of each episode in the callback of ``evaluate_policy``, which is
    called for one env after the other.

    :param reader: reads the components of a step
    :param num_envs: N
    """

    def __init__(self, reader: ComponentReader, num_envs: int):
        self.returns: list[NDArray[np.float64]] = []
        self._reader = reader
        self._running = np.zeros((num_envs, len(reader.spec)))
        self._rows = self._running
        self._index, self._n_steps = num_envs, 0

    def add(self, local_variables: dict[str, Any]) -> None:
        """Count a step of an env.

        :param local_variables: those of ``evaluate_policy``
        """
        index, info = local_variables["i"], local_variables["info"]
        # The envs that still have episodes to play come in order, so this is a new step.
        if index <= self._index:
            self._n_steps += 1
            self._rows = self._reader.read_original(
                local_variables["rewards"], local_variables["infos"], self._n_steps
            )
        self._index = index
        self._running[index] += self._rows[index]
        # An episode ends where evaluate_policy counts it: a wrapper may report the loss of a life
        # as done.
        is_monitored = local_variables["is_monitor_wrapped"]
        if local_variables["done"] and (not is_monitored or "episode" in info):
            self.returns.append(self._running[index].copy())
            self._running[index] = 0.0
