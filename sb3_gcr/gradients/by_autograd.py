"""The actor-critic by PyTorch's autograd: K backward passes for K gradients, for every network."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch as th


def gramian_by_passes(
    log_prob: th.Tensor, cotangents: th.Tensor, parameters: Sequence[th.nn.Parameter]
) -> th.Tensor:
    """Gramian of the component gradients by K backward passes: works for every network.

    G = J Jᵀ with rows g^(k) = Σ_b c_b^(k) ∇_θ log π_b, over the parameters that log π depends on.
    The graph is kept.

    :param log_prob: with its graph, shape (B,)
    :param cotangents: c, shape (B, K)
    :param parameters: candidates; those that log π does not depend on contribute nothing
    :return: G, shape (K, K)
    """
    if not log_prob.requires_grad:  # a frozen actor
        return cotangents.new_zeros(cotangents.shape[1], cotangents.shape[1])
    rows = []
    for cotangent in cotangents.unbind(1):
        gradients = th.autograd.grad(
            log_prob, parameters, cotangent, retain_graph=True, allow_unused=True
        )
        rows.append(th.cat([gradient.flatten() for gradient in gradients if gradient is not None]))
    jacobian = th.stack(rows)
    return jacobian @ jacobian.T


class ManyBackwards:
    """An actor-critic of any kind, evaluated with SB3's ``evaluate_actions`` and differentiated
    with K + 1 backward passes.

    Call :meth:`evaluate` with a minibatch, then :meth:`gramian` and :meth:`backward`.

    :param policy: an SB3 ``ActorCriticPolicy``
    """

    def __init__(self, policy: Any):
        self.policy = policy
        self._parameters = [
            parameter for parameter in policy.parameters() if parameter.requires_grad
        ]

    def one_thread(self) -> AbstractContextManager[Any]:
        """Threads are PyTorch's own business here."""
        return nullcontext()

    def array(self, tensor: th.Tensor) -> th.Tensor:
        """A tensor of the minibatch in the form that the other methods take and return: as it
        is.
        """
        return tensor

    def evaluate(self, observations: Any, actions: th.Tensor) -> ManyBackwards:
        """Forward pass of actor and critic; sets ``values`` (B, K) and ``log_prob`` (B,)."""
        with th.enable_grad():
            self._values, self._log_prob, entropy = self.policy.evaluate_actions(
                observations, actions
            )
            self._entropy_loss = self._log_prob.mean() if entropy is None else -entropy.mean()
        self.values, self.log_prob = self._values.detach(), self._log_prob.detach()
        return self

    def gramian(self, cotangents: th.Tensor, n_samples: int | None = None) -> th.Tensor:
        """Gramian of the component gradients, shape (K, K).

        :param cotangents: of log π, shape (B, K)
        :param n_samples: take the first n rows of the minibatch instead of all; they are in random
            order already
        """
        if n_samples is not None:
            cotangents = cotangents.clone()
            cotangents[n_samples:] = 0
        return gramian_by_passes(self._log_prob, cotangents, self._parameters)

    def entropy_loss(self) -> th.Tensor:
        """PPO's entropy loss: minus the mean entropy, or the mean log π where the entropy has no
        closed form.
        """
        return self._entropy_loss.detach()

    def backward(self, cotangent: th.Tensor, value_cotangents: th.Tensor, ent_coef: float) -> None:
        """Set the gradient of the whole loss; frees the graph.

        :param cotangent: of log π, shape (B,)
        :param value_cotangents: of the values, shape (B, K)
        :param ent_coef: weight of the entropy loss
        """
        for parameter in self._parameters:
            parameter.grad = None
        outputs, cotangents = [self._log_prob, self._values], [cotangent, value_cotangents]
        if ent_coef != 0:
            outputs.append(self._entropy_loss)
            cotangents.append(th.full_like(self._entropy_loss, ent_coef))
        pairs = [pair for pair in zip(outputs, cotangents, strict=True) if pair[0].requires_grad]
        th.autograd.backward([output for output, _ in pairs], [gradient for _, gradient in pairs])

    def clip_gradients(self, max_norm: float) -> float:
        """Scale all gradients down to a joint norm of at most ``max_norm``; the norm before."""
        return th.nn.utils.clip_grad_norm_(self._parameters, max_norm).item()
