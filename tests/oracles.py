"""Independent oracles: naive loops in gradient space, written from the paper's words, with
gradients instead of Gramians.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_gcr.angles import visiting_order


def pcgrad_with_levels(jacobian: Any, levels: Any, rng: np.random.Generator) -> Any:
    """Each gradient, projected off every conflicting original gradient of its own or a higher
    level, in the given order.
    """
    order = visiting_order(np.asarray(levels), rng)
    total = np.zeros(jacobian.shape[1])
    for i, mine in enumerate(jacobian):
        mine = mine.copy()
        for j in order[i]:
            if j == i or levels[j] > levels[i] or not jacobian[j].any():
                continue
            dot = mine @ jacobian[j]
            if dot < 0:
                mine -= dot / (jacobian[j] @ jacobian[j]) * jacobian[j]
        total += mine
    return total


def authors_in_place(jacobian: Any, levels: Any, rng: np.random.Generator) -> Any:
    """One pass over all gradients, each projected off the tasks as the pass has left them so
    far.
    """
    gradients = jacobian.copy()
    n = len(gradients)
    for i in rng.permutation(n):
        for j in rng.permutation(n):
            both_regularisers = levels[i] > 0 and levels[j] > 0
            task_meets_regulariser = levels[i] == 0 and levels[j] > 0
            if i == j or both_regularisers or task_meets_regulariser or not gradients[j].any():
                continue
            dot = gradients[i] @ gradients[j]
            if dot < 0:
                gradients[i] = gradients[i] - dot / (gradients[j] @ gradients[j]) * gradients[j]
    return gradients.sum(0)


def random_jacobian(rng: np.random.Generator, n: int, size: int, spread: float = 1.0) -> Any:
    """Gaussian directions with log-normal norms, standard deviation ``spread`` of the logarithm."""
    directions = rng.normal(size=(n, size))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.exp(spread * rng.normal(size=(n, 1)))
