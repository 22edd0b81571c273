"""Unbiased products of gradients: on noise of known structure, and by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_gcr.conflicts.blocks import Blocks
from sb3_gcr.conflicts.estimators import Estimate, block_products, estimate, leave_one_out

Numbers = NDArray[np.float64]
N_BLOCKS, SIZE, DRAWS = 24, 40, 200


def gradients_of(truth: Numbers, mixture: Numbers, rng: np.random.Generator) -> Numbers:
    """Blocks of noisy gradients, shape (n, K, D): row i of ``mixture`` says how much of each
    shared noise signal term i has.
    """
    noise = rng.normal(size=(N_BLOCKS, mixture.shape[1], SIZE))
    return truth + mixture @ noise


def known_truth() -> tuple[Numbers, Numbers]:
    """Three gradients, the first two in conflict by a cosine of -0.5; and noise of which those two
    share most, with the same sign.
    """
    truth = np.zeros((3, SIZE))
    truth[0, 0] = 1.0
    truth[1, :2] = -0.5, np.sqrt(0.75)
    truth[2, 2] = 0.8
    mixture = np.array([[0.5, 0.0, 0.1], [0.45, 0.1, 0.0], [0.0, 0.0, 0.5]])
    return truth, mixture


def test_the_mean_is_the_truth_and_the_intervals_cover_it_where_naive_products_do_neither() -> None:
    truth, mixture = known_truth()
    rng = np.random.default_rng(0)
    draws = [block_products(gradients_of(truth, mixture, rng)) for _ in range(DRAWS)]
    estimates = [estimate(products) for products in draws]
    upper = np.triu_indices(3)
    found = np.array([one.gramian[upper] for one in estimates])
    expected = (truth @ truth.T)[upper]
    error_of_mean = found.std(0, ddof=1) / np.sqrt(DRAWS)
    assert (abs(found.mean(0) - expected) < 2 * error_of_mean).all()
    naive = np.array([np.einsum("aaij->ij", products)[upper] / N_BLOCKS for products in draws])
    bias = naive.mean(0) - expected
    assert (abs(bias[[0, 1, 3, 5]]) > 10 * naive.std(0, ddof=1)[[0, 1, 3, 5]] / DRAWS**0.5).all()
    assert naive.mean(0)[1] > 0 > expected[1]  # it even calls the conflict an agreement
    errors = np.array([one.errors[upper] for one in estimates])
    covers = abs(found - expected) < 1.96 * errors
    assert 0.92 < covers.mean() < 0.98


def test_identical_and_opposite_terms() -> None:
    truth, mixture = known_truth()
    signs = np.array([[1.0], [1.0], [-1.0]])
    one = np.repeat(truth[:1], 3, 0) * signs
    shared = np.repeat(mixture[:1], 3, 0) * signs / 2
    found = estimate(block_products(gradients_of(one, shared, np.random.default_rng(1))))
    np.testing.assert_allclose(found.cosines, [[1, 1, -1], [1, 1, -1], [-1, -1, 1]], atol=1e-9)
    assert found.z[0, 2] < -5
    assert found.z[0, 1] > 5


def test_a_term_without_gradient_has_no_signal_whatever_noise_it_shares() -> None:
    truth, mixture = known_truth()
    truth[1] = 0.0
    rng = np.random.default_rng(2)
    draws = [estimate(block_products(gradients_of(truth, mixture, rng))) for _ in range(DRAWS)]
    assert np.mean([not one.has_signal[1] for one in draws]) >= 0.95
    assert np.mean([one.has_signal[[0, 2]] for one in draws]) > 0.9
    silent = next(one for one in draws if list(one.has_signal) == [True, False, True])
    assert np.isnan(silent.cosines[:, 1]).all()
    assert not np.isnan(silent.cosines[0, 2])
    assert abs(np.mean([one.signal[1] for one in draws])) < 0.02


def test_signal_is_the_share_of_the_squared_norm() -> None:
    """|g|² = 1 and 40 numbers of noise with variance 0.25 + 0.01: 1 of 11.4."""
    truth, mixture = known_truth()
    rng = np.random.default_rng(3)
    draws = [estimate(block_products(gradients_of(truth, mixture, rng))) for _ in range(50)]
    assert np.mean([one.signal[0] for one in draws]) == pytest.approx(1 / 11.4, rel=0.05)


def test_numbers_by_hand() -> None:
    """Blocks g = 1, 2, 4 of one number: pairs 2, 4, 8, mean 14/3; without one of them 8, 4, 2."""
    products = block_products(np.array([1.0, 2.0, 4.0]).reshape(3, 1, 1))
    np.testing.assert_allclose(leave_one_out(products).ravel(), [8, 4, 2])
    found = estimate(products)
    assert found.gramian.item() == pytest.approx(14 / 3)
    spread = (8 - 14 / 3) ** 2 + (4 - 14 / 3) ** 2 + (2 - 14 / 3) ** 2
    assert found.errors.item() == pytest.approx((2 / 3 * spread) ** 0.5)
    assert found.squared_norms.item() == pytest.approx(7)


def test_gradients_that_vanish_have_no_signal_and_no_warning() -> None:
    found = estimate(np.zeros((4, 4, 2, 2)))
    assert not found.has_signal.any()
    assert (found.signal == 0).all()
    assert (found.z == 0).all()
    assert np.isnan(found.cosines).all()


def test_two_blocks_have_no_error() -> None:
    message = "Parameter `products` must be of at least 3 blocks, found 2."
    with pytest.raises(ValueError, match=message):
        estimate(np.zeros((2, 2, 1, 1)))


def test_blocks_hold_what_fits_and_share_what_does_not() -> None:
    rng = np.random.default_rng(4)
    rollouts = rng.normal(size=(7, 2, 5)).astype(np.float32)
    separate = filled(rollouts, memory=10**6)
    np.testing.assert_allclose(separate, block_products(rollouts.astype(float)), rtol=1e-4)
    shared = filled(rollouts, memory=1)  # never fewer than three: rollouts 0 1 2, 3 4, 5 6
    means = np.stack([rollouts[:3].mean(0), rollouts[3:5].mean(0), rollouts[5:].mean(0)])
    np.testing.assert_allclose(shared, block_products(means.astype(float)), rtol=1e-4, atol=1e-6)


def filled(rollouts: NDArray[np.float32], memory: int) -> Numbers:
    blocks = Blocks(len(rollouts), memory)
    for rollout in rollouts:
        blocks.add(rollout)
    return blocks.products()


def test_a_cosine_beyond_one_is_one() -> None:
    ones: Any = np.ones((2, 2))
    found = Estimate(np.array([[1.0, 1.2], [1.2, 1.0]]), 0.1 * ones, np.ones(2))
    np.testing.assert_allclose(found.cosines, ones)
