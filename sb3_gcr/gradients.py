"""The component losses, their cotangents, and the Gramian of their gradients.

All K surrogates share one log π(a_b|s_b), so the gradient of component k is Σ_b c_b^(k) ∇_θ log π(a_b|s_b): its cotangent
c^(k) is all that distinguishes it. The step of any weights w is one backward pass with the cotangent c w. NumPy arrays and
tensors both fit into losses and cotangents.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import torch as th

from sb3_gcr.advantages import ArrayT


def surrogate_losses(log_prob: ArrayT, old_log_prob: ArrayT, advantages: ArrayT, clip_range: float) -> ArrayT:
    r"""PPO's clipped surrogate loss of each sample and component, to be minimised; one ratio ρ for all components.

    .. math:: L_b^{(k)} = -\min(ρ_b Â_b^{(k)}, \mathrm{clip}(ρ_b, 1-ε, 1+ε) Â_b^{(k)}), \qquad
        L^{(k)} = \frac{1}{B} \sum_b L_b^{(k)}

    :param log_prob: log π(a_b|s_b) of the current policy, shape (B,)
    :param old_log_prob: the same of the policy that collected the data, shape (B,)
    :param advantages: Â, shape (B, K)
    :param clip_range: ε
    :return: losses before the mean over samples, shape (B, K)
    """
    ratio = _exp(log_prob - old_log_prob)[:, None]
    xp: Any = th if isinstance(ratio, th.Tensor) else np
    return -xp.minimum(ratio * advantages, ratio.clip(1 - clip_range, 1 + clip_range) * advantages)


def surrogate_cotangents(log_prob: ArrayT, old_log_prob: ArrayT, advantages: ArrayT, clip_range: float) -> ArrayT:
    r"""The derivatives of the mean :func:`surrogate_losses` by log π in closed form: all that an update needs of them.

    .. math:: c_b^{(k)} = \frac{∂L^{(k)}}{∂\log π_b} = -\frac{ρ_b Â_b^{(k)}}{B} \text{ where not clipped, else } 0

    :param log_prob: log π(a_b|s_b), shape (B,)
    :param old_log_prob: shape (B,)
    :param advantages: Â, shape (B, K)
    :param clip_range: ε
    :return: cotangents c, shape (B, K)
    """
    ratio = _exp(log_prob - old_log_prob)[:, None]
    cotangents = ratio * advantages
    cotangents[cotangents > ratio.clip(1 - clip_range, 1 + clip_range) * advantages] = 0.0
    cotangents *= -1 / len(advantages)
    return cotangents


def kl_estimates(log_prob: ArrayT, old_log_prob: ArrayT) -> ArrayT:
    """Each sample's term (ρ - 1) - log ρ of the estimate of KL(old ‖ current) that SB3's PPO logs, shape (B,)."""
    log_ratio = log_prob - old_log_prob
    return _exp(log_ratio) - 1 - log_ratio


def leaves_range(log_prob: ArrayT, old_log_prob: ArrayT, clip_range: float) -> ArrayT:
    """Which samples' ratios have left the clip range, abs(ρ - 1) > ε: SB3's clip fraction is their share; shape (B,)."""
    return abs(_exp(log_prob - old_log_prob) - 1) > clip_range  # type: ignore[no-any-return]


def value_errors(values: ArrayT, old_values: ArrayT, returns: ArrayT, clip_range_vf: float | None) -> ArrayT:
    r"""Error of each value head at each sample; the change of a head is clipped as in SB3's PPO.

    .. math:: L_V^{(k)} = \frac{1}{B} \sum_b e_b^{(k)\,2}, \qquad e_b^{(k)} = V_b^{(k)} - Ĝ_b^{(k)}

    with V replaced by V_old + clip(V - V_old, -c, c) if a ``clip_range_vf`` c is given.

    :param values: V, shape (B, K)
    :param old_values: V when the data were collected, shape (B, K)
    :param returns: Ĝ, shape (B, K)
    :param clip_range_vf: c in units of the return, or None
    :return: e, shape (B, K)
    """
    if clip_range_vf is not None:
        values = old_values + (values - old_values).clip(-clip_range_vf, clip_range_vf)
    return values - returns


def value_cotangents(values: ArrayT, old_values: ArrayT, returns: ArrayT, clip_range_vf: float | None) -> ArrayT:
    r"""The derivatives ∂L_V^(k)/∂V_b^(k) = 2 e_b^(k) / B of the losses of :func:`value_errors`, 0 where clipped.

    :param values: V, shape (B, K)
    :param old_values: V when the data were collected, shape (B, K)
    :param returns: Ĝ, shape (B, K)
    :param clip_range_vf: c in units of the return, or None
    :return: cotangents, shape (B, K)
    """
    errors = value_errors(values, old_values, returns, clip_range_vf)
    if clip_range_vf is not None:
        errors[abs(values - old_values) > clip_range_vf] = 0.0
    errors *= 2 / len(values)
    return errors


def _exp(array: ArrayT) -> Any:
    return array.exp() if isinstance(array, th.Tensor) else np.exp(array)


def gramian_by_passes(log_prob: th.Tensor, cotangents: th.Tensor, parameters: Sequence[th.nn.Parameter]) -> th.Tensor:
    """Gramian of the component gradients by K backward passes: works for every network.

    G = J Jᵀ with rows g^(k) = Σ_b c_b^(k) ∇_θ log π_b, over the parameters that log π depends on. The graph is kept.

    :param log_prob: with its graph, shape (B,)
    :param cotangents: c, shape (B, K)
    :param parameters: candidates; those that log π does not depend on contribute nothing
    :return: G, shape (K, K)
    """
    if not log_prob.requires_grad:  # a frozen actor
        return cotangents.new_zeros(cotangents.shape[1], cotangents.shape[1])
    rows = []
    for cotangent in cotangents.unbind(1):
        gradients = th.autograd.grad(log_prob, parameters, cotangent, retain_graph=True, allow_unused=True)
        rows.append(th.cat([gradient.flatten() for gradient in gradients if gradient is not None]))
    jacobian = th.stack(rows)
    return jacobian @ jacobian.T


class ManyBackwards:
    """An actor-critic of any kind, evaluated with SB3's ``evaluate_actions`` and differentiated with K + 1 backward passes.

    Call :meth:`evaluate` with a minibatch, then :meth:`gramian` and :meth:`backward`.

    :param policy: an SB3 ``ActorCriticPolicy``
    """

    def __init__(self, policy: Any):
        self.policy = policy
        self._parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]

    def one_thread(self) -> AbstractContextManager[Any]:
        """Threads are PyTorch's own business here."""
        return nullcontext()

    def array(self, tensor: th.Tensor) -> th.Tensor:
        """A tensor of the minibatch in the form that the other methods take and return: as it is."""
        return tensor

    def evaluate(self, observations: Any, actions: th.Tensor) -> ManyBackwards:
        """Forward pass of actor and critic; sets ``values`` (B, K) and ``log_prob`` (B,)."""
        with th.enable_grad():
            self._values, self._log_prob, entropy = self.policy.evaluate_actions(observations, actions)
            self._entropy_loss = self._log_prob.mean() if entropy is None else -entropy.mean()
        self.values, self.log_prob = self._values.detach(), self._log_prob.detach()
        return self

    def gramian(self, cotangents: th.Tensor, n_samples: int | None = None) -> th.Tensor:
        """Gramian of the component gradients, shape (K, K).

        :param cotangents: of log π, shape (B, K)
        :param n_samples: take the first n rows of the minibatch instead of all; they are in random order already
        """
        if n_samples is not None:
            cotangents = cotangents.clone()
            cotangents[n_samples:] = 0
        return gramian_by_passes(self._log_prob, cotangents, self._parameters)

    def entropy_loss(self) -> th.Tensor:
        """PPO's entropy loss: minus the mean entropy, or the mean log π where the entropy has no closed form."""
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
