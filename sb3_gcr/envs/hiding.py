"""A wrapper that hides parts of an observation, so that a policy needs memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Observation = NDArray[np.floating[Any]]


class HideObservations(
    gym.ObservationWrapper[Observation, Any, Observation], gym.utils.RecordConstructorArgs
):
    """Sets some entries of an observation to 0, always or after the first observations of an
    episode.

    Without the velocities of a robot, or with a target that is shown at the start alone, the best
    action depends on what was seen before.

    :param env: an env whose observation is a vector
    :param indices: which entries to hide; negative ones count from the end
    :param after: how many observations of an episode show them; 0 hides them always
    :raises ValueError: for another observation space, an index that the observation does not have,
        or a negative ``after``
    """

    def __init__(self, env: gym.Env[Any, Any], indices: Sequence[int], after: int = 0):
        gym.utils.RecordConstructorArgs.__init__(self, indices=indices, after=after)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(
                "Parameter `env` must have observations that are vectors (a Box of one axis), "
                f"found {space}."
            )
        size = space.shape[0]
        wrong = [index for index in indices if not -size <= index < size]
        if wrong:
            raise ValueError(
                f"Parameter `indices` must be numbers from {-size} to {size - 1}, found {wrong}."
            )
        if after < 0:
            raise ValueError(f"Parameter `after` must be an integer ≥ 0, found {after!r}.")
        self.indices = list(indices)
        self.after = after
        self._n_seen = 0
        self.observation_space = spaces.Box(
            _zeroed(np.minimum(space.low, 0), space.low, self.indices),
            _zeroed(np.maximum(space.high, 0), space.high, self.indices),
            dtype=space.dtype.type,  # type: ignore[union-attr]
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        :param seed: as in Gymnasium
        :param options: as in Gymnasium
        """
        self._n_seen = 0
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Observation) -> Observation:
        """The observation with what is hidden set to 0.

        :param observation: of the env
        """
        self._n_seen += 1
        if self._n_seen <= self.after:
            return observation
        hidden = observation.copy()
        hidden[self.indices] = 0.0
        return hidden


def _zeroed(bounds: Observation, other: Observation, indices: Sequence[int]) -> Observation:
    """Bounds at some indices, others elsewhere."""
    mixed = other.copy()
    mixed[list(indices)] = bounds[list(indices)]
    return mixed
