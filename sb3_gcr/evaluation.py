"""Evaluate a policy and see what each reward component paid."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gcr.rewards.reading import find_reward_spec
from sb3_gcr.rewards.spec import COMPONENTS_KEY, ERROR_KEY


class ComponentEvaluation(NamedTuple):
    """Return per episode, and the part of each component in it, by name."""

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
    """SB3's ``evaluate_policy``, with the undiscounted return of every component in the units of
    the env.

    :param model: anything with ``predict``
    :param env: an env or VecEnv that reports reward components
    :param n_eval_episodes: number of episodes
    :param deterministic: whether to take the policy's mode instead of a sample
    :param render: whether to render
    :param callback: called with ``locals(), globals()`` for every env after each step, as in SB3
    :param reward_threshold: raise if the mean return is below it, as in SB3
    :param return_episode_rewards: return lists per episode instead of means
    :param warn: warn about a missing ``Monitor``
    :return: means and standard deviations; or returns and lengths per episode, and the returns of
        each component by name
    :raises ValueError: if the env reports no components
    """
    venv = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
    spec = find_reward_spec(venv)
    if spec is None:
        raise ValueError(
            "Parameter `env` must report reward components, found none. Wrap it with "
            "`RewardDecomposition`."
        )
    running = np.zeros((venv.num_envs, len(spec)))
    episodes: list[np.ndarray[Any, Any]] = []

    def collect(local_variables: dict[str, Any], global_variables: dict[str, Any]) -> None:
        index, info = local_variables["i"], local_variables["info"]
        batched = getattr(venv, COMPONENTS_KEY, None)
        row = batched[index] if batched is not None else info.get(COMPONENTS_KEY)
        if row is None:
            raise ValueError(
                f"Env index {index}: "
                f"{info.get(ERROR_KEY, 'found no `reward_components` in its info.')}"
            )
        running[index] += row
        # An episode ends where evaluate_policy counts it: a wrapper may report the loss of a life
        # as done.
        if local_variables["done"] and (
            not local_variables["is_monitor_wrapped"] or "episode" in info
        ):
            episodes.append(running[index].copy())
            running[index] = 0.0
        if callback is not None:
            callback(local_variables, global_variables)

    rewards, lengths = evaluate_policy(
        model,
        venv,
        n_eval_episodes=n_eval_episodes,
        deterministic=deterministic,
        render=render,
        callback=collect,
        reward_threshold=reward_threshold,
        return_episode_rewards=True,
        warn=warn,
    )
    components = np.array(episodes)
    if return_episode_rewards:
        return (
            rewards,
            lengths,
            {name: components[:, index].tolist() for index, name in enumerate(spec.names)},
        )  # type: ignore[return-value]
    return ComponentEvaluation(
        float(np.mean(rewards)),
        float(np.std(rewards)),
        dict(zip(spec.names, components.mean(0).tolist(), strict=True)),
        dict(zip(spec.names, components.std(0).tolist(), strict=True)),
    )
