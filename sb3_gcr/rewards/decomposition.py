"""A wrapper that collects the terms of a reward from the info dict, and the table of Gymnasium's
envs that report them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_gcr.rewards.spec import COMPONENTS_KEY, ERROR_KEY, Level, RewardSpec, parse_level
from sb3_gcr.rewards.sums import SUM_TOLERANCE, find_fault

_RUNNING = {"reward_forward": "task", "reward_survive": "task", "reward_ctrl": "regulariser"}


_RUNNING_WITH_CONTACT = {**_RUNNING, "reward_contact": "regulariser"}


_CRUISING = {"reward_forward": "task", "reward_ctrl": "regulariser"}


#: Arguments of :class:`RewardDecomposition` for Gymnasium's MuJoCo envs whose info reports the
#: terms of their reward.
GYMNASIUM_ENVS: dict[str, dict[str, Any]] = {
    "Ant-v5": {"components": _RUNNING_WITH_CONTACT},
    "Humanoid-v5": {"components": _RUNNING_WITH_CONTACT},
    "HalfCheetah-v5": {"components": _CRUISING},
    "Swimmer-v5": {"components": _CRUISING},
    "Hopper-v5": {"components": _RUNNING},
    "Walker2d-v5": {"components": _RUNNING},
    "Pusher-v5": {
        "components": {"reward_dist": "task", "reward_near": "task", "reward_ctrl": "regulariser"}
    },
    "Reacher-v5": {"components": {"reward_dist": "task", "reward_ctrl": "regulariser"}},
    "HumanoidStandup-v5": {
        "components": {
            "reward_linup": "task",
            "reward_quadctrl": "regulariser",
            "reward_impact": "regulariser",
        },
        "residual": "alive",
    },
    "InvertedDoublePendulum-v5": {
        "components": {
            "reward_survive": "task",
            "distance_penalty": "regulariser",
            "velocity_penalty": "regulariser",
        }
    },
    "InvertedPendulum-v5": {"components": {"reward_survive": "task"}},
}


class RewardDecomposition(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Collects the terms of a reward from the info dict into ``info["reward_components"]``, a float
    array of shape (K,).

    The reward itself stays what it is. A term that is missing, not finite, or does not add up to
    the reward is reported in ``info["reward_components_error"]``, because a wrapper inside a
    ``SubprocVecEnv`` cannot raise where anyone would see it; ``GCRPPO`` and ``evaluate_components``
    raise it with the index of the env.

    :param env: the environment to wrap
    :param components: levels by info key, e.g. ``{"reward_forward": "task", "reward_ctrl":
        "regulariser"}``; an info key that holds a vector maps to the levels of its entries by name,
        e.g. ``{"vector_reward": {"speed": "task", "energy": 1}}``, and is multiplied by
        ``info["reward_weights"]`` where that is present. None looks the env up in
        ``GYMNASIUM_ENVS``
    :param residual: name of a component for the rest of the reward, a task; ``{name: level}`` for
        another level
    :param tolerance: how far the sum may be from the reward, relative to the sum of the components'
        sizes
    :raises ValueError: if ``components`` is None and the env is not in the table, or if a name
        appears twice
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        components: Mapping[str, Level | Mapping[str, Level]] | None = None,
        residual: str | Mapping[str, Level] | None = None,
        tolerance: float = SUM_TOLERANCE,
    ):
        gym.utils.RecordConstructorArgs.__init__(
            self, components=components, residual=residual, tolerance=tolerance
        )
        gym.Wrapper.__init__(self, env)
        if components is None:
            known = GYMNASIUM_ENVS.get(env.spec.id if env.spec is not None else "")
            if known is None:
                raise ValueError(_unknown_env_message(env))
            components, residual = (
                known["components"],
                residual if residual is not None else known.get("residual"),
            )
        if not isinstance(components, Mapping):
            raise TypeError(
                f"Parameter `components` must map info keys to levels, found {components!r}."
            )
        self.components = dict(components)
        self.residual = {residual: "task"} if isinstance(residual, str) else dict(residual or {})
        if len(self.residual) > 1:
            raise ValueError(
                f"Parameter `residual` must name one component, found {list(self.residual)}."
            )
        if not tolerance >= 0:
            raise ValueError(f"Parameter `tolerance` must be a number ≥ 0, found {tolerance!r}.")
        self.reward_tolerance = tolerance
        pairs = [
            pair
            for key, level in self.components.items()
            for pair in (level.items() if isinstance(level, Mapping) else [(key, level)])
        ] + list(self.residual.items())
        self.reward_spec = RewardSpec(
            tuple(name for name, _ in pairs),
            tuple(parse_level(level, name) for name, level in pairs),
        )

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the env and add the components, or the sentence that says what is wrong with them,
        to its info.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        try:
            components = self._collect(info, float(reward))
            fault = find_fault(
                components[None],
                np.array([reward], dtype=float),
                self.reward_spec,
                self.reward_tolerance,
            )
            if fault is not None:
                raise ValueError(fault[1])
            info[COMPONENTS_KEY] = components
        except ValueError as error:
            info[ERROR_KEY] = str(error)
        return observation, reward, terminated, truncated, info

    def _collect(self, info: dict[str, Any], reward: float) -> NDArray[np.float64]:
        values: list[float] = []
        for key, level in self.components.items():
            if key not in info:
                raise ValueError(
                    f"Reward component '{key}' is missing: parameter `components` must name keys "
                    "of `info`, "
                    f"found only {sorted(map(str, info))}."
                )
            vector = np.atleast_1d(np.asarray(info[key], dtype=float))
            if isinstance(level, Mapping) and "reward_weights" in info:
                vector = vector * np.asarray(info["reward_weights"], dtype=float)
            expected = len(level) if isinstance(level, Mapping) else 1
            if vector.shape != (expected,):
                raise ValueError(
                    f'`info["{key}"]` must have shape ({expected},), found {vector.shape}.'
                )
            values.extend(vector)
        if self.residual:
            values.append(reward - sum(values))
        return np.array(values)


def _unknown_env_message(env: gym.Env[Any, Any]) -> str:
    """The error for an env without a table entry, with the info keys of one step as a help to write
    `components`.
    """
    env.reset()
    info = env.step(env.action_space.sample())[4]
    name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    return (
        f"Parameter `components` must be given for '{name}': its reward terms are known only for "
        f"{sorted(GYMNASIUM_ENVS)}. "
        f"The keys of its info are {sorted(map(str, info))}."
    )
