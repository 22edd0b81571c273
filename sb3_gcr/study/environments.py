"""The env of a cell, of whatever origin, with the terms of its reward in view."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)

from sb3_gcr.envs import BatchedVecEnv
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS, RewardDecomposition
from sb3_gcr.rewards.spec import COMPONENTS_KEY, ERROR_KEY, RewardSpec
from sb3_gcr.simulators.envpool_gym import pool_of

Env = gym.Env[Any, Any]


class TermReturns(gym.Wrapper[Any, Any, Any, Any]):
    """Adds up the reward's terms and reports their returns as ``r_<name>`` when an episode ends, as
    the envs of sb3_gcr do.

    :param env: an env whose info has ``reward_components``
    :raises ValueError: in a step without components, whatever the method
    """

    def __init__(self, env: Env):
        super().__init__(env)
        spec = env.get_wrapper_attr("reward_spec")
        self.reward_spec = spec if isinstance(spec, RewardSpec) else RewardSpec.from_dict(spec)
        self._keys = self.reward_spec.return_keys
        self._returns = np.zeros(len(self._keys))

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        self._returns = np.zeros(len(self._keys))
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the env."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        components = info.get(COMPONENTS_KEY)
        if components is None:
            raise ValueError(info.get(ERROR_KEY) or no_components_message(info))
        self._returns += components
        if terminated or truncated:
            info |= dict(zip(self._keys, self._returns.tolist(), strict=True))
        return observation, reward, terminated, truncated, info


def no_components_message(info: Mapping[str, Any]) -> str:
    """What to do about an env that says nothing of its reward's terms.

    :param info: of a step
    """
    keys = sorted(str(key) for key in info)
    return (
        f"The env reports no reward terms. The keys of its info are {keys}. Name those that are "
        "terms: `--components speed=task torque=regulariser`, and `--residual rest` where they do "
        "not sum to the reward. An env without terms in its info needs a line that puts them "
        'there: `info["speed"] = speed_reward`.'
    )


def make_envs(cell: Mapping[str, Any], n_envs: int, seed: int, n_threads: int = 1) -> VecEnv:
    """Many envs of a cell, without VecNormalize.

    :param cell: canonical
    :param n_envs: how many
    :param seed: of the first one; the next ones count up
    :param n_threads: threads of envs that have their own
    :raises ValueError: for an env without terms, and for terms that sb3_gcr's own env cannot take
    """
    env_id, env_kwargs = cell["env"], dict(cell["env_kwargs"])
    if env_id.startswith("sb3_gcr/"):
        make: Any = BatchedVecEnv
    elif env_id.startswith("envpool/"):
        make = pool_of
        env_kwargs |= _terms(cell)
    else:
        return make_vec_env(_maker(cell), n_envs, seed=seed)
    threads = {"n_threads": n_threads}
    return make_vec_env(
        env_id, n_envs, seed=seed, env_kwargs=env_kwargs, vec_env_cls=make, vec_env_kwargs=threads
    )


class Shown(VecEnvWrapper):
    """The same envs, which claim other components: those that an update is to work with.

    :param venv: the envs, VecNormalize included
    :param spec: what they claim
    """

    def __init__(self, venv: VecEnv, spec: RewardSpec):
        super().__init__(venv)
        self.reward_spec = spec

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the envs.

        :param attr_name: its name
        :param indices: of the envs
        """
        if attr_name == "reward_spec":
            return [self.reward_spec] * len(list(self._get_indices(indices)))
        return self.venv.get_attr(attr_name, indices)

    def reset(self) -> VecEnvObs:
        """Start all episodes."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Step all envs."""
        return self.venv.step_wait()


def make_one(cell: Mapping[str, Any]) -> Env:
    """One env of a cell with its terms in each info.

    :param cell: canonical
    :raises ValueError: for an unknown env, and for one without terms
    """
    if cell["env"].startswith(("sb3_gcr/", "envpool/")):
        terms = _terms(cell) if cell["env"].startswith("envpool/") else {}
        return gym.make(cell["env"], **cell["env_kwargs"], **terms)
    return _maker(cell)()


def make_bare(env: str, env_kwargs: Mapping[str, Any]) -> Env:
    """One env as its maker made it.

    :param env: id, or ``module:Class``
    :param env_kwargs: its arguments
    :raises ValueError: for an unknown env
    """
    module, _, name = env.partition(":")
    if name and hasattr(_import(module, env), name):
        made: Env = getattr(_import(module, env), name)(**env_kwargs)
        return made
    try:
        return gym.make(env, **env_kwargs)
    except (gym.error.UnregisteredEnv, gym.error.NamespaceNotFound) as error:
        raise ValueError(
            f"Unknown env {env!r}: give an id of Gymnasium ('HalfCheetah-v5'), of sb3_gcr "
            "('sb3_gcr/HumanoidRun-v0'), of EnvPool ('envpool/Ant-v5'), or 'module:Class'. "
            f"({error})"
        ) from None


def _import(module: str, env: str) -> Any:
    if os.getcwd() not in sys.path:  # a console script does not look there
        sys.path.insert(0, os.getcwd())
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"Env {env!r}: found no module '{error.name}'. It must be installed, or lie in the "
            "folder where the command is started."
        ) from None


def _maker(cell: Mapping[str, Any]) -> Callable[[], Env]:
    """A function that makes one env with its terms' returns."""

    def make() -> Env:
        env = make_bare(cell["env"], cell["env_kwargs"])
        given = _terms(cell)
        is_known = env.spec is not None and env.spec.id in GYMNASIUM_ENVS
        if given or is_known:
            env = RewardDecomposition(env, **given)
        if not env.has_wrapper_attr("reward_spec"):
            env.reset()
            raise ValueError(no_components_message(env.step(env.action_space.sample())[4]))
        return TermReturns(env)

    return make


def _terms(cell: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments that name the terms of the reward, where the cell names them."""
    named = {key: cell[key] for key in ("components", "residual")}
    return {key: value for key, value in named.items() if value is not None}
