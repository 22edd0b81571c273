"""Two methods compared: on one configuration over seeds, and over configurations."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_gcr.study.statistics import (
    Interval,
    holm,
    mean_interval,
    seeds_needed,
    sign_permutation,
    welch,
    welch_over_tasks,
)

Array = NDArray[np.float64]

#: Differences up to this share of the baseline do not matter.
MARGIN = 0.05
#: The margin of a difference that is no share: none, so that only its sign can be told.
NO_MARGIN = sys.float_info.min


class Contrast(NamedTuple):
    """A method against a baseline.

    ``estimate``, ``low`` and ``high`` are a share of the baseline's gain over random actions where
    ``relative``, else in the return's own unit. ``low``, ``high`` and ``p`` are NaN where there
    are too few values for an interval. ``holm`` is p, corrected for its family.

    :param baseline: what is compared with
    :param method: what is compared
    :param metric: column of the cells
    :param n_baseline: values of the baseline
    :param n_method: values of the method
    :param means: of baseline and method, in the return's own unit
    :param better: pairs in which the method is strictly better
    :param pairs: number of pairs
    :param more_seeds: about how many more decide it; None where this is not known
    :param kind: of interval: ``Welch``, ``Welch-Satterthwaite`` or ``Student``
    """

    baseline: str
    method: str
    metric: str
    n_baseline: int
    n_method: int
    means: tuple[float, float]
    estimate: float
    low: float
    high: float
    p: float
    holm: float
    better: int
    pairs: int
    more_seeds: int | None
    relative: bool
    kind: str

    @property
    def has_interval(self) -> bool:
        """Whether there were enough values."""
        return not math.isnan(self.low)

    @property
    def margin(self) -> float:
        """The largest difference that does not matter."""
        return MARGIN if self.relative else NO_MARGIN


def over_seeds(
    baseline: str, method: str, metric: str, a: ArrayLike, b: ArrayLike, random: float = math.nan
) -> Contrast:
    """Welch's difference of two methods on one configuration, as a share of what the baseline
    gains over random actions.

    Where the return of random actions is not known it is a share of the baseline's |mean|; where
    the baseline gains nothing, or its gain is not told from 0, it is the plain difference.

    :param baseline: name
    :param method: name
    :param metric: name of the returns
    :param a: returns of the baseline's seeds, shape (n_a,), at least 1
    :param b: returns of the method's seeds, shape (n_b,), at least 1
    :param random: mean return of random actions, or NaN
    """
    x = np.asarray(a, dtype=np.float64)
    y = np.asarray(b, dtype=np.float64)
    origin = 0.0 if math.isnan(random) else random
    gain = float(x.mean()) - origin
    relative = gain != 0.0 if math.isnan(random) else gain > 0.0
    interval = _interval(x - origin, y - origin, relative)
    if not math.isfinite(interval.low) and not math.isnan(interval.low):
        relative = False
        interval = _interval(x, y, relative)
    more = None
    if min(len(x), len(y)) >= 2:
        margin = MARGIN if relative else NO_MARGIN
        more = seeds_needed(x - origin, y - origin, margin, relative)
    return Contrast(
        baseline,
        method,
        metric,
        len(x),
        len(y),
        (float(x.mean()), float(y.mean())),
        interval.estimate,
        interval.low,
        interval.high,
        interval.p,
        interval.p,
        int((y[:, None] > x).sum()),
        len(x) * len(y),
        more,
        relative,
        "Welch",
    )


def _interval(x: Array, y: Array, relative: bool) -> Interval:
    if min(len(x), len(y)) >= 2:
        return welch(x, y, relative)
    difference = float(y.mean() - x.mean())
    if relative:
        difference /= abs(float(x.mean()))
    return Interval(difference, math.nan, math.nan, math.nan, math.nan)


def over_configurations(
    baseline: str,
    method: str,
    metric: str,
    a: Sequence[ArrayLike],
    b: Sequence[ArrayLike],
    kind: str = "Student",
) -> Contrast:
    """The mean difference of scores over configurations.

    ``Student`` takes the configurations as a sample of others: its interval is that of the mean of
    their differences, and p is that of the sign permutation. ``Welch-Satterthwaite`` takes them as
    all there are, and its interval has the spread of the seeds alone.

    :param baseline: name
    :param method: name
    :param metric: name of the scores
    :param a: scores of the baseline, one array of seeds a configuration
    :param b: scores of the method, for the same configurations in the same order
    :param kind: ``Student`` or ``Welch-Satterthwaite``
    """
    means = np.array([[_mean(one), _mean(two)] for one, two in zip(a, b, strict=True)])
    differences = means[:, 1] - means[:, 0]
    interval = Interval(float(differences.mean()), math.nan, math.nan, math.nan, math.nan)
    if kind == "Welch-Satterthwaite":
        interval = welch_over_tasks(a, b)
    elif len(differences) >= 2:
        interval = mean_interval(differences)._replace(p=sign_permutation(differences).p)
    return Contrast(
        baseline,
        method,
        metric,
        len(differences),
        len(differences),
        (float(means[:, 0].mean()), float(means[:, 1].mean())),
        interval.estimate,
        interval.low,
        interval.high,
        interval.p,
        interval.p,
        int((differences > 0.0).sum()),
        len(differences),
        None,
        True,
        kind,
    )


def _mean(values: ArrayLike) -> float:
    return float(np.asarray(values, dtype=np.float64).mean())


def corrected(family: Sequence[Contrast]) -> list[Contrast]:
    """The same contrasts with Holm's correction for all of them that have a p.

    :param family: contrasts that are looked at together
    """
    tested = [one.p for one in family if not math.isnan(one.p)]
    adjusted = iter(holm(tested).tolist() if tested else [])
    return [one if math.isnan(one.p) else one._replace(holm=next(adjusted)) for one in family]
