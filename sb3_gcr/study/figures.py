"""The pictures of a comparison; each function makes one figure and writes nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_gcr.study.contrasts import MARGIN, Contrast
from sb3_gcr.study.drawing import COLOURS, INK, blank, curve_axes, house_style, looks
from sb3_gcr.study.statistics import mean_interval
from sb3_gcr.study.words import called, number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Band(NamedTuple):
    """Mean and interval over seeds, window by window; NaN where there is none."""

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def band(curves: pd.DataFrame, column: str) -> Band:
    """The mean of the seeds with its 95 % interval (Student) in each window.

    :param curves: of one method on one configuration, one row a window of a cell
    :param column: whose mean
    """
    steps, means, lows, highs = [], [], [], []
    for step, group in curves.groupby("step"):
        values = group[column].dropna().to_numpy(dtype=float)
        low = high = math.nan
        if len(values) >= 2:
            interval = mean_interval(values)
            low, high = interval.low, interval.high
        steps.append(step)
        means.append(values.mean() if len(values) else math.nan)
        lows.append(low)
        highs.append(high)
    return Band(*(np.array(column, dtype=float) for column in (steps, means, lows, highs)))


def learning_curves(
    curves: pd.DataFrame,
    methods: Sequence[str],
    column: str = "return",
    ylabel: str = "return per episode",
    size: tuple[float, float] = (5.2, 3.3),
    title: str = "",
) -> Figure:
    """One thick line a method, its interval, and a thin line for each seed.

    :param curves: of one configuration, one row a window of a cell
    :param methods: in the order of the study; those without a value are left out
    :param column: what is drawn
    :param ylabel: its name
    :param size: of the figure in inches
    :param title: above the axes
    """
    with house_style():
        figure, axis = curve_axes(*size)
        for name, (colour, dash) in looks(methods).items():
            own = curves[curves["method"] == name].dropna(subset=[column])
            if own.empty:
                continue
            for _, seed in own.groupby("seed"):
                axis.plot(seed["step"], seed[column], color=colour, lw=0.6, alpha=0.45)
            line = band(own, column)
            axis.fill_between(line.steps, line.low, line.high, color=colour, alpha=0.2, lw=0)
            axis.plot(line.steps, line.mean, dash, color=colour, lw=2.0, label=called(name))
        axis.set(ylabel=ylabel, title=title)
        _steps_axis(axis)
        handles, labels = axis.get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="upper left", ncols=min(4, len(labels)))
    return figure


def _steps_axis(axis: Axes) -> None:
    from matplotlib.ticker import EngFormatter

    axis.set_xlabel("env steps")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))


def _legend(axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    if handles:
        axis.figure.legend(handles, labels, loc="outside upper left", ncols=min(4, len(labels)))


def term_bars(terms: pd.DataFrame, methods: Sequence[str], column: str = "final") -> Figure:
    """One row a term with a scale of its own, one bar a method with its 95 % interval.

    :param terms: of one configuration, one row a term of a cell
    :param methods: in the order of the study
    :param column: what is drawn, ``final`` or ``training``
    """
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(terms["term"]))
    levels = terms.dropna(subset=["level"]).groupby("term")["level"].max()
    names.sort(key=lambda name: levels.get(name, math.inf))
    with house_style():
        height = len(names) * (0.28 + 0.15 * len(methods)) + 0.4
        figure = Figure(figsize=(5.2, height), layout="constrained")
        axes = figure.subplots(len(names), 1, squeeze=False)[:, 0]
        for axis, term in zip(axes, names, strict=True):
            _bars(axis, terms[terms["term"] == term], methods, column)
            axis.set_yticks([])
            axis.set_ylabel(
                _term_label(term, levels.get(term)), rotation=0, ha="right", va="center"
            )
            axis.tick_params(labelsize=7.5)
            axis.grid(True, axis="x")
            axis.set_axisbelow(True)
            axis.margins(x=0.08)
        _legend(axes[0])
    return figure


def _term_label(term: str, level: float | None) -> str:
    kind = (
        ""
        if level is None
        else {0: "\ntask", 1: "\nregulariser"}.get(int(level), f"\nlevel {level:.0f}")
    )
    return f"{_broken(term)}{kind}"


def _broken(name: str, width: int = 16) -> str:
    """A long name on two lines, cut at an underscore."""
    if len(name) <= width or "_" not in name:
        return name
    cuts = [i for i, letter in enumerate(name) if letter == "_"]
    cut = min(cuts, key=lambda i: abs(i - len(name) / 2))
    return f"{name[: cut + 1]}\n{name[cut + 1 :]}"


def _bars(axis: Axes, terms: pd.DataFrame, methods: Sequence[str], column: str) -> None:
    for place, (name, (colour, _)) in enumerate(looks(methods).items()):
        values = terms[terms["method"] == name][column].dropna().to_numpy(dtype=float)
        if not len(values):
            continue
        axis.barh(-place, values.mean(), height=0.8, color=colour, label=called(name))
        if len(values) >= 2:
            interval = mean_interval(values)
            axis.plot([interval.low, interval.high], [-place, -place], color=INK, lw=1.0)
    axis.axvline(0.0, color=INK, lw=0.7)


def forest(contrasts: Sequence[Contrast], labels: Sequence[str]) -> Figure:
    """One row a contrast: the difference in per cent, its interval, and the margin as a band.

    :param contrasts: those that are no share are left out
    :param labels: one a contrast
    """
    with house_style():
        shown = [(one, text) for one, text in zip(contrasts, labels, strict=True) if one.relative]
        figure, axis = blank(5.2, 0.34 * len(shown) + 0.75)
        axis.axvspan(-100 * MARGIN, 100 * MARGIN, color=COLOURS[0], alpha=0.2, lw=0)
        axis.axvline(0.0, color=INK, lw=0.7)
        for place, (one, _) in enumerate(shown):
            colour = looks([one.method])[one.method][0]
            if one.has_interval:
                axis.plot([100 * one.low, 100 * one.high], [-place, -place], color=colour, lw=2.0)
            axis.plot([100 * one.estimate], [-place], "o", color=colour, ms=6)
        axis.set_yticks([-place for place in range(len(shown))], [text for _, text in shown])
        axis.set_ylim(0.6 - len(shown), 0.6)
        axis.set_xlabel("difference in %, with 95 % interval")
    return figure


def cosine_matrix(names: Sequence[str], matrix: np.ndarray, title: str) -> Figure:
    """Cosines between the gradients of the terms; red pairs fight, blue pairs agree.

    :param names: of the K terms
    :param matrix: shape (K, K), NaN where there is nothing
    :param title: above it
    """
    with house_style():
        n = len(names)
        side = max(3.6, 0.42 * n + 1.8)
        figure, axis = blank(side + 0.7, side)
        axis.grid(False)
        image = axis.imshow(matrix, cmap="RdBu", vmin=-1, vmax=1)
        axis.set_title(title)
        axis.set_xticks(range(n), names, rotation=45, ha="right")
        axis.set_yticks(range(n), names)
        for i in range(n):
            for j in range(n):
                _write(axis, j, i, matrix[i, j])
        figure.colorbar(image, ax=axis, label="cosine between gradients", shrink=0.8)
    return figure


def _write(axis: Axes, x: int, y: int, cosine: float) -> None:
    """A cell's number, readable on its colour."""
    if math.isnan(cosine):
        return
    colour = "#ffffff" if abs(cosine) > 0.6 else "#000000"
    axis.text(x, y, f"{cosine:.2f}", ha="center", va="center", color=colour, fontsize=7.5)


def pair_bars(pairs: pd.DataFrame, most: int = 12) -> Figure:
    """The most opposed pairs: their cosine at the end of training, a ring at the start.

    :param pairs: the table of pairs, in its order
    :param most: how many are drawn
    """
    with house_style():
        top = pairs.head(most)
        figure, axis = blank(5.2, 0.26 * len(top) + 0.75)
        for place, row in enumerate(top.itertuples()):
            colour = "#c8452f" if row.last < 0 else COLOURS[1]
            axis.barh(-place, row.last, height=0.7, color=colour)
            axis.plot([row.first], [-place], "o", mfc="none", mec=INK, ms=5)
        axis.axvline(0.0, color=INK, lw=0.7)
        axis.set_yticks([-place for place in range(len(top))], list(top["pair"]))
        axis.set_xlabel("cosine at the end (ring: at first)")
    return figure


def runtime_bars(runtime: pd.DataFrame, methods: Sequence[str]) -> Figure:
    """Collection and update of each method, stacked, in seconds for 100,000 steps.

    :param runtime: of one configuration, one row a method
    :param methods: in the order of the study
    """
    with house_style():
        rows = runtime.set_index("method")
        shown = [name for name in methods if name in rows.index]
        figure, axis = blank(5.2, 0.34 * len(shown) + 0.85)
        places = [-place for place in range(len(shown))]
        collect = rows.loc[shown, "collect"].fillna(0.0).to_numpy()
        update = rows.loc[shown, "update"].fillna(0.0).to_numpy()
        axis.barh(places, collect, height=0.65, color=COLOURS[0], label="collection")
        axis.barh(places, update, left=collect, height=0.65, color=COLOURS[2], label="update")
        for place, total in zip(places, collect + update, strict=True):
            axis.text(total, place, f" {number(total)}", va="center")
        axis.set_yticks(places, [called(name) for name in shown])
        axis.set_xlabel("seconds for 100,000 steps, mean of the cells")
        axis.margins(x=0.1)
        _legend(axis)
    return figure
