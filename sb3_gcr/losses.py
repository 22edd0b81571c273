"""The component losses and their cotangents: NumPy arrays and tensors both fit.

All K surrogates share one log π(a_b|s_b), so the gradient of component k is Σ_b c_b^(k) ∇_θ log
π(a_b|s_b): its cotangent c^(k) is all that distinguishes it. The step of any weights w is one
backward pass with the cotangent c w.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_gcr.advantages import ArrayT


class Clip(NamedTuple):
    """PPO's clip ranges at a moment of training."""

    policy: float
    """ε, of the ratio ρ."""
    values: float | None
    """Of a value head's change, in units of the return; None does not clip."""


def surrogate_losses(
    log_prob: ArrayT, old_log_prob: ArrayT, advantages: ArrayT, clip_range: float
) -> ArrayT:
    r"""PPO's clipped surrogate loss of each sample and component, to be minimised; one ratio ρ for
    all components.

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


def surrogate_cotangents(
    log_prob: ArrayT, old_log_prob: ArrayT, advantages: ArrayT, clip_range: float
) -> ArrayT:
    r"""The derivatives of the mean :func:`surrogate_losses` by log π in closed form: all that an
    update needs of them.

    .. math::
        c_b^{(k)} = \frac{∂L^{(k)}}{∂\log π_b}
        = -\frac{ρ_b Â_b^{(k)}}{B} \text{ where not clipped, else } 0

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
    """Each sample's term (ρ - 1) - log ρ of the estimate of KL(old ‖ current) that SB3's PPO logs,
    shape (B,).
    """
    log_ratio = log_prob - old_log_prob
    return _exp(log_ratio) - 1 - log_ratio


def leaves_range(log_prob: ArrayT, old_log_prob: ArrayT, clip_range: float) -> ArrayT:
    """Which samples' ratios have left the clip range, abs(ρ - 1) > ε: SB3's clip fraction is their
    share; shape (B,).
    """
    return abs(_exp(log_prob - old_log_prob) - 1) > clip_range  # type: ignore[no-any-return]


def value_errors(
    values: ArrayT, old_values: ArrayT, returns: ArrayT, clip_range_vf: float | None
) -> ArrayT:
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


def value_cotangents(
    values: ArrayT, old_values: ArrayT, returns: ArrayT, clip_range_vf: float | None
) -> ArrayT:
    r"""The derivatives ∂L_V^(k)/∂V_b^(k) = 2 e_b^(k) / B of the losses of :func:`value_errors`, 0
    where clipped.

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
