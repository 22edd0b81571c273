"""What a recurrent policy sees of a minibatch: sequences of different lengths, padded to one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import PyTorchObs

#: Hidden and cell state of an LSTM, each of shape (layers, S, units).
States = tuple[th.Tensor, ...]


class Sequences(NamedTuple):
    """S sequences of at most L steps; B of the S · L steps are valid, the rest is padding behind.

    A sequence goes on from the states that the policy had there in the rollout. Where an episode
    begins, a sequence begins, in states of zeros.
    """

    observations: PyTorchObs  # (S · L, …), one sequence after the other
    actor_states: States
    critic_states: States
    valid: th.Tensor  # which steps are no padding, (S · L,)

    @property
    def lengths(self) -> th.Tensor:
        """Number of valid steps of each sequence, shape (S,)."""
        return self.valid.reshape(self.actor_states[0].shape[1], -1).sum(1)

    def episode_starts(self) -> th.Tensor:
        """For sb3-contrib's policies, shape (S · L,): none, because the states are right as they
        are; then the LSTM runs through a whole sequence in one call.
        """
        return th.zeros(self.valid.shape, device=self.valid.device)

    def steps_of(self, indices: th.Tensor) -> th.Tensor:
        """Which of the B valid steps belong to some of the sequences, shape (B,).

        :param indices: which, shape (n,)
        """
        lengths = self.lengths
        is_taken = th.zeros_like(lengths, dtype=th.bool)
        is_taken[indices] = True
        return is_taken.repeat_interleave(lengths)

    def take(self, indices: th.Tensor) -> Sequences:
        """Some of the sequences.

        :param indices: which, shape (n,)
        """
        n_sequences = self.actor_states[0].shape[1]
        longest = int(self.lengths[indices].max())

        def cut(steps: th.Tensor) -> th.Tensor:
            return take_sequences(steps, n_sequences, indices, longest)

        if isinstance(self.observations, Mapping):
            observations: PyTorchObs = {name: cut(o) for name, o in self.observations.items()}
        else:
            observations = cut(self.observations)
        return Sequences(
            observations=observations,
            actor_states=tuple(state[:, indices] for state in self.actor_states),
            critic_states=tuple(state[:, indices] for state in self.critic_states),
            valid=cut(self.valid),
        )


class Layout(NamedTuple):
    """Where the B steps of a minibatch stand in S sequences of L steps."""

    firsts: NDArray[np.int_]  # number of the first step of each sequence, (S,)
    steps: NDArray[np.int_]  # number of each step, the last one repeated as padding, (S, L)
    valid: NDArray[np.bool_]  # which are no padding, (S, L)


def lay_out(begins: NDArray[np.bool_]) -> Layout:
    """Cut a minibatch into sequences.

    :param begins: which steps begin a sequence, shape (B,); the first one does in any case
    """
    firsts = np.flatnonzero(np.append(True, begins[1:]))
    lasts = np.append(firsts[1:], len(begins)) - 1
    steps = firsts[:, None] + np.arange((lasts - firsts).max() + 1)
    return Layout(firsts, np.minimum(steps, lasts[:, None]), steps <= lasts[:, None])


def take_sequences(
    steps: th.Tensor, n_sequences: int, indices: th.Tensor, length: int
) -> th.Tensor:
    """The first steps of some sequences.

    :param steps: shape (S · L, …)
    :param n_sequences: S
    :param indices: which sequences, shape (n,)
    :param length: L' ≤ L
    :return: shape (n · L', …)
    """
    by_sequence = steps.reshape(n_sequences, -1, *steps.shape[1:])
    return by_sequence[indices, :length].flatten(0, 1)


def draw_sequences(lengths: th.Tensor, n_samples: int, rng: np.random.Generator) -> th.Tensor:
    """Whole sequences in random order, until they have ``n_samples`` steps or all are taken.

    :param lengths: number of steps of each sequence, shape (S,)
    :param n_samples: number of steps wanted, at least 1
    :param rng: draws the order
    :return: indices, the smallest first, shape (n,)
    """
    order = rng.permutation(len(lengths))
    steps_before = np.cumsum(lengths.cpu().numpy()[order]) - lengths.cpu().numpy()[order]
    drawn = np.sort(order[steps_before < n_samples])
    return th.as_tensor(drawn, device=lengths.device)
