"""A folder belongs to one manifest, which is written out in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_gcr.study.manifest import Cell, Manifest
from sb3_gcr.study.provenance import git
from sb3_gcr.study.store import MANIFEST, Store, collect


def open_folder(manifest: Manifest, folder: Path, source: Path | None = None) -> Store:
    """The store of a manifest, with ``study.yml``; a folder of another manifest is refused.

    :param manifest: of the study
    :param folder: made where it is missing
    :param source: the file of the manifest, whose commit is written down
    :raises ValueError: if the folder belongs to another manifest
    """
    import yaml

    path = folder / MANIFEST
    if path.exists():
        before = Manifest.load(path)
        if before == manifest:
            return Store(folder)
        _demand_growth(manifest, before, folder)
    folder.mkdir(parents=True, exist_ok=True)
    content = {**manifest.to_dict(), "registered": _registered(source)}
    temporary = path.with_suffix(".tmp")
    temporary.write_text(
        yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8"
    )
    temporary.replace(path)
    return Store(folder)


def reuse(store: Store, cells: Sequence[Cell], folders: Sequence[str | Path]) -> int:
    """Copy the results of cells that other studies have run; returns how many.

    :param store: of this study
    :param cells: of this study
    :param folders: of other studies
    :raises FileNotFoundError: if a folder is not there
    """
    wanted = {cell.id for cell in cells if not store.is_done(cell.id)}
    copied = 0
    for folder in folders:
        for result in collect(folder).results:
            if result["id"] in wanted:
                store.write_result(result["id"], result)
                wanted.remove(result["id"])
                copied += 1
    return copied


def _demand_growth(manifest: Manifest, before: Manifest, folder: Path) -> None:
    if manifest.grows_from(before):
        return
    if manifest.tasks == before.tasks and manifest.name == before.name and not before.hypotheses:
        raise ValueError(
            f"'{folder}' has methods {list(before.methods)} and {len(before.seeds)} seeds; a study "
            "can grow, not shrink. Give at least these, or another folder with --out."
        )
    why = "is registered and cannot change" if before.hypotheses else "has other tasks or settings"
    raise ValueError(
        f"'{folder}' belongs to another manifest: '{before.name}' there {why}. "
        "Give another folder with --out."
    )


def _registered(source: Path | None) -> dict[str, Any] | None:
    """The last commit of the manifest's file, and whether the file differs from it."""
    if source is None:
        return None
    path = source.resolve()
    commit = git("log", "-1", "--format=%H %cI", "--", str(path))
    if not commit:
        return None
    revision, _, date = commit.partition(" ")
    changed = git("status", "--porcelain", "--", str(path))
    return {"commit": revision, "date": date, "changed": bool(changed)}
