"""The tables of a report, frame to frame: what the cells say, side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_gcr.study.contrasts import Contrast, corrected, over_seeds
from sb3_gcr.study.store import Record

if TYPE_CHECKING:
    import pandas as pd

TRAINING = "return_training"
FINAL = "return_final"
PPO = "ppo"
HEADS = "multi_head"
#: The method that a study is about: the first of these that it has.
MAIN_METHODS = ("gcr", "gcrppo", "guaranteed", "levels", "no_priority", "gcr_authors")


class Roles(NamedTuple):
    """Who is compared with whom.

    :param baseline: PPO where the study has it
    :param main: the method that the study is about
    :param heads: the heads alone, or None
    :param others: all other methods
    """

    baseline: str
    main: str
    heads: str | None
    others: tuple[str, ...]


class Answer(NamedTuple):
    """All contrasts of one configuration; None where a method is missing.

    :param headline: main method against baseline, return over training; not corrected
    :param surgery: main method against the heads alone
    :param heads: heads alone against baseline
    :param final: as the headline, final return
    :param others: other methods against the baseline
    """

    headline: Contrast | None
    surgery: Contrast | None
    heads: Contrast | None
    final: Contrast | None
    others: tuple[Contrast, ...]

    @property
    def contrasts(self) -> list[Contrast]:
        """Those that there are, the headline first."""
        named = [self.headline, self.surgery, self.heads, self.final]
        return [one for one in named if one is not None] + list(self.others)


def roles(methods: Sequence[str]) -> Roles | None:
    """Who is compared with whom; None where there is only one method.

    :param methods: of the study, in the order of its manifest
    """
    names = list(dict.fromkeys(methods))
    if len(names) < 2:
        return None
    baseline = next((name for name in (PPO, HEADS) if name in names), names[0])
    candidates = [name for name in names if name != baseline]
    first = [name for name in candidates if name != HEADS] or candidates
    main = next((name for name in MAIN_METHODS if name in first), first[0])
    heads = HEADS if HEADS in candidates and main != HEADS else None
    others = tuple(name for name in candidates if name not in (main, heads))
    return Roles(baseline, main, heads, others)


def compared(cells: pd.DataFrame, who: Roles) -> Answer:
    """The contrasts of one configuration; all but the headline are Holm-corrected together.

    :param cells: of that configuration
    :param who: the methods' parts
    """
    random = random_return(cells)

    def against(baseline: str | None, method: str, metric: str = TRAINING) -> Contrast | None:
        a = sample(cells, baseline, metric)
        b = sample(cells, method, metric)
        if len(a) == 0 or len(b) == 0:
            return None
        return over_seeds(str(baseline), method, metric, a, b, random)

    headline = against(who.baseline, who.main)
    rest = {
        "surgery": against(who.heads, who.main),
        "heads": against(who.baseline, who.heads) if who.heads else None,
        "final": against(who.baseline, who.main, FINAL),
    } | {name: against(who.baseline, name) for name in who.others}
    family = corrected([one for one in rest.values() if one is not None])
    known = dict(zip([key for key, one in rest.items() if one is not None], family, strict=True))
    others = tuple(known[name] for name in who.others if name in known)
    return Answer(headline, known.get("surgery"), known.get("heads"), known.get("final"), others)


def sample(cells: pd.DataFrame, method: str | None, column: str) -> np.ndarray:
    """The finite values of a method's seeds, in the order of the seeds."""
    rows = cells[cells["method"] == method].sort_values("seed")
    values = rows[column].to_numpy(dtype=float)
    return values[np.isfinite(values)]


def random_return(cells: pd.DataFrame) -> float:
    """Mean return of random actions over the cells; NaN where no cell has it."""
    values = cells["random_return"].dropna()
    return float(values.mean()) if len(values) else math.nan


def by_method(
    cells: pd.DataFrame, methods: Sequence[str]
) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """Configuration, method and cells, in the order of the methods."""
    for configuration, own in cells.groupby("configuration", sort=False):
        for method in methods:
            group = own[own["method"] == method]
            if len(group):
                yield str(configuration), method, group


def method_table(cells: pd.DataFrame, methods: Sequence[str]) -> pd.DataFrame:
    """One row a method of a configuration: seeds, means and standard deviations, conflicts.

    :param cells: one row a cell
    :param methods: in the order of the study
    """
    import pandas as pd

    rows = []
    for configuration, method, group in by_method(cells, methods):
        rows.append(
            {
                "configuration": configuration,
                "method": method,
                "n": len(group),
                "return over training": group[TRAINING].mean(),
                "sd": group[TRAINING].std(),
                "final return": group[FINAL].mean(),
                "sd of final": group[FINAL].std(),
                "conflicting pairs": group["conflict_count"].mean(),
                "conflict rate": group["conflict_rate"].mean(),
                "failed share": group["failed_share"].mean(),
                "dominance share": group["dominance_share"].mean(),
            }
        )
    return pd.DataFrame(rows)


def term_table(terms: pd.DataFrame, baseline: str, method: str) -> pd.DataFrame:
    """What each term of one configuration returns under two methods, tasks first.

    The p values are Holm-corrected over the terms of level 1 and lower priority, which is the
    family of "what the regularisers paid", and over the others.

    :param terms: of that configuration
    :param baseline: whose returns come first
    :param method: whose returns come second
    :return: columns term, level, baseline, method, and the contrast's numbers
    """
    import pandas as pd

    levels = terms.dropna(subset=["level"]).groupby("term", sort=False)["level"].max()
    found: list[tuple[str, float, Contrast]] = []
    for term in dict.fromkeys(terms["term"]):
        own = terms[terms["term"] == term]
        a = sample(own, baseline, "final")
        b = sample(own, method, "final")
        if len(a) and len(b):
            level = float(levels.get(term, math.nan))
            found.append((term, level, over_seeds(baseline, method, "final", a, b)))
    rows = []
    for regularisers in (False, True):
        group = [row for row in found if (row[1] >= 1) == regularisers]
        family = corrected([row[2] for row in group])
        rows += [(term, level, c) for (term, level, _), c in zip(group, family, strict=True)]
    rows.sort(key=lambda row: math.inf if math.isnan(row[1]) else row[1])
    return pd.DataFrame(
        [
            {
                "term": term,
                "level": level,
                "before": c.means[0],
                "after": c.means[1],
                "estimate": c.estimate,
                "low": c.low,
                "high": c.high,
                "relative": c.relative,
                "p": c.p,
                "holm": c.holm,
            }
            for term, level, c in rows
        ],
        columns=[
            "term",
            "level",
            "before",
            "after",
            "estimate",
            "low",
            "high",
            "relative",
            "p",
            "holm",
        ],
    )


class Cosines(NamedTuple):
    """Cosine matrices of a method on a configuration, mean over its cells.

    :param names: of the K terms
    :param first: over the first tenth of the updates, shape (K, K)
    :param last: over the last tenth, shape (K, K)
    :param kind: ``minibatch``, ``unbiased`` or both
    :param n: number of cells
    """

    names: tuple[str, ...]
    first: np.ndarray
    last: np.ndarray
    kind: str
    n: int


def mean_cosines(results: Sequence[Record]) -> Cosines | None:
    """The mean of the cells' matrices; None where no cell has one of two or more terms.

    :param results: of one method on one configuration
    """
    found = [result["cosines"] for result in results if result.get("cosines")]
    found = [one for one in found if len(one["names"]) > 1 and one.get("last") is not None]
    if not found:
        return None
    matrices = [
        np.mean([np.array(one[when], dtype=float) for one in found], axis=0)
        for when in ("first", "last")
    ]
    kinds = sorted({one["kind"] for one in found})
    return Cosines(
        tuple(found[0]["names"]), matrices[0], matrices[1], " and ".join(kinds), len(found)
    )


def pair_table(cosines: Cosines, levels: Record) -> pd.DataFrame:
    """Who conflicts with whom: all pairs, the most opposed at the end of training first.

    :param cosines: of a method on a configuration
    :param levels: level by term
    """
    import pandas as pd

    names = cosines.names
    rows = [
        {
            "pair": f"{names[i]} | {names[j]}",
            "levels": f"{levels.get(names[i], '')} | {levels.get(names[j], '')}",
            "first": cosines.first[i, j],
            "last": cosines.last[i, j],
        }
        for i in range(len(names))
        for j in range(i + 1, len(names))
    ]
    return pd.DataFrame(rows).sort_values("last", kind="stable", ignore_index=True)


def runtime_table(cells: pd.DataFrame, methods: Sequence[str]) -> pd.DataFrame:
    """Seconds of wall clock for each 100,000 steps, collection and update apart.

    :param cells: one row a cell
    :param methods: in the order of the study
    """
    import pandas as pd

    rows = []
    for configuration, method, group in by_method(cells, methods):
        scale = 1e5 / group["steps"]
        rows.append(
            {
                "configuration": configuration,
                "method": method,
                "n": len(group),
                "collect": (group["collect_s"] * scale).mean(),
                "update": (group["update_s"] * scale).mean(),
                "wall": (group["wall_s"] * scale).mean(),
                "cpu": (group["cpu_s"] * scale).mean(),
                "memory": group["memory_mb"].max(),
            }
        )
    return pd.DataFrame(rows)
