"""EnvPool's envs by Gymnasium ids, for tools that make and watch envs one by one; ``pool_of`` makes
many at once again.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_gcr.rewards.spec import COMPONENTS_KEY
from sb3_gcr.simulators.envpool import ENVPOOL_ENVS, EnvPoolVecEnv


class EnvPoolEnv(gym.Env[Any, Any]):
    """One EnvPool env; ``gym.make("envpool/Humanoid-v5")`` makes one. It cannot be rendered.

    The info of each step has the components, and their returns so far as ``r_<name>``.

    :param env_id: an id of ``ENVPOOL_ENVS``
    :param kwargs: settings of :class:`EnvPoolVecEnv`
    """

    def __init__(self, env_id: str, **kwargs: Any):
        self.arguments = {"env_id": env_id, **kwargs}
        self._pool = EnvPoolVecEnv(num_envs=1, num_threads=1, **self.arguments)
        self.observation_space, self.action_space = (
            self._pool.observation_space,
            self._pool.action_space,
        )
        self.reward_spec = self._pool.reward_spec
        self._returns = np.zeros(len(self.reward_spec))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        :param seed: of the env
        :param options: not used
        """
        super().reset(seed=seed)
        if seed is not None:
            self._pool.seed(seed)
        self._returns[:] = 0
        return _first(self._pool.reset()), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one step.

        :param action: inside the action space
        """
        observations, rewards, dones, infos = self._pool.step(np.asarray(action)[None])
        components = self._pool.reward_components[0]
        self._returns += components
        info = {
            COMPONENTS_KEY: components.copy(),
            **dict(zip(self.reward_spec.return_keys, self._returns.tolist(), strict=True)),
        }
        truncated = bool(infos[0].get("TimeLimit.truncated", False))
        observation = infos[0]["terminal_observation"] if dones[0] else _first(observations)
        return observation, float(rewards[0]), bool(dones[0]) and not truncated, truncated, info

    def close(self) -> None:
        """End the thread."""
        self._pool.close()


def _first(observations: Any) -> Any:
    return (
        {key: rows[0] for key, rows in observations.items()}
        if isinstance(observations, dict)
        else observations[0]
    )


def pool_of(
    env_fns: Sequence[Callable[[], gym.Env[Any, Any]]], n_threads: int | None = None
) -> VecEnv:
    """As many envs as functions in one pool, with Monitor's file: ``make_vec_env("envpool/Ant-v5",
    64, vec_env_cls=pool_of)``.

    Only the first env is built, to learn its settings and Monitor's arguments from it.

    :param env_fns: as for ``DummyVecEnv``; all must make the same env
    :param n_threads: threads that step the envs; None for all CPUs
    :raises ValueError: for an env that is not EnvPool's, or for a wrapper that would be lost
    """
    first = env_fns[0]()
    made = first.unwrapped
    if not isinstance(made, EnvPoolEnv):
        raise ValueError(
            "`pool_of` needs an env of EnvPool, such as 'envpool/Humanoid-v5', found "
            f"{type(made).__name__}."
        )
    env, monitor = first, None
    while isinstance(env, gym.Wrapper):
        monitor = env if isinstance(env, Monitor) else monitor
        if not isinstance(env, Monitor | OrderEnforcing | PassiveEnvChecker):
            raise ValueError(
                f"EnvPool steps the envs itself, so the wrapper {type(env).__name__} would never "
                "run."
            )
        env = env.env
    first.close()
    pool = EnvPoolVecEnv(num_envs=len(env_fns), num_threads=n_threads, **made.arguments)
    if monitor is None or monitor.results_writer is None:
        return pool
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The environment is already wrapped with a `Monitor`")
        return VecMonitor(pool, monitor.results_writer.file_handler.name, monitor.info_keywords)


def register_pools() -> None:
    """Make EnvPool's envs known to Gymnasium as ``envpool/<id>``; importing sb3_gcr does it."""
    for env_id in ENVPOOL_ENVS:
        if f"envpool/{env_id}" not in gym.registry:
            entry_point = "sb3_gcr.simulators.envpool_gym:EnvPoolEnv"
            gym.register(id=f"envpool/{env_id}", entry_point=entry_point, kwargs={"env_id": env_id})
