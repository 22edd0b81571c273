"""Who conflicts with whom, and who meets whom when: what the resolvers ask of a Gramian."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Gramian = NDArray[np.float64]
Levels = NDArray[np.integer[Any]]

#: Two gradients conflict when ⟨g_i, g_j⟩ is below minus this share of |g_i| |g_j|: rounding is no
#: conflict.
TOLERANCE = 1e-12


def cosines(gramian: Gramian) -> NDArray[np.float64]:
    """Cosine between each two gradients: G_ij / (|g_i| |g_j|), and 0 where one of them vanishes.

    :param gramian: G, shape (..., K, K)
    :return: shape (..., K, K)
    """
    return np.asarray(gramian / _products_of_norms(gramian))


def conflicts(gramian: Gramian) -> NDArray[np.bool_]:
    """Which pairs conflict: G_ij < 0 beyond rounding.

    :param gramian: G, shape (..., K, K)
    :return: shape (..., K, K), symmetric, False on the diagonal
    """
    return np.asarray(gramian < -TOLERANCE * _products_of_norms(gramian))


def _products_of_norms(gramian: Gramian) -> NDArray[np.float64]:
    """|g_i| |g_j|, shape (..., K, K); infinite for a gradient of length 0, which has no direction
    and so no conflicts.
    """
    norms = np.sqrt(gramian.diagonal(0, -2, -1))
    norms = np.where(norms > 0, norms, np.inf)
    return np.asarray(norms[..., :, None] * norms[..., None, :])


def visiting_order(levels: Levels, rng: np.random.Generator) -> NDArray[np.intp]:
    """Order in which each component meets the others: from the lowest priority up, level 0 last,
    random inside a level.

    :param levels: shape (K,)
    :param rng: source of the order inside a level
    :return: row i lists whom component i meets, shape (K, K)
    """
    n_components = len(levels)
    return np.argsort(rng.random((n_components, n_components)) - levels, axis=1)
