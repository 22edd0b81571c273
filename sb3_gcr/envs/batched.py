"""Many simulations of a task as a VecEnv of Stable-Baselines3."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.single import Painter, TaskEnv
from sb3_gcr.rewards.spec import COMPONENTS_KEY


class BatchedVecEnv(VecEnv):
    """All simulations of a task on one thread pool.

    ``make_vec_env("sb3_gcr/HumanoidRun-v0", 256, vec_env_cls=BatchedVecEnv)`` makes one. Only the
    first env is built, to learn the task, the time limit and Monitor's arguments from it; the
    numbers are those that a ``DummyVecEnv`` of the same envs gives. ``reward_components`` has the
    terms of the last step, shape (N, K), and the infos are filled for finished episodes only.

    :param env_fns: as for ``DummyVecEnv``; all must make the same env
    :param n_threads: threads that step the simulations; None for all CPUs
    :raises ValueError: for an env that is no task of this package, or for a wrapper that would be
        lost
    """

    def __init__(
        self, env_fns: Sequence[Callable[[], gym.Env[Any, Any]]], n_threads: int | None = None
    ):
        if not env_fns:
            raise ValueError("Parameter `env_fns` must contain at least one function, found none.")
        self._env = env_fns[0]()
        self._monitor, max_episode_steps = _unwrap(self._env)
        task_env: TaskEnv = self._env.unwrapped  # type: ignore[assignment]
        self.task = task_env.task
        self.engine = Engine(self.task, len(env_fns), n_threads, max_episode_steps)
        self.reward_spec = self.task.reward_spec
        #: Terms of the reward in the last step, shape (N, K).
        self.reward_components = np.zeros((len(env_fns), len(self.reward_spec)))
        #: Which simulation `render` shows.
        self.render_index = 0
        self._painter = Painter(self.engine, *task_env.picture_size)
        self._t_start = time.time()
        self._is_running = False
        super().__init__(len(env_fns), self._env.observation_space, self._env.action_space)
        self._actions = np.zeros(
            (self.num_envs, *self.task.action_space.shape), dtype=self.task.action_space.dtype
        )

    @property
    def n_diverged(self) -> int:
        """Simulations that diverged so far."""
        return self.engine.n_diverged

    def reset(self) -> NDArray[Any]:
        """Start all episodes, with the seeds given by ``seed``."""
        for index, seed in enumerate(self._seeds):
            if seed is not None:
                self.engine.seed(index, seed)
        self._reset_seeds()
        self._reset_options()
        self._is_running = True
        return self.engine.reset(np.arange(self.num_envs))

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions for the next step.

        :param actions: shape (N, n_actions)
        :raises ValueError: for another shape
        :raises RuntimeError: before the first reset, and after the env was closed
        """
        if not self._is_running:
            raise RuntimeError(
                "BatchedVecEnv must be reset before a step, and cannot step after `close`."
            )
        if np.shape(actions) != self._actions.shape:
            raise ValueError(
                f"Parameter `actions` must have shape {self._actions.shape}, found "
                f"{np.shape(actions)}."
            )
        self._actions[:] = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all simulations; finished ones have started anew when it returns."""
        step = self.engine.step(self._actions)
        self.reward_components = step.components
        rewards = step.components.sum(1).astype(np.float32)
        dones = step.terminated | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        finished = np.flatnonzero(dones)
        if len(finished):
            for index in finished:
                infos[index] = {
                    COMPONENTS_KEY: step.components[index].copy(),
                    "terminal_observation": step.observations[index].copy(),
                    "TimeLimit.truncated": bool(
                        step.truncated[index] and not step.terminated[index]
                    ),
                    **dict(
                        zip(
                            self.reward_spec.return_keys,
                            self.engine.returns[index].tolist(),
                            strict=True,
                        )
                    ),
                }
                if step.diverged[index]:
                    infos[index]["diverged"] = True
                infos[index]["episode"] = self._finish(int(index), infos[index])
            step.observations[finished] = self.engine.reset(finished)
        return step.observations, rewards, dones, infos

    def _finish(self, index: int, info: dict[str, Any]) -> dict[str, Any]:
        """What Monitor says of a finished episode; it goes to Monitor's file too."""
        episode = {
            "r": round(float(self.engine.returns[index].sum()), 6),
            "l": int(self.engine.lengths[index]),
            "t": round(time.time() - self._t_start, 6),
        }
        if self._monitor is not None:
            episode |= {key: info[key] for key in self._monitor.info_keywords}
            if self._monitor.results_writer is not None:
                self._monitor.results_writer.write_row(episode)
        return episode

    def close(self) -> None:
        """Close the window and Monitor's file, and end the threads."""
        self._is_running = False
        self._painter.close()
        self.engine.close()
        self._env.close()

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """A picture of the simulation ``render_index``."""
        return [self._painter.paint("rgb_array", self.render_index)]

    def render(self, mode: str | None = None) -> NDArray[Any] | None:
        """Show the simulation ``render_index``.

        :param mode: None for the env's ``render_mode``
        """
        if self.render_mode == "human" and mode in (None, "human"):
            self._painter.paint("human", self.render_index)
            return None
        return super().render(mode)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the env that all simulations share.

        :param attr_name: its name
        :param indices: one value for each of them
        """
        return [self._env.get_wrapper_attr(attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the env that all simulations share; those of its task are set on
        ``get_attr("task")[0]``.

        :param attr_name: its name
        :param value: its value
        :param indices: must be all
        """
        self._demand_all(indices)
        setattr(self._env.unwrapped, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the env that all simulations share, once.

        :param method_name: its name
        :param method_args: its arguments
        :param indices: must be all
        :param method_kwargs: its keyword arguments
        """
        self._demand_all(indices)
        return [
            self._env.get_wrapper_attr(method_name)(*method_args, **method_kwargs)
        ] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Whether the work of a wrapper is done: that of Monitor always is.

        :param wrapper_class: the wrapper
        :param indices: one answer for each of them
        """
        return [issubclass(wrapper_class, Monitor)] * len(list(self._get_indices(indices)))

    def _demand_all(self, indices: VecEnvIndices) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(
                f"Parameter `indices` must be None or all {self.num_envs} simulations, because "
                "they share one task, "
                f"found {indices!r}."
            )


def _unwrap(env: gym.Env[Any, Any]) -> tuple[Monitor | None, int | None]:
    """Monitor and the time limit of an env of ours, whose other wrappers are refused."""
    monitor, max_episode_steps = None, None
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Monitor):
            monitor = env
        elif isinstance(env, TimeLimit):
            max_episode_steps = env._max_episode_steps
        elif not isinstance(env, OrderEnforcing | PassiveEnvChecker):
            raise ValueError(
                f"BatchedVecEnv steps the simulations itself, so the wrapper {type(env).__name__} "
                "would never run. "
                "Use a VecEnvWrapper around BatchedVecEnv, or DummyVecEnv."
            )
        env = env.env
    if not isinstance(env, TaskEnv):
        raise ValueError(
            "BatchedVecEnv needs a task of sb3_gcr, such as 'sb3_gcr/HumanoidRun-v0', found "
            f"{type(env).__name__}."
        )
    return monitor, max_episode_steps
