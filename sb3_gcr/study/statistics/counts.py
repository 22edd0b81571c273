"""Counts and families of tests: Holm, e-values and intervals of wins, tables of wins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special, stats

from sb3_gcr.study.statistics.checks import (
    Array,
    check_counts,
    check_equal_lengths,
    check_share,
    checked_sample,
)


class Evidence(NamedTuple):
    """An e-value on wins, and what it allows to say at any time: p = min(1, 1 / E)."""

    e: float
    p: float
    wins: int
    n: int


class Proportion(NamedTuple):
    """A share of wins with its interval."""

    share: float
    low: float
    high: float


def holm(p_values: ArrayLike) -> Array:
    r"""Holm's adjusted p-values: reject all that are below α, and any error has probability ≤ α.

    .. math:: \tilde p_{(i)} = \min(1, \max_{j ≤ i} (m - j + 1) p_{(j)})

    S. Holm, Scandinavian Journal of Statistics 6 (1979).

    :param p_values: m of them, in any order, shape (m,)
    :return: adjusted, in the same order, shape (m,)
    :raises ValueError: no p-value, or one outside 0 to 1
    """
    p = checked_sample(p_values, "p_values", at_least=0)
    if len(p) == 0:
        raise ValueError("Parameter `p_values` must have at least one p-value, found none.")
    outside = p[(p < 0.0) | (p > 1.0)]
    if len(outside):
        raise ValueError(f"Parameter `p_values` must lie between 0 and 1, found {outside[0]}.")
    order = np.argsort(p, kind="stable")
    steps = np.arange(len(p), 0, -1) * p[order]
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(steps))
    return adjusted


def e_value(wins: int, n: int) -> Evidence:
    r"""The evidence of w wins in n configurations against a fair coin.

    .. math:: E = 2^n B(w + 1, n - w + 1)

    It is the likelihood ratio of a coin with a uniformly drawn chance to a fair one, so it may be
    looked at after each configuration: with a fair coin it ever reaches 20 with probability at
    most 1/20 (Ville; 2.0 % within 36 configurations, 2.7 % within 99). It grows for many losses as
    for many wins. A tie is no configuration.

    :param wins: w
    :param n: number of configurations without ties
    :raises ValueError: w outside 0 to n
    """
    check_counts(wins, n)
    # Above 2**1023 the exponential overflows: as much evidence as a float holds.
    log_e = n * math.log(2.0) + float(special.betaln(wins + 1, n - wins + 1))
    e = math.exp(log_e) if log_e < 709.0 else math.inf
    return Evidence(e, min(1.0, 1.0 / e), wins, n)


def wilson(wins: int, n: int, confidence: float = 0.95) -> Proportion:
    r"""Wilson's interval of a share of wins, E. B. Wilson, JASA 22 (1927): all shares q with

    .. math:: (w / n - q)^2 ≤ z^2 q (1 - q) / n

    :param wins: w
    :param n: number of comparisons, at least 1
    :param confidence: coverage of the interval
    :raises ValueError: no comparison, or w outside 0 to n
    """
    check_share(confidence, "confidence")
    check_counts(wins, n)
    if n == 0:
        raise ValueError("Parameter `n` must be at least 1, found 0: show such a cell as empty.")
    interval = stats.binomtest(wins, n).proportion_ci(confidence, method="wilson")
    return Proportion(wins / n, float(interval.low), float(interval.high))


def fisher(wins: Sequence[int], n: Sequence[int], resamples: int = 99_999, seed: int = 0) -> float:
    """Fisher's two-sided test of equal chances to win in the groups of a win table.

    Two groups (objective active, objective absent) are tested exactly, more (the levels of an
    objective) by drawing tables with the same margins. Groups without a configuration say nothing.

    :param wins: wins of each group, at least two groups
    :param n: configurations of each group
    :param resamples: number of drawn tables
    :param seed: of the draws
    :return: p; 1 where all configurations, or none, are won
    :raises ValueError: unequal lengths, one group, or wins outside 0 to n
    """
    check_equal_lengths(wins, n, ("wins", "n"), "group")
    if len(n) < 2:
        raise ValueError(f"Parameter `n` must have at least 2 groups, found {len(n)}.")
    for group_wins, group_n in zip(wins, n, strict=True):
        check_counts(group_wins, group_n)
    table = np.array([wins, np.subtract(n, wins)]).T
    table = table[table.sum(1) > 0]
    if len(table) < 2:
        return 1.0
    if len(table) == 2:
        return float(stats.fisher_exact(table).pvalue)
    draws = stats.MonteCarloMethod(n_resamples=resamples, rng=np.random.default_rng(seed))
    return float(stats.fisher_exact(table, method=draws).pvalue)
