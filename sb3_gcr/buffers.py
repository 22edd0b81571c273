"""Rollout storage for K reward components: what SB3's rollout buffers do, with a last axis of size
K.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples, RolloutBufferSamples

from sb3_gcr.advantages import component_gae


class ComponentBuffer(RolloutBuffer):
    """A base before a rollout buffer, whose ``rewards``, ``values``, ``advantages`` and ``returns``
    then have shape (T, N, K).

    :param args: the arguments of that buffer
    :param n_components: number K of reward components
    :param kwargs: the keyword arguments of that buffer
    """

    def __init__(self, *args: Any, n_components: int = 1, **kwargs: Any):
        self.n_components = n_components
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        for name in ("rewards", "values", "advantages", "returns"):
            setattr(
                self,
                name,
                np.zeros((self.buffer_size, self.n_envs, self.n_components), dtype=np.float32),
            )

    def add(  # type: ignore[override]
        self,
        obs: Any,
        action: NDArray[Any],
        reward: NDArray[Any],
        episode_start: NDArray[Any],
        value: th.Tensor,
        log_prob: th.Tensor,
        **kwargs: Any,
    ) -> None:
        """Add one step of all envs.

        :param obs: observations, one per env
        :param action: actions, one per env
        :param reward: reward components, shape (N, K)
        :param episode_start: shape (N,)
        :param value: V(s_t), shape (N, K)
        :param log_prob: log π(a_t|s_t), shape (N,)
        :param kwargs: what the buffer keeps beside, such as the states of an LSTM
        :raises ValueError: for values of another shape, which would be repeated for all components
        """
        if value.shape[1:] != (self.n_components,):
            raise ValueError(
                f"The policy's values must have shape (N, {self.n_components}), one per reward "
                f"component, found {tuple(value.shape)}."
            )
        # SB3 flattens values, and a single number broadcasts; the values themselves are stored
        # below.
        super().add(obs, action, reward, episode_start, value[:1, :1], log_prob, **kwargs)
        self.values[self.pos - 1] = value.cpu().numpy()

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: NDArray[Any]) -> None:
        """Fill ``advantages`` by :func:`~sb3_gcr.advantages.component_gae` and ``returns`` =
        advantages + values.

        :param last_values: V(s_T), shape (N, K)
        :param dones: whether the last step ended an episode, shape (N,)
        """
        self.advantages = component_gae(
            self.rewards,
            self.values,
            self.episode_starts,
            last_values.cpu().numpy(),
            dones,
            self.gamma,
            self.gae_lambda,
        )
        self.returns = self.advantages + self.values


class VectorRolloutBuffer(ComponentBuffer):
    """Rollout buffer whose ``rewards``, ``values``, ``advantages`` and ``returns`` have shape (T,
    N, K).

    :param args: the arguments of SB3's ``RolloutBuffer``
    :param n_components: number K of reward components
    :param kwargs: the keyword arguments of SB3's ``RolloutBuffer``
    """

    _samples_class: type[Any] = RolloutBufferSamples

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        self._tensors: dict[str, Any] = {}
        self._shuffled: dict[str, Any] = {}

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """Yield the rollout in random minibatches; ``old_values``, ``advantages`` and ``returns``
        have shape (B, K).

        The arrays become tensors on the device once per rollout; changes made to them after the
        first call are not seen. The minibatches of one call share memory with those of the next.

        :param batch_size: size B of a minibatch; None is the whole rollout
        """
        if not self._tensors:
            self._tensors = {
                "observations": _each(self.observations, self._to_samples),
                "actions": self._to_samples(self.actions.astype(np.float32, copy=False)),
                "old_values": self._to_samples(self.values),
                "old_log_prob": self._to_samples(self.log_probs).flatten(),
                "advantages": self._to_samples(self.advantages),
                "returns": self._to_samples(self.returns),
            }
        n_samples = self.buffer_size * self.n_envs
        # NumPy's global generator and one permutation a pass, as in SB3: the minibatches are PPO's.
        indices = th.from_numpy(np.random.permutation(n_samples)).to(self.device)
        if not self._shuffled:
            self._shuffled = {
                name: _each(tensor, th.empty_like) for name, tensor in self._tensors.items()
            }
        for name, tensor in self._tensors.items():
            _each(tensor, partial(_gather, indices), self._shuffled[name])
        batch_size = int(batch_size or n_samples)  # PyTorch takes no integers of NumPy
        parts = {
            name: _each(tensor, partial(th.split, split_size_or_sections=batch_size))
            for name, tensor in self._shuffled.items()
        }
        for index in range(-(-n_samples // batch_size)):
            yield self._samples_class(
                **{name: _each(tensors, itemgetter(index)) for name, tensors in parts.items()}
            )

    def _to_samples(self, array: Any) -> Any:
        return self.to_torch(self.swap_and_flatten(array), copy=False)


class VectorDictRolloutBuffer(VectorRolloutBuffer, DictRolloutBuffer):
    """:class:`VectorRolloutBuffer` for dictionary observations."""

    _samples_class = DictRolloutBufferSamples


def _gather(indices: th.Tensor, source: th.Tensor, target: th.Tensor) -> None:
    """Copy rows into memory that is there already: new memory would cost more than the copy."""
    th.index_select(source, 0, indices, out=target)


def _each(value: Any, function: Callable[..., Any], *others: Any) -> Any:
    """Apply a function to an array, or to every array of a dictionary."""
    if isinstance(value, dict):
        return {
            key: function(part, *(other[key] for other in others)) for key, part in value.items()
        }
    return function(value, *others)
