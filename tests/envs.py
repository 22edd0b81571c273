"""Small environments with reward components, for tests."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_gcr import RewardSpec

ACTIONS = {
    "Box": spaces.Box(-1, 1, (2,), np.float32),
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
    "MultiBinary": spaces.MultiBinary(3),
}
OBSERVATIONS = {
    "Box": spaces.Box(-10, 10, (4,), np.float32),
    "Discrete": spaces.Discrete(5),
    "MultiDiscrete": spaces.MultiDiscrete([3, 4]),
    "Image": spaces.Box(0, 255, (1, 36, 36), np.uint8),
    "ImageChannelsLast": spaces.Box(0, 255, (36, 36, 1), np.uint8),
    "Dict": spaces.Dict({"a": spaces.Box(-1, 1, (3,), np.float32), "b": spaces.Discrete(4)}),
    "DictImage": spaces.Dict(
        {"a": spaces.Box(-1, 1, (3,), np.float32), "i": spaces.Box(0, 255, (1, 36, 36), np.uint8)}
    ),
}
SPEC = RewardSpec(("go", "stay", "save"), (0, 0, 1))


class Env(gym.Env[Any, Any]):
    """Random observations; components depend on observation and action; ends at random and by a
    time limit.
    """

    def __init__(
        self,
        spec: RewardSpec | None = SPEC,
        observation: str = "Box",
        action: str = "Box",
        limit: int = 12,
        p_end: float = 0.05,
    ):
        self.observation_space, self.action_space = deepcopy(
            (OBSERVATIONS[observation], ACTIONS[action])
        )
        self.limit, self.p_end = limit, p_end
        self.n = 3 if spec is None else len(spec)
        if spec is not None:
            self.reward_spec = spec

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.t = 0
        return self._observe(), {}

    def _observe(self) -> Any:
        return self.observation_space.sample()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        push = float(np.sum(action))
        components = self.np_random.normal(size=self.n) + push * np.cos(3 * np.arange(self.n))
        terminated = bool(self.np_random.random() < self.p_end)
        truncated = self.t >= self.limit and not terminated
        return (
            self._observe(),
            float(components.sum()),
            terminated,
            truncated,
            {"reward_components": components},
        )


class Valley(gym.Env[Any, Any]):
    """One step: a task wants x = 1, a regulariser wants x = 0 (four times as much) and y = 0.5; the
    two fight over x alone.
    """

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-3, 3, (2,), np.float32)
    reward_spec = RewardSpec(("task", "effort"), (0, 1))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        x, y = map(float, action)
        components = np.array([-((x - 1) ** 2), -4 * x**2 - (y - 0.5) ** 2])
        return (
            np.zeros(1, np.float32),
            float(components.sum()),
            True,
            False,
            {"reward_components": components},
        )


class Terms(gym.Env[Any, Any]):
    """Reports whatever info it is given at each step; the reward is a given number."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, infos: list[dict[str, Any]], rewards: list[float]):
        self.infos, self.rewards, self.t = infos, rewards, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        index = min(self.t, len(self.infos) - 1)
        self.t += 1
        return np.zeros(1, np.float32), self.rewards[index], False, False, dict(self.infos[index])


class BatchedEnv(VecEnv):
    """A VecEnv that offers its components as one (N, K) array and returns no infos at all."""

    render_mode = None

    def __init__(self, num_envs: int = 4):
        super().__init__(num_envs, OBSERVATIONS["Box"], ACTIONS["Box"])
        self.reward_spec = SPEC
        self.rng = np.random.default_rng(0)
        self.reward_components = np.zeros((num_envs, 3))
        self.infos: list[dict[str, Any]] = []

    def reset(self) -> Any:
        return self.rng.normal(size=(self.num_envs, 4)).astype(np.float32)

    def step_async(self, actions: Any) -> None:
        self.actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        self.reward_components[:] = self.rng.normal(
            size=(self.num_envs, 3)
        )  # live: overwritten by every step
        rewards = self.reward_components.sum(1)
        return self.reset(), rewards, self.rng.random(self.num_envs) < 0.1, self.infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class Late(Env):
    """A third component, ``late``, pays nothing until so many steps have been made in all."""

    def __init__(self, first_payment: float = np.inf):
        super().__init__(RewardSpec(("go", "save", "late"), (0, 1, 0)))
        self.first_payment, self.n_steps = first_payment, 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        components = info["reward_components"]
        if self.n_steps < self.first_payment:
            components[2] = 0.0
        return observation, float(components.sum()), terminated, truncated, info
