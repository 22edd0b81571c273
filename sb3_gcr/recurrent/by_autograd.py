"""The recurrent actor-critic by PyTorch's autograd: K backward passes over the valid steps.

The steps of a sequence share their past, so their gradients do not come apart as those of single
observations do, and one backward pass does not give the Gramian. What keeps the price low: the K
passes run through the actor alone, their rows J make the step Jᵀ w without another one, and with
``gramian_samples`` they run through a few sequences only.
"""

from __future__ import annotations

import numpy as np
import torch as th
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RNNStates

from sb3_gcr.gradients.by_autograd import ByAutograd, gramian_by_passes, jacobian_by_passes
from sb3_gcr.gradients.hooks import is_hooked
from sb3_gcr.gradients.memory import Weights
from sb3_gcr.recurrent.sequences import Sequences, draw_sequences, take_sequences


def leaves_of(output: th.Tensor) -> set[th.Tensor]:
    """The tensors at the ends of an output's graph, such as the parameters that it depends on."""
    found = set()
    seen = set()
    nodes = [output.grad_fn]
    while nodes:
        node = nodes.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if hasattr(node, "variable"):
            found.add(node.variable)
        nodes += [following for following, _ in node.next_functions]
    return found


class RecurrentByAutograd(ByAutograd):
    """A policy with LSTMs, evaluated by sb3-contrib's ``evaluate_actions``.

    It is an :class:`~sb3_gcr.gradients.ActorCritic` whose observations are
    :class:`~sb3_gcr.recurrent.sequences.Sequences`; the B samples are their valid steps.

    :param policy: sb3-contrib's ``RecurrentActorCriticPolicy``
    :param rng: draws the sequences that the Gramian is taken from
    """

    way = "K backward passes through the sequences in PyTorch"

    policy: RecurrentActorCriticPolicy

    def __init__(self, policy: RecurrentActorCriticPolicy, rng: np.random.Generator):
        super().__init__(policy)
        self._rng = rng
        self._is_hooked = is_hooked(policy)
        self._jacobian_rows: th.Tensor | None = None  # J of all sequences, for the step
        self._actor: list[th.nn.Parameter] = []  # whose numbers are J's columns

    def evaluate(  # type: ignore[override]
        self, observations: Sequences, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Values V, shape (B, K), and log π(a|s), shape (B,), of the valid steps.

        :param observations: S · L steps, B of them valid
        :param actions: of all steps, shape (S · L, …)
        """
        self._sequences, self._actions = observations, actions
        valid = observations.valid
        with th.enable_grad(), self._hooks.can_be_silenced():
            values, log_prob, entropy = self.policy.evaluate_actions(
                observations.observations,  # type: ignore[arg-type]
                actions,
                RNNStates(observations.actor_states, observations.critic_states),
                observations.episode_starts(),
            )
            return self._keep(
                values[valid], log_prob[valid], None if entropy is None else entropy[valid]
            )

    def gramian(self, cotangents: th.Tensor, n_samples: int | None = None) -> th.Tensor:
        """G = J Jᵀ of the component gradients, shape (K, K).

        :param cotangents: c, shape (B, K)
        :param n_samples: take whole sequences in random order until they have n valid steps, where
            that costs less than all of them
        """
        drawn = self._draw(n_samples, cotangents)
        self._jacobian_rows = None
        with self._hooks.silent():
            if drawn is not None:
                rows = cotangents[self._sequences.steps_of(drawn)]
                return gramian_by_passes(self._log_prob_of(drawn), rows, self._parameters)
            if not self._actor:
                leaves = leaves_of(self._log_prob)
                self._actor = [p for p in self._parameters if p in leaves]
            jacobian = jacobian_by_passes(self._log_prob, cotangents, self._actor)
        if not self._is_hooked:  # hooks are to see the gradient of the step
            self._jacobian_rows = jacobian
        return jacobian @ jacobian.T

    def unbiased_gramian(self) -> None:
        """None: the steps of a sequence share their noise, even if they are different samples."""

    def _draw(self, n_samples: int | None, cotangents: th.Tensor) -> th.Tensor | None:
        """Numbers of some sequences, or None for all.

        In units of a forward pass of the actor, a backward pass costs 2: all sequences cost K of
        those; a share f of them costs f of K + 1/2, and the step one more, which J saves otherwise.
        """
        if n_samples is None:
            return None
        n_valid, n_components = cotangents.shape
        lengths = self._sequences.lengths
        drawn = draw_sequences(lengths, n_samples, self._rng)
        share = int(lengths[drawn].sum()) / n_valid
        return drawn if 2 + share * (2 * n_components + 1) < 2 * n_components else None

    def _log_prob_of(self, drawn: th.Tensor) -> th.Tensor:
        """Log π of the valid steps of some sequences, from a forward of the actor for them alone.

        :param drawn: numbers of the sequences
        """
        sequences = self._sequences.take(drawn)
        n_sequences = len(self._sequences.lengths)
        length = len(sequences.valid) // len(drawn)
        actions = take_sequences(self._actions, n_sequences, drawn, length)
        with th.enable_grad(), self._hooks.can_be_silenced():
            distribution, _ = self.policy.get_distribution(
                sequences.observations,  # type: ignore[arg-type]
                sequences.actor_states,  # type: ignore[arg-type]
                sequences.episode_starts(),
            )
            return distribution.log_prob(actions)[sequences.valid]

    def backward(
        self,
        cotangents: th.Tensor,
        weights: Weights,
        value_gradients: th.Tensor,
        ent_coef: float,
    ) -> None:
        """Set the parameters' gradients to those of the whole loss; frees the graph.

        :param cotangents: c, shape (B, K)
        :param weights: w, shape (K,)
        :param value_gradients: of the loss by the values, shape (B, K)
        :param ent_coef: weight of the entropy loss
        """
        rows = self._jacobian_rows
        if rows is not None:
            self._log_prob = self._log_prob.detach()  # J has its part already
        super().backward(cotangents, weights, value_gradients, ent_coef)
        if rows is None:
            return
        w = th.as_tensor(weights, dtype=cotangents.dtype, device=cotangents.device)
        step = (w @ rows).split([parameter.numel() for parameter in self._actor])
        for parameter, part in zip(self._actor, step, strict=True):
            gradient = part.view_as(parameter)
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
