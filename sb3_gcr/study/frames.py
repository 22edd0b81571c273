"""From results to frames: one row a cell, a term of a cell, or a window of a cell's training."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from sb3_gcr.study.collected import configuration_key
from sb3_gcr.study.store import Record

if TYPE_CHECKING:
    import pandas as pd

#: The scalars of a result, which become columns.
SCALARS = (
    "return_training",
    "return_final",
    "return_final_std",
    "random_return",
    "conflict_count",
    "conflict_rate",
    "failed_share",
    "dominance_share",
    "steps",
    "wall_s",
    "cpu_s",
    "collect_s",
    "update_s",
    "memory_mb",
)
KEYS = ("id", "configuration", "method", "seed")


class Frames(NamedTuple):
    """The results of a study as frames; numbers that a cell does not have are NaN.

    :param cells: one row a cell: id, configuration, method, seed, env, timesteps, the scalars,
        digest, git, dirty
    :param terms: one row a term of a cell: level, return over training, return at the end
    :param curves: one row a window of a cell: step, return, conflicts, conflict_rate
    :param term_curves: one row a term in a window of a cell: step, return, weight
    :param factors: one row a configuration: its env, its variant, which is that in which its
        settings differ from those of others, and one column for each keyword of an env
    """

    cells: pd.DataFrame
    terms: pd.DataFrame
    curves: pd.DataFrame
    term_curves: pd.DataFrame
    factors: pd.DataFrame


def frames(results: Sequence[Record], tasks: Sequence[Record] = ()) -> Frames:
    """The results as frames, in the order of the results.

    :param results: contents of ``result.json``
    :param tasks: of the manifest, whose names the configurations bear
    :raises ImportError: if pandas is missing
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError("Reports need pandas: pip install 'sb3_gcr[study]'") from error
    all_cells = [result["cell"] for result in results]
    names = labels(all_cells, tasks)
    varied = _varied(all_cells)
    cells: list[dict[str, Any]] = []
    terms: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    term_curves: list[dict[str, Any]] = []
    factors: dict[str, dict[str, Any]] = {}
    for result, name in zip(results, names, strict=True):
        cell = result["cell"]
        key = {
            "id": result["id"],
            "configuration": name,
            "method": cell["method"],
            "seed": cell["seed"],
        }
        factors[name] = {
            "env": cell["env"],
            "variant": _variant(cell, varied),
            **(cell.get("env_kwargs") or {}),
        }
        cells.append(key | _cell(result))
        terms += [key | row for row in _terms(result)]
        curves += [key | row for row in _windows(result)]
        term_curves += [key | row for row in _term_windows(result)]
    cell_columns = [*KEYS, "env", "timesteps", *SCALARS, "digest", "git", "dirty"]
    numbers = dict.fromkeys(SCALARS, float)
    return Frames(
        pd.DataFrame(cells, columns=cell_columns).astype(numbers),
        pd.DataFrame(terms, columns=[*KEYS, "term", "level", "training", "final"]).astype(
            {"training": float, "final": float}
        ),
        pd.DataFrame(
            curves, columns=[*KEYS, "step", "return", "conflicts", "conflict_rate"]
        ).astype({"return": float, "conflicts": float, "conflict_rate": float}),
        pd.DataFrame(term_curves, columns=[*KEYS, "term", "step", "return", "weight"]).astype(
            {"return": float, "weight": float}
        ),
        pd.DataFrame.from_dict(factors, orient="index", dtype=object),
    )


def labels(cells: Sequence[Record], tasks: Sequence[Record]) -> list[str]:
    """The configuration's name of each cell: that of the manifest's task, else the env and that
    in which configurations differ.

    :param cells: of the results
    :param tasks: of the manifest
    """
    named = {configuration_key(task): str(task["name"]) for task in tasks if task.get("name")}
    varied = _varied(cells)
    return [named.get(configuration_key(cell)) or _described(cell, varied) for cell in cells]


def _varied(cells: Sequence[Record]) -> list[str]:
    """Keywords and settings that do not have the same value in all cells."""
    flat = [_flat(cell) for cell in cells]
    keys = sorted({key for one in flat for key in one})
    return [key for key in keys if len({json.dumps(one.get(key)) for one in flat}) > 1]


def _flat(cell: Record) -> dict[str, Any]:
    own = {"timesteps": cell["timesteps"]}
    return own | dict(cell.get("settings") or {}) | dict(cell.get("env_kwargs") or {})


def _described(cell: Record, varied: Sequence[str]) -> str:
    flat = _flat(cell)
    words = [f"{key}={flat[key]}" for key in varied if flat.get(key) is not None]
    return " ".join([cell["env"], *words])


def _variant(cell: Record, varied: Sequence[str]) -> str:
    """Settings and steps in which configurations differ; their keywords are no part of it."""
    own = {"timesteps": cell["timesteps"], **(cell.get("settings") or {})}
    return " ".join(f"{key}={own[key]}" for key in varied if key in own)


def short(configuration: str) -> str:
    """A configuration's name without namespace and version, for axes and heads."""
    env, *words = configuration.split(" ")
    name = env.rsplit("/", 1)[-1].rsplit(":", 1)[-1]
    stem, _, version = name.rpartition("-v")
    return " ".join([stem if version.isdigit() else name, *words])


def _cell(result: Record) -> dict[str, Any]:
    provenance = result.get("provenance") or {}
    scalars = {name: result["scalars"].get(name) for name in SCALARS}
    return {
        "env": result["cell"]["env"],
        "timesteps": result["cell"]["timesteps"],
        **scalars,
        "digest": provenance.get("digest"),
        "git": provenance.get("git"),
        "dirty": bool(provenance.get("dirty")),
    }


def _terms(result: Record) -> list[dict[str, Any]]:
    final = result.get("final_terms") or {}
    curves = (result.get("curves") or {}).get("terms") or {}
    levels = result.get("levels") or {}
    names = list(final) or list(curves)
    rows = []
    for name in names:
        windows = [value for value in curves.get(name, []) if value is not None]
        training = sum(windows) / len(windows) if windows else None
        rows.append(
            {
                "term": name,
                "level": levels.get(name),
                "training": training,
                "final": final.get(name),
            }
        )
    return rows


def _windows(result: Record) -> list[dict[str, Any]]:
    curves = result.get("curves") or {}
    steps = curves.get("steps") or []
    columns = {key: _column(curves.get(key), steps) for key in ("conflicts", "conflict_rate")}
    returns = _column(curves.get("return"), steps)
    return [
        {
            "step": step,
            "return": returns[i],
            "conflicts": columns["conflicts"][i],
            "conflict_rate": columns["conflict_rate"][i],
        }
        for i, step in enumerate(steps)
    ]


def _term_windows(result: Record) -> list[dict[str, Any]]:
    curves = result.get("curves") or {}
    steps = curves.get("steps") or []
    rows = []
    for name, values in (curves.get("terms") or {}).items():
        returns = _column(values, steps)
        weights = _column((curves.get("weights") or {}).get(name), steps)
        rows += [
            {"term": name, "step": step, "return": returns[i], "weight": weights[i]}
            for i, step in enumerate(steps)
        ]
    return rows


def _column(values: Sequence[float | None] | None, steps: Sequence[int]) -> Sequence[float | None]:
    """Nothing stands for a curve that the cell does not have."""
    return values if values else [None] * len(steps)
