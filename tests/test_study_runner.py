"""Claims, runners and engines: whatever happens to a runner, every cell has one whole result."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from sb3_gcr.study import runner as running
from sb3_gcr.study import store as files
from sb3_gcr.study.engines import LocalEngine
from sb3_gcr.study.manifest import Manifest, blocks, expand
from sb3_gcr.study.runner import Limits, Progress, Runner
from sb3_gcr.study.settings import DEFAULTS
from sb3_gcr.study.store import Store, collect

# Runners are killed as forks of this process, which are there at once.
pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")

CELL = [sys.executable, "-S", str(Path(__file__).with_name("study_cell.py"))]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "HEARTBEAT", 0.1)
    monkeypatch.setattr(files, "STALE", 1.0)
    monkeypatch.setattr(running, "PATIENCE", 0.02)
    monkeypatch.setattr(running, "LONG_PATIENCE", 0.1)


def study(seeds: int = 3, **env_kwargs: Any) -> Manifest:
    """A study whose cells `study_cell.py` can pretend to run."""
    task = {"env": "sb3_gcr/Walker2d-v0", "env_kwargs": env_kwargs, "timesteps": 1000}
    return Manifest.from_dict(
        {
            "name": "small",
            "methods": ["ppo", "gcr"],
            "seeds": seeds,
            "minutes": 1,
            "settings": DEFAULTS,
            "tasks": {"walk": task},
        }
    )


def run(manifest: Manifest, folder: Path, **limits: Any) -> list[str]:
    """A whole run in this process; ids of the failed cells."""
    folder.mkdir(exist_ok=True)
    store = Store(folder)
    engine = LocalEngine(store, command=CELL)
    runner = Runner(blocks(manifest), store, engine, Limits(**{"jobs": 2, **limits}))
    return [cell.id for cell in runner.run()]


def content(folder: Path) -> dict[str, Any]:
    """All results, and nothing that is not one."""
    return {result["id"]: result for result in collect(folder).results}


def diary(folder: Path) -> Counter[str]:
    return Counter((folder / "diary.txt").read_text().splitlines())


def test_all_cells_run_once_and_leave_nothing_else(tmp_path: Path) -> None:
    manifest = study()
    assert run(manifest, tmp_path) == []
    assert set(content(tmp_path)) == {cell.id for cell in expand(manifest)}
    assert set(diary(tmp_path).values()) == {1}
    names = {path.name for path in tmp_path.glob("cells/*/*")}
    assert names == {"result.json", "log.txt"}
    before = content(tmp_path)
    assert run(manifest, tmp_path) == []
    assert content(tmp_path) == before
    assert set(diary(tmp_path).values()) == {1}


def test_kill_at_random_moments(tmp_path: Path) -> None:
    """After twenty kills every cell has one whole result, the same as without them."""
    manifest, random_number = study(seeds=8), random.Random(0)
    fork = multiprocessing.get_context("fork")
    for _ in range(20):
        process = fork.Process(target=run, args=(manifest, tmp_path / "killed"))
        process.start()
        time.sleep(random_number.uniform(0.02, 0.6))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    assert run(manifest, tmp_path / "killed") == []
    run(manifest, tmp_path / "undisturbed")
    assert content(tmp_path / "killed") == content(tmp_path / "undisturbed")
    ended = {line: n for line, n in diary(tmp_path / "killed").items() if line.startswith("end")}
    assert set(ended.values()) == {1}


def test_two_runners_on_one_folder(tmp_path: Path) -> None:
    manifest = study(seeds=6)
    fork = multiprocessing.get_context("fork")
    both = [fork.Process(target=run, args=(manifest, tmp_path)) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join(60)
        assert process.exitcode == 0
    assert len(content(tmp_path)) == 12
    assert set(diary(tmp_path).values()) == {1}


@pytest.mark.parametrize(
    ("fate", "error"),
    [
        ("raise", "exit code 1: RuntimeError: the robot is gone"),
        ("crash", "the process was ended by signal 6"),
        ("hang", "took longer than 0.02 minutes and was ended"),
    ],
)
def test_bad_cells_are_tried_twice_and_named(tmp_path: Path, fate: str, error: str) -> None:
    manifest = study(seeds=1, fate=fate)
    good, bad = expand(manifest)
    assert run(manifest, tmp_path, minutes=0.02 if fate == "hang" else 1) == [bad.id]
    collected = collect(tmp_path)
    assert [result["id"] for result in collected.results] == [good.id]
    assert collected.errors[0]["attempts"] == 2
    assert collected.errors[0]["cell"] == bad.canonical()
    assert collected.errors[0]["error"] == error
    assert "cell gcr-0 has begun" in collected.errors[0]["log_tail"]
    assert diary(tmp_path)["begin gcr-0"] == 2
    run(manifest, tmp_path)  # it is kept, not tried again
    assert diary(tmp_path)["begin gcr-0"] == 2


def test_nothing_begins_that_cannot_end_in_time(tmp_path: Path) -> None:
    assert run(study(), tmp_path, hours=1 / 3600) == []
    assert content(tmp_path) == {}


def test_whole_blocks_come_first(tmp_path: Path) -> None:
    """Cells take about 20 s by the table; a block of two with one job 41 s."""
    assert run(study(), tmp_path, hours=30 / 3600, jobs=1) == []
    assert content(tmp_path) == {}
    run(study(), tmp_path, hours=60 / 3600, jobs=1)
    assert len(content(tmp_path)) == 6  # measured, they take 0.1 s


def test_progress_counts(tmp_path: Path) -> None:
    seen: list[Progress] = []
    store = Store(tmp_path)
    engine = LocalEngine(store, command=CELL)
    Runner(blocks(study()), store, engine, Limits(jobs=2), seen.append).run()
    assert (seen[0].total, seen[0].done, seen[0].running) == (6, 0, 1)
    assert seen[0].seconds_left > 50  # by the table, two at a time
    assert (seen[-1].done, seen[-1].running, seen[-1].failed) == (6, 0, 0)
    assert seen[-1].seconds_left == 0


def test_a_claim_is_one_runners_until_it_is_stale(tmp_path: Path) -> None:
    store = Store(tmp_path)
    mine = store.claim("a")
    assert mine is not None
    assert store.claim("a") is None
    assert store.is_claimed("a")
    old = time.time() - 5
    os.utime(mine.path, (old, old))
    theirs = store.claim("a")
    assert theirs is not None
    assert not mine.touch()
    mine.release()
    assert theirs.touch()
    theirs.release()
    assert not store.is_claimed("a")
    assert list(store.path("a").iterdir()) == []


def test_of_many_runners_one_takes_a_stale_claim(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for turn in range(20):
        first = store.claim(f"cell{turn}")
        assert first is not None
        os.utime(first.path, (1, 1))
    fork = multiprocessing.get_context("fork")
    with fork.Pool(4) as pool:
        won = pool.starmap(_take, [(tmp_path, f"cell{turn}") for turn in range(20)] * 4)
    assert Counter(name for name in won if name) == {f"cell{turn}": 1 for turn in range(20)}


def _take(folder: Path, name: str) -> str | None:
    claim = Store(folder).claim(name)
    return name if claim is not None and claim.touch() else None


def test_results_are_json_without_nan(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.write_error("a", {"seed": 1}, "once")
    store.write_result("a", {"id": "a", "x": float("nan"), "y": [float("inf"), 1.5]})
    text = store.path("a", "result.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == {"id": "a", "x": None, "y": [None, 1.5]}
    assert collect(tmp_path).errors == []


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="must be the folder of a study, found none at"):
        collect(tmp_path / "none")
