"""What the commands of ``sb3-gcr-study`` do."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from sb3_gcr.logs.shown import format_table
from sb3_gcr.study import compare as comparing
from sb3_gcr.study.costs import Costs, estimate
from sb3_gcr.study.engines import Engine, LocalEngine, RayEngine
from sb3_gcr.study.folders import open_folder, reuse
from sb3_gcr.study.manifest import Cell, Manifest, blocks, expand, find
from sb3_gcr.study.probe import probe, shown
from sb3_gcr.study.runner import Limits, Progress, Runner
from sb3_gcr.study.store import ERROR, MANIFEST, Store, collect

PROGRAM = "sb3-gcr-study"


def say(text: str) -> None:
    """Write a line to the terminal."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def folder_of(options: argparse.Namespace, manifest: Manifest) -> Path:
    """Where a study is: as given, beside its ``study.yml``, or in ``results``."""
    if options.out is not None:
        return Path(options.out)
    path = Path(options.manifest)
    return path.parent if path.name == MANIFEST else Path("results") / manifest.name


def plan(options: argparse.Namespace) -> int:
    """Say what a study comes to."""
    manifest = Manifest.load(options.manifest)
    say(plan_of(manifest, Store(folder_of(options, manifest))))
    if options.cells:
        say("\n".join(f"{one.id}  {one.label}" for one in expand(manifest)))
    return 0


def plan_of(manifest: Manifest, store: Store) -> str:
    """Cells, methods, seeds and minutes.

    :param manifest: of the study
    :param store: its folder, which may not be there yet
    """
    cells = expand(manifest)
    left = [cell for cell in cells if not store.is_done(cell.id)]
    costs = Costs(collect(store.folder).results if store.folder.is_dir() else ())
    lines = [
        f"{manifest.name}: {len(cells)} cells, {len(left)} to run, about "
        f"{duration(sum(map(costs.seconds, left)))} on one core.",
        f"Methods: {', '.join(manifest.methods)}.",
        f"Seeds: {', '.join(map(str, manifest.seeds))}.",
        "Tasks:",
    ]
    lines += [f"  {task.name}: {task.env}, {task.timesteps:,} steps" for task in manifest.tasks]
    if manifest.hypotheses:
        lines.append("Hypotheses:")
    lines += [f"  {name}: {one['claim']}" for name, one in manifest.hypotheses.items()]
    return "\n".join(lines)


def run(options: argparse.Namespace) -> int:
    """Run a study, or go on with it."""
    manifest = Manifest.load(options.manifest)
    return run_manifest(manifest, options, find(options.manifest))


def run_manifest(manifest: Manifest, options: argparse.Namespace, source: Path | None) -> int:
    """Run the cells of a manifest; 1 where cells have failed.

    :param manifest: of the study
    :param options: of the command line
    :param source: the manifest's file
    """
    shard, n_shards = shard_of(options.shard)
    folder = folder_of(options, manifest)
    store = open_folder(manifest, folder, source)
    limits = Limits(
        jobs=options.jobs,
        threads=options.threads,
        hours=options.hours,
        minutes=options.minutes or manifest.minutes,
    )
    if options.reuse:
        say(f"{reuse(store, expand(manifest), options.reuse)} cells taken over.")
    own = [block for place, block in enumerate(blocks(manifest)) if place % n_shards == shard]
    failed = Runner(own, store, make_engine(options, store), limits, ProgressLine()).run()
    for line in failures(failed, store):
        sys.stderr.write(line + "\n")
    return 1 if failed else 0


def make_engine(options: argparse.Namespace, store: Store) -> Engine:
    """The engine that the command line asks for."""
    if options.engine == "local":
        return LocalEngine(store, options.threads)
    return RayEngine(store, options.threads, options.address, options.jobs)


def shard_of(text: str | None) -> tuple[int, int]:
    """Index and number of shards of "2/4".

    :param text: of the command line
    :raises ValueError: for anything else
    """
    if text is None:
        return 0, 1
    first, _, second = text.partition("/")
    if not first.isdigit() or not second.isdigit() or not 1 <= int(first) <= int(second):
        raise ValueError(f"--shard takes which of how many, such as 2/4, found {text!r}.")
    return int(first) - 1, int(second)


def failures(cells: Sequence[Cell], store: Store) -> list[str]:
    """A failed cell a line, with the command that repeats it.

    :param cells: that have failed
    :param store: of the study
    """
    import json

    lines = []
    for cell in cells:
        error = json.loads(store.path(cell.id, ERROR).read_text(encoding="utf-8"))
        manifest = shlex.quote(str(store.folder / MANIFEST))
        lines.append(
            f"FAILED {cell.label}: {error['error']}\n"
            f"  log: {store.path(cell.id, 'log.txt')}\n"
            f"  again: {PROGRAM} cell {manifest} {cell.id}"
        )
    return lines


def status(options: argparse.Namespace) -> int:
    """Say what is done; 1 where cells have failed."""
    manifest = Manifest.load(options.manifest)
    store = Store(folder_of(options, manifest))
    rows = [["task", "method", "done", "running", "failed", "to do"]]
    cells = expand(manifest)
    for task in manifest.tasks:
        for method in manifest.methods:
            own = [cell.id for cell in cells if (cell.task, cell.method) == (task, method)]
            done = sum(map(store.is_done, own))
            failed = sum(map(store.has_failed, own))
            running = sum(store.is_claimed(one) and not store.is_done(one) for one in own)
            to_do = len(own) - done - failed - running
            counts = [str(number) for number in (done, running, failed, to_do)]
            rows.append([task.name, method, *counts])
    say(format_table(rows))
    failed_cells = [cell for cell in cells if store.has_failed(cell.id)]
    for line in failures(failed_cells, store):
        say(line)
    return 1 if failed_cells else 0


def report(options: argparse.Namespace) -> int:
    """Write the report of what is there; runs nothing."""
    path = Path(options.manifest)
    folder = path if path.is_dir() else folder_of(options, Manifest.load(path))
    return tell(folder)


def tell(folder: Path) -> int:
    """Write the report and say the answer.

    :param folder: of a study
    """
    comparing.check_extras()
    from sb3_gcr.study import report as reporting

    page = reporting.write(folder)
    say(reporting.answer(folder))
    say(f"\nReport: {page}")
    return 0


def cell(options: argparse.Namespace) -> int:
    """Run one cell in the foreground, also one that has failed; 1 where it fails."""
    from sb3_gcr.study.cells import run_cell

    manifest = Manifest.load(options.manifest)
    found = [one for one in expand(manifest) if one.id == options.id]
    if not found:
        raise ValueError(
            f"'{manifest.name}' has no cell {options.id!r}; `{PROGRAM} plan --cells` lists them."
        )
    store = open_folder(manifest, folder_of(options, manifest), find(options.manifest))
    store.forget_error(options.id)
    claim = store.claim(options.id)
    if claim is None:
        state = "is done" if store.is_done(options.id) else "belongs to a runner that is at it"
        say(f"{found[0].label} {state}.")
        return 0
    try:
        store.write_result(options.id, run_cell(found[0].canonical(), options.threads))
    except Exception as error:  # whatever it was belongs to the cell
        traceback.print_exc()
        store.write_error(options.id, found[0].canonical(), f"{type(error).__name__}: {error}")
        return 1
    finally:
        claim.release()
    say(f"{found[0].label} is done.")
    return 0


def sbatch(options: argparse.Namespace) -> int:
    """Print a script for SLURM: an array of runners that share one folder."""
    manifest = Manifest.load(options.manifest)
    folder = folder_of(options, manifest)
    every = blocks(manifest)
    n = min(options.array or len(every), len(every))
    seconds = max(
        sum(estimate(cell) for block in every[shard::n] for cell in block) for shard in range(n)
    )
    hours = math.ceil(1.5 * seconds / 3600 + manifest.minutes / 60)
    command = [PROGRAM, "run", str(options.manifest), "--out", str(folder), "--jobs", "1"]
    say(
        "\n".join(
            [
                "#!/bin/bash",
                f"#SBATCH --job-name={manifest.name.replace(' ', '-').replace('/', '-')}",
                f"#SBATCH --array=1-{n}",
                f"#SBATCH --cpus-per-task={options.threads}",
                f"#SBATCH --time={hours}:00:00",
                f"{shlex.join(command)} --threads {options.threads} --hours {hours} "
                f'--shard "$SLURM_ARRAY_TASK_ID/{n}"',
            ]
        )
    )
    return 0


def compare(options: argparse.Namespace) -> int:
    """Probe, plan, run and answer; 1 where cells have failed."""
    manifest = comparing.make_manifest(
        options.env,
        options.methods,
        options.timesteps,
        options.seeds,
        comparing.pairs(options.env_kwargs, "--env-kwargs"),
        comparing.pairs(options.components, "--components") or None,
        residual_of(options.residual),
        comparing.pairs(options.settings, "--settings"),
    )
    options.manifest = str(Path(options.out) / MANIFEST)
    first = expand(manifest)[0]
    say(shown(probe(first.canonical())))
    comparing.check_extras()
    store = open_folder(manifest, Path(options.out))
    say("\n" + plan_of(manifest, store))
    if not options.yes and not confirmed(manifest, store):
        return 0
    code = run_manifest(manifest, options, None)
    tell(Path(options.out))
    return code


def residual_of(text: str | None) -> dict[str, str] | None:
    """Name and level of ``--residual rest`` or ``rest=regulariser``.

    :param text: of the command line
    """
    if text is None:
        return None
    name, _, level = text.partition("=")
    return {name: level or "task"}


def confirmed(manifest: Manifest, store: Store) -> bool:
    """Whether to begin: Enter, or nothing left to run."""
    if all(store.is_done(cell.id) for cell in expand(manifest)):
        return True
    if not sys.stdin.isatty():
        say("Nobody is here to press Enter: give --yes.")
        return False
    return input("Enter begins, anything else ends: ") == ""


class ProgressLine:
    """Shows the progress on one line of a terminal, else on a line each time."""

    def __call__(self, progress: Progress) -> None:
        """Show it."""
        text = (
            f"{progress.done} of {progress.total} done, {progress.running} running, "
            f"{progress.failed} failed, {progress.core_hours:.2f} core-hours, "
            f"about {duration(progress.seconds_left)} left"
        )
        is_last = progress.running == 0
        if sys.stderr.isatty():
            sys.stderr.write(f"\r\x1b[K{text}" + ("\n" if is_last else ""))
        else:
            sys.stderr.write(text + "\n")
        sys.stderr.flush()


def duration(seconds: float) -> str:
    """Seconds in words.

    :param seconds: at least 0
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
