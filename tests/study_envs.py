"""Small envs for the tests of studies, as a user would write them."""

from __future__ import annotations

import os
import time
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Walk(gym.Env[Any, Any]):
    """A walk of 20 steps: action to the right pays speed, its square costs."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, gain: float = 1.0):
        self.gain = gain
        self._position, self._steps = 0.0, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._position, self._steps = float(self.np_random.normal()), 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        push = float(action[0])
        self._position += 0.1 * push
        self._steps += 1
        speed, torque = self.gain * push, -0.5 * push**2
        info = {"speed": speed, "torque": torque}
        return self._observe(), speed + torque, False, self._steps == 20, info

    def _observe(self) -> Any:
        return np.array([self._position, self._steps / 20], dtype=np.float32)


class Silent(Walk):
    """Says nothing about its terms."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, _ = super().step(action)
        return observation, reward, terminated, truncated, {"weather": 1}


class Raising(Walk):
    """Raises in its 300th step."""

    n_steps = 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        Raising.n_steps += 1
        if Raising.n_steps == 300:
            raise RuntimeError("the robot is gone")
        return super().step(action)


class Crashing(Walk):
    """Ends its process."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        os.abort()


class Hanging(Walk):
    """Never ends a step."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(1000)
        raise AssertionError
