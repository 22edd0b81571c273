"""The paper's tables: what can be recomputed from its own numbers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sb3_gcr.study import paper
from sb3_gcr.study.statistics import (
    e_value,
    holm,
    iqm,
    line,
    spc,
    spearman,
    welch_from_summaries,
    wilson,
)

# Generators as `rng`, tables of more than two rows in Fisher's test: what [study] asks for.
pytest.importorskip("scipy", minversion="1.15")

SPC = np.array([row.spc_percent for row in paper.TASKS])
RECOMPUTED = np.array([spc(row.baseline_mean, row.gcr_mean).percent for row in paper.TASKS])
CONFLICTS = np.array([row.conflicts for row in paper.TASKS])
RATE = np.array([row.conflict_rate for row in paper.TASKS])
K = np.array([row.components for row in paper.TASKS])
ALIGNED = np.array([row.mask_aligned for row in paper.TASKS])
NAMES = [row.task for row in paper.TASKS]


def p_of(what: str) -> float:
    row = paper.TASKS[NAMES.index(what)]
    return welch_from_summaries(row.baseline, row.gcr).p


def claim(start: str) -> paper.Claim:
    found = [one for one in paper.CLAIMS if one.what.startswith(start)]
    assert len(found) == 1
    return found[0]


def test_there_are_thirteen_tasks_in_the_order_of_their_conflicts() -> None:
    assert len(set(NAMES)) == 13
    assert list(CONFLICTS) == sorted(CONFLICTS)
    # 3 · 2 / 2 and 26 · 25 / 2
    assert (paper.TASKS[0].pairs, paper.TASKS[-1].pairs) == (3, 325)
    assert ((RATE > 0) & (RATE < 1)).all()
    assert [name for name, aligned in zip(NAMES, ALIGNED, strict=True) if not aligned] == [
        "Velocity-Rough-H1",
        "Ant",
        "Humanoid",
        "Velocity-Rough-G1",
        "Tracking-LocoManip-Digit",
    ]


@pytest.mark.parametrize(
    ("task", "printed", "digits"),
    [
        ("Humanoid", 0.00024, 5),
        ("Velocity-Rough-G1", 0.022, 3),
        ("Repose-Cube-Allegro", 0.024, 3),
        ("Tracking-LocoManip-Digit", 0.028, 3),
        ("Velocity-Rough-Unitree-Go2", 0.043, 3),
    ],
)
def test_the_paired_t_tests_are_welchs(task: str, printed: float, digits: int) -> None:
    assert round(p_of(task), digits) == printed
    assert claim(f"p of {task}").printed == printed
    assert claim(f"p of {task}").recomputed == pytest.approx(p_of(task), rel=2e-3)
    row = paper.TASKS[NAMES.index(task)]
    oracle = stats.ttest_ind_from_stats(
        row.gcr_mean, row.gcr_sd, 10, row.baseline_mean, row.baseline_sd, 10, equal_var=False
    )
    assert p_of(task) == pytest.approx(oracle.pvalue)


def test_after_holm_one_task_is_left() -> None:
    adjusted = dict(zip(NAMES, holm([p_of(name) for name in NAMES]), strict=True))
    assert round(adjusted.pop("Humanoid"), 4) == 0.0032
    assert min(adjusted.values()) >= 0.26


def test_conflicts_go_with_the_change_in_three_versions() -> None:
    by_count = spearman(CONFLICTS, SPC)
    assert round(by_count.rho, 3) == 0.736
    assert by_count.rho == pytest.approx(claim("Spearman's ρ of").recomputed, abs=5e-5)
    assert by_count.p == pytest.approx(0.0053, abs=7e-4)
    assert round(spearman(RATE, SPC).rho, 3) == 0.758
    assert round(spearman(K, SPC).rho, 3) == 0.265
    asymptotic = stats.spearmanr(CONFLICTS, SPC).pvalue
    assert round(asymptotic, 4) == claim("p of Spearman").printed
    assert asymptotic == pytest.approx(claim("p of Spearman").recomputed, abs=5e-6)
    assert round(stats.spearmanr(RATE, SPC).pvalue, 4) == 0.0027
    right = spearman(CONFLICTS[ALIGNED], SPC[ALIGNED])
    assert right.exact
    assert round(right.rho, 2) == 0.26
    assert right.p == pytest.approx(0.53, abs=0.02)


def test_the_correlation_moves_with_the_seeds() -> None:
    """Means drawn again with their standard errors: ρ from .45 to .86."""
    rng = np.random.default_rng(0)
    rho = []
    for _ in range(1_000):
        drawn = []
        for row in paper.TASKS:
            a = rng.normal(row.baseline_mean, row.baseline_sd / np.sqrt(10))
            b = rng.normal(row.gcr_mean, row.gcr_sd / np.sqrt(10))
            drawn.append(spc(a, b).percent)
        rho.append(stats.spearmanr(CONFLICTS, drawn).statistic)
    np.testing.assert_allclose(np.percentile(rho, [2.5, 97.5]), [0.45, 0.86], atol=0.04)


def test_wins() -> None:
    wins = sum(row.gcr_mean > row.baseline_mean for row in paper.TASKS)
    assert wins == claim("tasks of 13").printed == claim("tasks of 13").recomputed
    assert round(stats.binomtest(wins, 13, alternative="greater").pvalue, 4) == 0.0461
    assert round(stats.binomtest(wins, 13).pvalue, 3) == 0.092
    assert round(stats.wilcoxon(RECOMPUTED).pvalue, 3) == 0.094
    assert round(e_value(wins, 13).e, 2) == 2.05
    assert e_value(paper.THROWING.wins, paper.THROWING.configurations).e == pytest.approx(
        1.22e4, rel=5e-3
    )
    assert (paper.THROWING.wins, paper.THROWING.configurations) == (73, 99)
    assert (paper.HUMANOID.wins, paper.HUMANOID.configurations) == (74, 74)
    assert wilson(73, 99).low > 0.5


def test_the_changes() -> None:
    change = dict(zip(NAMES, RECOMPUTED, strict=True))
    assert round(SPC.mean(), 2) == 4.63
    assert round(RECOMPUTED.mean(), 3) == claim("mean SPC").recomputed == 4.489
    assert round(np.median(RECOMPUTED), 2) == 1.0
    assert round(iqm([RECOMPUTED]).value, 2) == 1.03
    assert round(change["Humanoid"], 2) == claim("SPC in percent of Humanoid").recomputed == 17.55
    digit = "Tracking-LocoManip-Digit"
    assert round(change[digit], 2) == claim(f"SPC in percent of {digit}").recomputed == 34.01
    humanoid = paper.TASKS[NAMES.index("Humanoid")]
    plain = 100 * (humanoid.gcr_mean / humanoid.baseline_mean - 1)
    assert round(plain, 2) == humanoid.spc_percent == claim("SPC in percent of Humanoid").printed
    rest = [one for name, one in change.items() if name not in ("Humanoid", digit)]
    assert round(np.mean(rest), 1) == 0.6
    # All others are printed to the precision of their means.
    others = [name not in ("Humanoid", digit) for name in NAMES]
    np.testing.assert_allclose(SPC[others], RECOMPUTED[others], atol=0.04)


def test_the_effect_sits_where_the_mask_is_wrong() -> None:
    assert round(SPC[~ALIGNED].mean(), 1) == 11.6
    assert round(SPC[ALIGNED].mean(), 2) == 0.26


def test_the_line_through_the_thirteen_tasks_is_one_tasks() -> None:
    """Humanoid, not Digit, which carries the slope, is farthest from the line."""
    fit = line(CONFLICTS, SPC)
    slope, intercept = np.polyfit(CONFLICTS, SPC, 1)
    assert (fit.slope, fit.intercept) == pytest.approx((slope, intercept))
    assert NAMES[int(np.argmax(np.abs(fit.residuals)))] == "Humanoid"
    assert fit.residuals.sum() == pytest.approx(0.0, abs=1e-9)


def test_the_families_count_what_they_drew() -> None:
    draws = sum(len(one.cardinalities) * one.draws for one in paper.FAMILIES)
    counted = sum(one.configurations for one in paper.FAMILIES)
    tasks = claim("unique tasks")
    assert len(NAMES) + draws == tasks.printed
    assert len(NAMES) + counted == tasks.recomputed
    for family in paper.FAMILIES:
        assert max(family.cardinalities) == len(family.objectives)
        assert family.configurations <= len(family.cardinalities) * family.draws


def test_ten_runs_cannot_be_three_standard_deviations_away() -> None:
    """The farthest that one run can be is when the nine others agree."""
    one_apart = np.zeros(10)
    one_apart[0] = 1.0
    largest = stats.zscore(one_apart, ddof=1).max()
    rule = claim("z beyond")
    assert round(largest, 3) == rule.recomputed
    assert largest < rule.printed
    drawn = np.random.default_rng(0).standard_cauchy((2_000, 10))
    assert np.abs(stats.zscore(drawn, axis=1, ddof=1)).max() <= largest + 1e-12


def test_no_two_positive_returns_change_by_five_hundred_percent() -> None:
    assert spc(1e-9, 1e9).percent == pytest.approx(200.0)
    assert claim("largest SPC").printed > 200.0
    assert claim("largest SPC").recomputed is None
