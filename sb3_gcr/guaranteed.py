"""The resolver with which no level ever harms a component of a higher one: projections onto dual
cones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.angles import Gramian, Levels, conflicts

Numbers = NDArray[np.float64]

#: A component whose squared gradient norm is below this share of the largest one has no gradient.
ZERO_ROW = 1e-40
#: Eigenvalues of a Gramian of unit gradients below this share of the largest are rounding.
ROUNDING = 1e-13
#: Ridge of the non-negative least squares on unit gradients: picks the minimal-norm weights when G
#: is singular.
RIDGE = 1e-10


def guaranteed(gramian: Gramian, levels: Levels, rng: np.random.Generator) -> Numbers:
    """Level by level, so that no level ever harms a component of a higher one, for any number of
    tasks.

    Inside a level UPGrad (arXiv:2406.16232) with sum preference: each g_i is projected onto the
    level's dual cone {d : ⟨g_j, d⟩ ≥ 0 for all j of the level} and the projections are added. The
    level's sum is then projected onto the dual cone of all components of higher levels. Members of
    a lower level may end worse: that is what priority means.

    :param gramian: G, shape (K, K)
    :param levels: priority level of each component, 0 the highest, shape (K,)
    :param rng: ignored, the result is deterministic
    :return: weights, shape (K,)
    """
    weights = np.ones(len(gramian))
    squared_norms = np.diag(gramian)
    if not conflicts(gramian).any():
        return weights
    alive = np.flatnonzero(squared_norms > ZERO_ROW * squared_norms.max())
    norms = np.sqrt(squared_norms[alive])
    unit_gradients = _columns(gramian[np.ix_(alive, alive)] / np.outer(norms, norms))
    projected = np.diag(norms)  # W in units of unit gradients: row i is g_i' as it is built up
    for level in np.unique(levels[alive]):
        own, higher = levels[alive] == level, levels[alive] < level
        for i in np.flatnonzero(own):
            projected[i] += _dual_cone_step(unit_gradients, projected[i], own)
        first = np.flatnonzero(own)[0]
        projected[first] += _dual_cone_step(unit_gradients, projected[own].sum(0), higher)
    weights[alive] = projected.sum(0) / norms
    return weights


def _columns(gramian: Gramian) -> Numbers:
    """A matrix A with AᵀA = G: its columns are the gradients, written in K coordinates."""
    eigenvalues, eigenvectors = np.linalg.eigh(gramian)
    eigenvalues[eigenvalues < ROUNDING * eigenvalues.max()] = 0.0
    return np.asarray(np.sqrt(eigenvalues)[:, None] * eigenvectors.T)


def _dual_cone_step(columns: Numbers, coefficients: Numbers, members: NDArray[np.bool_]) -> Numbers:
    """What to add to ``coefficients`` so that d = columns @ coefficients lands on the nearest point
    of the members' dual cone.

    min_λ |d + A_members λ|² subject to λ ≥ 0; its optimality conditions are ⟨g_j, d + A λ⟩ ≥ 0 with
    equality where λ_j > 0.
    """
    from scipy.optimize import (
        nnls,  # here, because it would be a tenth of the time of `import sb3_gcr`
    )

    step = np.zeros_like(coefficients)
    size = np.linalg.norm(coefficients)
    if members.any() and size > 0:
        ridge = np.sqrt(RIDGE) * np.eye(int(members.sum()))
        target = -(columns @ coefficients) / size
        step[members] = (
            size
            * nnls(
                np.vstack([columns[:, members], ridge]), np.append(target, np.zeros(len(ridge)))
            )[0]
        )
    return step
