"""Who conflicts with whom, and who meets whom when."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from sb3_gcr.angles import conflicts, cosines, visiting_order


def test_conflicts_and_cosines_by_hand() -> None:
    jacobian = np.array([[1.0, 0.0], [-2.0, 2.0], [0.0, 0.0]])
    gramian = jacobian @ jacobian.T
    assert conflicts(gramian).tolist() == [
        [False, True, False],
        [True, False, False],
        [False, False, False],
    ]
    np.testing.assert_allclose(
        cosines(gramian), [[1, -(0.5**0.5), 0], [-(0.5**0.5), 1, 0], [0, 0, 0]]
    )


def test_many_gramians_at_once() -> None:
    gramians = np.array([[[4.0, -2.0], [-2.0, 4.0]], [[1.0, 3.0], [3.0, 25.0]]])
    np.testing.assert_allclose(cosines(gramians), [[[1, -0.5], [-0.5, 1]], [[1, 0.6], [0.6, 1]]])
    assert conflicts(gramians).any((1, 2)).tolist() == [True, False]


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
def test_rounding_is_no_conflict(scale: float) -> None:
    gramian = scale * np.array([[1.0, -1e-14], [-1e-14, 1.0]])
    assert not conflicts(gramian).any()
    gramian[0, 1] = gramian[1, 0] = -1e-10 * scale
    assert conflicts(gramian).tolist() == [[False, True], [True, False]]


def test_level_zero_is_visited_last() -> None:
    levels = np.array([2, 0, 1, 0, 1])
    for seed in range(20):
        for row in visiting_order(levels, np.random.default_rng(seed)):
            assert sorted(row) == [0, 1, 2, 3, 4]
            assert levels[row].tolist() == [2, 1, 1, 0, 0]


def test_orders_inside_a_level_are_equally_likely_and_rows_are_drawn_apart() -> None:
    """Six orders of three, for each of two rows: each pair of orders in 1 of 36 draws."""
    rng = np.random.default_rng(0)
    draws = 7200
    pairs: Counter[tuple[int, ...]] = Counter()
    for _ in range(draws):
        order = visiting_order(np.zeros(3, dtype=int), rng)
        pairs[(*order[0].tolist(), *order[1].tolist())] += 1
    assert len(pairs) == 36
    counts = np.array(list(pairs.values()))
    chi_squared = ((counts - draws / 36) ** 2 / (draws / 36)).sum()
    assert chi_squared < 66.6  # 0.1 % of 35 degrees of freedom
