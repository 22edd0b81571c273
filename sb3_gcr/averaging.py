"""An experiment: resolvers that see an average of unbiased Gramians in place of a minibatch's own.

A minibatch's Gramian is mostly noise that its gradients share. The policy moves slowly, so that
unbiased Gramians of many minibatches can be averaged; an average of them need not be the Gramian of
any gradients, which is why its negative eigenvalues are dropped.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Gramian = NDArray[np.float64]


class GramianAverage:
    r"""Exponential average of unbiased Gramians, as positive semi-definite matrix.

    .. math:: S ← (1 - 1/n) S + Ĝ / n, \qquad s ← (1 - 1/n) s + 1/n, \qquad \bar G = (S / s)_+

    :param n_minibatches: n, about so many count; at least 1
    """

    def __init__(self, n_minibatches: int):
        self.share = 1 / n_minibatches
        self._sum: Gramian | None = None
        self._weight = 0.0

    def add(self, gramian: Gramian | None) -> Gramian | None:
        """The average, with one more minibatch; None while there has been none.

        :param gramian: Ĝ, shape (K, K); None for a minibatch that has none
        """
        if gramian is not None:
            before = np.zeros_like(gramian) if self._sum is None else self._sum
            self._sum = (1 - self.share) * before + self.share * gramian
            self._weight = (1 - self.share) * self._weight + self.share
        return None if self._sum is None else positive_part(self._sum / self._weight)


def positive_part(matrix: Gramian) -> Gramian:
    """The nearest positive semi-definite matrix: negative eigenvalues become 0.

    :param matrix: symmetric, shape (K, K)
    """
    eigenvalues, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * eigenvalues.clip(min=0)) @ vectors.T)
