"""When the hypotheses of a study were committed, and whether that was before its first cell."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from sb3_gcr.study.collected import Collected
from sb3_gcr.study.store import MANIFEST, Record

STUDIES = Path(__file__).with_name("studies")


def registration(folder: Path, study: Collected) -> str:
    """The commit of the manifest and whether it came before the first cell, in a sentence.

    :param folder: of the study
    :param study: what it holds
    :return: nothing for a study without hypotheses
    """
    if not study.manifest.get("hypotheses"):
        return ""
    for path in (STUDIES / f"{study.name}.yml", folder / MANIFEST):
        commit = last_commit(path) if _is_that(path, study.manifest) else None
        if commit is not None:
            return sentence(*commit, first_start(study.results))
    return "These hypotheses are in no commit: nothing shows that they were there first."


def last_commit(path: Path) -> tuple[str, datetime] | None:
    """The last commit that changed a file, and when; None without one.

    :param path: of the file
    """
    command = ["git", "log", "-1", "--format=%h %cI", "--", path.name]
    try:
        done = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, check=False)
    except OSError:
        return None
    name, _, when = done.stdout.strip().partition(" ")
    return (name, datetime.fromisoformat(when)) if when else None


def first_start(results: Sequence[Record]) -> datetime | None:
    """When the first cell began; None where no cell says."""
    times = [str((one.get("provenance") or {}).get("started") or "") for one in results]
    return min((datetime.fromisoformat(time) for time in times if time), default=None)


def sentence(commit: str, committed: datetime, started: datetime | None) -> str:
    """Whether the commit came first.

    :param commit: its short name
    :param committed: when
    :param started: when the first cell began
    """
    lead = f"The hypotheses were committed in {commit} on {committed:%Y-%m-%d %H:%M %z}"
    if started is None:
        return f"{lead}; the cells do not say when they began."
    if started.tzinfo is None:
        started = started.astimezone()
    if committed <= started:
        return f"{lead}, before the first cell ({started:%Y-%m-%d %H:%M %z})."
    return f"{lead}, which is LATER than the first cell ({started:%Y-%m-%d %H:%M %z})."


def _is_that(path: Path, manifest: Record) -> bool:
    """Whether the file is there and holds this manifest."""
    if not path.exists():
        return False
    if path.name == MANIFEST:
        return True
    from sb3_gcr.study.manifest import Manifest

    return bool(Manifest.load(path).to_dict()["digest"] == manifest.get("digest"))
