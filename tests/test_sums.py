"""Whether components add up: near rounding, given what is added up; one sentence per cause."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_gcr import RewardSpec
from sb3_gcr.rewards.sums import SUM_TOLERANCE, adds_up, find_fault

SPEC = RewardSpec(("bonus", "effort"), (0, 1))


def sentence(row: list[float], reward: float, tolerance: float = SUM_TOLERANCE) -> str | None:
    fault = find_fault(np.array([row]), np.array([reward]), SPEC, tolerance)
    return None if fault is None else fault.sentence


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_small_term_is_missed_beside_a_bonus_of_5(dtype: type[np.floating]) -> None:
    """The acceleration of a legged robot, -1.6e-4, which a tolerance of 1e-4 of 10 would hide."""
    for forgotten, noticed in ((-1.6e-4, True), (0.0, False)):
        reward = dtype(5 - 3.7e-4 + forgotten)
        rows = np.array([[5, -3.7e-4]], dtype=dtype)
        fault = find_fault(rows, np.array([reward], dtype=dtype), SPEC, SUM_TOLERANCE)
        assert (fault is not None) is noticed


def test_double_precision_notices_a_millionth() -> None:
    assert sentence([5.1, -0.3], 4.8) is None
    assert sentence([5.1, -0.3], 4.8 + 1e-6) is not None


def test_the_miss_is_shown_where_six_digits_hide_it() -> None:
    found = sentence([5.1, -0.37], 4.7300012345)
    assert found is not None
    assert "the reward 4.7300012345, found 4.73 (bonus=5.1, effort=-0.37)" in found


def test_sums_of_float32_in_another_order() -> None:
    """Twenty terms of mixed sizes that cancel, added up in float32 from the other end."""
    terms = np.random.default_rng(0).normal(size=(500, 20)) * np.logspace(-3, 3, 20)
    rows = terms.astype(np.float32)
    rewards = np.array([sum(row[::-1], np.float32(0)) for row in rows], dtype=np.float32)
    spec = RewardSpec(tuple(f"t{i}" for i in range(20)), (0,) * 20)
    assert find_fault(rows.astype(float), rewards, spec, SUM_TOLERANCE) is None
    assert find_fault(rows.astype(float), rewards.astype(float), spec, SUM_TOLERANCE) is None


def test_the_reward_of_float32_and_terms_of_double_precision() -> None:
    row = np.array([[0.1 + 1e-9, 1e3 / 3]])
    assert find_fault(row, row.sum(1).astype(np.float32), SPEC, SUM_TOLERANCE) is None


@pytest.mark.parametrize(
    ("row", "reward"), [([0.766109, -0.0570107], 0.71), ([0.004, 0.0], 0.0), ([0.5031, 0.0], 0.5)]
)
def test_rounded_rewards(row: list[float], reward: float) -> None:
    """Two decimals are at most 0.005 off; the same in float32."""
    assert sentence(row, reward) is not None
    assert sentence(row, reward, tolerance=1e-4) is not None
    assert sentence(row, reward, tolerance=0.005) is None
    assert sentence(row, float(np.float32(reward)), tolerance=0.005) is None


def test_a_tolerance_for_rounding_hides_no_more_than_that() -> None:
    assert sentence([0.766109, -0.0570107], 0.70, tolerance=0.005) is not None


def test_float16() -> None:
    """Terms in double precision, summed and handed on in float16: 11 bits are left."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(500, 2))
    half = rows.astype(np.float16)
    rewards = half[:, 0] + half[:, 1]
    assert find_fault(rows, rewards.astype(float), SPEC, 2e-3) is None
    fault = find_fault(rows[:1], rewards[:1].astype(float), SPEC, SUM_TOLERANCE)
    assert fault is not None
    assert fault.sentence.endswith(
        "The reward looks like a float16. If it is, give `RewardDecomposition(tolerance=0.002)`; "
        "if not, a term is missing."
    )


@pytest.mark.parametrize(
    ("reward", "cause"),
    [
        (
            5 * (0.766109 - 0.0570107),
            "It is 5 times their sum: give `RewardDecomposition(weights=5)`.",
        ),
        (
            0.766109 + 0.0570107,
            "With the other sign of 'effort' they do: a penalty is a negative number.",
        ),
        (0.766109, "Without 'effort' they do: it seems not to be in the reward."),
        (
            0.71,
            "The reward looks rounded to 2 decimals. If it is, give "
            "`RewardDecomposition(tolerance=0.005)`; if not, a term is missing.",
        ),
        (
            0.8123457,
            "Name the missing terms, or collect the rest in a component of its own with "
            '`RewardDecomposition(residual="name")`.',
        ),
    ],
)
def test_one_sentence_per_cause(reward: float, cause: str) -> None:
    assert sentence([0.766109, -0.0570107], reward) == (
        f"The reward components must sum to the reward {reward:.6g}, found 0.709098 "
        f"(bonus=0.766109, effort=-0.0570107). {cause}"
    )


def test_round_numbers_fit_by_chance_and_name_no_cause() -> None:
    found = sentence([1.0, 5.0], 3.0)
    assert found is not None
    assert found.endswith('`RewardDecomposition(residual="name")`.')


def test_what_is_not_finite_is_named() -> None:
    assert sentence([1.0, -np.inf], -np.inf) == (
        "Reward component 'effort' must be finite, found -inf (bonus=1, effort=-inf)."
    )
    assert sentence([1.0, 2.0], np.nan, tolerance=np.inf) == (
        "The reward must be finite, found nan (bonus=1, effort=2)."
    )


def test_the_first_env_at_fault_is_named() -> None:
    rows = np.array([[1.0, 2.0], [1.0, 3.0], [0.0, 0.0]])
    fault = find_fault(rows, np.array([3.0, 3.0, 1.0]), SPEC, SUM_TOLERANCE)
    assert fault is not None
    assert fault.env_index == 1
    assert not adds_up(rows[1], 3.0)
    assert adds_up(rows[1], 3.0, tolerance=0.2)
