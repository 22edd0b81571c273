"""Rollout storage for recurrent policies and K reward components."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.buffers import RecurrentDictRolloutBuffer, RecurrentRolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples

from sb3_gcr.buffers import ComponentBuffer
from sb3_gcr.recurrent.sequences import Sequences, States


class _SequenceBuffer(ComponentBuffer):
    """A base before a recurrent rollout buffer of sb3-contrib's, whose ``rewards``, ``values``,
    ``advantages`` and ``returns`` then have shape (T, N, K).

    Its minibatches are sb3-contrib's, but padding is left to the policy: ``observations`` are
    :class:`~sb3_gcr.recurrent.sequences.Sequences`, and all that the losses need (log π, values,
    advantages, returns) has one row for each of the B valid steps, so that its means are those over
    valid steps.
    """

    def _get_samples(  # type: ignore[override]
        self, batch_inds: NDArray[np.int_], env_change: NDArray[Any], env: Any = None
    ) -> RolloutBufferSamples:
        padded: Any = super()._get_samples(batch_inds, env_change, env)  # type: ignore[call-arg, arg-type]
        return RolloutBufferSamples(
            observations=self._to_sequences(padded),  # type: ignore[arg-type]
            actions=padded.actions.float(),  # as SB3's buffers, for MultiBinary
            old_values=self.to_torch(self.values[batch_inds]),
            old_log_prob=self.to_torch(self.log_probs[batch_inds]).flatten(),
            advantages=self.to_torch(self.advantages[batch_inds]),
            returns=self.to_torch(self.returns[batch_inds]),
        )

    def _to_sequences(self, padded: Any) -> Sequences:
        """What the policy sees of sb3-contrib's minibatch."""
        n_sequences = padded.lstm_states.pi[0].shape[1]
        starts = padded.episode_starts.reshape(n_sequences, -1)[:, 0]
        goes_on = (1.0 - starts).view(1, n_sequences, 1)
        return Sequences(
            observations=padded.observations,
            actor_states=_scale(padded.lstm_states.pi, goes_on),
            critic_states=_scale(padded.lstm_states.vf, goes_on),
            valid=padded.mask.reshape(-1, self.n_components)[:, 0] > 0,
        )


class VectorRecurrentRolloutBuffer(_SequenceBuffer, RecurrentRolloutBuffer):  # type: ignore[misc]
    """sb3-contrib's ``RecurrentRolloutBuffer`` for K reward components.

    :param args: the arguments of sb3-contrib's ``RecurrentRolloutBuffer``
    :param n_components: number K of reward components
    :param kwargs: the keyword arguments of sb3-contrib's ``RecurrentRolloutBuffer``
    """


class VectorRecurrentDictRolloutBuffer(_SequenceBuffer, RecurrentDictRolloutBuffer):  # type: ignore[misc]
    """:class:`VectorRecurrentRolloutBuffer` for dictionary observations."""


def _scale(states: States, factor: th.Tensor) -> States:
    return tuple(state * factor for state in states)
