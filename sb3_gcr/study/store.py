"""A study's folder: who runs which cell, what came out, and what failed.

::

    study.yml                  the manifest, expanded: name, digest, n_cells, tasks, methods, seeds
    cells/<id>/result.json     of a finished cell
    cells/<id>/error.json      of a cell that failed; `attempts` says how often
    cells/<id>/log.txt         what the cell printed, all attempts
    cells/<id>/claim           a runner has the cell; its mtime is the runner's heartbeat

``study.yml`` has ``tasks`` as a list with one entry a configuration (name, env, env_kwargs,
components, residual, settings, timesteps), ``methods`` as a list of names and ``seeds`` as a list,
so that a study has ``len(tasks) * len(methods) * len(seeds)`` cells.

``result.json``, strict JSON (null where a number is missing or not finite)::

    schema        1
    id            12 hex digits
    cell          schema, env, env_kwargs, components, residual, method (its name), algorithm (what
                  the method is), settings (equal for all methods), timesteps, seed
    scalars       return_training    mean of the windows' returns
                  return_final       mean return of the evaluation's deterministic episodes
                  return_final_std   their standard deviation
                  random_return      mean return of episodes of random actions
                  conflict_count     conflicting pairs a minibatch, mean over training
                  conflict_rate      the same as a share of all pairs
                  failed_share       episodes of the evaluation that a termination ended
                  dominance_share    largest component's share of Σ |g_k|, mean over training
                  steps, wall_s, cpu_s, collect_s, update_s, evaluate_s, memory_mb
    final_terms   mean return of each term in the evaluation, by name
    curves        50 windows of equal length: steps (the end of each), return, terms (by name),
                  conflicts, conflict_rate, weights (by name; of the terms, as the update had them)
    levels        level of each term that the update used, by name
    cosines       names, first and last tenth of the updates (K, K), kind "minibatch"
    provenance    git, dirty, digest, versions, cpu, threads, started, finished

A window in which no episode ended repeats the one before it; before the first end it is null. A
cell on the summed reward has the terms' returns and the env's levels, but no conflicts, weights and
cosines: null.

``error.json``: id, cell, attempts, error (one line), log_tail.
"""

from __future__ import annotations

import json
import math
import os
import socket
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

#: Version of ``result.json``.
SCHEMA = 1
#: A runner touches its claims every so many seconds.
HEARTBEAT = 5.0
#: A claim that nobody has touched for so many seconds belongs to a runner that is gone.
STALE = 30.0
#: How often a cell is tried before it counts as failed.
ATTEMPTS = 2
#: Lines of the log that an error keeps.
TAIL = 30

RESULT = "result.json"
ERROR = "error.json"
CLAIM = "claim"
LOG = "log.txt"
MANIFEST = "study.yml"

Record = Mapping[str, Any]


class Collected(NamedTuple):
    """What a folder holds.

    :param results: contents of ``result.json``, in the order of the ids
    :param errors: contents of ``error.json`` of the cells that have failed for good
    """

    results: Sequence[Record]
    errors: Sequence[Record]


class Claim:
    """A runner's right to run a cell, as long as it keeps touching it.

    :param path: the file
    :param token: its content, which no other claim has
    """

    def __init__(self, path: Path, token: str):
        self.path = path
        self.token = token

    def touch(self) -> bool:
        """Show that the runner lives; False where another one has taken the cell."""
        try:
            if self.path.read_text(encoding="utf-8") != self.token:
                return False
            os.utime(self.path)
        except FileNotFoundError:
            return False
        return True

    def release(self) -> None:
        """Give the cell back, unless another runner has taken it."""
        if self.touch():
            self.path.unlink(missing_ok=True)


class Store:
    """The cells of a folder.

    :param folder: the study's folder; made where it is missing
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)

    def path(self, cell_id: str, name: str = "") -> Path:
        """A file of a cell, or its folder.

        :param cell_id: 12 hex digits
        :param name: of the file
        """
        return self.folder / "cells" / cell_id / name

    def is_done(self, cell_id: str) -> bool:
        """Whether the cell has a result."""
        return self.path(cell_id, RESULT).exists()

    def has_failed(self, cell_id: str) -> bool:
        """Whether the cell has no result and will not be tried again."""
        return not self.is_done(cell_id) and self.attempts(cell_id) >= ATTEMPTS

    def attempts(self, cell_id: str) -> int:
        """How often the cell has failed."""
        error = _read(self.path(cell_id, ERROR))
        return 0 if error is None else int(error["attempts"])

    def is_claimed(self, cell_id: str) -> bool:
        """Whether a living runner has the cell."""
        age = _age(self.path(cell_id, CLAIM))
        return age is not None and age <= STALE

    def claim(self, cell_id: str) -> Claim | None:
        """Take a cell that has no result and that no living runner has; None where it cannot be.

        :param cell_id: of the cell
        """
        path = self.path(cell_id, CLAIM)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not self.is_claimed(cell_id):
            _take_away(path)
        token = f"{socket.gethostname()} {os.getpid()} {uuid.uuid4().hex}\n"
        claim = _create(path, token)
        if claim is not None and (self.is_done(cell_id) or self.has_failed(cell_id)):
            claim.release()  # another runner ended it since this one looked
            return None
        return claim

    def write_result(self, cell_id: str, result: Record) -> None:
        """Write a result in one piece and forget the errors before it.

        :param cell_id: of the cell
        :param result: as above; numbers that are not finite become null
        """
        _write(self.path(cell_id, RESULT), result)
        self.forget_error(cell_id)

    def write_error(self, cell_id: str, cell: Record, error: str) -> None:
        """Count a failed attempt.

        :param cell_id: of the cell
        :param cell: canonical
        :param error: one line
        """
        record = {
            "id": cell_id,
            "cell": cell,
            "attempts": self.attempts(cell_id) + 1,
            "error": error,
            "log_tail": self.log_tail(cell_id),
        }
        _write(self.path(cell_id, ERROR), record)

    def forget_error(self, cell_id: str) -> None:
        """Let a failed cell be tried again.

        :param cell_id: of the cell
        """
        self.path(cell_id, ERROR).unlink(missing_ok=True)

    def log_tail(self, cell_id: str) -> str:
        """The last lines of the cell's log."""
        path = self.path(cell_id, LOG)
        if not path.exists():
            return ""
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(lines[-TAIL:])


def collect(folder: str | Path) -> Collected:
    """Results and errors of a folder; reads only.

    :param folder: of a study
    :raises FileNotFoundError: if there is no such folder
    """
    store = Store(folder)
    if not store.folder.is_dir():
        raise FileNotFoundError(
            f"Parameter `folder` must be the folder of a study, found none at '{folder}'. "
            "`sb3-gcr-study run` and `compare` make one."
        )
    ids = sorted(path.name for path in store.folder.glob("cells/*"))
    results = [store.path(one, RESULT) for one in ids if store.is_done(one)]
    errors = [store.path(one, ERROR) for one in ids if store.has_failed(one)]
    return Collected(
        [json.loads(path.read_text(encoding="utf-8")) for path in results],
        [json.loads(path.read_text(encoding="utf-8")) for path in errors],
    )


def load_result(store: Store, cell_id: str) -> Record:
    """The result of a cell that is done.

    :param store: the folder
    :param cell_id: of the cell
    """
    record: Record = json.loads(store.path(cell_id, RESULT).read_text(encoding="utf-8"))
    return record


def plain(value: Any) -> Any:
    """The same in JSON's own types; numbers that are not finite become None.

    :param value: of numbers, NumPy's too, words, lists and mappings
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _create(path: Path, token: str) -> Claim | None:
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
    except FileExistsError:
        return None
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(token)
    return Claim(path, token)


def _take_away(path: Path) -> None:
    """Remove a stale claim; of several runners the one whose rename succeeds removes it."""
    try:
        token = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return
    taken = path.with_name(f"{CLAIM}.{uuid.uuid4().hex}")
    try:
        path.rename(taken)
    except FileNotFoundError:
        return
    if taken.read_text(encoding="utf-8") != token:
        _put_back(taken, path)
    taken.unlink()


def _put_back(taken: Path, path: Path) -> None:
    """Another runner was faster and this is its new claim; a link fails where one is there."""
    with suppress(OSError):
        os.link(taken, path)


def _age(path: Path) -> float | None:
    """Seconds since the last heartbeat."""
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return None


def _read(path: Path) -> Record | None:
    try:
        record: Record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    return record


def _write(path: Path, record: Record) -> None:
    """Write a file in one piece: it is there as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(plain(record), indent=1, allow_nan=False, ensure_ascii=False)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    temporary.write_text(text + "\n", encoding="utf-8")
    temporary.replace(path)
