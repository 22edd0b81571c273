"""Weights that add up exactly, or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_gcr.rewards.fitting import fit_sum, independent_columns, round_weight


def test_weights_and_a_constant_are_found_from_numbers_of_all_sizes() -> None:
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(50, 3)) * [1e-6, 1, 1e6]
    fit = fit_sum(columns, columns @ [4, -0.5, 3] + 2)
    assert fit.is_exact
    np.testing.assert_allclose(fit.weights, [4, -0.5, 3], rtol=1e-3)
    assert fit.constant == pytest.approx(2)


def test_float32_is_exact_and_a_thousandth_more_is_not() -> None:
    columns = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    target = columns.sum(1)
    assert fit_sum(columns.astype(float), target.astype(float)).is_exact
    target[7] += 0.001
    assert not fit_sum(columns.astype(float), target.astype(float)).is_exact


def test_constants_and_combinations_tell_nothing_new() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 50))
    columns = np.column_stack([a, np.full(50, 3.0), 2 * a, b, a - b + 1, np.zeros(50)])
    assert independent_columns(columns) == [0, 3]


@pytest.mark.parametrize(
    ("weight", "rounded"), [(4.0000001, 4.0), (-0.4999999, -0.5), (1 / 3, 1 / 3), (12.5, 12.5)]
)
def test_weights_are_numbers_that_people_write(weight: float, rounded: float) -> None:
    assert round_weight(weight) == rounded
