"""Interleaved pairs: how a subject and its baseline are measured against each other."""

from __future__ import annotations

import gc
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch as th

#: A row has at least so many pairs, whatever its time budget.
MIN_PAIRS = 5
#: How a measured value (seconds, or bytes) is shown in it.
UNITS: dict[str, Callable[[float], float]] = {
    "ms": lambda seconds: 1e3 * seconds,
    "µs": lambda seconds: 1e6 * seconds,
    "steps/s": lambda seconds: 1 / seconds,
    "MB": lambda size: 1e-6 * size,
}
#: What a row may need, and the sentence that is printed where it is missing.
NEEDS = {
    "sbx": "sbx is not installed: pip install 'sb3_gcr[bench]'.",
    "torchjd": "TorchJD is not installed: pip install 'sb3_gcr[torchjd]'.",
    "envpool": "EnvPool is not installed: pip install 'sb3_gcr[envpool]'.",
    "sb3_contrib": "sb3-contrib is not installed: pip install 'sb3_gcr[recurrent]'.",
    "cuda": "torch.cuda.is_available() is False.",
}


def _nothing() -> None:
    """Nothing to prepare."""


def _no_rate() -> float | None:
    """No conflicts to count."""
    return None


@dataclass(frozen=True)
class Contestant:
    """Something that costs: ``measure`` returns one figure, in seconds or bytes, smaller is
    better.
    """

    label: str
    measure: Callable[[], float]
    conflict_rate: Callable[[], float | None] = _no_rate


@dataclass(frozen=True)
class Case:
    """One row to measure: the contestants are made when it is their turn."""

    group: str
    setting: str
    subject: Callable[[], Contestant]
    baseline: Callable[[], Contestant]
    bar: float | None = None
    unit: str = "ms"
    needs: tuple[str, ...] = ()
    max_pairs: int | None = None
    warm_up: bool = True


@dataclass(frozen=True)
class Row:
    """Result of a case; ``ratios`` are those of the pairs, subject over baseline."""

    group: str
    setting: str
    subject: str
    baseline: str
    unit: str
    bar: float | None
    conflict_rate: float | None
    subject_values: list[float]
    baseline_values: list[float]
    ratios: list[float] = field(default_factory=list)

    @property
    def name(self) -> str:
        """What identifies the row in another run."""
        return f"{self.group}: {self.setting}: {self.subject} / {self.baseline}"

    @property
    def medians(self) -> tuple[float, float]:
        """Median cost of subject and baseline."""
        return float(np.median(self.subject_values)), float(np.median(self.baseline_values))

    @property
    def ratio(self) -> float:
        """Median of the pairs' ratios."""
        return float(np.median(self.ratios))

    @property
    def quartiles(self) -> tuple[float, float]:
        """Lower and upper quartile of the pairs' ratios."""
        low, high = np.quantile(self.ratios, (0.25, 0.75))
        return float(low), float(high)


def timed(
    run: Callable[[], object],
    prepare: Callable[[], None] = _nothing,
    calls: int = 1,
    device: str = "cpu",
) -> Callable[[], float]:
    """A ``measure`` for :class:`Contestant`: seconds of ``run`` divided by ``calls``, without those
    of ``prepare``.
    """

    def measure() -> float:
        prepare()
        synchronize(device)
        # As timeit does: a collection that happens to fall into one of the two would be charged to
        # it alone.
        gc.disable()
        try:
            start = time.perf_counter()
            run()
            synchronize(device)
            return (time.perf_counter() - start) / calls
        finally:
            gc.enable()

    return measure


def synchronize(device: str) -> None:
    """Wait until the device has finished what it was given."""
    if device.startswith("cuda"):
        th.cuda.synchronize()


def missing(case: Case) -> str | None:
    """The sentence that says why a case cannot run here, or None."""
    for need in case.needs:
        found = (
            th.cuda.is_available() if need == "cuda" else importlib.util.find_spec(need) is not None
        )
        if not found:
            return NEEDS[need]
    return None


def measure_pairs(case: Case, pairs: int, seconds: float, report: Callable[[int], None]) -> Row:
    """Measure baseline and subject in turn: B S B S …

    :param case: what to measure
    :param pairs: number of pairs
    :param seconds: the row ends early after this time, but not before ``MIN_PAIRS`` pairs
    :param report: called with the number of pairs done
    """
    subject, baseline = case.subject(), case.baseline()
    wanted = min(pairs, case.max_pairs or pairs)
    if case.warm_up:
        # The first measurement allocates, builds optimiser states, and compiles where there is a
        # compiler.
        baseline.measure()
        subject.measure()
    subject_values: list[float] = []
    baseline_values: list[float] = []
    start = time.perf_counter()
    while len(subject_values) < wanted:
        if len(subject_values) >= MIN_PAIRS and time.perf_counter() - start > seconds:
            break
        baseline_values.append(baseline.measure())
        subject_values.append(subject.measure())
        report(len(subject_values))
    return Row(
        case.group,
        case.setting,
        subject.label,
        baseline.label,
        case.unit,
        case.bar,
        subject.conflict_rate(),
        subject_values,
        baseline_values,
        [mine / other for mine, other in zip(subject_values, baseline_values, strict=True)],
    )
