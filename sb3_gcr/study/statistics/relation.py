"""How one number of a task goes with another: rank correlation and a straight line."""

from __future__ import annotations

from math import factorial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from sb3_gcr.study.statistics.checks import (
    Array,
    check_equal_lengths,
    check_share,
    checked_sample,
)

#: Permutations that are held at once, which bounds the memory.
BATCH = 10_000


class Correlation(NamedTuple):
    """Spearman's ρ with its two-sided permutation p; ``exact`` where all orders were tried."""

    rho: float
    p: float
    n: int
    exact: bool


class Line(NamedTuple):
    """A least-squares line: its slope with interval and p against 0, and what it leaves over."""

    slope: float
    low: float
    high: float
    p: float
    intercept: float
    residuals: Array


def spearman(x: ArrayLike, y: ArrayLike, resamples: int = 99_999, seed: int = 0) -> Correlation:
    r"""Spearman's rank correlation, tested by permuting who belongs to whom.

    .. math:: ρ = \mathrm{corr}(\mathrm{rank}(x), \mathrm{rank}(y)), \qquad p = P_π(|ρ_π| ≥ |ρ|)

    Ties get their mean rank. All n! orders are tried where they are at most ``resamples``; else so
    many are drawn, and the observed one counts as one of them.

    :param x: one value a task, shape (n,), at least 3
    :param y: one value for each of the same tasks, shape (n,)
    :param resamples: number of drawn orders
    :param seed: of the draws
    :raises ValueError: unequal lengths, too few values, not finite ones, or all of them equal
    """
    x, y = _checked_pairs(x, y)
    ranks = [_standard_ranks(x, "x"), _standard_ranks(y, "y")]

    def correlation(permuted: Array, axis: int) -> Array:
        return (permuted * ranks[1]).sum(axis)

    result = stats.permutation_test(
        (ranks[0],),
        correlation,
        permutation_type="pairings",
        vectorized=True,
        n_resamples=resamples,
        batch=BATCH,
        rng=np.random.default_rng(seed),
    )
    exact = factorial(len(x)) <= resamples
    return Correlation(float(result.statistic), float(result.pvalue), len(x), exact)


def line(x: ArrayLike, y: ArrayLike, confidence: float = 0.95) -> Line:
    r"""The least-squares line through the tasks, with Student's interval of its slope.

    .. math::
        y_i = α + β x_i + e_i, \qquad
        β ± t_{n-2} \sqrt{\frac{\sum_i e_i^2 / (n - 2)}{\sum_i (x_i - \bar x)^2}}

    :param x: one value a task, shape (n,), at least 3
    :param y: one value for each of the same tasks, shape (n,)
    :param confidence: coverage of the interval
    :return: with the residuals e, shape (n,)
    :raises ValueError: unequal lengths, too few values, not finite ones, or equal x
    """
    check_share(confidence, "confidence")
    x, y = _checked_pairs(x, y)
    _check_spread(x, "x")
    fit = stats.linregress(x, y)
    half = float(stats.t.ppf(0.5 + confidence / 2.0, len(x) - 2)) * float(fit.stderr)
    slope = float(fit.slope)
    residuals = y - (fit.intercept + slope * x)
    return Line(
        slope, slope - half, slope + half, float(fit.pvalue), float(fit.intercept), residuals
    )


def _checked_pairs(x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Both as finite rows of one length."""
    first = checked_sample(x, "x", at_least=3, unit="task")
    second = checked_sample(y, "y", at_least=3, unit="task")
    check_equal_lengths(first, second, ("x", "y"), "task")
    return first, second


def _check_spread(values: Array, name: str) -> None:
    """Refuse values that are all equal: nothing goes with a constant."""
    if np.ptp(values) == 0.0:
        raise ValueError(
            f"Parameter `{name}` must have at least two different values, found {values[0]} only."
        )


def _standard_ranks(values: Array, name: str) -> Array:
    """Ranks with mean 0 and length 1, so that a correlation is an inner product."""
    _check_spread(values, name)
    ranks = stats.rankdata(values)
    ranks = ranks - ranks.mean()
    return ranks / np.linalg.norm(ranks)
