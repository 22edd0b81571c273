"""The hypotheses of a manifest, judged by the rules that they were registered with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_gcr.study import rules
from sb3_gcr.study.contrasts import MARGIN, Contrast, over_configurations, over_seeds
from sb3_gcr.study.scores import Scores
from sb3_gcr.study.statistics import Evidence, e_value, holm, registered_looks
from sb3_gcr.study.store import Record
from sb3_gcr.study.tables import random_return, sample

if TYPE_CHECKING:
    import pandas as pd

ALPHA = 0.05


class Judged(NamedTuple):
    """A hypothesis and what the cells say to it.

    :param name: as in the manifest
    :param claim: as in the manifest
    :param contrast: of the units that are there; None where there are none
    :param n: units that are there: configurations, or seeds of each method
    :param look: units of the last registered look that is reached; 0 before the first
    :param p: at that look, Bonferroni over the looks; NaN before the first
    :param holm: p, Holm-corrected over the study's hypotheses
    :param evidence: e-value on wins, which may be looked at any time; None for seeds
    :param status: ``supported``, ``refuted``, ``opposite``, ``open`` or ``no look yet``
    :param rules: what the manifest calls supported and refuted
    :param detail: the numbers of a rule that is none of p and interval
    """

    name: str
    claim: str
    contrast: Contrast | None
    n: int
    look: int
    p: float
    holm: float
    evidence: Evidence | None
    status: str
    rules: tuple[str, str]
    detail: str = ""


def judged(
    manifest: Record, cells: pd.DataFrame, factors: pd.DataFrame, scores: Scores
) -> list[Judged]:
    """All hypotheses of a manifest, Holm-corrected together.

    :param manifest: with hypotheses and looks
    :param cells: one row a cell
    :param factors: one row a configuration
    :param scores: scaled returns by configuration, in the order of the manifest's tasks
    """
    looks = tuple(manifest.get("looks") or ())
    found = [
        _examined(str(name), one, looks, cells, scores)
        for name, one in (manifest.get("hypotheses") or {}).items()
    ]
    found = [with_own_rule(one, cells, factors, scores) for one in found]
    # One that has not been looked at counts as p = 1, so that the family never grows later.
    p_values = [1.0 if math.isnan(one.p) else one.p for one in found]
    adjusted = holm(p_values) if found else np.array([])
    return [
        one if one.detail else _with_status(one, float(p))
        for one, p in zip(found, adjusted, strict=True)
    ]


def with_own_rule(
    one: Judged, cells: pd.DataFrame, factors: pd.DataFrame, scores: Scores
) -> Judged:
    """The hypothesis, judged already where its rule is about slopes or about two variants.

    :param one: with the contrast that it is about
    :param cells: one row a cell
    :param factors: one row a configuration
    :param scores: scaled returns
    """
    if one.contrast is None:
        return one
    c = one.contrast
    if "slope" in one.rules[0]:
        found = rules.slopes_rule(cells, factors, c.baseline, c.method, c.metric)
    elif "raw gain" in one.rules[0]:
        found = rules.variants_rule(scores, factors, c.baseline, c.method, c.metric)
    else:
        return one
    status, detail = found
    nan = math.nan
    return one._replace(status=status, detail=detail, p=nan, holm=nan, look=0, evidence=None)


def _examined(
    name: str, hypothesis: Record, looks: Sequence[int], cells: pd.DataFrame, scores: Scores
) -> Judged:
    method, baseline = hypothesis["contrast"]
    metric = hypothesis["metric"]
    registered = (str(hypothesis["supported"]), str(hypothesis["refuted"]))
    empty = Judged(
        name, str(hypothesis["claim"]), None, 0, 0, math.nan, math.nan, None, "open", registered
    )
    if hypothesis["unit"] == "seed":
        return _over_seeds(empty, method, baseline, metric, looks, cells)
    return _over_configurations(empty, method, baseline, metric, looks, scores)


def _over_configurations(
    empty: Judged, method: str, baseline: str, metric: str, looks: Sequence[int], scores: Scores
) -> Judged:
    a = scores.samples.get((baseline, metric), {})
    b = scores.samples.get((method, metric), {})
    both = [name for name in a if name in b]
    if not both:
        return empty
    x, y = [a[name] for name in both], [b[name] for name in both]
    contrast = over_configurations(baseline, method, metric, x, y)
    differences = np.array([two.mean() - one.mean() for one, two in zip(x, y, strict=True)])
    n_decided = int((differences != 0.0).sum())
    reached = registered_looks(differences, looks or (max(2, len(both)),))
    last = reached[-1] if reached else None
    return empty._replace(
        contrast=contrast,
        n=len(both),
        look=last.n if last else 0,
        p=last.adjusted_p if last else math.nan,
        evidence=e_value(contrast.better, n_decided),
    )


def _over_seeds(
    empty: Judged,
    method: str,
    baseline: str,
    metric: str,
    looks: Sequence[int],
    cells: pd.DataFrame,
) -> Judged:
    """Welch over the seeds of the one configuration that has both methods."""
    names = [
        name
        for name, own in cells.groupby("configuration", sort=False)
        if {method, baseline} <= set(own["method"])
    ]
    if len(names) != 1:
        return empty
    own = cells[cells["configuration"] == names[0]]
    a, b = sample(own, baseline, metric), sample(own, method, metric)
    if not len(a) or not len(b):
        return empty
    random = random_return(own)
    n = min(len(a), len(b))
    reached = [look for look in (looks or (max(2, n),)) if look <= n]
    p = math.nan
    if reached:
        first = over_seeds(baseline, method, metric, a[: reached[-1]], b[: reached[-1]], random)
        p = min(1.0, max(1, len(looks)) * first.p)
    contrast = over_seeds(baseline, method, metric, a, b, random)
    return empty._replace(contrast=contrast, n=n, look=reached[-1] if reached else 0, p=p)


def _with_status(one: Judged, adjusted: float) -> Judged:
    return one._replace(holm=adjusted, status=status(one, adjusted))


def status(one: Judged, adjusted: float) -> str:
    """Supported, refuted, the opposite, or neither; nothing before the first look.

    A rule to refute that has a ± wants the interval inside the margin, any other below it.

    :param one: with p at a look
    :param adjusted: that p, Holm-corrected
    """
    if one.contrast is None or math.isnan(one.p):
        return "no look yet"
    estimate, low, high = one.contrast.estimate, one.contrast.low, one.contrast.high
    if adjusted < ALPHA and estimate > 0.0:
        return "supported"
    if adjusted < ALPHA and estimate < 0.0:
        return "opposite"
    two_sided = "±" in one.rules[1]
    if one.contrast.relative and high < MARGIN and (low > -MARGIN or not two_sided):
        return "refuted"
    return "open"
