"""Whether the components of a reward add up to it, and if not, why."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.rewards.spec import RewardSpec

#: By how much components in double precision may miss the reward, relative to the sum of sizes.
SUM_TOLERANCE = 1e-9
#: What a few roundings of float32 may add to that, relative to the sizes of what was rounded.
SINGLE_ROUNDING = 8 * float(np.finfo(np.float32).eps)
#: What to give for a reward in float16: four of its roundings.
HALF_TOLERANCE = 2e-3
#: Rewards with more decimals than this are not taken for rounded ones.
MOST_DECIMALS = 5

FORGOTTEN = (
    "Name the missing terms, or collect the rest in a component of its own with "
    '`RewardDecomposition(residual="name")`.'
)


class Fault(NamedTuple):
    """What is wrong with the components of an env, and whether it is their sum."""

    env_index: int
    sentence: str
    is_sum: bool


def find_fault(
    components: NDArray[Any], rewards: NDArray[Any], spec: RewardSpec, tolerance: float
) -> Fault | None:
    """First env whose components are not finite or do not sum to its reward.

    :param components: shape (N, K)
    :param rewards: shape (N,)
    :param spec: names the K components
    :param tolerance: allowed abs(Σ_k r^(k) - r) beyond rounding, relative to
        Σ_k abs(r^(k)) + abs(r); for a rounded reward, the allowed half of its last decimal
    """
    with np.errstate(invalid="ignore", over="ignore"):
        miss = np.abs(components.sum(1) - rewards)
        sizes = np.abs(components).sum(1) + np.abs(rewards)
        least = SINGLE_ROUNDING if rewards.dtype == np.float32 else SUM_TOLERANCE
        if (miss <= least * sizes).all() and np.isfinite(sizes).all():  # nearly always
            return None
        finite = np.isfinite(components).all(1) & np.isfinite(rewards)
        fits = miss <= _allowed(components, rewards, tolerance)
    for index in np.flatnonzero(~(finite & fits)):
        row, reward = components[index], float(rewards[index])
        if not finite[index]:
            return Fault(int(index), _infinite_sentence(row, reward, spec), False)
        if tolerance < np.inf and not _is_rounded(row.sum(), reward, tolerance):
            sentence = sum_sentence(row, reward, spec, _cause(row, reward, spec))
            return Fault(int(index), sentence, True)
    return None


def all_add_up(
    components: NDArray[Any], rewards: NDArray[Any], tolerance: float = SUM_TOLERANCE
) -> bool:
    """Whether components sum to the reward in each step.

    :param components: shape (n, K)
    :param rewards: shape (n,)
    :param tolerance: as for :func:`find_fault`
    """
    miss = np.abs(components.sum(1) - rewards)
    return bool((miss <= _allowed(components, rewards, tolerance)).all())


def adds_up(row: NDArray[Any], reward: float, tolerance: float = SUM_TOLERANCE) -> bool:
    """Whether components sum to a reward.

    :param row: shape (K,)
    :param reward: their sum, perhaps
    :param tolerance: as for :func:`find_fault`
    """
    return all_add_up(row[None], np.array([reward]), tolerance)


def sum_sentence(row: NDArray[Any], reward: float, spec: RewardSpec, cause: str) -> str:
    """What the components sum to, and why that is not the reward.

    :param row: shape (K,)
    :param reward: what they should sum to
    :param spec: names the K components
    :param cause: the sentences that follow
    """
    digits = 6 if f"{reward:.6g}" != f"{row.sum():.6g}" else 12
    return (
        f"The reward components must sum to the reward {reward:.{digits}g}, found "
        f"{row.sum():.{digits}g} ({_listed(row, spec)}). {cause}"
    )


def _allowed(
    components: NDArray[Any], rewards: NDArray[Any], tolerance: float
) -> NDArray[np.float64]:
    """By how much each env may miss its reward: what float32 rounds of the numbers that it made.

    A number that float32 holds exactly was perhaps made by it, in which case a sum may have been,
    too.
    """
    sizes = np.abs(np.asarray(components, dtype=float))
    reward_sizes = np.abs(np.asarray(rewards, dtype=float))
    total = sizes.sum(1) + reward_sizes
    is_single = sizes.astype(np.float32) == sizes
    rounded = np.where(
        reward_sizes.astype(np.float32) == reward_sizes, total, np.where(is_single, sizes, 0).sum(1)
    )
    allowed: NDArray[np.float64] = max(tolerance, SUM_TOLERANCE) * total + SINGLE_ROUNDING * rounded
    return allowed


def _has_decimals(reward: float, decimals: int) -> bool:
    """Whether a reward is a number of so many decimals, and coarse enough to tell."""
    rounded = round(reward, decimals)
    is_coarse = 10.0**-decimals > 2 * SINGLE_ROUNDING * abs(reward)
    return is_coarse and reward in (rounded, float(np.float32(rounded)))


def _most_decimals(total: float, reward: float) -> int | None:
    """The number of decimals that the reward may have been rounded to, for that total."""
    for decimals in range(MOST_DECIMALS, 0, -1):
        if _has_decimals(reward, decimals) and abs(total - reward) <= _half(decimals):
            return decimals
    return None


def _half(decimals: int) -> float:
    """Half a unit of the last decimal, with what float32 makes of it."""
    return 0.5 * 10.0**-decimals * (1 + 1e-3)


def _is_rounded(total: float, reward: float, tolerance: float) -> bool:
    """Whether rounding explains the miss, and ``tolerance`` allows it."""
    decimals = _most_decimals(total, reward)
    return decimals is not None and 0.5 * 10.0**-decimals <= tolerance * (1 + 1e-9)


def _cause(row: NDArray[Any], reward: float, spec: RewardSpec) -> str:
    """The one thing that explains the miss, or the general advice."""
    total = float(row.sum())
    factor = _two_digits(reward / total) if total else 0.0
    if not _is_telling(reward):
        return _rounding_cause(row, reward) or FORGOTTEN
    if factor and adds_up(row * factor, reward):
        return f"It is {factor:g} times their sum: give `RewardDecomposition(weights={factor:g})`."
    for index, name in enumerate(spec.names):
        other = row.copy()
        other[index] = -row[index]
        if adds_up(other, reward):
            return f"With the other sign of '{name}' they do: a penalty is a negative number."
        other[index] = 0.0
        if adds_up(other, reward):
            return f"Without '{name}' they do: it seems not to be in the reward."
    return _rounding_cause(row, reward) or FORGOTTEN


def _is_telling(value: float) -> bool:
    """Whether a number has so many digits that it fits no sum by chance."""
    return float(f"{value:.3g}") != value


def _two_digits(factor: float) -> float:
    return float(f"{factor:.2g}")


def _rounding_cause(row: NDArray[Any], reward: float) -> str:
    total = float(row.sum())
    decimals = _most_decimals(total, reward)
    if decimals is not None and reward != round(reward):
        return (
            f"The reward looks rounded to {decimals} decimals. If it is, give "
            f"`RewardDecomposition(tolerance={0.5 * 10.0**-decimals:g})`; if not, a term is "
            "missing."
        )
    with np.errstate(over="ignore"):
        is_half = float(np.float16(reward)) == reward
    size = float(np.abs(row).sum()) + abs(reward)
    if is_half and abs(total - reward) <= HALF_TOLERANCE * size:
        return (
            "The reward looks like a float16. If it is, give "
            f"`RewardDecomposition(tolerance={HALF_TOLERANCE:g})`; if not, a term is missing."
        )
    return ""


def _infinite_sentence(row: NDArray[Any], reward: float, spec: RewardSpec) -> str:
    for name, value in zip(spec.names, row, strict=True):
        if not np.isfinite(value):
            return (
                f"Reward component '{name}' must be finite, found {value} ({_listed(row, spec)})."
            )
    return f"The reward must be finite, found {reward} ({_listed(row, spec)})."


def _listed(row: NDArray[Any], spec: RewardSpec) -> str:
    return ", ".join(f"{name}={value:.6g}" for name, value in zip(spec.names, row, strict=True))
