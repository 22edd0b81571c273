"""The fast twin of ``gcr`` is held to its definition: the same draws, the same weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_gcr import fast_gcr, resolvers
from sb3_gcr.fast_gcr import FEW
from tests.oracles import random_jacobian


def compare(gramian: Any, levels: Any, seed: int) -> Any:
    """Weights of the twin, which must be those of the definition."""
    expected = resolvers.gcr(gramian, levels, np.random.default_rng(seed))
    found = fast_gcr.gcr(gramian, levels, np.random.default_rng(seed))
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    return found


@settings(max_examples=400, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 30),
    size=st.integers(1, 40),
    n_levels=st.integers(1, 5),
    n_zero=st.integers(0, 3),
    spread=st.floats(0, 3),
    log_scale=st.floats(-8, 8),
)
def test_random_gramians(
    seed: int, n: int, size: int, n_levels: int, n_zero: int, spread: float, log_scale: float
) -> None:
    """Few and many components and levels, with and without gradient, of all sizes."""
    rng = np.random.default_rng(seed)
    jacobian = random_jacobian(rng, n, size, spread) * 10**log_scale
    jacobian[rng.permutation(n)[:n_zero]] = 0
    gramian = jacobian @ jacobian.T
    levels = rng.integers(0, n_levels, n)
    compare(gramian, levels, seed)
    expected = resolvers.no_priority(gramian, levels, np.random.default_rng(seed))
    found = fast_gcr.no_priority(gramian, levels, np.random.default_rng(seed))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("n", [2, FEW, FEW + 1, 30])
def test_the_draws_matter(n: int) -> None:
    """What is compared depends on the order, so a twin with an order of its own would not pass."""
    jacobian = random_jacobian(np.random.default_rng(0), n, 2 + n // 3)
    gramian, levels = jacobian @ jacobian.T, np.zeros(n, dtype=int)
    found = {tuple(compare(gramian, levels, seed).round(6)) for seed in range(5)}
    assert len(found) == (1 if n == 2 else 5)


@pytest.mark.parametrize("n", [FEW, FEW + 1])
def test_rounding_is_no_conflict_for_few_or_many(n: int) -> None:
    """A small gradient next to a huge one: what rounding makes of orthogonal must not show in its
    weight.
    """
    gramian = np.eye(n)
    gramian[0, 0] = 1e24
    gramian[0, 1] = gramian[1, 0] = -1e-2  # cosine -1e-14
    gramian[2, 3] = gramian[3, 2] = -0.5
    weights = compare(gramian, np.zeros(n, dtype=int), 0)
    np.testing.assert_array_equal(weights, np.where(np.isin(np.arange(n), (2, 3)), 1.5, 1.0))


@pytest.mark.parametrize("n", [3, FEW + 1])
def test_without_conflicts_nothing_is_drawn(n: int) -> None:
    rng = np.random.default_rng(0)
    weights = fast_gcr.gcr(np.eye(n) + 1, np.zeros(n, dtype=int), rng)
    np.testing.assert_array_equal(weights, np.ones(n))
    assert rng.random() == np.random.default_rng(0).random()


@pytest.mark.parametrize("n", [4, FEW + 1])
def test_the_gramian_is_not_changed(n: int) -> None:
    jacobian = random_jacobian(np.random.default_rng(0), n, 2)
    gramian = jacobian @ jacobian.T
    before = gramian.copy()
    compare(gramian, np.arange(n) % 2, 0)
    np.testing.assert_array_equal(gramian, before)
