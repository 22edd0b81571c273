"""The paper's pictures beyond curves and matrices: scaling with conflict, and heat maps of wins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sb3_gcr.study.drawing import COLOURS, INK, blank, house_style
from sb3_gcr.study.paper_tables import ABSENT, LEVELS, Scaling

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: What the abscissa of a scaling figure is called.
MEASURES = {
    "conflict_count": "conflicting pairs of terms",
    "conflict_rate": "share of pairs that conflict",
    "components": "number of terms K",
}


def scaling_figure(ours: Scaling | None, theirs: Scaling | None) -> Figure:
    """SPC against a measure of conflict: our configurations, the paper's tasks, and a line each.

    :param ours: from the cells, or None
    :param theirs: from the paper's table, or None
    """
    with house_style():
        figure, axis = blank()
        drawn = [
            (theirs, COLOURS[0], "s", "the paper"),
            (ours, COLOURS[2], "o", "these cells"),
        ]
        for one, colour, marker, name in drawn:
            if one is None:
                continue
            label = f"{name}: ρ = {one.correlation.rho:.2f}, p = {one.correlation.p:.2g}"
            axis.plot(one.x, one.y, marker, color=colour, ms=5, alpha=0.85, label=label)
            ends = np.array([one.x.min(), one.x.max()])
            axis.plot(ends, one.line.intercept + one.line.slope * ends, color=colour, lw=1.2)
            axis.set_xlabel(MEASURES[one.what])
        axis.axhline(0.0, color=INK, lw=0.7)
        axis.set_ylabel("symmetric percentage change")
        handles, labels = axis.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left")
    return figure


def win_heat_map(table: pd.DataFrame) -> Figure:
    """Win rates by objective and level, n in each cell, hatched where there is nothing.

    :param table: of :func:`~sb3_gcr.study.paper_tables.win_table`
    """
    columns = [*LEVELS, ABSENT]
    counts = [[row[level] for level in columns] for _, row in table.iterrows()]
    names = [f"L{level}" if level != ABSENT else ABSENT for level in columns]
    return _heat_map(counts, list(table["objective"]), names)


def pair_heat_map(pairs: pd.DataFrame) -> Figure:
    """Win rates where two objectives are active together, n in each cell.

    :param pairs: of :func:`~sb3_gcr.study.paper_tables.objective_pairs`
    """
    names = list(dict.fromkeys([*pairs["first"], *pairs["second"]]))
    counts: list[list[tuple[int, int] | None]] = [[None] * len(names) for _ in names]
    for row in pairs.itertuples():
        i, j = names.index(row.first), names.index(row.second)
        counts[j][i] = (row.wins, row.n)
    return _heat_map([one[:-1] for one in counts[1:]], names[1:], names[:-1])


def _heat_map(
    counts: Sequence[Sequence[tuple[int, int] | None]], rows: Sequence[str], columns: Sequence[str]
) -> Figure:
    """Shares of wins as colours from 0 to 1; None leaves a cell out."""
    from matplotlib.patches import Rectangle

    shares = np.array(
        [[one[0] / one[1] if one and one[1] else math.nan for one in row] for row in counts]
    )
    with house_style():
        figure, axis = blank(0.62 * len(columns) + 2.0, 0.5 * len(rows) + 1.0)
        axis.grid(False)
        image = axis.imshow(shares, cmap="RdBu", vmin=0, vmax=1, aspect="auto")
        for y, row in enumerate(counts):
            for x, one in enumerate(row):
                if one is None:
                    continue
                if one[1] == 0:
                    axis.add_patch(
                        Rectangle((x - 0.5, y - 0.5), 1, 1, fill=False, hatch="////", ec=COLOURS[0])
                    )
                text = f"{100 * one[0] / one[1]:.0f} %\n({one[1]})" if one[1] else "(0)"
                dark = one[1] > 0 and abs(one[0] / one[1] - 0.5) > 0.3
                colour = INK if one[1] == 0 else "#ffffff" if dark else "#000000"
                axis.text(x, y, text, ha="center", va="center", fontsize=7.5, color=colour)
        axis.set_xticks(range(len(columns)), columns)
        axis.set_yticks(range(len(rows)), rows)
        figure.colorbar(image, ax=axis, label="share of wins")
    return figure
