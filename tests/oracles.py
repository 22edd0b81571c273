"""Independent oracles: naive loops in gradient space, written from the paper's words, with
gradients instead of Gramians. What the library draws, they enumerate.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import permutations, product
from typing import Any

import numpy as np

Steps = set[tuple[float, ...]]


def pcgrad_with_levels(jacobian: Any, levels: Sequence[int]) -> Steps:
    """All steps that the paper's rule may take.

    Each gradient meets the others of its own level, in any order, and then those of the higher
    levels from the lowest up, inside a level again in any order; from each original gradient that
    it conflicts with it is projected off.
    """
    outcomes = []
    for i in range(len(jacobian)):
        others = [j for j in range(len(jacobian)) if j != i and levels[j] <= levels[i]]
        found = [_meet(jacobian[i], jacobian[list(order)]) for order in orders(others, levels)]
        outcomes.append({_rounded(one) for one in found})
    return {_rounded(sum(map(np.array, one))) for one in product(*outcomes)}


def orders(met: Sequence[int], levels: Sequence[int]) -> Iterable[tuple[int, ...]]:
    """All orders from the lowest priority up, free inside a level."""
    ranks = sorted({levels[j] for j in met}, reverse=True)
    groups = [permutations([j for j in met if levels[j] == rank]) for rank in ranks]
    return (sum(parts, ()) for parts in product(*groups))


def authors_in_place(jacobian: Any, levels: Sequence[int]) -> Steps:
    """All steps that the authors' released rule may take: one pass over all gradients in any order,
    each projected off the tasks, in any order, as the pass has left them so far.
    """
    n = len(jacobian)
    steps: Steps = set()
    for outer in permutations(range(n)):
        states = [np.array(jacobian, dtype=float)]
        for i in outer:
            tasks = [j for j in range(n) if j != i and levels[j] == 0]
            following = []
            for state in states:
                for inner in permutations(tasks):
                    moved = state.copy()
                    moved[i] = _meet(state[i], state[list(inner)])
                    following.append(moved)
            states = list({_rounded(state.ravel()): state for state in following}.values())
        steps |= {_rounded(state.sum(0)) for state in states}
    return steps


def unmatched(some: Any, others: Any) -> int:
    """How many vectors have none that is the same to rounding among others.

    :param some: shape (n, D)
    :param others: shape (m, D)
    """
    some, others = np.array(sorted(some)), np.array(sorted(others))
    distances = np.abs(some[:, None] - others).max(2).min(1)
    return int((distances > 1e-6 * (1 + np.abs(some).max(1))).sum())


def _meet(mine: Any, others: Any) -> Any:
    """Take from a gradient what opposes others, one after the other."""
    for other in others:
        dot = mine @ other
        if dot < 0:
            mine = mine - dot / (other @ other) * other
    return mine


def _rounded(vector: Any) -> tuple[float, ...]:
    return tuple((np.round(vector, 9) + 0.0).tolist())


def random_jacobian(rng: np.random.Generator, n: int, size: int, spread: float = 1.0) -> Any:
    """Gaussian directions with log-normal norms, standard deviation ``spread`` of the logarithm."""
    directions = rng.normal(size=(n, size))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.exp(spread * rng.normal(size=(n, 1)))
