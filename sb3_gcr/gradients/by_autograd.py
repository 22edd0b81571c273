"""The actor-critic by PyTorch's autograd: K backward passes for K gradients, for every policy.

All K surrogates share log π(a_b|s_b), so g^(k) = Σ_b c_b^(k) ∇_θ log π(a_b|s_b): a vector–Jacobian
product of log π with the cotangent c^(k). The step of weights w is one more, with the cotangent
c w.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gcr.gradients.hooks import BackwardHooks
from sb3_gcr.gradients.memory import Weights


def jacobian_by_passes(
    log_prob: th.Tensor, cotangents: th.Tensor, parameters: Sequence[th.nn.Parameter]
) -> th.Tensor:
    """J with the rows g^(k) = Σ_b c_b^(k) ∇_θ log π_b, by K backward passes.

    Only parameters that log π depends on contribute. The graph is kept.

    :param log_prob: with its graph, shape (B,)
    :param cotangents: c, shape (B, K)
    :param parameters: θ and others; log π need not depend on all of them
    :return: J, shape (K, D)
    """
    if not log_prob.requires_grad:  # a frozen actor
        parameters = []
    no_gradient = cotangents.new_zeros(0)
    rows = []
    for cotangent in cotangents.unbind(1):
        gradients: Sequence[th.Tensor | None] = ()
        if parameters:
            gradients = th.autograd.grad(
                log_prob, parameters, cotangent, retain_graph=True, allow_unused=True
            )
        parts = [gradient.flatten() for gradient in gradients if gradient is not None]
        rows.append(th.cat([no_gradient, *parts]))
    return th.stack(rows)


def gramian_by_passes(
    log_prob: th.Tensor, cotangents: th.Tensor, parameters: Sequence[th.nn.Parameter]
) -> th.Tensor:
    """G = J Jᵀ of :func:`jacobian_by_passes`, shape (K, K)."""
    jacobian = jacobian_by_passes(log_prob, cotangents, parameters)
    return jacobian @ jacobian.T


class ByAutograd:
    """A policy of any kind, evaluated by SB3's ``evaluate_actions`` and differentiated by autograd.

    It is an :class:`~sb3_gcr.gradients.ActorCritic`; its arrays are tensors.

    :param policy: an SB3 ``ActorCriticPolicy``
    """

    way = "K backward passes in PyTorch"

    def __init__(self, policy: ActorCriticPolicy):
        self.policy = policy
        self._parameters = [p for p in policy.parameters() if p.requires_grad]
        self._hooks = BackwardHooks(policy)

    def session(self) -> AbstractContextManager[object]:
        """Threads are PyTorch's own business here."""
        return nullcontext()

    def array(self, tensor: th.Tensor) -> th.Tensor:
        """A tensor as it is."""
        return tensor

    def evaluate(self, observations: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Values V, shape (B, K), and log π(a|s), shape (B,)."""
        with th.enable_grad(), self._hooks.can_be_silenced():
            evaluated = self.policy.evaluate_actions(observations, actions)  # type: ignore[arg-type]
            return self._keep(*evaluated)

    def _keep(
        self, values: th.Tensor, log_prob: th.Tensor, entropy: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        """Keep what was evaluated with its graph, and return it without."""
        self._values, self._log_prob = values, log_prob
        self._entropy_loss = log_prob.mean() if entropy is None else -entropy.mean()
        return values.detach(), log_prob.detach()

    def entropy_loss(self) -> th.Tensor:
        """Minus the mean entropy, or the mean log π where the entropy has no closed form."""
        return self._entropy_loss.detach()

    def gramian(self, cotangents: th.Tensor, n_samples: int | None = None) -> th.Tensor:
        """G = J Jᵀ of the component gradients, shape (K, K).

        :param cotangents: c, shape (B, K)
        :param n_samples: take the first n rows instead of all
        """
        if n_samples is not None:
            cotangents = cotangents.clone()
            cotangents[n_samples:] = 0
        with self._hooks.silent():
            return gramian_by_passes(self._log_prob, cotangents, self._parameters)

    def jacobian(self, cotangents: th.Tensor) -> th.Tensor:
        """The component gradients of the minibatch as rows J, shape (K, D).

        :param cotangents: c, shape (B, K)
        """
        with self._hooks.silent():
            return jacobian_by_passes(self._log_prob, cotangents, self._parameters)

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
        # As PPO: of frozen parameters, too, since an optimiser steps whatever has a gradient.
        self.policy.optimizer.zero_grad()
        w = th.as_tensor(weights, dtype=cotangents.dtype, device=cotangents.device)
        outputs = [self._log_prob, self._values]
        gradients = [cotangents @ w, value_gradients]
        if ent_coef != 0:
            outputs.append(self._entropy_loss)
            gradients.append(th.full_like(self._entropy_loss, ent_coef))
        pairs = [pair for pair in zip(outputs, gradients, strict=True) if pair[0].requires_grad]
        th.autograd.backward([pair[0] for pair in pairs], [pair[1] for pair in pairs])

    def clip_gradients(self, max_norm: float) -> float:
        """Scale all gradients to a joint norm of at most ``max_norm``; return the norm before."""
        return th.nn.utils.clip_grad_norm_(self.policy.parameters(), max_norm).item()
