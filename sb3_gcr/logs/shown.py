"""What an update shows to people: a table, the cosine matrix as file and as picture."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.logger import Figure as Picture
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

from sb3_gcr.conflicts.estimators import Estimate
from sb3_gcr.rewards.spec import RewardSpec, level_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: File in the logger's folder with one row of cosines per update, within its minibatches.
COSINES_FILE = "cosines.csv"
#: The same without the noise that gradients of the same samples share, and the products behind it.
UNBIASED_FILE = "cosines_unbiased.csv"


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
        "explained var.": "gcr/explained_variance",
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


class CosineTable(KVWriter):
    """The files ``cosines.csv`` and ``cosines_unbiased.csv`` beside the other files of a logger:
    one row of cosines per update.

    They begin anew with their logger, as ``progress.csv`` does.

    :param folder: of the logger
    :param spec: names the components
    """

    def __init__(self, folder: str, spec: RewardSpec):
        self.spec = spec
        self._pairs = np.triu_indices(len(spec), 1)
        names = pair_names(spec)
        self._path = Path(folder) / COSINES_FILE
        self._path.unlink(missing_ok=True)
        self._add(self._path, ["time/total_timesteps", *names])
        self._unbiased_path = Path(folder) / UNBIASED_FILE
        self._unbiased_path.unlink(missing_ok=True)
        products = product_names(spec)
        self._add(self._unbiased_path, ["time/total_timesteps", *names, *products])

    @classmethod
    def of(cls, logger: Logger, spec: RewardSpec) -> CosineTable | None:
        """The table of a logger, begun if it has none yet; None for a logger without a folder.

        :param logger: SB3's
        :param spec: names the components
        :raises ValueError: for a logger that another model with other components has used
        """
        folder = logger.get_dir()
        if folder is None:
            return None
        found = [table for table in logger.output_formats if isinstance(table, cls)]
        if not found:
            found = [cls(folder, spec)]
            logger.output_formats.append(found[0])
        if found[0].spec.names != spec.names:
            raise ValueError(
                f"A logger's '{COSINES_FILE}' must have the components of the model, "
                f"{list(spec.names)}, found {list(found[0].spec.names)} in '{folder}'. "
                "Give the model a logger of its own: `model.set_logger(configure(...))`."
            )
        return found[0]

    def append(
        self, timestep: int, matrix: NDArray[np.float64], unbiased: Estimate | None = None
    ) -> None:
        """Add one row to each file, the cosines of all pairs.

        :param timestep: first column
        :param matrix: shape (K, K), within minibatches
        :param unbiased: without shared noise; a pair without a signal stays blank
        """
        self._add(self._path, [timestep, *_cells(matrix[self._pairs])])
        if unbiased is None:
            return
        products = unbiased.gramian[np.triu_indices(len(self.spec))]
        row = [*_cells(unbiased.cosines[self._pairs]), *_cells(products)]
        self._add(self._unbiased_path, [timestep, *row])

    def _add(self, path: Path, row: Sequence[object]) -> None:
        with path.open("a", newline="") as file:
            csv.writer(file).writerow(row)

    def write(
        self,
        key_values: dict[str, Any],
        key_excluded: dict[str, tuple[str, ...]],
        step: int = 0,
    ) -> None:
        """The logger's single numbers are not for this table."""

    def close(self) -> None:
        """Nothing is open between two rows."""


def pair_names(spec: RewardSpec) -> list[str]:
    """Columns of the cosines of all pairs i < j."""
    return [f"{first} | {second}" for first, second in combinations(spec.names, 2)]


def product_names(spec: RewardSpec) -> list[str]:
    """Columns of the products Ĝ_ij, i ≤ j."""
    first, second = np.triu_indices(len(spec))
    return [f"{spec.names[i]} * {spec.names[j]}" for i, j in zip(first, second, strict=True)]


def _cells(numbers: NDArray[np.float64]) -> list[str]:
    """Numbers of a row; NaN is blank."""
    return ["" if np.isnan(number) else f"{number:.6g}" for number in numbers]


def log_cosines(
    logger: Logger,
    spec: RewardSpec,
    timestep: int,
    matrix: NDArray[np.float64],
    unbiased: Estimate,
    as_picture: bool,
) -> None:
    """Write cosine matrices to their files, and to TensorBoard as a picture.

    :param logger: SB3's
    :param spec: names the components
    :param timestep: of the update
    :param matrix: shape (K, K), within minibatches
    :param unbiased: without shared noise
    :param as_picture: whether to draw them
    """
    table = CosineTable.of(logger, spec)
    if table is None:
        return
    table.append(timestep, matrix, unbiased)
    formats = logger.output_formats
    if as_picture and any(isinstance(f, TensorBoardOutputFormat) for f in formats):
        matrices = {
            f"{timestep} steps\nwithout shared noise": unbiased.cosines,
            f"{timestep} steps\nwithin minibatches": matrix,
        }
        figure = Picture(cosine_figure(spec, matrices), close=False)
        logger.record("gcr/cosines", figure, exclude=("stdout", "log", "json", "csv"))


def cosine_figure(spec: RewardSpec, matrices: Mapping[str, NDArray[np.float64]]) -> Figure:
    """Cosine matrices side by side; red pairs fight, blue pairs agree, grey ones have no signal.

    :param spec: names the components
    :param matrices: matrices of shape (K, K) by title, NaN where there is no signal
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
        axis.set_facecolor("#e6e6e6")  # where there is no signal
        image = axis.imshow(matrix, cmap="RdBu", vmin=-1, vmax=1)
        axis.set_title(title)
        axis.set_xticks(range(n), spec.names, rotation=45, ha="right")
        axis.set_yticks(range(n), spec.names)
        for i in range(n):
            for j in range(n):
                colour = "white" if abs(matrix[i, j]) > 0.6 else "black"
                label = "–" if np.isnan(matrix[i, j]) else f"{matrix[i, j]:.2f}"
                axis.text(j, i, label, ha="center", va="center", color=colour, fontsize=8)
    figure.colorbar(image, ax=list(axes), label="cosine between gradients", shrink=0.8)
    return figure
