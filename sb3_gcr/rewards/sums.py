"""Whether the components of a reward add up to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.rewards.spec import RewardSpec

#: By how much the components may miss the reward, relative to the sum of their sizes.
SUM_TOLERANCE = 1e-4


def find_fault(
    components: NDArray[Any], rewards: NDArray[Any], spec: RewardSpec, tolerance: float
) -> tuple[int, str] | None:
    """First env whose components are not finite or do not sum to its reward.

    :param components: shape (N, K)
    :param rewards: shape (N,)
    :param spec: names the K components
    :param tolerance: allowed abs(Σ_k r^(k) - r) relative to Σ_k abs(r^(k)) + abs(r)
    :return: index of the env and what is wrong, or None
    """
    with np.errstate(invalid="ignore"):
        total = components.sum(1)
        allowed = tolerance * (np.abs(components).sum(1) + np.abs(rewards))
        healthy = np.isfinite(total)
        if tolerance < np.inf:
            healthy &= np.abs(total - rewards) <= allowed
    if healthy.all():
        return None
    index = int(np.argmin(healthy))
    row, reward = components[index], rewards[index]
    listed = ", ".join(f"{name}={value:.6g}" for name, value in zip(spec.names, row, strict=True))
    for name, value in zip(spec.names, row, strict=True):
        if not np.isfinite(value):
            return index, f"Reward component '{name}' must be finite, found {value} ({listed})."
    return index, (
        f"The reward components must sum to the reward {reward:.6g}, found {row.sum():.6g} "
        f"({listed}). "
        "Name the missing terms, or collect the rest in a component of its own with "
        '`RewardDecomposition(residual="name")`.'
    )
