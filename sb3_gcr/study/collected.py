"""What lies in a study's folder: the manifest, the results of its cells, and the failed cells."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sb3_gcr.study.store import MANIFEST, Record, collect

#: What makes a configuration: all of a cell but method and seed.
PARTS = ("env", "env_kwargs", "components", "residual", "settings", "timesteps")


class Failure(NamedTuple):
    """A cell that ended with an error, as often as it was tried."""

    id: str
    method: str
    seed: int
    env: str
    attempts: int
    error: str
    log_tail: str


class Collected(NamedTuple):
    """Everything that a report is made of.

    :param name: of the study
    :param manifest: ``study.yml`` as it was parsed
    :param results: one ``result.json`` a finished cell, in the manifest's order of tasks, methods
        and seeds
    :param failures: failed cells, in that order too
    :param n_cells: how many cells the manifest has; None where it does not say
    """

    name: str
    manifest: Record
    results: Sequence[Record]
    failures: Sequence[Failure]
    n_cells: int | None

    @property
    def is_interim(self) -> bool:
        """Whether cells are still to come."""
        return self.n_cells is not None and self.n_ended < self.n_cells

    @property
    def n_ended(self) -> int:
        """Cells that are done or have failed."""
        return len(self.results) + len(self.failures)


def collected(folder: str | Path) -> Collected:
    """Read a study's folder and change nothing.

    :param folder: with ``study.yml`` and ``cells/<id>/result.json`` or ``error.json``
    :raises FileNotFoundError: if there is no ``study.yml``
    :raises ImportError: if PyYAML is missing
    """
    try:
        import yaml
    except ImportError as error:
        raise ImportError("Studies need PyYAML: pip install 'sb3_gcr[study]'") from error
    path = Path(folder) / MANIFEST
    if not path.exists():
        raise FileNotFoundError(
            f"Parameter `folder` must contain '{MANIFEST}', found none in '{folder}'. "
            "Give the folder that `sb3-gcr-study compare --out` or `sb3-gcr-study run` wrote."
        )
    manifest = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    found = collect(folder)
    results = _ordered(found.results, manifest)
    failures = [_failure(error) for error in _ordered(found.errors, manifest)]
    name = str(manifest.get("name") or path.resolve().parent.name)
    return Collected(name, manifest, results, failures, manifest.get("n_cells"))


def configuration_key(cell: Record) -> str:
    """What a cell shares with those that it is compared with.

    :param cell: of a result, or a task of a manifest
    """
    return json.dumps({part: cell.get(part) or None for part in PARTS}, sort_keys=True)


def _ordered(records: Sequence[Record], manifest: Record) -> list[Record]:
    """In the order of tasks, methods and seeds; what the manifest does not name comes last."""
    tasks = [configuration_key(task) for task in manifest.get("tasks") or []]
    methods = [str(name) for name in manifest.get("methods") or []]

    def place(record: Record) -> tuple[int, int, int, str]:
        cell = record["cell"]
        key, method = configuration_key(cell), cell["method"]
        task_place = tasks.index(key) if key in tasks else len(tasks)
        method_place = methods.index(method) if method in methods else len(methods)
        return task_place, method_place, cell["seed"], record["id"]

    return sorted(records, key=place)


def _failure(error: Record) -> Failure:
    cell = error["cell"]
    return Failure(
        error["id"],
        cell["method"],
        cell["seed"],
        cell["env"],
        error["attempts"],
        str(error["error"]),
        str(error.get("log_tail") or ""),
    )
