"""Running the cells of a study: which one next, for how long, and what to do when one fails."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from sb3_gcr.study import store as files
from sb3_gcr.study.costs import Costs
from sb3_gcr.study.engines import Ended, Engine
from sb3_gcr.study.manifest import Cell
from sb3_gcr.study.store import Claim, Store

#: How often a runner looks at its cells, and at those of others [s].
PATIENCE, LONG_PATIENCE = 0.2, 2.0


@dataclass(frozen=True)
class Limits:
    """What a runner may use.

    :param jobs: cells at the same time
    :param threads: of each cell
    :param hours: nothing begins that cannot end within; None for no limit
    :param minutes: after which a cell has failed
    """

    jobs: int = 1
    threads: int = 1
    hours: float | None = None
    minutes: float = 60.0


@dataclass
class Job:
    """A cell that this runner runs.

    :param is_lost: another runner took it over, because this one seemed to be gone
    """

    cell: Cell
    claim: Claim
    handle: Any
    began: float
    is_lost: bool = False


class Progress(NamedTuple):
    """Where a run stands.

    :param seconds_left: until all is done, at the pace so far
    """

    total: int
    done: int
    running: int
    failed: int
    core_hours: float
    seconds_left: float


class Runner:
    """Runs cells block by block until all are done or have failed, or the time is over.

    Several runners can work on one folder. A runner also waits for the cells of others, and takes
    over those of a runner that is gone.

    :param blocks: cells that belong together, in order
    :param store: the folder
    :param engine: starts the cells
    :param limits: what may be used
    :param show: called with the progress whenever it changed
    """

    def __init__(
        self,
        blocks: Sequence[Sequence[Cell]],
        store: Store,
        engine: Engine,
        limits: Limits,
        show: Callable[[Progress], None] = lambda progress: None,
    ):
        self.blocks, self.store, self.engine = blocks, store, engine
        self.limits, self.show = limits, show
        self.cells = [cell for block in blocks for cell in block]
        done = [cell for cell in self.cells if store.is_done(cell.id)]
        self.costs = Costs(files.load_result(store, cell.id) for cell in done)
        self._jobs: list[Job] = []
        self._begun: set[int] = set()
        self._start = time.monotonic()
        self._core_seconds = 0.0
        self._lock = threading.Lock()
        self._stopped = threading.Event()

    def run(self) -> list[Cell]:
        """Run until the end; returns the cells that have failed."""
        heart = threading.Thread(target=self._beat, daemon=True)
        heart.start()
        try:
            while self._step():
                time.sleep(PATIENCE if self._jobs else LONG_PATIENCE)
        finally:
            self._stopped.set()
            heart.join()
            for job in self._jobs:
                self.engine.kill(job.handle)
                job.claim.release()
        return [cell for cell in self.cells if self.store.has_failed(cell.id)]

    def _step(self) -> bool:
        """Look at all cells once; False where nothing is left to do or to wait for."""
        ended = [job for job in self._jobs if self._has_ended(job)]
        if self._jobs and not ended and len(self._jobs) == self.limits.jobs:
            return True
        waiting = self._waiting()
        while len(self._jobs) < self.limits.jobs and self._begin_next(waiting):
            self.show(self._progress())
        if ended:
            self.show(self._progress())
        if self._jobs:
            return True
        return any(self.store.is_claimed(cell.id) and self._has_time(cell) for cell in waiting)

    def _waiting(self) -> list[Cell]:
        """Cells without an end that this runner does not run."""
        mine = {job.cell.id for job in self._jobs}
        return [
            cell
            for cell in self.cells
            if cell.id not in mine
            and not self.store.is_done(cell.id)
            and not self.store.has_failed(cell.id)
        ]

    def _begin_next(self, waiting: Sequence[Cell]) -> bool:
        """Begin the first cell that can be; False where there is none."""
        ids = {cell.id for cell in waiting} - {job.cell.id for job in self._jobs}
        for place, block in enumerate(self.blocks):
            cells = [cell for cell in block if cell.id in ids]
            if not cells or not self._may_begin(place, cells):
                continue
            for cell in cells:
                if self._has_time(cell) and self._begin(cell):
                    self._begun.add(place)
                    return True
        return False

    def _may_begin(self, place: int, cells: Sequence[Cell]) -> bool:
        """A block begins where all of it can end in time."""
        seconds = sum(map(self.costs.seconds, cells)) / self.limits.jobs
        return place in self._begun or self._fits(seconds)

    def _has_time(self, cell: Cell) -> bool:
        return self._fits(self.costs.seconds(cell))

    def _fits(self, seconds: float) -> bool:
        if self.limits.hours is None:
            return True
        return time.monotonic() - self._start + seconds <= 3600 * self.limits.hours

    def _begin(self, cell: Cell) -> bool:
        """Claim and start a cell; False where another runner has or had it."""
        claim = self.store.claim(cell.id)
        if claim is None:
            return False
        job = Job(cell, claim, self.engine.start(cell), time.monotonic())
        with self._lock:
            self._jobs.append(job)
        return True

    def _has_ended(self, job: Job) -> bool:
        """Whether a cell has ended, or was ended now because it hangs or is another runner's."""
        ended = self.engine.poll(job.handle)
        seconds = time.monotonic() - job.began
        if ended is None and seconds > 60 * self.limits.minutes:
            self.engine.kill(job.handle)
            ended = Ended(f"took longer than {self.limits.minutes:g} minutes and was ended")
        if ended is None and not job.is_lost:
            return False
        if ended is None:
            self.engine.kill(job.handle)
        elif ended.error is not None:
            self.store.write_error(job.cell.id, job.cell.canonical(), ended.error)
        else:
            self.costs.add(files.load_result(self.store, job.cell.id))
        self._core_seconds += seconds * self.limits.threads
        with self._lock:
            self._jobs.remove(job)
        job.claim.release()
        return True

    def _beat(self) -> None:
        """Touch the claims, also while the runner waits for something."""
        while not self._stopped.wait(files.HEARTBEAT):
            with self._lock:
                jobs = list(self._jobs)
            for job in jobs:
                job.is_lost = not job.claim.touch()

    def _progress(self) -> Progress:
        failed = sum(self.store.has_failed(cell.id) for cell in self.cells)
        done = sum(self.store.is_done(cell.id) for cell in self.cells)
        left = sum(map(self.costs.seconds, self._waiting()))
        for job in self._jobs:
            spent = time.monotonic() - job.began
            left += max(0.0, self.costs.seconds(job.cell) - spent)
        return Progress(
            total=len(self.cells),
            done=done,
            running=len(self._jobs),
            failed=failed,
            core_hours=self._core_seconds / 3600,
            seconds_left=left / self.limits.jobs,
        )
