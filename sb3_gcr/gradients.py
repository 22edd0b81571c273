"""The component losses, their cotangents, and the Gramian of their gradients.

All K surrogates share one log π(a_b|s_b), so the gradient of component k is Σ_b c_b^(k) ∇_θ log π(a_b|s_b): its cotangent
c^(k) is all that distinguishes it. The step of any weights w is one backward pass with the cotangent c w.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch as th


class Surrogates(NamedTuple):
    """The K clipped surrogate losses of a minibatch and what follows from the same ratios."""

    losses: th.Tensor  # (K,)
    cotangents: th.Tensor  # (B, K)
    kl: th.Tensor  # ()
    clip_fraction: th.Tensor  # ()


def clipped_surrogates(log_prob: th.Tensor, old_log_prob: th.Tensor, advantages: th.Tensor, clip_range: float) -> th.Tensor:
    r"""PPO's clipped surrogate loss of each component, to be minimised; one ratio ρ for all of them.

    .. math:: L^{(k)} = -\frac{1}{B} \sum_b \min(ρ_b Â_b^{(k)}, \mathrm{clip}(ρ_b, 1-ε, 1+ε) Â_b^{(k)})

    :param log_prob: log π(a_b|s_b) of the current policy, shape (B,)
    :param old_log_prob: the same of the policy that collected the data, shape (B,)
    :param advantages: Â, shape (B, K)
    :param clip_range: ε
    :return: losses, shape (K,)
    """
    return evaluate_surrogates(log_prob, old_log_prob, advantages, clip_range).losses


def evaluate_surrogates(log_prob: th.Tensor, old_log_prob: th.Tensor, advantages: th.Tensor, clip_range: float) -> Surrogates:
    r"""The losses of :func:`clipped_surrogates` with their derivatives by log π in closed form.

    .. math:: c_b^{(k)} = \frac{∂L^{(k)}}{∂\log π_b} = -\frac{ρ_b Â_b^{(k)}}{B} \text{ where not clipped, else } 0, \qquad
        KL ≈ \frac{1}{B} \sum_b (ρ_b - 1) - \log ρ_b

    :param log_prob: log π(a_b|s_b), shape (B,)
    :param old_log_prob: shape (B,)
    :param advantages: Â, shape (B, K)
    :param clip_range: ε
    :return: losses L, cotangents c, KL(old ‖ current), and the share of samples with abs(ρ - 1) > ε, both as in SB3's PPO
    """
    log_ratio = log_prob - old_log_prob
    ratio = log_ratio.exp()
    column = ratio.unsqueeze(1)
    unclipped = column * advantages
    clipped = column.clamp(1 - clip_range, 1 + clip_range) * advantages
    excess = ratio - 1
    return Surrogates(
        losses=-th.min(unclipped, clipped).mean(0),
        cotangents=th.where(unclipped <= clipped, unclipped, 0.0) / -len(advantages),
        kl=(excess - log_ratio).mean(),
        clip_fraction=(excess.abs() > clip_range).to(ratio.dtype).mean(),
    )


def value_errors(
    values: th.Tensor, old_values: th.Tensor, returns: th.Tensor, clip_range_vf: float | None
) -> tuple[th.Tensor, th.Tensor]:
    r"""Mean squared error of each value head and its derivative; the change of a head is clipped as in SB3's PPO.

    .. math:: L_V^{(k)} = \frac{1}{B} \sum_b (V_b^{(k)} - Ĝ_b^{(k)})^2

    with V replaced by V_old + clip(V - V_old, -c, c) if a ``clip_range_vf`` c is given.

    :param values: V, shape (B, K)
    :param old_values: V when the data were collected, shape (B, K)
    :param returns: Ĝ, shape (B, K)
    :param clip_range_vf: c in units of the return, or None
    :return: losses, shape (K,), and cotangents ∂L_V^(k)/∂V_b^(k), shape (B, K)
    """
    if clip_range_vf is None:
        error = values - returns
        return (error * error).mean(0), error * (2 / len(values))
    change = values - old_values
    error = old_values + change.clamp(-clip_range_vf, clip_range_vf) - returns
    free = change.abs() <= clip_range_vf
    return (error * error).mean(0), th.where(free, error, 0.0) * (2 / len(values))


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
