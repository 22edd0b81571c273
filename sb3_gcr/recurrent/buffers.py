"""Rollout storage for recurrent policies and K reward components."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.buffers import RecurrentDictRolloutBuffer, RecurrentRolloutBuffer
from stable_baselines3.common.type_aliases import PyTorchObs, RolloutBufferSamples

from sb3_gcr.buffers import ComponentBuffer
from sb3_gcr.recurrent.sequences import Sequences, States, lay_out


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
        begins_episode = self.episode_starts[batch_inds, 0] > 0
        layout = lay_out(begins_episode | (env_change[batch_inds, 0] > 0))
        steps = batch_inds[layout.steps.flatten()]
        return RolloutBufferSamples(
            observations=Sequences(  # type: ignore[arg-type]
                observations=self._observations_at(steps),
                actor_states=self._states_at("pi", batch_inds, layout.firsts),
                critic_states=self._states_at("vf", batch_inds, layout.firsts),
                valid=self.to_torch(layout.valid.flatten(), copy=False),
            ),
            actions=self._to_floats(self.actions[steps]),  # as SB3's buffers, for MultiBinary
            old_values=self._to_floats(self.values[batch_inds]),
            old_log_prob=self._to_floats(self.log_probs[batch_inds]).flatten(),
            advantages=self._to_floats(self.advantages[batch_inds]),
            returns=self._to_floats(self.returns[batch_inds]),
        )

    def _observations_at(self, steps: NDArray[np.int_]) -> PyTorchObs:
        if isinstance(self.observations, dict):
            parts = self.observations.items()
            return {name: self.to_torch(array[steps], copy=False) for name, array in parts}
        return self.to_torch(self.observations[steps], copy=False)

    def _states_at(
        self, network: str, batch_inds: NDArray[np.int_], firsts: NDArray[np.int_]
    ) -> States:
        """States before the first step of each sequence, none where it begins an episode."""
        steps = batch_inds[firsts]
        goes_on = 1.0 - self.episode_starts[steps, :, None]
        arrays = [getattr(self, f"{kind}_states_{network}") for kind in ("hidden", "cell")]
        return tuple(
            self._to_floats((array[steps] * goes_on).swapaxes(0, 1)).contiguous()
            for array in arrays
        )

    def _to_floats(self, array: NDArray[Any]) -> th.Tensor:
        return self.to_torch(array.astype(np.float32, copy=False), copy=False)


class VectorRecurrentRolloutBuffer(_SequenceBuffer, RecurrentRolloutBuffer):  # type: ignore[misc]
    """sb3-contrib's ``RecurrentRolloutBuffer`` for K reward components.

    :param args: the arguments of sb3-contrib's ``RecurrentRolloutBuffer``
    :param n_components: number K of reward components
    :param kwargs: the keyword arguments of sb3-contrib's ``RecurrentRolloutBuffer``
    """


class VectorRecurrentDictRolloutBuffer(_SequenceBuffer, RecurrentDictRolloutBuffer):  # type: ignore[misc]
    """:class:`VectorRecurrentRolloutBuffer` for dictionary observations."""
