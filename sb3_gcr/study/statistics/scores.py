"""One number for two returns, and one scale for the returns of several tasks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sb3_gcr.study.statistics.checks import Array


class Change(NamedTuple):
    """A symmetric percentage change, and whether the two returns differ in sign."""

    percent: float
    signs_differ: bool


def spc(a: float, b: float) -> Change:
    r"""Symmetric percentage change from the baseline's return a to b.

    .. math:: SPC(a, b) = 200 \frac{b - a}{|a| + |b|}

    It lies between -200 and 200. Where the signs differ, or one return is 0, it is ±200 whatever
    the sizes: the flag says that it measures nothing then.

    :param a: the baseline's mean return
    :param b: the other method's mean return
    :return: percent; 0 for two zeros
    :raises ValueError: a return that is not finite
    """
    for name, value in (("a", a), ("b", b)):
        if not np.isfinite(value):
            raise ValueError(f"Parameter `{name}` must be finite, found {value}.")
    if a == b:
        return Change(0.0, False)
    percent = 200.0 * (b - a) / (abs(a) + abs(b))
    return Change(float(percent), bool(np.sign(a) != np.sign(b)))


def normalised_score(x: ArrayLike, random: float, reference: float) -> Array:
    r"""Returns on the scale from a random policy (0) to the reference (1).

    .. math:: (x - \mathrm{random}) / (\mathrm{reference} - \mathrm{random})

    :param x: returns, any shape; NaN stays NaN
    :param random: mean return of random actions
    :param reference: mean return of the reference, which is PPO's pilot
    :return: without unit, the shape of ``x``
    :raises ValueError: a reference that is not above random
    """
    if not (np.isfinite(random) and np.isfinite(reference) and reference > random):
        raise ValueError(
            f"Parameter `reference` must be above `random`, found {reference} and {random}: "
            "give the reference more steps, or report raw returns."
        )
    return (np.asarray(x, dtype=np.float64) - random) / (reference - random)
