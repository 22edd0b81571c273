"""Verdicts and sentences of a study, word for word."""

from __future__ import annotations

import math

import pytest

from sb3_gcr.study import answers, words
from sb3_gcr.study.answers import Paid, Verdict, verdict
from sb3_gcr.study.contrasts import Contrast, corrected, over_configurations, over_seeds
from sb3_gcr.study.hypotheses import Judged, status
from sb3_gcr.study.statistics import Evidence


def contrast(
    estimate: float,
    low: float = math.nan,
    high: float = math.nan,
    method: str = "gcr",
    baseline: str = "ppo",
    holm: float = 0.01,
    metric: str = "return_training",
    more: int | None = 6,
    relative: bool = True,
    better: int = 23,
    pairs: int = 25,
    kind: str = "Welch",
) -> Contrast:
    return Contrast(
        baseline,
        method,
        metric,
        5,
        5,
        (100.0, 100.0),
        estimate,
        low,
        high,
        holm,
        holm,
        better,
        pairs,
        more,
        relative,
        kind,
    )


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.05, 0.23, Verdict.HIGHER),
        (0.001, 0.02, Verdict.HIGHER),  # above 0 comes before inside the margin
        (-0.23, -0.05, Verdict.LOWER),
        (-0.02, -0.001, Verdict.LOWER),
        (-0.049, 0.049, Verdict.SAME),
        (0.0, 0.0, Verdict.SAME),
        (0.0, 0.04, Verdict.SAME),
        (-0.05, 0.04, Verdict.UNDECIDED),
        (-0.04, 0.05, Verdict.UNDECIDED),
        (-0.04, 0.20, Verdict.UNDECIDED),
        (math.nan, math.nan, Verdict.UNDECIDED),
        (-math.inf, math.inf, Verdict.UNDECIDED),
    ],
)
def test_the_verdict_of_an_interval(low: float, high: float, expected: Verdict) -> None:
    assert verdict(low, high) is expected


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (
            contrast(0.14, 0.05, 0.23),
            "GCRPPO learns faster than PPO here: return over training +14 % (95 % interval 5 to "
            "23, Welch), better in 23 of 25 pairs of runs.",
        ),
        (
            contrast(-0.14, -0.23, -0.05, better=2),
            "Use PPO, GCRPPO learns more slowly here: return over training -14 % (95 % interval "
            "-23 to -5, Welch), better in 2 of 25 pairs of runs.",
        ),
        (
            contrast(0.01, -0.02, 0.04, better=13),
            "No difference that matters between GCRPPO and PPO here: return over training +1 % "
            "(95 % interval -2 to 4, Welch), better in 13 of 25 pairs of runs.",
        ),
        (
            contrast(0.0, 0.0, 0.0, better=0),
            "No difference that matters between GCRPPO and PPO here: return over training 0 % "
            "(95 % interval 0 to 0, Welch), better in 0 of 25 pairs of runs.",
        ),
        (
            contrast(0.08, -0.04, 0.2, better=16),
            "Undecided: about 6 more seeds. GCRPPO against PPO: return over training +8 % (95 % "
            "interval -4 to 20, Welch), better in 16 of 25 pairs of runs.",
        ),
        (
            contrast(0.08, -0.04, 0.2, more=1),
            "Undecided: about 1 more seed. GCRPPO against PPO: return over training +8 % (95 % "
            "interval -4 to 20, Welch), better in 23 of 25 pairs of runs.",
        ),
        (
            contrast(0.001, -0.04, 0.2, more=4_000),
            "Undecided: more than 1,000 more seeds. GCRPPO against PPO: return over training "
            "+0.1 % (95 % interval -4 to 20, Welch), better in 23 of 25 pairs of runs.",
        ),
        (
            contrast(0.08, more=None, better=1, pairs=1),
            "Undecided: one seed has no interval, run at least 2. GCRPPO against PPO: return over "
            "training +8 %, better in 1 of 1 pairs of runs.",
        ),
        (
            contrast(3.21, 1.5, 4.92, relative=False),
            "GCRPPO learns faster than PPO here: return over training +3.21 (95 % interval 1.5 to "
            "4.92, Welch), better in 23 of 25 pairs of runs.",
        ),
    ],
)
def test_the_headline(found: Contrast, sentence: str) -> None:
    assert answers.headline(found) == sentence


def test_the_headline_over_configurations() -> None:
    found = contrast(0.12, 0.03, 0.21, better=18, pairs=25, kind="Student")
    assert answers.headline(found, "over 25 configurations", "configurations") == (
        "GCRPPO learns faster than PPO over 25 configurations: return over training +12 % (95 % "
        "interval 3 to 21, Student), better in 18 of 25 configurations."
    )


UP, SAME, OPEN = (0.11, 0.02, 0.2), (0.01, -0.03, 0.04), (0.03, -0.06, 0.12)
DOWN = (-0.11, -0.2, -0.02)


@pytest.mark.parametrize(
    ("main", "surgery", "heads", "sentence"),
    [
        (
            Verdict.HIGHER,
            UP,
            SAME,
            "The surgery does it, not the heads: +11 % (2 to 20) over multi_head.",
        ),
        (
            Verdict.HIGHER,
            UP,
            OPEN,
            "The surgery does it: +11 % (2 to 20) over multi_head; of the heads nothing is shown, "
            "+3 % (-6 to 12) over PPO.",
        ),
        (
            Verdict.HIGHER,
            UP,
            UP,
            "The surgery and the heads both do it: +11 % (2 to 20) over multi_head, which is +11 % "
            "(2 to 20) over PPO.",
        ),
        (
            Verdict.HIGHER,
            SAME,
            UP,
            "The heads do it, not the surgery: +11 % (2 to 20) over PPO.",
        ),
        (
            Verdict.HIGHER,
            OPEN,
            UP,
            "The heads do it: +11 % (2 to 20) over PPO; of the surgery nothing is shown, +3 % (-6 "
            "to 12) over multi_head.",
        ),
        (
            Verdict.HIGHER,
            OPEN,
            OPEN,
            "Whether the surgery or the heads do it is not shown: +3 % (-6 to 12) over multi_head, "
            "which is +3 % (-6 to 12) over PPO.",
        ),
        (
            Verdict.LOWER,
            DOWN,
            SAME,
            "The surgery costs it, not the heads: -11 % (-20 to -2) over multi_head.",
        ),
        (
            Verdict.UNDECIDED,
            OPEN,
            DOWN,
            "Surgery: no difference shown, +3 % (-6 to 12) over multi_head; heads alone: lower, "
            "-11 % (-20 to -2) over PPO.",
        ),
        (
            Verdict.SAME,
            SAME,
            SAME,
            "Surgery: no difference that matters, +1 % (-3 to 4) over multi_head; heads alone: no "
            "difference that matters, +1 % (-3 to 4) over PPO.",
        ),
    ],
)
def test_the_surgery_or_the_heads(
    main: Verdict,
    surgery: tuple[float, float, float],
    heads: tuple[float, float, float],
    sentence: str,
) -> None:
    one = contrast(*surgery, method="gcr", baseline="multi_head")
    two = contrast(*heads, method="multi_head", baseline="ppo")
    assert answers.cause(main, one, two) == sentence


@pytest.mark.parametrize(
    ("numbers", "holm", "sentence"),
    [
        ((-0.01, -0.09, 0.07), 0.9, "Final return: no difference shown (-1 %, -9 to 7)."),
        ((0.09, 0.02, 0.16), 0.03, "Final return: higher (+9 %, 2 to 16)."),
        ((0.09, 0.02, 0.16), 0.06, "Final return: no difference shown (+9 %, 2 to 16)."),
        ((-0.09, -0.16, -0.02), 0.03, "Final return: lower (-9 %, -16 to -2)."),
        ((0.01, -0.02, 0.04), 0.9, "Final return: no difference that matters (+1 %, -2 to 4)."),
        ((0.01,), math.nan, "Final return: no difference shown (+1 %)."),
    ],
)
def test_the_final_return(numbers: tuple[float, ...], holm: float, sentence: str) -> None:
    assert answers.final(contrast(*numbers, holm=holm, metric="return_final")) == sentence


def test_one_more_method() -> None:
    found = contrast(0.16, 0.08, 0.25, method="guaranteed")
    assert answers.against(found) == "guaranteed against PPO: higher, +16 % (8 to 25)."


def paid(
    before: float, after: float, low: float, high: float, holm: float, name: str = "torque"
) -> Paid:
    return Paid(name, before, after, low, high, holm, True)


@pytest.mark.parametrize(
    ("terms", "sentence"),
    [
        ([], "There are no regularisers."),
        (
            [paid(-31, -30, -0.02, 0.09, 0.4)],
            "Regularisers paid for nothing: torque -31 -> -30.",
        ),
        (
            [paid(-31, -31.5, -0.04, 0.01, 0.4)],
            "Regularisers paid for nothing: torque -31 -> -31.5.",
        ),
        (
            [paid(-31, -30, -0.3, 0.36, 0.9)],
            "No regulariser is shown to have paid: torque -31 -> -30.",
        ),
        (
            [paid(-31, -30, math.nan, math.nan, math.nan)],
            "No regulariser is shown to have paid: torque -31 -> -30.",
        ),
        (
            [paid(-31, -45, -0.6, -0.3, 0.01)],
            "Regularisers paid: torque -31 -> -45.",
        ),
        (
            [paid(-31, -45, -0.6, -0.3, 0.01), paid(-3, -3.1, -0.2, 0.1, 0.5, "action_rate")],
            "Regularisers paid: torque -31 -> -45. 1 other did not.",
        ),
        (
            [
                paid(-31, -45, -0.6, -0.3, 0.01),
                paid(-3, -3.1, -0.2, 0.1, 0.5, "action_rate"),
                paid(-1, -1, -0.2, 0.1, 0.5, "limits"),
            ],
            "Regularisers paid: torque -31 -> -45. 2 others did not.",
        ),
        (
            [paid(-31, -45, -0.6, -0.01, 0.07)],
            "No regulariser is shown to have paid: torque -31 -> -45.",
        ),
        (
            [paid(-31, -33, math.nan, math.nan, math.nan)],
            "No regulariser is shown to have paid: torque -31 -> -33.",
        ),
    ],
)
def test_what_the_regularisers_paid(terms: list[Paid], sentence: str) -> None:
    assert answers.regularisers(terms) == sentence


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            (2.3, 10, "speed | torque", -0.4),
            "2.3 of 10 pairs conflict; most of all speed | torque (cosine -0.40 at the end).",
        ),
        ((0.0, 10, "speed | torque", 0.1), "0 of 10 pairs conflict."),
        ((0.71, 1, "a | b", 0.1), "0.71 of 1 pair conflict."),
        ((math.nan, 0, "", 0.0), "No conflicts were measured."),
    ],
)
def test_the_conflicts(arguments: tuple[float, int, str, float], sentence: str) -> None:
    assert answers.conflicts(*arguments) == sentence


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ("MyEnv", [500_000], [5, 5, 5], [], 15, 15),
            "MyEnv, 500,000 steps, 5 seeds, equal settings.",
        ),
        (
            ("MyEnv", [500_000], [1, 1], [], 2, None),
            "MyEnv, 500,000 steps, 1 seed, equal settings.",
        ),
        (
            ("MyEnv", [500_000], [2, 3, 2], [], 7, 15),
            "Interim, 7 of 15 runs: MyEnv, 500,000 steps, 2 to 3 seeds, equal settings.",
        ),
        (
            ("2 envs", [10_000, 20_000], [4, 5], [("gcr", 3), ("ppo", 1)], 15, 15),
            "2 envs, 10,000 to 20,000 steps, 4 to 5 seeds, equal settings; 2 of 15 runs failed "
            "(GCRPPO with seed 3, PPO with seed 1).",
        ),
        (
            ("MyEnv", [], [0], [("gcr", 3)], 1, 15),
            "Interim, 1 of 15 runs: MyEnv, 0 seeds, equal settings; 1 of 1 runs failed (GCRPPO "
            "with seed 3).",
        ),
    ],
)
def test_the_first_sentence(arguments: tuple[object, ...], sentence: str) -> None:
    assert answers.opening(*arguments) == sentence  # type: ignore[arg-type]


def test_no_answer_without_runs() -> None:
    assert answers.no_headline("gcr", "ppo", 0, 3) == "No answer yet: no finished run of GCRPPO."
    assert answers.no_headline("gcr", "ppo", 0, 0) == (
        "No answer yet: no finished run of GCRPPO and none of PPO."
    )


def judge(holm: float, low: float, high: float, refuted: str, p: float = 0.01) -> str:
    found = contrast((low + high) / 2, low, high)
    one = Judged("H1", "It helps.", found, 24, 24, p, holm, None, "open", ("", refuted))
    return status(one, holm)


@pytest.mark.parametrize(
    ("holm", "low", "high", "refuted", "p", "expected"),
    [
        (0.01, 0.02, 0.16, "below +5 %", 0.01, "supported"),
        (0.01, -0.16, -0.02, "below +5 %", 0.01, "opposite"),
        (0.3, -0.06, 0.04, "below +5 %", 0.3, "refuted"),
        (0.3, -0.06, 0.04, "within ±5 %", 0.3, "open"),
        (0.3, -0.04, 0.04, "within ±5 %", 0.3, "refuted"),
        (0.06, 0.01, 0.16, "below +5 %", 0.02, "open"),
        (1.0, 0.01, 0.16, "below +5 %", math.nan, "no look yet"),
    ],
)
def test_the_status_of_a_hypothesis(
    holm: float, low: float, high: float, refuted: str, p: float, expected: str
) -> None:
    assert judge(holm, low, high, refuted, p) == expected


def test_the_sentence_of_a_hypothesis() -> None:
    found = contrast(0.09, 0.02, 0.16, baseline="multi_head", better=17, pairs=24, kind="Student")
    evidence = Evidence(9.312, 0.1, 17, 24)
    one = Judged(
        "H1", "Surgery helps.", found, 24, 24, 0.01, 0.012, evidence, "supported", ("", "")
    )
    assert answers.hypothesis(one) == (
        "H1, supported: Surgery helps. GCRPPO over multi_head +9 % (2 to 16, Student) in 24 "
        "configurations, Holm p 0.012 at the look of 24, better in 17 of 24 (E = 9.31)."
    )
    before = one._replace(n=7, look=0, status="no look yet", evidence=None)
    assert answers.hypothesis(before) == (
        "H1, no look yet: Surgery helps. GCRPPO over multi_head +9 % (2 to 16, Student) in 7 "
        "configurations, better in 17 of 24."
    )
    nothing = one._replace(contrast=None, status="no look yet")
    assert answers.hypothesis(nothing) == (
        "H1, no look yet: Surgery helps. No unit has both methods yet."
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (-31.04, "-31"),
        (0.0199, "0.0199"),
        (0.00001234, "0.0000123"),
        (1234.5, "1,234"),
        (-0.0, "0"),
        (math.nan, "–"),
        (math.inf, "∞"),
        (2.3, "2.3"),
    ],
)
def test_numbers(value: float, text: str) -> None:
    assert words.number(value) == text


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0"), (0.004, "0.4"), (-0.0004, "-0.04"), (0.1449, "14"), (12.0, "1,200")],
)
def test_shares(share: float, text: str) -> None:
    assert words.percent(share) == text


def test_a_share_is_of_the_gain_over_random_actions() -> None:
    """PPO gains 10 over random actions, the other 13: a plain ratio would say 3 %."""
    found = over_seeds("ppo", "gcr", "return_training", [99.0, 101.0], [102.0, 104.0], 90.0)
    assert found.relative
    assert found.estimate == pytest.approx(0.3)
    assert (found.better, found.pairs, found.means) == (4, 4, (100.0, 103.0))
    plain = over_seeds("ppo", "gcr", "return_training", [99.0, 101.0], [102.0, 104.0])
    assert plain.estimate == pytest.approx(0.03)


def test_a_negative_return_without_random_actions() -> None:
    found = over_seeds("ppo", "gcr", "final", [-30.0, -30.0], [-33.0, -33.0])
    assert (found.relative, found.estimate) == (True, pytest.approx(-0.1))


def test_what_does_not_beat_random_actions_is_compared_in_its_own_unit() -> None:
    """v = 2 / 2 + 2 / 2 = 2, two degrees of freedom, t = 4.3027, half = 6.085."""
    found = over_seeds("ppo", "gcr", "return_training", [9.0, 11.0], [12.0, 14.0], 20.0)
    assert not found.relative
    assert (found.estimate, found.low, found.high) == pytest.approx((3.0, -3.085, 9.085), abs=1e-3)
    assert answers.headline(found).startswith("Undecided: about ")


def test_a_baseline_that_is_not_told_from_random_actions_has_no_share() -> None:
    found = over_seeds("ppo", "gcr", "return_training", [-9.0, 11.0], [50.0, 52.0], 0.0)
    assert not found.relative
    assert found.estimate == pytest.approx(50.0)


def test_one_seed_has_no_interval() -> None:
    found = over_seeds("ppo", "gcr", "return_training", [10.0], [12.0, 13.0], 0.0)
    assert found.estimate == pytest.approx(0.25)
    assert not found.has_interval
    assert math.isnan(found.p)
    assert found.more_seeds is None


def test_no_variance_is_a_point() -> None:
    found = over_seeds("ppo", "gcr", "return_training", [10.0, 10.0], [12.0, 12.0], 0.0)
    assert (found.estimate, found.low, found.high, found.p) == pytest.approx((0.2, 0.2, 0.2, 0.0))
    same = over_seeds("ppo", "gcr", "return_training", [10.0, 10.0], [10.0, 10.0], 0.0)
    assert verdict(same.low, same.high, same.margin) is Verdict.SAME


def test_configurations_are_pairs() -> None:
    """Differences .1, .2, .3: mean .2, sd .1, t of 2 is 4.3027; 2 of 8 signs are as extreme."""
    a = [[1.0], [1.0], [1.0]]
    b = [[1.1], [1.2], [1.3]]
    found = over_configurations("ppo", "gcr", "return_training", a, b)
    assert (found.estimate, found.low, found.high) == pytest.approx(
        (0.2, 0.2 - 0.2484, 0.2 + 0.2484), abs=1e-4
    )
    assert found.p == pytest.approx(0.25)
    assert (found.better, found.pairs) == (3, 3)


def test_the_family_is_corrected_and_runs_without_an_interval_are_no_part_of_it() -> None:
    family = [contrast(0.1, 0.01, 0.2, holm=p) for p in (0.01, 0.04)] + [
        contrast(0.1, holm=math.nan)
    ]
    assert [one.holm for one in corrected(family)] == pytest.approx(
        [0.02, 0.04, math.nan], nan_ok=True
    )
