"""What a run leaves behind: a table for people, a file for the next run."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch as th

from benchmarks.measuring import UNITS, Row

PACKAGES = (
    "sb3_gcr",
    "torch",
    "stable_baselines3",
    "sb3_contrib",
    "numpy",
    "gymnasium",
    "mujoco",
    "envpool",
    "torchjd",
    "sbx-rl",
    "jax",
    "jaxlib",
)
#: Columns of the table that hold words.
WORDS = 4
EXPLANATION = (
    "ratio: time or memory of the row over that of what it is compared with, below 1 is cheaper; "
    "median of interleaved pairs, "
    "then their quartiles.\nconflicts: share of component pairs whose gradients point against each "
    "other, half by design."
)


def describe_machine(threads: int) -> dict[str, Any]:
    """Hardware and versions that the figures belong to."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "threads": threads,
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
        "python": platform.python_version(),
        **versions,
    }


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")),
        platform.processor(),
    )


def save(
    path: Path, machine: Mapping[str, Any], rows: Sequence[Row], absent: Sequence[str]
) -> None:
    """Write everything that was measured as JSON.

    :param path: file to write
    :param machine: from :func:`describe_machine`
    :param rows: all rows
    :param absent: one sentence for each reason why rows are missing
    """
    path.write_text(
        json.dumps(
            {"machine": machine, "rows": [asdict(row) for row in rows], "absent": absent}, indent=1
        )
        + "\n"
    )


def load(path: Path) -> tuple[dict[str, Any], list[Row], list[str]]:
    """Read what :func:`save` wrote: machine, rows, reasons why rows are missing."""
    content = json.loads(path.read_text())
    return content["machine"], [Row(**row) for row in content["rows"]], content["absent"]


def table(rows: Sequence[Row], earlier: Sequence[Row] | None = None) -> str:
    """One line per row.

    :param rows: at least one
    :param earlier: rows of another run; adds its ratios and how much each has changed
    """
    head = [
        "group",
        "setting",
        "row",
        "compared with",
        "measured",
        "other",
        "unit",
        "ratio",
        "quartiles",
        "conflicts",
        "bar",
    ]
    if earlier is not None:
        head += ["earlier", "change"]
    before = {row.name: row.ratio for row in earlier or ()}
    lines = [head]
    for row in rows:
        cells = _cells(row)
        if earlier is not None:
            ratio = before.get(row.name)
            cells += (
                ["", ""]
                if ratio is None
                else [f"{ratio:.2f}", f"{100 * (row.ratio / ratio - 1):+.0f} %"]
            )
        lines.append(cells)
    return _aligned(lines)


def _cells(row: Row) -> list[str]:
    low, high = row.quartiles
    return [
        row.group,
        row.setting,
        row.subject,
        row.baseline,
        *(_number(UNITS[row.unit](value)) for value in row.medians),
        row.unit,
        f"{row.ratio:.2f}" if row.ratio > 0.1 else f"{row.ratio:.3f}",
        f"{low:.2f} – {high:.2f}",
        "" if row.conflict_rate is None else f"{100 * row.conflict_rate:.0f} %",
        "" if row.bar is None else f"≤ {row.bar:.2f} {'met' if row.ratio <= row.bar else 'MISSED'}",
    ]


def _number(value: float) -> str:
    """Three digits or more, never an exponent."""
    return f"{value:.{2 if value < 10 else 1 if value < 100 else 0}f}"


def _aligned(lines: Sequence[Sequence[str]]) -> str:
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    aligned = [
        "  ".join(
            c.ljust(w) if i < WORDS else c.rjust(w)
            for i, (c, w) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    ]
    return "\n".join([aligned[0], "-" * len(aligned[0]), *aligned[1:]])
