"""Many simulations of a task as a vector env of Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.tasks.catalogue import make_task
from sb3_gcr.rewards.spec import COMPONENTS_KEY

Array = NDArray[Any]


class TaskVectorEnv(gym.vector.VectorEnv[Array, Array, Array]):
    """A task of :mod:`sb3_gcr.envs` as a Gymnasium vector env;
    ``gym.make_vec("sb3_gcr/HumanoidRun-v0", 256)`` makes one.

    Finished episodes start anew in the same step: ``info["final_obs"]`` and ``info["final_info"]``
    say how they ended, and ``info["reward_components"]``, shape (N, K), always has the terms of the
    step just made.

    :param task: name of the task
    :param num_envs: N
    :param max_episode_steps: steps until truncation; None for no limit
    :param n_threads: threads that step the simulations; None for all CPUs
    :param kwargs: arguments of the task
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 as declared there

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        n_threads: int | None = None,
        **kwargs: Any,
    ):
        self.task = make_task(task, **kwargs)
        self.engine = Engine(self.task, num_envs, n_threads, max_episode_steps)
        self.num_envs = num_envs
        self.reward_spec = self.task.reward_spec
        self.single_observation_space = self.task.observation_space
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Start all episodes.

        :param seed: None, the seed of the first simulation (the next ones count up), or one for
            each
        :param options: not used
        """
        if isinstance(seed, int):
            seed = [seed + index for index in range(self.num_envs)]
        if seed is not None and len(seed) != self.num_envs:
            raise ValueError(
                f"Parameter `seed` must be an integer or have {self.num_envs} entries, found "
                f"{len(seed)}."
            )
        for index, own in enumerate(seed or []):
            if own is not None:
                self.engine.seed(index, own)
        return self.engine.reset(np.arange(self.num_envs)), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Advance all simulations by one control step.

        :param actions: shape (N, n_actions)
        """
        step = self.engine.step(np.asarray(actions, dtype=self.single_action_space.dtype))
        infos: dict[str, Any] = {COMPONENTS_KEY: step.components}
        dones = step.terminated | step.truncated
        finished = np.flatnonzero(dones)
        if len(finished):
            final = np.full(self.num_envs, None, dtype=object)
            for index in finished:
                final[index] = step.observations[index].copy()
            infos |= {
                "final_obs": final,
                "_final_obs": dones,
                "final_info": {COMPONENTS_KEY: step.components.copy(), f"_{COMPONENTS_KEY}": dones},
                "_final_info": dones,
            }
            step.observations[finished] = self.engine.reset(finished)
        return step.observations, step.components.sum(1), step.terminated, step.truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self.engine.close()
