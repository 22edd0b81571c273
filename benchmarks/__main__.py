"""Command line: measure, print one table, save it, compare it with an earlier one."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import torch as th
from tqdm import tqdm

from benchmarks import (
    gpu,
    learning,
    memory,
    parts,
    recurrent,
    report,
    simulations,
    updates,
)
from benchmarks.measuring import Case, Row, measure_pairs, missing

GROUPS = {
    "update": updates.cases,
    "recurrent": recurrent.cases,
    "learn": learning.cases,
    "memory": memory.cases,
    "parts": parts.cases,
    "envs": simulations.cases,
    "gpu": gpu.cases,
}


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "--rows",
        nargs="+",
        choices=GROUPS,
        default=list(GROUPS),
        metavar="GROUP",
        help=", ".join(GROUPS),
    )
    parser.add_argument(
        "--bars", action="store_true", help="only the rows that have a bar to clear"
    )
    parser.add_argument(
        "--pairs", type=int, default=25, help="pairs per row, at most (default: %(default)s)"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=8.0,
        help="time per row after which 5 pairs do (default: %(default)s)",
    )
    parser.add_argument(
        "--quick", action="store_true", help="3 pairs per row: shows that it runs, not how fast"
    )
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        help="threads of PyTorch; 1 also holds JAX to one (default: 1)",
    )
    parser.add_argument("--save", type=Path, metavar="FILE", help="write all figures as JSON")
    parser.add_argument(
        "--load", type=Path, metavar="FILE", help="measure nothing, show the figures of this file"
    )
    parser.add_argument(
        "--compare", type=Path, metavar="FILE", help="set them beside the figures of this file"
    )
    return parser.parse_args()


def limit_threads(threads: int) -> None:
    """Hold this process, the ones it starts, and XLA, if it is not loaded yet, to so many
    threads.
    """
    th.set_num_threads(threads)
    os.environ["OMP_NUM_THREADS"] = str(threads)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")  # the rows that it appears in are rows of the CPU
    if threads == 1:
        os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")


def measure(cases: list[Case], pairs: int, seconds: float) -> tuple[list[Row], list[str], bool]:
    """All rows, one sentence per reason why some are missing, and whether one of these reasons is
    an error.
    """
    rows, absent, failed = [], dict[str, int](), False
    progress = tqdm(cases, file=sys.stderr, unit="row")
    for case in progress:
        reason = missing(case)
        if reason is not None:
            absent[reason] = absent.get(reason, 0) + 1
            continue
        progress.set_description(f"{case.group}: {case.setting}")
        try:
            rows.append(
                measure_pairs(case, pairs, seconds, lambda n: progress.set_postfix_str(f"pair {n}"))
            )
        except Exception as error:  # the other rows are worth having
            failed = True
            reason = f"{case.group} failed: {type(error).__name__}: {error}"
            absent[reason] = absent.get(reason, 0) + 1
    return (
        rows,
        [f"Not measured, {n} row{'s' * (n > 1)}: {reason}" for reason, n in absent.items()],
        failed,
    )


def main() -> int:
    """Run the command line; 1 if a row failed."""
    arguments = parse_arguments()
    earlier = report.load(arguments.compare)[1] if arguments.compare else None
    failed = False
    if arguments.load:
        machine, rows, absent = report.load(arguments.load)
    else:
        limit_threads(arguments.threads)
        cases = [
            case
            for group in arguments.rows
            for case in GROUPS[group]()
            if case.bar or not arguments.bars
        ]
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            os.environ["SB3_LOGDIR"] = (
                folder  # where the loggers without a folder of their own write
            )
            pairs = 3 if arguments.quick else arguments.pairs
            rows, absent, failed = measure(cases, pairs, arguments.seconds)
        machine = {
            **report.describe_machine(arguments.threads),
            "minutes": round((time.perf_counter() - start) / 60, 1),
        }
    if arguments.save:
        report.save(arguments.save, machine, rows, absent)
    print(", ".join(f"{name}: {value}" for name, value in machine.items() if value is not None))
    print(report.table(rows, earlier))
    print(report.EXPLANATION)
    print("\n".join(absent))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
