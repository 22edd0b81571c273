"""One gradient per component, and their Gramian: what the update asks of an actor-critic.

Read ``by_autograd`` first, the reference that works for every policy; then ``gramian``, the same
numbers from one backward pass; then ``by_hand``, which makes that pass for actors and critics of
linear layers, on the ``layers`` and ``heads`` that it needs. ``fitting`` says which policies
``by_hand`` computes, ``memory`` where its arrays lie.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gcr.gradients.by_autograd import ByAutograd
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.gradients.fitting import fits
from sb3_gcr.gradients.memory import Array, Weights

#: What a policy sees of a minibatch: its observations, or sequences of them.
Observed = TypeVar("Observed", contravariant=True)

#: Values of GCRPPO's parameter ``gramian_method``.
METHODS = ("auto", "one_backward", "passes")


class ActorCritic(Protocol[Observed]):
    """A policy as the update sees it, minibatch by minibatch, under ``torch.no_grad``.

    The order of calls is :meth:`evaluate`, :meth:`gramian`, :meth:`backward`,
    :meth:`clip_gradients`. An array is NumPy's or PyTorch's, whichever :meth:`array` gives.
    """

    #: How the gradients are computed, for the log.
    way: str

    def session(self) -> AbstractContextManager[object]:
        """What must hold during an update, such as the number of threads."""

    def array(self, tensor: th.Tensor) -> Array:
        """A tensor of the rollout in the form that the other methods take and return."""

    def evaluate(self, observations: Observed, actions: th.Tensor) -> tuple[Array, Array]:
        """Values V, shape (B, K), and log π(a|s), shape (B,)."""

    def entropy_loss(self) -> Array:
        """PPO's entropy loss of the minibatch, one number."""

    def gramian(self, cotangents: Array, n_samples: int | None = None) -> Array:
        """G = J Jᵀ of the component gradients, shape (K, K).

        :param cotangents: c = ∂L^(k)/∂log π_b, shape (B, K)
        :param n_samples: take the first n rows instead of all; they are in random order already
        """

    def begin_epoch(self) -> None:
        """The samples of the minibatches to come have been seen before."""

    def unbiased_gramian(self) -> Array | None:
        """Ĝ of the last :meth:`gramian`, without the noise that its gradients share, shape (K, K):
        from products of different samples alone. None where there are none.
        """

    def backward(
        self, cotangents: Array, weights: Weights, value_gradients: Array, ent_coef: float
    ) -> None:
        """Set the parameters' gradients to those of the whole loss; the actor's part is Jᵀ w.

        :param cotangents: c, shape (B, K)
        :param weights: w, shape (K,)
        :param value_gradients: of the loss by the values, shape (B, K)
        :param ent_coef: weight of the entropy loss
        """

    def clip_gradients(self, max_norm: float) -> float:
        """Scale all gradients to a joint norm of at most ``max_norm``; return the norm before."""


def choose(policy: ActorCriticPolicy, method: str, batch_size: int) -> ActorCritic[PyTorchObs]:
    """The cheapest way through a policy that gives the exact Gramian.

    :param policy: the policy as it is now: layers may be frozen, replaced or hooked at any time
    :param method: one of ``METHODS``
    :param batch_size: size B of the minibatches to come
    :raises ValueError: if ``method`` asks for one backward pass, and the policy needs several
    """
    if method == "passes":
        return ByAutograd(policy)
    if fits(policy):
        return ByHand(policy, batch_size)
    if method == "one_backward":
        raise ValueError(
            "Parameter `gramian_method` must be 'auto' or 'passes' for this policy, found "
            "'one_backward', which needs an actor and a critic of linear layers and common "
            "activations, a flat features extractor and no gSDE."
        )
    return ByAutograd(policy)
