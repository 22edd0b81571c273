"""What a training run looked like: a table per component and three pictures, from the files that
the logger wrote.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.conflicts.estimators import Estimate
from sb3_gcr.logs.shown import (
    COSINES_FILE,
    UNBIASED_FILE,
    cosine_figure,
    format_table,
    pair_names,
    product_names,
)
from sb3_gcr.rewards.spec import RewardSpec, level_label

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

STEPS = "time/total_timesteps"
#: Updates that an average of unbiased products takes at least, for its error.
FEWEST_UPDATES = 3


class Report(NamedTuple):
    """The table as text, and the pictures that were written."""

    table: str
    pictures: list[Path]


def write_report(folder: str | Path, spec: RewardSpec) -> Report:
    """Write ``returns.png``, ``cosines.png`` and ``conflicts.png`` beside the log of a run, and
    make its table.

    The cosines are those without the noise that gradients of the same samples share, where the log
    has them for at least three updates; the picture says which they are.

    :param folder: where the logger wrote ``progress.csv`` (``configure(folder, ["csv", ...])``) and
        GCRPPO ``cosines.csv`` and ``cosines_unbiased.csv``
    :param spec: ``model.reward_spec``, at least two components
    :raises FileNotFoundError: if the folder has no such files
    :raises ValueError: if the log ends before the first update, or is that of other components
    :raises ImportError: if pandas or matplotlib is missing
    """
    progress = _read(folder, "progress.csv")
    _read(folder, COSINES_FILE)  # named before anything else that may be wrong
    missing = [key for name in spec.names if (key := f"gcr/weight/{name}") not in progress]
    if missing:
        raise ValueError(
            "Parameter `folder` must contain the log of at least two rollouts with these "
            "components, "
            f"found none of {missing} in '{folder}/progress.csv'."
        )
    figures = {
        "returns.png": _returns_figure(progress, spec),
        "cosines.png": _cosines_figure(folder, spec),
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


def _cosines_figure(folder: str | Path, spec: RewardSpec) -> Figure:
    """Cosines over the first and the last tenth of the updates: from products without shared noise
    where these say anything, else within minibatches.
    """
    within = _read(folder, COSINES_FILE)
    _check_cosines(within, COSINES_FILE, pair_names(spec), folder)
    unbiased = _read_unbiased(folder, spec)
    if unbiased is not None:
        estimates = {
            f"{when}\nwithout shared noise": _estimate(rows, spec).cosines
            for when, rows in _tenths(unbiased, FEWEST_UPDATES)
        }
        pairs = np.triu_indices(len(spec), 1)
        if any(np.isfinite(matrix[pairs]).any() for matrix in estimates.values()):
            return cosine_figure(spec, estimates)
    means = {
        f"{when}\nwithin minibatches, noise included": _mean_matrix(rows, spec)
        for when, rows in _tenths(within, 1)
    }
    return cosine_figure(spec, means)


def _check_cosines(rows: pd.DataFrame, name: str, expected: list[str], folder: str | Path) -> None:
    """Refuse the file of other components, or of no update."""
    found = list(rows.columns.drop(STEPS, errors="ignore"))
    if found != expected or not len(rows):
        raise ValueError(
            f"Parameter `folder` must contain a '{name}' with the columns {expected} and at least "
            f"one update, found {found} and {len(rows)} updates in '{folder}'."
        )


def _read_unbiased(folder: str | Path, spec: RewardSpec) -> pd.DataFrame | None:
    """The log of unbiased products; None where it does not have enough updates with some."""
    if not (Path(folder) / UNBIASED_FILE).exists():
        return None
    rows = _read(folder, UNBIASED_FILE)
    if len(rows):
        _check_cosines(rows, UNBIASED_FILE, pair_names(spec) + product_names(spec), folder)
    rows = rows[rows.iloc[:, -1].notna()]
    return rows if len(rows) >= FEWEST_UPDATES else None


def _tenths(rows: pd.DataFrame, fewest: int) -> list[tuple[str, pd.DataFrame]]:
    """The first and the last tenth of the updates with what to call them."""
    tenth = max(fewest, len(rows) // 10)
    first, last = rows.iloc[:tenth], rows.iloc[-tenth:]
    return [
        (f"start, up to {first[STEPS].iloc[-1]:,} steps", first),
        (f"end, from {last[STEPS].iloc[0]:,} steps", last),
    ]


def _mean_matrix(rows: pd.DataFrame, spec: RewardSpec) -> NDArray[np.float64]:
    """Means of the columns of pairs as a matrix with ones on its diagonal."""
    matrix = np.eye(len(spec))
    matrix[np.triu_indices(len(spec), 1)] = rows.drop(columns=STEPS).mean().to_numpy()
    return np.triu(matrix) + np.triu(matrix, 1).T


def _estimate(rows: pd.DataFrame, spec: RewardSpec) -> Estimate:
    """Mean unbiased products over updates, and their errors from their scatter: each update has a
    rollout of its own.
    """
    n_components = len(spec)
    upper = np.triu_indices(n_components)
    products = rows[product_names(spec)].to_numpy()
    gramian, errors = np.zeros((2, n_components, n_components))
    gramian[upper] = products.mean(0)
    errors[upper] = products.std(0, ddof=1) / np.sqrt(len(products))
    gramian = np.triu(gramian) + np.triu(gramian, 1).T
    errors = np.triu(errors) + np.triu(errors, 1).T
    return Estimate(gramian, errors, gramian.diagonal())
