"""Products of gradients without their shared noise, and how certain they are.

A Gramian of one sample set multiplies gradients that share their noise: its expectation is
g_i·g_j + Cov(ĝ_i, ĝ_j). Two blocks of samples that have nothing in common share none, so that
E[ĝ_i^a·ĝ_j^b] = g_i·g_j for a ≠ b. Everything here follows from the products of the blocks,

    X^ab_ij = g_i^a·g_j^b,    shape (n, n, K, K).

Pure functions on NumPy arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

#: Blocks that a standard error needs: leaving one out must leave a pair.
MIN_BLOCKS = 3
#: A number is taken to differ from 0 beyond so many standard errors.
CERTAIN = 2.0


class Estimate(NamedTuple):
    """Unbiased products of K gradients."""

    gramian: Numbers
    """Ĝ, shape (K, K), in squared units of the gradients."""
    errors: Numbers
    """Standard error of each entry of Ĝ, shape (K, K)."""
    squared_norms: Numbers
    """Mean squared norm of a block's gradient, its noise included, shape (K,)."""

    @property
    def z(self) -> Numbers:
        """Ĝ in units of its standard error, shape (K, K); 0 where both vanish."""
        at_once = np.where(self.gramian == 0, 0.0, np.copysign(np.inf, self.gramian))
        return np.divide(self.gramian, self.errors, where=self.errors > 0, out=at_once)

    @property
    def has_signal(self) -> NDArray[np.bool_]:
        """Whose squared length Ĝ_ii is positive by two standard errors, shape (K,)."""
        return np.asarray(self.gramian.diagonal() > CERTAIN * self.errors.diagonal())

    @property
    def signal(self) -> Numbers:
        """Share of a block's squared gradient norm that is signal, shape (K,); 0 for a gradient
        that vanishes, and a little below 0 by chance where there is none.
        """
        return signal_shares(self.gramian, self.squared_norms)

    @property
    def cosines(self) -> Numbers:
        """Ĝ_ij / √(Ĝ_ii Ĝ_jj), shape (K, K); NaN where one of the two has no signal."""
        return cosines_of_signal(self.gramian, self.has_signal)


def block_products(gradients: NDArray[np.floating]) -> Numbers:
    """X^ab_ij = g_i^a·g_j^b of all blocks.

    :param gradients: shape (n, K, D)
    :return: X, shape (n, n, K, K)
    """
    n_blocks, n_components, _ = gradients.shape
    rows = gradients.reshape(n_blocks * n_components, -1)
    products = (rows @ rows.T).astype(float)
    by_block = products.reshape(n_blocks, n_components, n_blocks, n_components)
    return by_block.transpose(0, 2, 1, 3)


def estimate(products: Numbers) -> Estimate:
    r"""Ĝ from the products of different blocks, and its standard errors by the jackknife.

    .. math::
        Ĝ = \frac{1}{n(n-1)} \sum_{a ≠ b} X^{ab}, \qquad
        se^2 = \frac{n-1}{n} \sum_c (Ĝ_{(-c)} - Ĝ)^2

    with Ĝ_(−c) from all blocks but c, whose mean is Ĝ. Where noise is all there is, the error comes
    out too large, up to √2 times.

    :param products: X, shape (n, n, K, K)
    :return: Ĝ, its errors, and the squared norms that it has to be compared with
    :raises ValueError: for fewer than three blocks
    """
    n_blocks = len(products)
    if n_blocks < MIN_BLOCKS:
        raise ValueError(
            f"Parameter `products` must be of at least {MIN_BLOCKS} blocks, found {n_blocks}."
        )
    gramian = _mean_of_pairs(products)
    without = leave_one_out(products)
    variance = (n_blocks - 1) / n_blocks * ((without - gramian) ** 2).sum(0)
    own = np.einsum("aaii->i", products) / n_blocks
    return Estimate(gramian, np.sqrt(variance), own)


def leave_one_out(products: Numbers) -> Numbers:
    """Ĝ_(−c) from all blocks but c, for each c.

    :param products: X, shape (n, n, K, K)
    :return: shape (n, K, K)
    """
    n_blocks = len(products)
    total = n_blocks * (n_blocks - 1) * _mean_of_pairs(products)
    own = np.einsum("aaij->aij", products)
    of_block = products.sum(1) + products.sum(0) - 2 * own
    of_block = (of_block + of_block.transpose(0, 2, 1)) / 2
    return np.asarray((total - of_block) / ((n_blocks - 1) * (n_blocks - 2)))


def _mean_of_pairs(products: Numbers) -> Numbers:
    """Mean over a ≠ b, symmetric, shape (K, K)."""
    n_blocks = len(products)
    total = products.sum((0, 1)) - np.einsum("aaij->ij", products)
    return np.asarray((total + total.T) / (2 * n_blocks * (n_blocks - 1)))


def signal_shares(gramian: Numbers, squared_norms: Numbers) -> Numbers:
    """Ĝ_ii as a share of the squared norm with noise; 0 for a gradient that vanishes.

    :param gramian: Ĝ, shape (K, K)
    :param squared_norms: with noise, shape (K,)
    :return: shape (K,)
    """
    shares = np.zeros(len(gramian))
    return np.divide(gramian.diagonal(), squared_norms, where=squared_norms > 0, out=shares)


def cosines_of_signal(gramian: Numbers, has_signal: NDArray[np.bool_]) -> Numbers:
    """Cosines from unbiased products; one that chance takes beyond ±1 is ±1.

    :param gramian: Ĝ, shape (K, K)
    :param has_signal: which gradients have a length that can be told from 0, shape (K,)
    :return: shape (K, K), NaN where one of the two has none
    """
    lengths = np.sqrt(np.where(has_signal, gramian.diagonal(), np.nan))
    return np.clip(gramian / np.outer(lengths, lengths), -1.0, 1.0)
