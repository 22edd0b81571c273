"""Rows of peak memory over K at one million parameters; run as a module it is one of the measured
processes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from functools import partial

import torch as th

from benchmarks.measuring import Case, Contestant
from benchmarks.rollouts import Setting, torch_update
from sb3_gcr import GCRPPO

#: The actor has 999 634 parameters.
MILLION = Setting({"pi": [833, 833], "vf": [64, 64]}, batch_size=256, n_samples=1024, n_epochs=1)


def peak_of_process(n_components: int, method: str | None = None) -> Contestant:
    """Peak resident memory in bytes of a process that imports, builds a model, and updates it
    twice.
    """
    arguments = [str(n_components), *(["--method", method] if method else [])]
    # Linux lets a new program inherit the peak of the process that started it, hence the small
    # shell in between.
    command = [
        "sh",
        "-c",
        '"$@"; exit $?',
        "sh",
        sys.executable,
        "-m",
        "benchmarks.memory",
        *arguments,
    ]

    def measure() -> float:
        process = subprocess.run(command, capture_output=True, text=True)
        if process.returncode != 0:
            raise RuntimeError(process.stderr.strip().splitlines()[-1])
        return float(process.stdout)

    return Contestant(f"GCRPPO K={n_components}" + (f" {method}" if method else ""), measure)


def cases() -> list[Case]:
    """All rows of this group."""
    one = partial(peak_of_process, 1)
    return [
        Case("memory", "D=1M B=256", subject, one, bar, "MB", max_pairs=3, warm_up=False)
        for subject, bar in (
            (partial(peak_of_process, 50), 1.2),
            (partial(peak_of_process, 50, "passes"), None),
        )
    ]


def main() -> None:
    """Update one model twice and print the peak memory of this process in bytes."""
    import resource  # not on Windows

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("n_components", type=int)
    parser.add_argument("--method")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    kwargs = {"gramian_method": arguments.method} if arguments.method else {}
    contestant = torch_update("", GCRPPO, MILLION, arguments.n_components, **kwargs)
    for _ in range(2):
        contestant.measure()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(peak if sys.platform == "darwin" else 1024 * peak)  # bytes there, KiB elsewhere


if __name__ == "__main__":
    main()
