"""A study as data: tasks, methods and seeds, and the cells that they come to.

A manifest is a YAML file::

    name: walkers
    purpose: study            # or pilot (seeds from 1000), tuning (from 2000)
    question: Does surgery help a walker?
    methods: [ppo, multi_head, gcr]
    seeds: 3                  # 0, 1, 2; or a list
    minutes: 15               # after which a cell has failed
    settings: {...}           # all of them, equal for all methods
    tasks:
      walker:
        env: sb3_gcr/Walker2d-v0
        timesteps: 600_000
        # optional: env_kwargs, components, residual, settings (those that differ),
        # variants (by name: env_kwargs, settings), draw (seed, number, at_least, factors)
    hypotheses:               # optional; with them the manifest is registered and cannot grow
      H1:
        claim: Surgery helps beyond the heads.
        contrast: [gcr, multi_head]
        metric: return_training
        unit: configuration   # or seed
        supported: Holm p < 0.05 and a mean above 0
        refuted: the interval lies below +5 %
    looks: [12, 24, 36]       # optional: how many configurations, or seeds, each look has
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_gcr.study.configurations import (
    Cell,
    Fields,
    Task,
    cell_id,
    digest,
    draw_configurations,
)
from sb3_gcr.study.methods import METHODS, Method, named
from sb3_gcr.study.reading import (
    HELD_OUT,
    check_held_out,
    check_keys,
    positive,
    read_hypotheses,
    read_seeds,
    read_tasks,
)

__all__ = [
    "HELD_OUT",
    "Cell",
    "Manifest",
    "Method",
    "Task",
    "blocks",
    "cell_id",
    "draw_configurations",
    "expand",
    "find",
]

#: What only the folder's ``study.yml`` has, beside the manifest.
WRITTEN = ("digest", "n_cells", "registered")
KEYS = {
    "name",
    "purpose",
    "question",
    "methods",
    "seeds",
    "minutes",
    "settings",
    "tasks",
    "hypotheses",
    "looks",
}


@dataclass(frozen=True)
class Manifest:
    """A whole study.

    :param name: of the study
    :param purpose: "study", "pilot" or "tuning"
    :param question: in a sentence
    :param tasks: configurations
    :param methods: names
    :param seeds: of each configuration and method
    :param minutes: a cell that takes longer has failed
    :param hypotheses: what is claimed, by name
    :param looks: number of units at each look
    """

    name: str
    purpose: str
    question: str
    tasks: tuple[Task, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    minutes: float
    hypotheses: Fields
    looks: tuple[int, ...]

    @classmethod
    def load(cls, path: str | Path) -> Manifest:
        """Read a YAML file, or a manifest of this package by its name.

        :param path: of the file, or the name
        :raises FileNotFoundError: if there is neither
        :raises ValueError: for unknown, missing and wrong entries
        """
        file = find(path)
        return cls.from_dict(_load_yaml(file.read_text(encoding="utf-8"), str(file)))

    @classmethod
    def from_dict(cls, given: Any) -> Manifest:
        """A manifest of what a YAML file holds, or of :meth:`to_dict`.

        :param given: the parsed file
        :raises ValueError: for unknown, missing and wrong entries
        """
        if not isinstance(given, Mapping):
            raise ValueError(f"A manifest must map names to values, found {given!r}.")
        given = {key: value for key, value in given.items() if key not in WRITTEN}
        name = str(given.get("name", "?"))
        check_keys(given, KEYS, {"name", "methods", "seeds", "minutes", "tasks"}, f"Study '{name}'")
        methods = tuple(named(given["methods"]))
        purpose = given.get("purpose", "study")
        manifest = cls(
            name=name,
            purpose=purpose,
            question=str(given.get("question", "")),
            tasks=tuple(read_tasks(given["tasks"], given.get("settings") or {})),
            methods=methods,
            seeds=read_seeds(given["seeds"], purpose, name),
            minutes=positive(given["minutes"], f"Study '{name}': `minutes`"),
            hypotheses=read_hypotheses(given.get("hypotheses") or {}, methods),
            looks=tuple(given.get("looks") or ()),
        )
        check_held_out(manifest.purpose, manifest.tasks)
        return manifest

    def to_dict(self) -> dict[str, Any]:
        """The manifest with all configurations written out, its digest and number of cells."""
        content = {
            "name": self.name,
            "purpose": self.purpose,
            "question": self.question,
            "methods": list(self.methods),
            "seeds": list(self.seeds),
            "minutes": self.minutes,
            "tasks": [dict(vars(task)) for task in self.tasks],
            "hypotheses": dict(self.hypotheses),
            "looks": list(self.looks),
        }
        n_cells = len(self.tasks) * len(self.methods) * len(self.seeds)
        return {**content, "digest": digest(content)[:12], "n_cells": n_cells}

    def grows_from(self, before: Manifest) -> bool:
        """Whether this manifest is the same, or the same with more seeds or methods.

        A registered manifest, one with hypotheses, does not grow.

        :param before: the manifest of a folder
        """
        if self == before:
            return True
        more = set(self.seeds) >= set(before.seeds) and set(self.methods) >= set(before.methods)
        fixed = self.tasks == before.tasks and self.name == before.name
        return more and fixed and not (self.hypotheses or before.hypotheses)


def find(path: str | Path) -> Path:
    """The file of a manifest.

    :param path: of the file, or the name of a manifest of this package
    :raises FileNotFoundError: if there is neither
    """
    shipped = Path(__file__).with_name("studies")
    for file in (Path(path), shipped / f"{path}.yml"):
        if file.is_file():
            return file
    names = sorted(one.stem for one in shipped.glob("*.yml"))
    raise FileNotFoundError(
        f"Parameter `manifest` must be a YAML file or one of {names}, found {str(path)!r}."
    )


def expand(manifest: Manifest) -> list[Cell]:
    """All cells, block by block.

    :param manifest: of the study
    """
    return [cell for block in blocks(manifest) for cell in block]


def blocks(manifest: Manifest) -> list[list[Cell]]:
    """Cells that belong together, a configuration and a seed with all methods; the first seed of
    all configurations comes first.

    :param manifest: of the study
    """
    return [
        [Cell(task, method, METHODS[method].to_dict(), seed) for method in manifest.methods]
        for seed in manifest.seeds
        for task in manifest.tasks
    ]


def _load_yaml(text: str, name: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise ImportError("Studies need PyYAML: pip install 'sb3_gcr[study]'") from error
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"'{name}' must be YAML: {error}") from error
