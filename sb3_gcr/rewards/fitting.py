"""With which weights numbers add up to a reward, exactly or not at all."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: By how much a weighted sum may miss, relative to the sizes of what it adds up: terms and reward
#: may both have been rounded to float32.
EXACT = 1e-5
#: A column that misses the span of others by less than this share of its size adds nothing.
DEPENDENT = 1e-7


class Fit(NamedTuple):
    """Weights, shape (K,), a constant, and the largest miss relative to what was added up."""

    weights: NDArray[np.float64]
    constant: float
    miss: float

    @property
    def is_exact(self) -> bool:
        """Whether only rounding is left."""
        return self.miss <= EXACT


def fit_sum(columns: NDArray[np.float64], target: NDArray[np.float64]) -> Fit:
    """Least squares: target ≈ columns @ weights + constant, the columns scaled to size 1.

    :param columns: shape (n, K)
    :param target: shape (n,)
    """
    scale = np.abs(columns).max(0, initial=0.0)
    scale = np.where(scale > 0, scale, 1.0)
    design = np.column_stack([columns / scale, np.ones(len(columns))])
    solution = np.linalg.lstsq(design, target, rcond=None)[0]
    weights = solution[:-1] / scale
    parts = np.column_stack([columns * weights, np.full(len(columns), solution[-1])])
    sizes = np.abs(parts).sum(1) + np.abs(target)
    miss = np.abs(parts.sum(1) - target)
    relative = np.divide(miss, sizes, out=np.zeros_like(miss), where=sizes > 0)
    return Fit(weights, float(solution[-1]), float(relative.max(initial=0.0)))


def independent_columns(columns: NDArray[np.float64]) -> list[int]:
    """Indices of the columns that are neither constant nor a combination of those before them.

    :param columns: shape (n, K)
    """
    chosen: list[int] = []
    for index in range(columns.shape[1]):
        column = columns[:, index]
        others = np.column_stack([columns[:, chosen], np.ones(len(columns))])
        left = column - others @ np.linalg.lstsq(others, column, rcond=None)[0]
        if np.linalg.norm(left) > DEPENDENT * np.linalg.norm(column):
            chosen.append(index)
    return chosen


def round_weight(weight: float) -> float:
    """The number of at most four digits that a fitted weight is, where it is one.

    :param weight: as fitted
    """
    for digits in range(1, 5):
        rounded = float(f"{weight:.{digits}g}")
        if abs(rounded - weight) <= 1e-5 * abs(weight):
            return rounded
    return weight
