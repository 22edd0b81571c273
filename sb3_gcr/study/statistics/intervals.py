"""Welch's intervals: of one difference, of the mean of several tasks' differences, of a ratio.

A percentile bootstrap covers too little at three to five seeds; Student's t with the degrees of
freedom of Welch and Satterthwaite does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from sb3_gcr.study.statistics.checks import (
    Array,
    check_equal_lengths,
    check_share,
    checked_sample,
    checked_tasks,
)

#: More seeds than anybody runs; the search for a number of seeds ends there.
MOST_SEEDS = 2**30


class Summary(NamedTuple):
    """A sample as a table prints it: mean, standard deviation (ddof 1), number of seeds."""

    mean: float
    sd: float
    n: int


class Interval(NamedTuple):
    """An estimate with its two-sided interval, the p-value against 0, and degrees of freedom."""

    estimate: float
    low: float
    high: float
    p: float
    df: float


def summary(values: ArrayLike) -> Summary:
    """Mean, standard deviation (ddof 1) and number of one method's seeds.

    :param values: shape (n,), n at least 2
    :raises ValueError: too few seeds, or values that are not finite
    """
    sample = checked_sample(values, "values")
    return Summary(float(sample.mean()), float(sample.std(ddof=1)), len(sample))


def welch(a: ArrayLike, b: ArrayLike, relative: bool = False, confidence: float = 0.95) -> Interval:
    """Welch's difference of two methods on one task; see :func:`welch_from_summaries`.

    :param a: the baseline's seeds, shape (n_a,), at least 2
    :param b: the other method's seeds, shape (n_b,), at least 2; seeds are no pairs
    :param relative: whether the difference is a share of the baseline's mean
    :param confidence: coverage of the interval
    :raises ValueError: too few seeds, values that are not finite, a relative difference to 0
    """
    return welch_from_summaries(
        summary(checked_sample(a, "a")), summary(checked_sample(b, "b")), relative, confidence
    )


def welch_from_summaries(
    a: Summary, b: Summary, relative: bool = False, confidence: float = 0.95
) -> Interval:
    r"""Welch's difference of two methods from mean, standard deviation and number of seeds.

    .. math::
        v = s^2 / n, \qquad
        ν = \frac{(v_a + v_b)^2}{v_a^2 / (n_a - 1) + v_b^2 / (n_b - 1)}, \qquad
        \bar b - \bar a ± t_ν \sqrt{v_a + v_b}

    The relative difference is (b̄ - ā) / |ā|, with Fieller's interval: all ratios r = b̄ / ā that the
    same t with the same ν does not reject,

    .. math:: (\bar b - r \bar a)^2 ≤ t_ν^2 (v_b + r^2 v_a)

    so it leaves out 0 exactly where the absolute one does. It is unbounded where the baseline's
    own mean is not told from 0. Both in B. L. Welch, Biometrika 34 (1947), and E. C. Fieller,
    Journal of the Royal Statistical Society B 16 (1954).

    :param a: the baseline
    :param b: the other method
    :param relative: whether the difference is a share of the baseline's mean
    :param confidence: coverage of the interval
    :raises ValueError: fewer than two seeds, or a relative difference to 0
    """
    check_share(confidence, "confidence")
    _check_summary(a, "a")
    _check_summary(b, "b")
    variances = np.array([_variance_of_mean(a), _variance_of_mean(b)])
    difference = _t_interval(b.mean - a.mean, variances, np.array([a.n - 1, b.n - 1]), confidence)
    if not relative:
        return difference
    if a.mean == 0.0:
        raise ValueError(
            "Parameter `a` must have a mean other than 0 for a relative difference, found 0: "
            "use relative=False."
        )
    t = _quantile(difference.df, confidence)
    lowest, highest = _ratios(a.mean, b.mean, variances[0], variances[1], t)
    ends = sorted(float(np.sign(a.mean)) * (ratio - 1.0) for ratio in (lowest, highest))
    estimate = (b.mean - a.mean) / abs(a.mean)
    return Interval(estimate, ends[0], ends[1], difference.p, difference.df)


def welch_over_tasks(
    a: Sequence[ArrayLike], b: Sequence[ArrayLike], confidence: float = 0.95
) -> Interval:
    r"""The mean of M tasks' differences, with the degrees of freedom of Welch and Satterthwaite.

    .. math::
        D = \frac{1}{M} \sum_m (\bar b_m - \bar a_m), \qquad
        V = \frac{1}{M^2} \sum_i v_i, \qquad
        ν = \frac{(\sum_i v_i)^2}{\sum_i v_i^2 / (n_i - 1)}

    i runs over the 2M samples. The tasks are these tasks and no sample of others: how much they
    differ from one another is not in the interval. The scores must be on one scale, see
    :func:`~sb3_gcr.study.statistics.normalised_score`.

    :param a: the baseline's seeds, one array a task
    :param b: the other method's, for the same tasks in the same order
    :param confidence: coverage of the interval
    :raises ValueError: unequal numbers of tasks, too few seeds, values that are not finite
    """
    check_share(confidence, "confidence")
    check_equal_lengths(a, b, ("a", "b"), "task")
    samples_a = checked_tasks(a, "a")
    samples_b = checked_tasks(b, "b")
    summaries = [summary(sample) for sample in samples_a + samples_b]
    n_tasks = len(samples_a)
    mean_a = np.mean([one.mean for one in summaries[:n_tasks]])
    mean_b = np.mean([one.mean for one in summaries[n_tasks:]])
    variances = np.array([_variance_of_mean(one) for one in summaries]) / n_tasks**2
    dfs = np.array([one.n - 1 for one in summaries])
    return _t_interval(float(mean_b - mean_a), variances, dfs, confidence)


def mean_interval(differences: ArrayLike, confidence: float = 0.95) -> Interval:
    r"""Student's interval of the mean over configurations, which are pairs.

    .. math:: \bar d ± t_{n-1} s / \sqrt{n}

    :param differences: b - a of each configuration, shape (n,), at least 2
    :param confidence: coverage of the interval
    :raises ValueError: too few configurations, or values that are not finite
    """
    check_share(confidence, "confidence")
    one = summary(checked_sample(differences, "differences", unit="configuration"))
    return _t_interval(
        one.mean, np.array([_variance_of_mean(one)]), np.array([one.n - 1]), confidence
    )


def is_decided(low: float, high: float, margin: float) -> bool:
    """Whether an interval allows a verdict: it leaves out 0, or it lies inside ±margin.

    :param low: lower end
    :param high: upper end
    :param margin: the largest difference that does not matter, in the interval's unit
    """
    return low > 0.0 or high < 0.0 or (-margin < low and high < margin)


def seeds_needed(
    a: ArrayLike,
    b: ArrayLike,
    margin: float,
    relative: bool = False,
    confidence: float = 0.95,
) -> int:
    """About how many more seeds of each method until Welch's interval allows a verdict.

    The smallest n of both methods whose interval would be decided if means and standard
    deviations stayed as they are, less the seeds that the smaller sample has. With few seeds this
    is a rough number: the standard deviation of three seeds is itself uncertain by half.

    :param a: the baseline's seeds, shape (n_a,)
    :param b: the other method's seeds, shape (n_b,)
    :param margin: the largest difference that does not matter; a share of |ā| if ``relative``
    :param relative: as in :func:`welch`
    :param confidence: coverage of the interval
    :return: 0 where the verdict is there already
    :raises ValueError: a margin that is not positive, or what :func:`welch` refuses
    """
    if not margin > 0.0:
        raise ValueError(f"Parameter `margin` must be above 0, found {margin}.")
    now_a = summary(checked_sample(a, "a"))
    now_b = summary(checked_sample(b, "b"))

    def decided(n_a: int, n_b: int) -> bool:
        then_a, then_b = now_a._replace(n=n_a), now_b._replace(n=n_b)
        interval = welch_from_summaries(then_a, then_b, relative, confidence)
        return is_decided(interval.low, interval.high, margin)

    if decided(now_a.n, now_b.n):
        return 0
    fewest = min(now_a.n, now_b.n)
    undecided, enough = fewest, 2 * fewest
    while not decided(enough, enough) and enough < MOST_SEEDS:
        undecided, enough = enough, 2 * enough
    while enough - undecided > 1:
        middle = (undecided + enough) // 2
        if decided(middle, middle):
            enough = middle
        else:
            undecided = middle
    return enough - fewest


def _check_summary(one: Summary, name: str) -> None:
    """Refuse a summary without a variance."""
    if one.n < 2:
        raise ValueError(
            f"Parameter `{name}` must have at least 2 seeds, found {one.n}: run more seeds."
        )
    if not (np.isfinite(one.mean) and 0.0 <= one.sd < np.inf):
        raise ValueError(
            f"Parameter `{name}` must have a finite mean and a standard deviation of at least 0, "
            f"found {one.mean} and {one.sd}."
        )


def _variance_of_mean(one: Summary) -> float:
    """V = s² / n."""
    return one.sd**2 / one.n


def _quantile(df: float, confidence: float) -> float:
    """t_ν of a two-sided interval."""
    return float(special.stdtrit(df, 0.5 + confidence / 2.0))


def _t_interval(estimate: float, variances: Array, dfs: Array, confidence: float) -> Interval:
    """The interval of a sum of independent means, whose variances add.

    Without any variance the interval is a point, and p is 1 at 0 and 0 elsewhere.
    """
    total = float(variances.sum())
    if total == 0.0:
        p = 1.0 if estimate == 0.0 else 0.0
        return Interval(estimate, estimate, estimate, p, float(dfs.sum()))
    shares = variances / total
    df = 1.0 / float((shares**2 / dfs).sum())
    error = np.sqrt(total)
    half = _quantile(df, confidence) * error
    p = 2.0 * float(special.stdtr(df, -abs(estimate) / error))
    return Interval(estimate, float(estimate - half), float(estimate + half), p, df)


def _ratios(a: float, b: float, v_a: float, v_b: float, t: float) -> tuple[float, float]:
    """Fieller's ends r of b / a: the roots of (b - r a)² = t² (v_b + r² v_a)."""
    bend = a**2 - t**2 * v_a
    if bend <= 0.0:
        return -np.inf, np.inf
    root = np.sqrt(max(0.0, a**2 * v_b + b**2 * v_a - t**2 * v_a * v_b))
    return float((a * b - t * root) / bend), float((a * b + t * root) / bend)
