"""Rules of hypotheses that are neither a p nor an interval of one contrast."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sb3_gcr.study.contrasts import MARGIN
from sb3_gcr.study.scores import Scores
from sb3_gcr.study.statistics import Line, line, mean_interval
from sb3_gcr.study.tables import random_return, sample
from sb3_gcr.study.words import percent

if TYPE_CHECKING:
    import pandas as pd

Ruling = tuple[str, str]
#: The setting whose two values are the raw and the scaled returns.
SCALING = "normalize_reward"


def slopes_rule(
    cells: pd.DataFrame, factors: pd.DataFrame, baseline: str, method: str, metric: str
) -> Ruling:
    """Whether the gain grows with conflict: supported where the slopes over conflict count and rate
    have intervals above 0, refuted where that over the dose includes 0 and is narrower than ±5 %.

    A point is a configuration and seed. The dose is the keyword that takes three or more positive
    values, in steps of a factor of three.

    :param cells: one row a cell
    :param factors: one row a configuration
    :param baseline: what the gain is over
    :param method: whose gain it is
    :param metric: of the gain
    :return: status and the numbers in a sentence
    """
    points = gains(cells, baseline, method, metric)
    points["dose"] = points["configuration"].map(dose(factors))
    found = {what: _line(points, what) for what in ("conflict_count", "conflict_rate", "dose")}
    names = ("a conflicting pair", "100 % of conflict rate", "three times the dose")
    parts = [
        f"{percent(one.slope, sign=True)} % for {name} ({percent(one.low)} to {percent(one.high)})"
        for name, one in zip(names, found.values(), strict=True)
        if one is not None
    ]
    count, rate, over_dose = found.values()
    status = "open"
    if count and rate and count.low > 0.0 and rate.low > 0.0:
        status = "supported"
    elif over_dose and over_dose.low <= 0.0 <= over_dose.high:
        half = (over_dose.high - over_dose.low) / 2.0
        status = "refuted" if half < MARGIN else "open"
    if not parts:
        return "no look yet", "The slopes need three pairs of runs with different conflicts."
    return status, f"The gain changes by {', '.join(parts)}, from {len(points)} pairs of runs."


def gains(cells: pd.DataFrame, baseline: str, method: str, metric: str) -> pd.DataFrame:
    """The gain of each configuration and seed that both methods have, as a share of what the
    baseline gains over random actions in that configuration, beside the method's conflicts.
    """
    import pandas as pd

    rows = []
    for name, own in cells.groupby("configuration", sort=False):
        random = random_return(own)
        reference = sample(own, baseline, metric)
        gain = reference.mean() - random if len(reference) else math.nan
        if not gain > 0.0:
            continue
        a = own[own["method"] == baseline].set_index("seed")
        b = own[own["method"] == method].set_index("seed")
        for seed in [one for one in b.index if one in a.index]:
            rows.append(
                {
                    "configuration": str(name),
                    "gain": (b.loc[seed, metric] - a.loc[seed, metric]) / gain,
                    "conflict_count": b.loc[seed, "conflict_count"],
                    "conflict_rate": b.loc[seed, "conflict_rate"],
                }
            )
    columns = ["configuration", "gain", "conflict_count", "conflict_rate"]
    return pd.DataFrame(rows, columns=columns)


def dose(factors: pd.DataFrame) -> dict[str, float]:
    """Logarithm to base three of the one keyword with three or more positive values."""
    for name in factors.columns:
        values = [
            value
            for value in factors[name]
            if isinstance(value, int | float) and not isinstance(value, bool) and value > 0
        ]
        if len(values) == len(factors) and len(set(values)) >= 3:
            logs = (math.log(value) / math.log(3.0) for value in values)
            return {str(key): log for key, log in zip(factors.index, logs, strict=True)}
    return {}


def _line(points: pd.DataFrame, what: str) -> Line | None:
    both = points[[what, "gain"]].dropna()
    if len(both) < 3 or both[what].nunique() < 2:
        return None
    return line(both[what].to_numpy(dtype=float), both["gain"].to_numpy(dtype=float))


def variants_rule(
    scores: Scores, factors: pd.DataFrame, baseline: str, method: str, metric: str
) -> Ruling:
    """Whether a gain is larger with raw returns than with scaled ones: supported where the interval
    of the difference lies above 0 and the scaled gain is at most half of the raw one, refuted where
    it is more than half.

    :param scores: scaled by each configuration's own baseline
    :param factors: one row a configuration, with its variant
    :param baseline: what the gain is over
    :param method: whose gain it is
    :param metric: of the gain
    :return: status and the numbers in a sentence
    """
    a = scores.samples.get((baseline, metric), {})
    b = scores.samples.get((method, metric), {})
    by_task: dict[str, dict[str, float]] = {}
    for name in [one for one in a if one in b]:
        row = factors.loc[name].to_dict()
        variant = "raw" if f"{SCALING}=False" in str(row.pop("variant")) else "scaled"
        by_task.setdefault(str(row), {})[variant] = float(b[name].mean() - a[name].mean())
    pairs = np.array([[one["raw"], one["scaled"]] for one in by_task.values() if len(one) == 2])
    if len(pairs) < 2:
        return "no look yet", "The rule needs two configurations with raw and with scaled returns."
    raw, scaled = pairs.mean(0)
    interval = mean_interval(pairs[:, 0] - pairs[:, 1])
    status = "open"
    if scaled > raw / 2.0:
        status = "refuted"
    elif interval.low > 0.0:
        status = "supported"
    return status, (
        f"Raw gain {percent(raw, sign=True)} %, scaled gain {percent(scaled, sign=True)} %, "
        f"difference {percent(interval.estimate, sign=True)} % ({percent(interval.low)} to "
        f"{percent(interval.high)}, Student) in {len(pairs)} configurations."
    )
