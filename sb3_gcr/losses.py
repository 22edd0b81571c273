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

#: Values of GCRPPO's parameter ``surrogate_clipping``.
CLIPPINGS = ("joint", "component")


class Clip(NamedTuple):
    """How PPO clips at a moment of training."""

    policy: float
    """ε, of the ratio ρ."""
    values: float | None
    """Of a value head's change, in units of the return; None does not clip."""
    clipping: str = "joint"
    """What decides whether a sample is clipped, see :func:`is_clipped`."""


def is_clipped(ratio: ArrayT, advantages: ArrayT, clip: Clip) -> ArrayT:
    r"""Where the clipped surrogate is the smaller one, so that its slope is 0.

    .. math:: ρ_b S_b > \mathrm{clip}(ρ_b, 1-ε, 1+ε) S_b

    "joint" is PPO's own decision, one for each sample: S_b = Σ_k Â_b^(k). "component" is the
    paper's, one for each sample and component: S_b = Â_b^(k). Where components disagree, the
    latter lets through those whose sign is not that of the sum, and they push ρ back.

    :param ratio: ρ, shape (B, 1)
    :param advantages: Â, shape (B, K)
    :param clip: ε and what decides
    :return: shape (B, 1) for "joint", (B, K) for "component"
    """
    deciding = advantages.sum(1)[:, None] if clip.clipping == "joint" else advantages
    return ratio * deciding > _clipped(ratio, clip.policy) * deciding  # type: ignore[no-any-return]


def surrogate_losses(
    log_prob: ArrayT, old_log_prob: ArrayT, advantages: ArrayT, clip: Clip
) -> ArrayT:
    r"""PPO's clipped surrogate loss of each sample and component, to be minimised; one ratio ρ for
    all components.

    .. math:: L_b^{(k)} = -(u_b ρ_b + (1 - u_b) \mathrm{clip}(ρ_b, 1-ε, 1+ε)) Â_b^{(k)}, \qquad
        L^{(k)} = \frac{1}{B} \sum_b L_b^{(k)}

    with u = 0 where :func:`is_clipped`, else 1. With "joint" clipping Σ_k L^(k) is PPO's loss on
    Σ_k Â^(k); with "component" L_b^(k) is -min(ρ_b Â_b^(k), clip(ρ_b) Â_b^(k)), the paper's.

    :param log_prob: log π(a_b|s_b) of the current policy, shape (B,)
    :param old_log_prob: the same of the policy that collected the data, shape (B,)
    :param advantages: Â, shape (B, K)
    :param clip: ε and what decides
    :return: losses before the mean over samples, shape (B, K)
    """
    ratio = _exp(log_prob - old_log_prob)[:, None]
    xp: Any = th if isinstance(ratio, th.Tensor) else np
    clipped = is_clipped(ratio, advantages, clip)
    return -xp.where(clipped, _clipped(ratio, clip.policy), ratio) * advantages


def surrogate_cotangents(
    log_prob: ArrayT, old_log_prob: ArrayT, advantages: ArrayT, clip: Clip
) -> ArrayT:
    r"""The derivatives of the mean :func:`surrogate_losses` by log π in closed form: all that an
    update needs of them.

    .. math:: c_b^{(k)} = \frac{∂L^{(k)}}{∂\log π_b} = -\frac{u_b ρ_b Â_b^{(k)}}{B}

    :param log_prob: log π(a_b|s_b), shape (B,)
    :param old_log_prob: shape (B,)
    :param advantages: Â, shape (B, K)
    :param clip: ε and what decides
    :return: cotangents c, shape (B, K)
    """
    ratio = _exp(log_prob - old_log_prob)[:, None]
    cotangents = ratio * advantages
    clipped = is_clipped(ratio, advantages, clip)
    cotangents[clipped[:, 0] if clip.clipping == "joint" else clipped] = 0.0
    cotangents *= -1 / len(advantages)
    return cotangents


def brakes(log_prob: ArrayT, old_log_prob: ArrayT, advantages: ArrayT, clip_range: float) -> ArrayT:
    """Which samples PPO clips while clipping by component still lets a gradient through, which then
    points against the summed advantage, back to the old policy; shape (B,).

    :param log_prob: log π(a_b|s_b), shape (B,)
    :param old_log_prob: shape (B,)
    :param advantages: Â, shape (B, K)
    :param clip_range: ε
    """
    ratio = _exp(log_prob - old_log_prob)[:, None]
    jointly = is_clipped(ratio, advantages, Clip(clip_range, None, "joint"))[:, 0]
    by_component = is_clipped(ratio, advantages, Clip(clip_range, None, "component"))
    return jointly & (~by_component & (advantages != 0)).any(1)


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


def _clipped(ratio: ArrayT, clip_range: float) -> ArrayT:
    return ratio.clip(1 - clip_range, 1 + clip_range)  # type: ignore[no-any-return]


def _exp(array: ArrayT) -> Any:
    return array.exp() if isinstance(array, th.Tensor) else np.exp(array)
