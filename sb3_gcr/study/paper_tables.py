"""The paper's tables, rebuilt from a study's cells, with the paper's own numbers beside them."""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_gcr.study import paper
from sb3_gcr.study.contrasts import corrected, over_seeds
from sb3_gcr.study.statistics import (
    Correlation,
    Line,
    fisher,
    holm,
    iqm,
    line,
    mean_interval,
    probability_of_improvement,
    spc,
    spearman,
    welch_from_summaries,
    wilson,
)
from sb3_gcr.study.tables import FINAL, TRAINING, random_return, sample

if TYPE_CHECKING:
    import pandas as pd

#: The paper's task that is nearest to one of ours: the same aim, another simulator and reward.
NEAREST = {
    "Ant": "Ant",
    "Humanoid": "Humanoid",
    "HumanoidRun": "Humanoid",
    "Go1JoystickRoughTerrain": "Velocity-Rough-Unitree-Go2",
    "H1JoystickGaitTracking": "Velocity-Rough-H1",
    "G1JoystickRoughTerrain": "Velocity-Rough-G1",
    "PandaPickCube": "Lift-Cube-Franka",
    "PandaOpenCabinet": "Open-Drawer-Franka",
    "LeapCubeReorient": "Repose-Cube-Allegro",
}
#: Levels of a multi-objective task's ranges, and the word for an objective that is absent.
LEVELS = tuple(range(paper.LEVELS))
ABSENT = "NA"


class Scaling(NamedTuple):
    """How the change goes with conflict: one version of the scaling figure.

    :param what: ``conflict_count``, ``conflict_rate`` or ``components``
    :param x: one value a configuration
    :param y: SPC in per cent
    :param correlation: Spearman's
    :param line: least squares
    """

    what: str
    x: np.ndarray
    y: np.ndarray
    correlation: Correlation
    line: Line


def nearest(env: str) -> paper.TaskRow | None:
    """The row of the paper's task that is nearest to an env of ours, or None."""
    stem = env.rsplit("/", 1)[-1].rsplit("-v", 1)[0]
    name = NEAREST.get(stem)
    return next((row for row in paper.TASKS if row.task == name), None)


def table_1(cells: pd.DataFrame, baseline: str, method: str) -> pd.DataFrame:
    """One row a configuration: final returns of both, SPC, conflict, and what the paper left out.

    :param cells: one row a cell
    :param baseline: PPO
    :param method: what is compared with it
    :return: configurations in which both methods have a run; p Holm-corrected over them
    """
    import pandas as pd

    rows, contrasts = [], []
    for configuration, group in cells.groupby("configuration", sort=False):
        a, b = sample(group, baseline, FINAL), sample(group, method, FINAL)
        if not len(a) or not len(b):
            continue
        contrasts.append(over_seeds(baseline, method, FINAL, a, b, random_return(group)))
        own = group[group["method"] == method]
        change = spc(a.mean(), b.mean())
        theirs = nearest(group["env"].iloc[0])
        rows.append(
            {
                "configuration": configuration,
                "n": min(len(a), len(b)),
                "mean_baseline": a.mean(),
                "sd_baseline": _sd(a),
                "max_baseline": a.max(),
                "mean_method": b.mean(),
                "sd_method": _sd(b),
                "max_method": b.max(),
                "spc": change.percent,
                "signs_differ": change.signs_differ,
                "conflict_count": own["conflict_count"].mean(),
                "conflict_rate": own["conflict_rate"].mean(),
                "improvement": _improvement(a, b),
                "training_baseline": sample(group, baseline, TRAINING).mean(),
                "training_method": sample(group, method, TRAINING).mean(),
                "failed_share": own["failed_share"].mean(),
                "paper_task": theirs.task if theirs else "",
                "paper_spc": theirs.spc_percent if theirs else math.nan,
                "paper_conflicts": theirs.conflicts if theirs else math.nan,
            }
        )
    for row, contrast in zip(rows, corrected(contrasts), strict=True):
        row |= {
            "estimate": contrast.estimate,
            "low": contrast.low,
            "high": contrast.high,
            "relative": contrast.relative,
            "p": contrast.p,
            "holm": contrast.holm,
        }
    return pd.DataFrame(rows)


def _sd(values: np.ndarray) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else math.nan


def _improvement(a: np.ndarray, b: np.ndarray) -> float:
    """Probability that a run of b beats one of a; NaN with one seed."""
    if min(len(a), len(b)) < 2:
        return math.nan
    return probability_of_improvement([a], [b]).probability


def paper_table_1() -> pd.DataFrame:
    """The paper's thirteen tasks with what its own numbers come to."""
    import pandas as pd

    intervals = [welch_from_summaries(row.baseline, row.gcr, relative=True) for row in paper.TASKS]
    adjusted = holm([one.p for one in intervals])
    return pd.DataFrame(
        {
            "task": row.task,
            "mean_baseline": row.baseline_mean,
            "sd_baseline": row.baseline_sd,
            "mean_method": row.gcr_mean,
            "sd_method": row.gcr_sd,
            "spc": spc(row.baseline_mean, row.gcr_mean).percent,
            "printed_spc": row.spc_percent,
            "conflict_count": row.conflicts,
            "conflict_rate": row.conflict_rate,
            "components": row.components,
            "low": interval.low,
            "high": interval.high,
            "p": interval.p,
            "holm": corrected_p,
        }
        for row, interval, corrected_p in zip(paper.TASKS, intervals, adjusted, strict=True)
    )


def win_frame(
    cells: pd.DataFrame, factors: pd.DataFrame, baseline: str, method: str
) -> pd.DataFrame:
    """One row a multi-objective configuration: the level of each objective, and who wins.

    :param cells: one row a cell
    :param factors: one row a configuration
    :param baseline: whose mean final return must be passed
    :param method: who wins if it does; a tie is left out
    """
    import pandas as pd

    names = objectives(factors)
    rows = []
    for configuration, group in cells.groupby("configuration", sort=False):
        a, b = sample(group, baseline, FINAL), sample(group, method, FINAL)
        if len(a) and len(b) and a.mean() != b.mean():
            levels = {name: factors.loc[configuration].get(name) for name in names}
            rows.append({"env": group["env"].iloc[0], **levels, "won": bool(b.mean() > a.mean())})
    return pd.DataFrame(rows, columns=["env", *names, "won"], dtype=object)


def objectives(factors: pd.DataFrame) -> list[str]:
    """Columns that hold a level of a range, or nothing, in every configuration, and not the same
    in all of them.
    """
    return [
        name
        for name in factors.columns
        if name not in ("env", "variant")
        and len({level_of(value) for value in factors[name]}) > 1
        and all(level_of(value) is not None for value in factors[name])
    ]


def level_of(value: object) -> int | str | None:
    """A level as it stands in a table, ``NA`` for an absent objective, None for anything else."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ABSENT
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return int(value) if value in LEVELS else None


def win_table(wins: pd.DataFrame) -> pd.DataFrame:
    """Win rates by objective and level, with Fisher's test of active against absent.

    :param wins: of one env, one row a configuration
    :return: one row an objective; for each level and NA a (wins, n) pair
    """
    import pandas as pd

    rows = []
    for name in [column for column in wins.columns if column not in ("env", "won")]:
        levels = wins[name].map(level_of)
        counts = {level: _count(wins[levels == level]) for level in (*LEVELS, ABSENT)}
        active = _count(wins[levels != ABSENT])
        absent = counts[ABSENT]
        p = fisher([active[0], absent[0]], [active[1], absent[1]])
        rows.append({"objective": name, **counts, "active": active, "fisher": p})
    return pd.DataFrame(rows)


def _count(wins: pd.DataFrame) -> tuple[int, int]:
    return int(wins["won"].sum()), len(wins)


def win_cell(count: tuple[int, int]) -> str:
    """A cell of the win tables: "73 % (11), 43 to 90"; a dash where there is nothing."""
    if count[1] == 0:
        return "– (0)"
    share = wilson(*count)
    ends = f"{100 * share.low:.0f} to {100 * share.high:.0f}"
    return f"{100 * share.share:.0f} % ({count[1]}), {ends}"


def objective_pairs(wins: pd.DataFrame) -> pd.DataFrame:
    """Wins where two objectives are active together: one row a pair.

    :param wins: of one env, one row a configuration
    """
    import pandas as pd

    names = [column for column in wins.columns if column not in ("env", "won")]
    rows = []
    for first, second in combinations(names, 2):
        both = (wins[first].map(level_of) != ABSENT) & (wins[second].map(level_of) != ABSENT)
        count = _count(wins[both])
        rows.append({"first": first, "second": second, "wins": count[0], "n": count[1]})
    return pd.DataFrame(rows, columns=["first", "second", "wins", "n"])


def table_4(table: pd.DataFrame, families: pd.Series) -> pd.DataFrame:
    """SPC by family and overall: mean with interval, median, interquartile mean with interval.

    :param table: of :func:`table_1`
    :param families: the family of each of its rows
    """
    import pandas as pd

    groups = [(name, table[families == name]) for name in dict.fromkeys(families)]
    rows = []
    for name, group in [*groups, ("overall", table)]:
        values = group["spc"].to_numpy(dtype=float)
        mean = mean_interval(values) if len(values) > 1 else None
        middle = iqm([values]) if len(values) > 1 else None
        rows.append(
            {
                "family": name,
                "n": len(values),
                "mean": values.mean(),
                "low": mean.low if mean else math.nan,
                "high": mean.high if mean else math.nan,
                "median": float(np.median(values)),
                "iqm": middle.value if middle else math.nan,
                "iqm_low": middle.low if middle else math.nan,
                "iqm_high": middle.high if middle else math.nan,
                "signs_differ": int(group["signs_differ"].sum()),
            }
        )
    return pd.DataFrame(rows)


def scaling(table: pd.DataFrame, what: str, y: str = "spc") -> Scaling | None:
    """SPC against one measure of conflict; None for fewer than three different values.

    :param table: of :func:`table_1` or :func:`paper_table_1`, with the column
    :param what: ``conflict_count``, ``conflict_rate`` or ``components``
    :param y: the column of the change
    """
    both = table[[what, y]].dropna()
    if len(both) < 3 or both[what].nunique() < 2 or both[y].nunique() < 2:
        return None
    x, change = both[what].to_numpy(dtype=float), both[y].to_numpy(dtype=float)
    return Scaling(what, x, change, spearman(x, change), line(x, change))
