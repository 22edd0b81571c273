"""What a training run looked like: a table per component and three pictures, from the files that
the logger wrote.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_gcr.logs.shown import COSINES_FILE, cosine_figure, format_table
from sb3_gcr.rewards.spec import RewardSpec, level_label

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

STEPS = "time/total_timesteps"


class Report(NamedTuple):
    """The table as text, and the pictures that were written."""

    table: str
    pictures: list[Path]


def write_report(folder: str | Path, spec: RewardSpec) -> Report:
    """Write ``returns.png``, ``cosines.png`` and ``conflicts.png`` beside the log of a run, and
    make its table.

    :param folder: where the logger wrote ``progress.csv`` (``configure(folder, ["csv", ...])``) and
        GCRPPO ``cosines.csv``
    :param spec: ``model.reward_spec``, at least two components
    :raises FileNotFoundError: if the folder has no such files
    :raises ValueError: if the log ends before the first update, or is that of other components
    :raises ImportError: if pandas or matplotlib is missing
    """
    progress, cosines = _read(folder, "progress.csv"), _read(folder, COSINES_FILE)
    missing = [key for name in spec.names if (key := f"gcr/weight/{name}") not in progress]
    if missing:
        raise ValueError(
            "Parameter `folder` must contain the log of at least two rollouts with these "
            "components, "
            f"found none of {missing} in '{folder}/progress.csv'."
        )
    figures = {
        "returns.png": _returns_figure(progress, spec),
        "cosines.png": _cosines_figure(cosines, spec),
        "conflicts.png": _conflicts_figure(progress, spec),
    }
    for name, figure in figures.items():
        figure.savefig(Path(folder) / name, dpi=120)
    return Report(_table(progress, spec), [Path(folder) / name for name in figures])


def _read(folder: str | Path, name: str) -> pd.DataFrame:
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError("Reports need pandas: pip install 'sb3_gcr[plots]'") from error
    path = Path(folder) / name
    if not path.exists():
        raise FileNotFoundError(
            f"Parameter `folder` must contain '{name}', found none in '{folder}'. "
            'Train with `model.set_logger(configure(folder, ["csv", ...]))` for at least one '
            "update."
        )
    return pd.read_csv(path)


def _table(progress: pd.DataFrame, spec: RewardSpec) -> str:
    rows = [
        ["component", "level", "return at start", "return at end", "mean weight", "in conflict"]
    ]
    for name, level in spec:
        returns = progress[f"rollout/ep_rew/{name}"].dropna()
        first, last = (f"{returns.iloc[i]:.1f}" for i in (0, -1)) if len(returns) else ("", "")
        weight, share = (
            progress[f"gcr/weight/{name}"].mean(),
            progress[f"gcr/in_conflict/{name}"].mean(),
        )
        rows.append([name, level_label(level), first, last, f"{weight:.2f}", f"{share:.0%}"])
    return format_table(rows)


def _curves(
    progress: pd.DataFrame,
    spec: RewardSpec,
    key: str,
    total: tuple[str, str],
    labels: dict[str, str],
) -> Figure:
    """One curve per component, regularisers dashed, and a grey one for ``total``, a key and its
    label.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("Pictures need matplotlib: pip install 'sb3_gcr[plots]'") from error
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axis = figure.subplots()
    axis.set(xlabel="env steps", **labels)
    axis.grid(alpha=0.3)
    for name, level in spec:
        style = "-" if level == 0 else "--"
        axis.plot(
            progress[STEPS],
            progress[f"{key}/{name}"],
            style,
            label=f"{name} ({level_label(level)})",
        )
    axis.plot(progress[STEPS], progress[total[0]], "k", alpha=0.4, label=total[1])
    axis.legend()
    return figure


def _returns_figure(progress: pd.DataFrame, spec: RewardSpec) -> Figure:
    labels = {"title": "Return per component", "ylabel": "return per episode"}
    return _curves(progress, spec, "rollout/ep_rew", ("rollout/ep_rew_mean", "sum"), labels)


def _conflicts_figure(progress: pd.DataFrame, spec: RewardSpec) -> Figure:
    labels = {
        "title": "Conflicts between components",
        "ylabel": "share of minibatches in which it conflicts",
    }
    figure = _curves(
        progress, spec, "gcr/in_conflict", ("gcr/conflict_rate", "conflicting pairs"), labels
    )
    figure.axes[0].set_ylim(0, 1.02)
    return figure


def _cosines_figure(cosines: pd.DataFrame, spec: RewardSpec) -> Figure:
    """Mean cosines over the first and the last tenth of the updates."""
    tenth = max(1, len(cosines) // 10)
    matrices = {}
    for when, rows in (("start", cosines.iloc[:tenth]), ("end", cosines.iloc[-tenth:])):
        matrix = np.eye(len(spec))
        matrix[np.triu_indices(len(spec), 1)] = rows.drop(columns=STEPS).mean().to_numpy()
        steps = (
            f"up to {rows[STEPS].iloc[-1]:,}"
            if when == "start"
            else f"from {rows[STEPS].iloc[0]:,}"
        )
        matrices[f"{when} of training\n{steps} steps"] = np.triu(matrix) + np.triu(matrix, 1).T
    return cosine_figure(spec, matrices)
