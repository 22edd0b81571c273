"""From reward vectors to advantages: bootstrap, component GAE, joint normalisation.

Pure functions on arrays. The last axis is always the reward component, K of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
ArrayT = TypeVar("ArrayT", bound=Any)


def bootstrap_truncations(
    rewards: FloatArray, truncated: NDArray[np.bool_], terminal_values: FloatArray, gamma: float
) -> FloatArray:
    """Add the value of the state that a time limit cut off: r^(k) + γ V^(k)(s_terminal) where
    truncated.

    A time limit is not a termination: the episode would have gone on, and the critic says for how
    much.

    :param rewards: components of one step, shape (N, K)
    :param truncated: which of the N envs ended by a time limit, n of them, shape (N,)
    :param terminal_values: values of those envs' terminal observations, shape (n, K)
    :param gamma: discount factor per step
    :return: a new array of shape (N, K)
    """
    bootstrapped = rewards.copy()
    bootstrapped[truncated] += gamma * terminal_values
    return bootstrapped


def component_gae(
    rewards: FloatArray,
    values: FloatArray,
    episode_starts: FloatArray,
    last_values: FloatArray,
    last_dones: NDArray[Any],
    gamma: float,
    gae_lambda: float,
) -> FloatArray:
    r"""Generalised advantage estimation, once per component (
    arXiv:1506.02438).

    .. math::
        δ_t^{(k)} = r_t^{(k)} + γ (1 - d_t) V^{(k)}(s_{t+1}) - V^{(k)}(s_t), \qquad
        A_t^{(k)} = δ_t^{(k)} + γ λ (1 - d_t) A_{t+1}^{(k)}

    :param rewards: shape (T, N, K)
    :param values: V(s_t), shape (T, N, K)
    :param episode_starts: 1 where step t is the first of an episode, shape (T, N)
    :param last_values: V(s_T), shape (N, K)
    :param last_dones: whether step T - 1 ended an episode, shape (N,)
    :param gamma: discount factor γ per step
    :param gae_lambda: trade-off λ between bias (0) and variance (1)
    :return: advantages, shape (T, N, K); the returns Ĝ are ``advantages + values``
    """
    advantages = np.empty_like(values)
    next_values, next_advantages = last_values, np.zeros_like(last_values)
    continues = 1.0 - np.asarray(last_dones, dtype=values.dtype)
    for t in reversed(range(len(rewards))):
        alive = continues[:, None]
        delta = rewards[t] + gamma * alive * next_values - values[t]
        advantages[t] = delta + gamma * gae_lambda * alive * next_advantages
        next_values, next_advantages = values[t], advantages[t]
        continues = 1.0 - episode_starts[t]
    return advantages


class Normalised(NamedTuple):
    """Jointly normalised advantages, and by how much they were scaled."""

    advantages: Any
    """Â, of the type and shape of A."""
    kappa: Any
    """κ, one number."""


def normalize_jointly(
    advantages: ArrayT, eps: float = 1e-8, kappa_max: float = np.inf
) -> Normalised:
    r"""Joint normalisation: one scale κ for all components, so that the summed advantage has unit
    variance and the ratios between components are kept.

    .. math::
        Â = κ (A - \bar A), \qquad
        κ = 1 / \max(σ(\textstyle\sum_k A^{(k)}) + ε,\ \max_k σ(A^{(k)}) / κ_{max})

    The second term bounds κ where components cancel and the variance of their sum vanishes. σ has
    ddof 1, as in PPO; the mean is taken per component over all samples.

    :param advantages: A, NumPy array or tensor of shape (..., K)
    :param eps: ε, added to the standard deviation
    :param kappa_max: bound of κ · max_k σ(A^(k)), without unit
    :return: Â and κ; a single sample, whose deviation is undefined, as it is with κ = 1, as in PPO
    """
    samples = advantages.reshape(-1, advantages.shape[-1])
    n_samples = len(samples)
    if n_samples < 2:
        return Normalised(advantages, 1.0)
    scale = _std(samples.sum(-1), n_samples) + eps
    if np.isfinite(kappa_max):
        scale = scale.clip(min=_std(samples, n_samples).max() / kappa_max)
    kappa = 1.0 / scale
    return Normalised(kappa * (advantages - samples.mean(0)), kappa)


def _std(samples: Any, n_samples: int) -> Any:
    """Standard deviation over the first axis with ddof 1, of NumPy arrays and of tensors."""
    return (((samples - samples.mean(0)) ** 2).sum(0) / (n_samples - 1)) ** 0.5
