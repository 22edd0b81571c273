"""From reward vectors to advantages: bootstrap, component GAE, joint normalisation.

Pure functions on arrays. The last axis is always the reward component, K of them.
"""

from __future__ import annotations

from typing import Any, TypeVar

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
    r"""Generalised advantage estimation, once per component (METHOD: component GAE;
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


def joint_scale(advantages: ArrayT, eps: float = 1e-8, kappa_max: float = np.inf) -> Any:
    r"""One scale for all components: the summed advantage gets unit variance, ratios between
    components are kept.

    .. math:: κ = 1 / \max(σ(\textstyle\sum_k A^{(k)}) + ε,\ \max_k σ(A^{(k)}) / κ_{max})

    The second term bounds κ where components cancel and the variance of their sum vanishes. σ has
    ddof 1, as in PPO.

    :param advantages: NumPy array or torch tensor of shape (samples, K)
    :param eps: added to the standard deviation
    :param kappa_max: bound of κ · max_k σ(A^(k)), without unit
    :return: κ; 1 for a single sample, whose standard deviation is undefined
    """
    n_samples = len(advantages)
    if n_samples < 2:
        return 1.0
    total = advantages.sum(-1)
    scale = _std(total, n_samples) + eps
    if np.isfinite(kappa_max):
        scale = scale.clip(min=_std(advantages, n_samples).max() / kappa_max)
    return 1.0 / scale


def normalize_jointly(advantages: ArrayT, eps: float = 1e-8, kappa_max: float = np.inf) -> ArrayT:
    """Joint normalisation Â = κ (A - mean), with the κ of :func:`joint_scale` (METHOD: joint
    normalisation).

    :param advantages: NumPy array or torch tensor of shape (..., K); the mean is taken per
        component over all samples
    :param eps: see :func:`joint_scale`
    :param kappa_max: see :func:`joint_scale`
    :return: same type and shape; a single sample is returned as it is, as in PPO
    """
    samples = advantages.reshape(-1, advantages.shape[-1])
    if len(samples) < 2:
        return advantages
    return joint_scale(samples, eps, kappa_max) * (advantages - samples.mean(0))


def _std(samples: Any, n_samples: int) -> Any:
    """Standard deviation over the first axis with ddof 1, spelled so that NumPy arrays and torch
    tensors both take it.
    """
    return (((samples - samples.mean(0)) ** 2).sum(0) / (n_samples - 1)) ** 0.5
