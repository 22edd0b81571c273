"""What an update shows to people: a table, the cosine matrix as file and as picture."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.rewards.spec import RewardSpec, level_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: File in the logger's folder with one row of cosines per update.
COSINES_FILE = "cosines.csv"


def component_table(spec: RewardSpec, values: Mapping[str, Any]) -> str:
    """The table per component that goes to the terminal beside SB3's.

    :param spec: names and levels
    :param values: logged values by key; missing ones stay blank
    """
    columns = {
        "return": "rollout/ep_rew",
        "weight": "gcr/weight",
        "in conflict": "gcr/in_conflict",
        "gradient norm": "gcr/grad_norm",
        "explained var.": "train/explained_variance",
    }
    rows = [["component", "level", *columns]]
    for name, level in spec:
        cells = [values.get(f"{key}/{name}") for key in columns.values()]
        rows.append(
            [name, level_label(level), *("" if cell is None else f"{cell:.3g}" for cell in cells)]
        )
    return format_table(rows)


def format_table(rows: Sequence[Sequence[str]]) -> str:
    """Plain-text table: the first row is the head, the first two columns are words, the others
    numbers.

    :param rows: cells, every row of the same length
    """
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "| "
        + " | ".join(
            c.ljust(w) if i < 2 else c.rjust(w)
            for i, (c, w) in enumerate(zip(row, widths, strict=True))
        )
        + " |"
        for row in rows
    ]
    rule = "-" * len(lines[0])
    return "\n".join([rule, lines[0], rule, *lines[1:], rule])


def append_cosines(
    folder: str, spec: RewardSpec, timestep: int, matrix: NDArray[np.float64]
) -> None:
    """Add one row, the cosines of all pairs, to the CSV file ``cosines.csv``.

    :param folder: where the file is or will be
    :param spec: names the components
    :param timestep: first column
    :param matrix: shape (K, K)
    """
    path = Path(folder) / COSINES_FILE
    pairs = [(i, j) for i in range(len(spec)) for j in range(i + 1, len(spec))]
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if is_new:
            writer.writerow(
                ["time/total_timesteps", *(f"{spec.names[i]} | {spec.names[j]}" for i, j in pairs)]
            )
        writer.writerow([timestep, *(f"{matrix[i, j]:.6g}" for i, j in pairs)])


def cosine_figure(spec: RewardSpec, matrices: Mapping[str, NDArray[np.float64]]) -> Figure:
    """Cosine matrices side by side; red pairs fight, blue pairs agree.

    :param spec: names the components
    :param matrices: matrices of shape (K, K) by title
    :raises ImportError: if matplotlib is missing
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("Pictures need matplotlib: pip install 'sb3_gcr[plots]'") from error
    n = len(spec)
    side = max(3.2, 0.55 * n + 1.6)
    figure = Figure(figsize=(side * len(matrices) + 0.8, side), layout="constrained")
    axes = figure.subplots(1, len(matrices), squeeze=False)[0]
    for axis, (title, matrix) in zip(axes, matrices.items(), strict=True):
        image = axis.imshow(matrix, cmap="RdBu", vmin=-1, vmax=1)
        axis.set_title(title)
        axis.set_xticks(range(n), spec.names, rotation=45, ha="right")
        axis.set_yticks(range(n), spec.names)
        for i in range(n):
            for j in range(n):
                colour = "white" if abs(matrix[i, j]) > 0.6 else "black"
                axis.text(
                    j, i, f"{matrix[i, j]:.2f}", ha="center", va="center", color=colour, fontsize=8
                )
    figure.colorbar(image, ax=list(axes), label="cosine between gradients", shrink=0.8)
    return figure
