"""Where cells run: in processes of this machine, or on a Ray cluster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import IO, Any, NamedTuple, Protocol

from sb3_gcr.study.manifest import Cell
from sb3_gcr.study.store import LOG, Store

#: Runs one cell, whose request comes through stdin.
COMMAND = (sys.executable, "-m", "sb3_gcr.study.process")


class Ended(NamedTuple):
    """How a cell ended.

    :param error: one line, or None where it has its result
    """

    error: str | None


class Engine(Protocol):
    """Starts cells and says when they have ended."""

    def start(self, cell: Cell) -> Any:
        """Begin a cell; returns a handle."""

    def poll(self, handle: Any) -> Ended | None:
        """How the cell ended; None while it runs."""

    def kill(self, handle: Any) -> None:
        """End the cell now."""


class LocalEngine:
    """A process a cell, which ends with the runner.

    :param store: where the cells write
    :param threads: of each cell
    :param command: that runs a cell
    """

    def __init__(self, store: Store, threads: int = 1, command: Sequence[str] = COMMAND):
        self.store, self.threads, self.command = store, threads, list(command)

    def start(self, cell: Cell) -> tuple[Cell, subprocess.Popen[str]]:
        """Begin a cell in a new process.

        :param cell: to run
        """
        request = {
            "id": cell.id,
            "cell": cell.canonical(),
            "folder": str(self.store.folder.resolve()),
            "threads": self.threads,
        }
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        environment = {**os.environ, **dict.fromkeys(names, str(self.threads))}
        with self.store.path(cell.id, LOG).open("a", encoding="utf-8") as log:
            log.write(f"== {time.strftime('%Y-%m-%d %H:%M:%S')} {cell.label}\n")
            log.flush()
            process = subprocess.Popen(
                self.command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
                env=environment,
            )
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended already; `poll` says how
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
        return cell, process

    def poll(self, handle: tuple[Cell, subprocess.Popen[str]]) -> Ended | None:
        """How the process ended; None while it runs.

        :param handle: of :meth:`start`
        """
        cell, process = handle
        code = process.poll()
        if code is None:
            return None
        _close(process.stdin)
        if code == 0 and self.store.is_done(cell.id):
            return Ended(None)
        if code < 0:
            return Ended(f"the process was ended by signal {-code}")
        lines = [line for line in self.store.log_tail(cell.id).splitlines() if line.strip()]
        last = lines[-1] if lines and not lines[-1].startswith("==") else ""
        return Ended(f"exit code {code}: {last}" if last else f"exit code {code}")

    def kill(self, handle: tuple[Cell, subprocess.Popen[str]]) -> None:
        """End the process.

        :param handle: of :meth:`start`
        """
        _, process = handle
        process.kill()
        process.wait()
        _close(process.stdin)


def _close(stream: IO[str] | None) -> None:
    assert stream is not None
    with suppress(BrokenPipeError):
        stream.close()


class RayEngine:
    """A Ray task a cell; results come back to this machine, which writes them.

    :param store: where the results go
    :param threads: of each cell
    :param address: of a cluster, "auto" for the one of this machine, None to start one here
    :param jobs: processors of a cluster that is started here
    :raises ImportError: if Ray is not installed
    """

    def __init__(
        self, store: Store, threads: int = 1, address: str | None = None, jobs: int | None = None
    ):
        try:
            ray: Any = import_module("ray")
        except ImportError as error:
            raise ImportError(
                f"`--engine ray` needs Ray: pip install 'sb3_gcr[ray]' ({error})"
            ) from error
        self._ray, self.store = ray, store
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        environment: dict[str, Any] = {"env_vars": dict.fromkeys(names, str(threads))}
        started_here: dict[str, int] = {} if address else {"num_cpus": (jobs or 1) * threads}
        if not address:  # modules beside the command are importable there too
            environment["env_vars"]["PYTHONPATH"] = os.pathsep.join([os.getcwd(), *sys.path])
        ray.init(
            address=address,
            runtime_env=environment,
            include_dashboard=False if not address else None,
            log_to_driver=False,
            ignore_reinit_error=True,
            **started_here,
        )
        remote = ray.remote(num_cpus=threads, max_retries=0, max_calls=1)
        self._task = remote(_run_remotely)
        self._threads = threads

    def start(self, cell: Cell) -> tuple[Cell, Any]:
        """Hand a cell to the cluster.

        :param cell: to run
        """
        return cell, self._task.remote(cell.canonical(), self._threads)

    def poll(self, handle: tuple[Cell, Any]) -> Ended | None:
        """Write the result where the task has ended; None while it runs.

        :param handle: of :meth:`start`
        """
        cell, reference = handle
        ready, _ = self._ray.wait([reference], timeout=0)
        if not ready:
            return None
        try:
            result = self._ray.get(reference)
        except Exception as error:  # of the cell, whatever it was, or of its worker
            log = self.store.path(cell.id, LOG)
            with log.open("a", encoding="utf-8") as file:
                file.write(f"{error}\n")
            lines = [line for line in str(error).splitlines() if line.strip()]
            return Ended(f"{type(error).__name__}: {lines[-1] if lines else ''}")
        self.store.write_result(cell.id, result)
        return Ended(None)

    def kill(self, handle: tuple[Cell, Any]) -> None:
        """End the task's worker.

        :param handle: of :meth:`start`
        """
        self._ray.cancel(handle[1], force=True)


def _run_remotely(cell: dict[str, Any], threads: int) -> dict[str, Any]:
    from sb3_gcr.study.cells import run_cell

    return run_cell(cell, threads)
