"""Gradients of independent blocks of samples, in bounded memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.conflicts.estimators import MIN_BLOCKS

#: Bytes that the gradients of all blocks may take together.
MEMORY = 256 * 2**20
_BYTES = 4


class Blocks:
    """Mean gradients (n, K, D) of n blocks, in single precision.

    A block is one rollout where that fits into memory; else consecutive rollouts share a block, so
    that memory does not grow with their number, and there are never fewer than three blocks.

    :param n_rollouts: number of rollouts to come
    :param memory: bytes for all blocks
    """

    def __init__(self, n_rollouts: int, memory: int = MEMORY):
        self.n_rollouts, self.memory = n_rollouts, memory
        self._n_added = 0
        self._sums: list[NDArray[np.float32]] = []
        self._sizes: list[int] = []

    def add(self, gradients: NDArray[np.float32]) -> None:
        """Add the gradients of the next rollout.

        :param gradients: shape (K, D)
        """
        n_blocks = self._count(gradients.size)
        block = self._n_added * n_blocks // self.n_rollouts
        self._n_added += 1
        if block == len(self._sums):
            self._sums.append(gradients.astype(np.float32))
            self._sizes.append(1)
            return
        self._sums[block] += gradients
        self._sizes[block] += 1

    def _count(self, n_numbers: int) -> int:
        """How many blocks of so many numbers fit."""
        fitting = self.memory // max(1, n_numbers * _BYTES)
        return min(self.n_rollouts, max(MIN_BLOCKS, fitting))

    def products(self) -> NDArray[np.float64]:
        """X^ab_ij = g_i^a·g_j^b of the mean gradients, shape (n, n, K, K); one pair of blocks at a
        time, so that no copy of all of them is made.
        """
        n_blocks, n_components = len(self._sums), len(self._sums[0])
        products = np.empty((n_blocks, n_blocks, n_components, n_components))
        for a in range(n_blocks):
            for b in range(a, n_blocks):
                product = self._sums[a] @ self._sums[b].T
                products[a, b] = product / (self._sizes[a] * self._sizes[b])
                products[b, a] = products[a, b].T
        return products
