"""The study's statistics: by hand, against other people's code, and in simulations."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from scipy import optimize, stats

from sb3_gcr.study.statistics import (
    Change,
    Summary,
    e_value,
    fisher,
    holm,
    iqm,
    is_decided,
    line,
    mean_interval,
    normalised_score,
    probability_of_improvement,
    registered_looks,
    seeds_needed,
    sign_permutation,
    spc,
    spearman,
    summary,
    welch,
    welch_from_summaries,
    welch_over_tasks,
    wilson,
)

# Generators as `rng`, tables of more than two rows in Fisher's test: what [study] asks for.
pytest.importorskip("scipy", minversion="1.15")

# Intervals


def test_welch_by_hand() -> None:
    """Means 2 and 7, variances 2 and 8 of two seeds each: v = 1 and 4."""
    interval = welch([1, 3], [5, 9])
    assert interval.estimate == 5
    # (1 + 4)² / (1² + 4²)
    assert interval.df == pytest.approx(25 / 17)
    half = stats.t.ppf(0.975, 25 / 17) * np.sqrt(5)
    assert (interval.low, interval.high) == pytest.approx((5 - half, 5 + half))


@pytest.mark.parametrize("sizes", [(2, 2), (3, 5), (10, 4), (50, 50)])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99])
def test_welch_is_scipys(sizes: tuple[int, int], confidence: float) -> None:
    rng = np.random.default_rng(sizes[0])
    a = rng.normal(3, 1, sizes[0])
    b = rng.normal(4, 5, sizes[1])
    oracle = stats.ttest_ind(b, a, equal_var=False)
    ends = oracle.confidence_interval(confidence)
    interval = welch(a, b, confidence=confidence)
    assert interval.p == pytest.approx(oracle.pvalue)
    assert interval.df == pytest.approx(oracle.df)
    assert (interval.low, interval.high) == pytest.approx((ends.low, ends.high))


def test_the_relative_interval_holds_every_ratio_that_the_test_accepts() -> None:
    rng = np.random.default_rng(0)
    for sign in (1, -1):
        a = sign * rng.normal(100, 8, 5)
        b = sign * rng.normal(110, 15, 4)
        interval = welch(a, b, relative=True)
        quantile = stats.t.ppf(0.975, welch(a, b).df)

        def excess(change: float, a: np.ndarray = a, b: np.ndarray = b, q: float = quantile):
            baseline = a + change * abs(a.mean()) * a / a.mean()
            return abs(stats.ttest_ind(b, baseline, equal_var=False).statistic) - q

        ends = [
            optimize.brentq(excess, interval.estimate, interval.estimate + side)
            for side in (-0.9, 0.9)
        ]
        assert (interval.low, interval.high) == pytest.approx(ends, rel=1e-6)
        assert interval.estimate == pytest.approx((b.mean() - a.mean()) / abs(a.mean()))


def test_a_certain_baseline_only_divides() -> None:
    b = [9.0, 12.0, 14.0]
    absolute = welch([10, 10, 10], b)
    relative = welch([10, 10, 10], b, relative=True)
    assert relative[:3] == pytest.approx([value / 10 for value in absolute[:3]])
    of_a_cost = welch([-10, -10, -10], np.negative(b), relative=True)
    assert of_a_cost[:3] == pytest.approx((-relative[0], -relative[2], -relative[1]))


def test_the_relative_interval_leaves_out_0_where_the_absolute_does() -> None:
    rng = np.random.default_rng(1)
    decisions = set()
    for _ in range(300):
        a, b = rng.normal(10, 1, 4), rng.normal(11, 2, 4)
        interval = welch(a, b, relative=True)
        assert (interval.low > 0 or interval.high < 0) == (interval.p < 0.05)
        assert welch(3 * a, 3 * b, relative=True) == pytest.approx(interval)
        decisions.add(interval.p < 0.05)
    assert decisions == {True, False}


def test_a_ratio_to_a_mean_that_may_be_0_is_unbounded() -> None:
    interval = welch([-1, 1.1], [3, 4], relative=True)
    assert (interval.low, interval.high) == (-np.inf, np.inf)


def test_without_variance_the_interval_is_a_point() -> None:
    assert welch([2, 2], [2, 2]) == (0, 0, 0, 1, 2)
    assert welch([2, 2], [5, 5]) == (3, 3, 3, 0, 2)
    assert welch([2, 2], [5, 5], relative=True)[:3] == (1.5, 1.5, 1.5)


def test_one_task_is_welch_and_four_equal_tasks_halve_it() -> None:
    a, b = [1.0, 2.0, 4.0], [3.0, 7.0]
    one = welch(a, b)
    assert welch_over_tasks([a], [b]) == pytest.approx(one)
    four = welch_over_tasks([a] * 4, [b] * 4)
    assert four.estimate == pytest.approx(one.estimate)
    assert four.df == pytest.approx(4 * one.df)
    widths = (four.high - four.low) / stats.t.ppf(0.975, four.df)
    assert widths == pytest.approx((one.high - one.low) / stats.t.ppf(0.975, one.df) / 2)


def test_tasks_weigh_alike_whatever_their_numbers_of_seeds() -> None:
    result = welch_over_tasks([[0, 0], [0, 0, 0, 0]], [[1, 1], [4, 4, 4, 4]])
    assert result.estimate == 2.5


def test_the_mean_of_configurations_is_students() -> None:
    d = np.random.default_rng(2).normal(1, 2, 12)
    oracle = stats.ttest_1samp(d, 0)
    ends = oracle.confidence_interval(0.9)
    result = mean_interval(d, 0.9)
    assert result == pytest.approx((d.mean(), ends.low, ends.high, oracle.pvalue, 11))


def welch_of_two(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    return welch(a, b)[1:3]


def relative_of_two(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    return welch(a, b, relative=True)[1:3]


@pytest.mark.parametrize("n", [3, 5, 10])
@pytest.mark.parametrize(
    ("interval", "truth"), [(welch_of_two, 2.0), (relative_of_two, 0.1)], ids=["absolute", "ratio"]
)
@pytest.mark.parametrize("sds", [(1.0, 1.0), (1.0, 3.0)])
def test_intervals_cover_95_percent(
    interval: Callable[[np.ndarray, np.ndarray], tuple[float, float]],
    truth: float,
    n: int,
    sds: tuple[float, float],
) -> None:
    """Means 20 and 22; three standard errors of 4,000 draws are .0103."""
    rng = np.random.default_rng(n)
    a = rng.normal(20, sds[0], (4_000, n))
    b = rng.normal(22, sds[1], (4_000, n))
    covered = 0
    for one_a, one_b in zip(a, b, strict=True):
        low, high = interval(one_a, one_b)
        covered += low <= truth <= high
    # Welch is an approximation: with three seeds of equal variance it covers .965.
    assert 0.95 - 0.0103 <= covered / 4_000 <= 0.97 + 0.0103


@pytest.mark.parametrize("n", [3, 5, 10])
def test_the_interval_over_tasks_covers_95_percent(n: int) -> None:
    rng = np.random.default_rng(n)
    sds = np.array([0.5, 1.0, 4.0])[:, None]
    covered = 0
    for _ in range(2_000):
        a = rng.normal(0, sds, (3, n))
        b = rng.normal([[1.0], [2.0], [6.0]], sds[::-1], (3, n))
        _, low, high, _, _ = welch_over_tasks(list(a), list(b))
        covered += low <= 3.0 <= high
    assert 0.95 - 0.0146 <= covered / 2_000 <= 0.97 + 0.0146


@pytest.mark.parametrize(
    ("low", "high", "decided"),
    [
        (0.01, 0.2, True),
        (-0.2, -0.01, True),
        (-0.04, 0.04, True),
        (0.0, 0.2, False),
        (-0.05, 0.04, False),
        (-0.04, 0.05, False),
        (-0.04, 0.2, False),
        (-np.inf, np.inf, False),
    ],
)
def test_an_interval_decides_beside_0_or_inside_the_margin(
    low: float, high: float, decided: bool
) -> None:
    assert is_decided(low, high, 0.05) is decided


def test_seeds_needed_are_the_fewest_that_decide() -> None:
    rng = np.random.default_rng(3)
    needs = []
    for _ in range(50):
        a, b = rng.normal(10, 1, 4), rng.normal(10.5, 2, 4)
        more = seeds_needed(a, b, 0.05, relative=True)
        for n in {4 + more, max(4, 3 + more)}:
            then = [summary(one)._replace(n=n) for one in (a, b)]
            interval = welch_from_summaries(then[0], then[1], relative=True)
            assert is_decided(interval.low, interval.high, 0.05) is (n == 4 + more)
        needs.append(more)
    assert min(needs) == 0 < max(needs)


def test_seeds_needed_by_hand() -> None:
    """Equal means and variances 2: half a width of z √(4 / n) below .1 from n = 1537 on."""
    assert seeds_needed([-1, 1], [-1, 1], 0.1) == pytest.approx(4 * 1.96**2 / 0.01, rel=2e-3)
    finer = [seeds_needed([-1, 1], [-1, 1], margin) for margin in (0.8, 0.4, 0.2, 0.1)]
    assert finer == sorted(finer)
    assert seeds_needed([0, 0.1], [5, 5.1], 0.1) == 0


# Counts


def test_holm_by_hand_and_as_statsmodels() -> None:
    # 3 · .01, 2 · .03, and .04 not below the one before it
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    np.testing.assert_array_equal(holm([0.7, 0.9]), [1, 1])
    np.testing.assert_array_equal(holm([0.2]), [0.2])
    multitest = pytest.importorskip("statsmodels.stats.multitest")
    p = np.random.default_rng(4).random(20) ** 3
    np.testing.assert_allclose(holm(p), multitest.multipletests(p, method="holm")[1])


@pytest.mark.parametrize(
    ("wins", "n", "e"),
    [
        (0, 0, 1),
        (1, 1, 1),
        (1, 2, 2 / 3),
        (2, 2, 4 / 3),
        (9, 10, 1024 / 110),
        (7, 7, 16),
        (8, 8, 256 / 9),
    ],
)
def test_e_values_by_hand(wins: int, n: int, e: float) -> None:
    result = e_value(wins, n)
    assert result.e == pytest.approx(e)
    assert result.p == pytest.approx(min(1, 1 / e))
    assert e_value(n - wins, n).e == pytest.approx(e)


def test_an_e_value_is_a_fair_game() -> None:
    """Before each toss of a fair coin its mean afterwards is what it is now."""
    for n in range(20):
        for wins in range(n + 1):
            after = (e_value(wins + 1, n + 1).e + e_value(wins, n + 1).e) / 2
            assert after == pytest.approx(e_value(wins, n).e)
    more = [e_value(wins, 30).e for wins in range(15, 31)]
    assert more == sorted(more)


def test_a_look_after_every_block_alarms_falsely_in_less_than_5_percent() -> None:
    n_blocks = 99
    alarming = np.zeros((n_blocks + 1, n_blocks + 1), bool)
    for n in range(n_blocks + 1):
        for wins in range(n + 1):
            alarming[n, wins] = e_value(wins, n).e >= 20
    tosses = np.random.default_rng(5).integers(0, 2, (20_000, n_blocks))
    wins = tosses.cumsum(1)
    alarms = alarming[np.arange(1, n_blocks + 1), wins]
    # Three standard errors of 20,000 games are .003.
    assert alarms[:, :36].any(1).mean() == pytest.approx(0.0203, abs=0.003)
    assert alarms.any(1).mean() == pytest.approx(0.0274, abs=0.0035)


def test_e_values_do_not_overflow() -> None:
    assert e_value(1500, 1500).p == 0
    assert np.isfinite(e_value(1000, 1000).e)
    assert 0 < e_value(1000, 2000).e < 1


def test_wilson_by_hand_and_as_statsmodels() -> None:
    z2 = stats.norm.ppf(0.975) ** 2
    assert wilson(0, 7) == pytest.approx((0, 0, z2 / (7 + z2)))
    assert wilson(7, 7) == pytest.approx((1, 7 / (7 + z2), 1))
    proportion = pytest.importorskip("statsmodels.stats.proportion")
    for wins, n in ((1, 3), (73, 99), (5, 10)):
        ends = proportion.proportion_confint(wins, n, alpha=0.1, method="wilson")
        assert wilson(wins, n, 0.9) == pytest.approx((wins / n, *ends))


def test_fisher_by_hand() -> None:
    # Four cups of each kind, three right: (16 + 16 + 1 + 1) of 70 tables
    assert fisher([3, 1], [4, 4]) == pytest.approx(34 / 70)
    # Both wins in one of three groups of two: 3 of the 15 places for two wins
    assert fisher([2, 0, 0], [2, 2, 2]) == pytest.approx(3 / 15, abs=0.005)
    assert fisher([2, 0, 0], [2, 2, 2], seed=1) == fisher([2, 0, 0], [2, 2, 2], seed=1)
    # A level that nobody drew says nothing
    assert fisher([3, 0, 1], [4, 0, 4]) == pytest.approx(34 / 70)
    assert fisher([4, 5], [4, 5]) == fisher([0, 0, 0], [1, 2, 3]) == 1
    assert fisher([3, 0], [4, 0]) == 1


# Permutations


@pytest.mark.parametrize(
    ("differences", "p"),
    [([1, 2, 3], 2 / 8), ([3, -1], 1), ([5, 5, 5, -1], 4 / 16), ([0, 0], 1), ([-1] * 6, 2 / 64)],
)
def test_sign_permutations_by_hand(differences: list[float], p: float) -> None:
    result = sign_permutation(differences)
    assert result == (np.mean(differences), p, len(differences), True)


def test_all_signs_are_tried_and_drawn_ones_agree() -> None:
    d = np.random.default_rng(6).normal(0.5, 1, 13)
    as_extreme = 0
    for signs in itertools.product((-1, 1), repeat=13):
        as_extreme += abs(np.dot(signs, d)) >= abs(d.sum()) - 1e-12
    assert sign_permutation(d).p == as_extreme / 2**13
    drawn = sign_permutation(d, resamples=5_000, seed=1)
    assert not drawn.exact
    assert drawn.p == pytest.approx(as_extreme / 2**13, abs=0.015)
    assert sign_permutation(d, resamples=5_000, seed=1) == drawn
    assert sign_permutation(d, resamples=5_000, seed=2) != drawn
    assert sign_permutation(np.ones(30), resamples=999).p > 0


def test_looks_are_those_that_were_registered() -> None:
    d = np.random.default_rng(7).normal(0.6, 1, 40)
    looks = (4, 8, 16)
    assert registered_looks(d[:3], looks) == []
    assert [look.n for look in registered_looks(d[:9], looks)] == [4, 8]
    every = registered_looks(d, looks)
    assert every == registered_looks(d[:16], looks)
    for look in every:
        alone = sign_permutation(d[: look.n])
        assert (look.mean, look.p) == (alone.mean, alone.p)
        assert look.adjusted_p == pytest.approx(min(1, 3 * look.p))


def test_looks_together_alarm_falsely_in_less_than_5_percent() -> None:
    """Three standard errors of 400 studies are .033."""
    rng = np.random.default_rng(8)
    alarms = 0
    for _ in range(400):
        looks = registered_looks(rng.standard_t(3, 10), (6, 8, 10))
        alarms += any(look.adjusted_p < 0.05 for look in looks)
    assert 0 < alarms / 400 <= 0.05 + 0.033


def test_spearman_by_hand() -> None:
    assert spearman([1, 2, 3], [10, 20, 90]) == pytest.approx((1, 2 / 6, 3, True))
    # The six orders have ρ of 1, ½, ½, -½, -½ and -1
    assert spearman([1, 2, 3], [1, 3, 2]) == pytest.approx((0.5, 1, 3, True))
    assert spearman([1, 2, 3, 4], [4, 3, 2, 1]) == pytest.approx((-1, 2 / 24, 4, True))


def test_spearman_is_scipys_and_seeded() -> None:
    rng = np.random.default_rng(9)
    x, y = rng.integers(0, 6, 20), rng.normal(size=20)
    result = spearman(x, y, resamples=20_000)
    oracle = stats.spearmanr(x, y)
    assert result.rho == pytest.approx(oracle.statistic)
    assert result.p == pytest.approx(oracle.pvalue, abs=0.02)
    assert not result.exact
    assert spearman(x, y, resamples=20_000) == result
    assert spearman(np.exp(x), y**3, resamples=20_000) == result


def test_a_line_by_hand() -> None:
    """y = 1 + 2 x + (1, -2, 1): s² = 6 with one degree of freedom, Σ x² = 2."""
    fit = line([-1, 0, 1], [0, -1, 4])
    assert (fit.slope, fit.intercept) == pytest.approx((2, 1))
    np.testing.assert_allclose(fit.residuals, [1, -2, 1])
    half = np.tan(np.pi * 0.475) * np.sqrt(3)  # Student's t with one degree is Cauchy's
    assert (fit.low, fit.high) == pytest.approx((2 - half, 2 + half))
    assert fit.p == pytest.approx(2 / np.pi * np.arctan(np.sqrt(3) / 2))


# Bootstrap


def test_the_interquartile_mean() -> None:
    assert iqm([[1, 2, 3, 4, 5, 6, 7, 8]]).value == 4.5
    assert iqm([[1, 2, 3, 4], [5, 6, 7, 800]]).value == 4.5
    assert iqm([[1, 3]]).value == 2
    result = iqm([np.arange(20.0), np.arange(20.0) + 5])
    assert result.low < result.value < result.high
    assert iqm([np.arange(20.0), np.arange(20.0) + 5]) == result
    assert iqm([np.arange(20.0), np.arange(20.0) + 5], seed=1) != result


def test_runs_are_drawn_inside_their_task() -> None:
    """Tasks far apart whose runs agree leave nothing to chance."""
    # (1 + 7 + 7 + 100 + 100) / 5: of seven runs one is left out at each end
    assert iqm([[1, 1], [100, 100, 100], [7, 7]]) == pytest.approx((43, 43, 43))
    result = probability_of_improvement([[1, 2], [101, 102]], [[3, 4], [103, 104]])
    assert result == (1, 1, 1, 8, 8)


def test_the_probability_of_improvement() -> None:
    # Of 2 > 1, 2 = 2, 3 > 1 and 3 > 2 three are better and one is equal
    result = probability_of_improvement([[1, 2]], [[2, 3]])
    assert (result.probability, result.better, result.pairs) == (0.875, 3, 4)
    rng = np.random.default_rng(10)
    a, b = rng.integers(0, 9, 5), rng.integers(2, 11, 7)
    there = probability_of_improvement([a], [b])
    back = probability_of_improvement([b], [a])
    assert there.probability == pytest.approx(stats.mannwhitneyu(b, a).statistic / 35)
    assert there.probability + back.probability == pytest.approx(1)
    assert 0 <= there.low <= there.probability <= there.high <= 1
    assert probability_of_improvement([a], [b]) == there
    both = probability_of_improvement([a, [1, 2]], [b, [2, 3]])
    assert both.probability == pytest.approx((there.probability + 0.875) / 2)


def test_percentiles_of_many_runs_cover_95_percent() -> None:
    """With fifty runs they do; with three to five nobody should rely on them."""
    rng = np.random.default_rng(11)
    covered = 0
    for _ in range(300):
        result = iqm([rng.normal(0, 1, 50)], resamples=400)
        covered += result.low <= 0 <= result.high
    assert 0.95 - 0.045 <= covered / 300 <= 0.95 + 0.03


# Scores


@pytest.mark.parametrize(
    ("a", "b", "change"),
    [
        (100, 300, (100, False)),
        (300, 100, (-100, False)),
        (-300, -100, (100, False)),
        (-1, 1, (200, True)),
        (1, -1, (-200, True)),
        (0, 5, (200, True)),
        (0, 0, (0, False)),
        (-2, -2, (0, False)),
    ],
)
def test_symmetric_changes_by_hand(a: float, b: float, change: tuple[float, bool]) -> None:
    assert spc(a, b) == Change(*change)
    assert spc(b, a).percent == -spc(a, b).percent


def test_normalised_scores() -> None:
    np.testing.assert_allclose(normalised_score([-10, 0, 10, 30], -10, 10), [0, 0.5, 1, 2])
    assert np.isnan(normalised_score(np.array([[np.nan]]), 0, 1)).all()


# Errors


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: welch([1], [1, 2]),
            "Parameter `a` must have at least 2 seeds, found 1: run more seeds.",
        ),
        (
            lambda: welch([1, 2], [1, np.nan]),
            "Parameter `b` must have finite values, found nan at position 1: leave failed runs "
            "out and report how many there were.",
        ),
        (
            lambda: welch([1, 2], [[1, 2]]),
            "Parameter `b` must be one row of numbers, found an array of shape (1, 2).",
        ),
        (
            lambda: welch([-1, 1], [1, 2], relative=True),
            "Parameter `a` must have a mean other than 0 for a relative difference, found 0: "
            "use relative=False.",
        ),
        (
            lambda: welch([1, 2], [1, 2], confidence=95),
            "Parameter `confidence` must lie between 0 and 1, found 95.",
        ),
        (
            lambda: welch_from_summaries(Summary(1, 1, 5), Summary(1, 1, 1)),
            "Parameter `b` must have at least 2 seeds, found 1: run more seeds.",
        ),
        (
            lambda: welch_from_summaries(Summary(1, -1, 5), Summary(1, 1, 5)),
            "Parameter `a` must have a finite mean and a standard deviation of at least 0, "
            "found 1 and -1.",
        ),
        (
            lambda: welch_over_tasks([[1, 2]], [[1, 2], [3, 4]]),
            "Parameters `a` and `b` must have one value for each task, found 1 and 2.",
        ),
        (
            lambda: welch_over_tasks([[1, 2], [1]], [[1, 2], [3, 4]]),
            "Parameter `a[1]` must have at least 2 seeds, found 1: run more seeds.",
        ),
        (lambda: iqm([]), "Parameter `scores` must have at least one task, found none."),
        (
            lambda: mean_interval([1]),
            "Parameter `differences` must have at least 2 configurations, found 1: "
            "run more configurations.",
        ),
        (
            lambda: seeds_needed([1, 2], [1, 2], 0),
            "Parameter `margin` must be above 0, found 0.",
        ),
        (
            lambda: holm([]),
            "Parameter `p_values` must have at least one p-value, found none.",
        ),
        (lambda: holm([0.1, 1.1]), "Parameter `p_values` must lie between 0 and 1, found 1.1."),
        (lambda: e_value(4, 3), "Parameter `wins` must lie between 0 and n = 3, found 4."),
        (
            lambda: wilson(0, 0),
            "Parameter `n` must be at least 1, found 0: show such a cell as empty.",
        ),
        (
            lambda: fisher([1, 2], [3]),
            "Parameters `wins` and `n` must have one value for each group, found 2 and 1.",
        ),
        (lambda: fisher([1], [3]), "Parameter `n` must have at least 2 groups, found 1."),
        (
            lambda: registered_looks([1, 2], (24, 12)),
            "Parameter `looks` must be growing numbers of configurations from 2 on, "
            "found [24, 12].",
        ),
        (
            lambda: spearman([1, 2, 3], [1, 2, 3, 4]),
            "Parameters `x` and `y` must have one value for each task, found 3 and 4.",
        ),
        (
            lambda: spearman([1, 2, 3], [5, 5, 5]),
            "Parameter `y` must have at least two different values, found 5.0 only.",
        ),
        (lambda: spc(np.nan, 1), "Parameter `a` must be finite, found nan."),
        (
            lambda: normalised_score([1], 5, 5),
            "Parameter `reference` must be above `random`, found 5 and 5: give the reference "
            "more steps, or report raw returns.",
        ),
    ],
)
def test_errors_say_what_is_wrong(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError) as error:  # noqa: PT011 - compared word for word below
        call()
    assert str(error.value) == message
