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

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_gcr.study.methods import METHODS, Method, named
from sb3_gcr.study.settings import check_names, check_settings
from sb3_gcr.study.store import SCHEMA

__all__ = [
    "Cell",
    "Manifest",
    "Method",
    "Task",
    "blocks",
    "cell_id",
    "draw_configurations",
    "expand",
]

#: First seed of each purpose, and the first that is too large.
SEEDS = {"study": (0, 1000), "pilot": (1000, 2000), "tuning": (2000, 1_000_000)}
#: No tuning sees envs whose name begins so, nor objectives of an env.
HELD_OUT = (
    "Ant",
    "Swimmer",
    "Pusher",
    "Reacher",
    "Hopper",
    "PandaOpenCabinet",
    "PandaPickCube",
    "H1",
    "Go1",
    "G1",
    "LeapCube",
)
#: What only the folder's ``study.yml`` has, beside the manifest.
WRITTEN = ("digest", "n_cells", "registered")
_KEYS = {
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
_TASK_KEYS = {
    "env",
    "timesteps",
    "env_kwargs",
    "components",
    "residual",
    "settings",
    "variants",
    "draw",
}
_HYPOTHESIS_KEYS = {"claim", "contrast", "metric", "unit", "supported", "refuted"}

Fields = Mapping[str, Any]


@dataclass(frozen=True)
class Task:
    """A configuration that all methods and seeds run on.

    :param name: for people; no part of a cell
    :param env: id of Gymnasium, sb3_gcr or EnvPool, or ``module:Class``
    :param env_kwargs: arguments of the env
    :param components: levels of the reward's terms by info key; None: the env says
    :param residual: name and level of the rest of the reward, or None
    :param settings: all of them
    :param timesteps: of each run
    """

    name: str
    env: str
    env_kwargs: Fields
    components: Fields | None
    residual: Fields | None
    settings: Fields
    timesteps: int


@dataclass(frozen=True)
class Cell:
    """One training: all that changes its numbers.

    :param task: the configuration
    :param method: name of the method
    :param algorithm: what the method is
    :param seed: of everything random
    """

    task: Task
    method: str
    algorithm: Fields
    seed: int

    def canonical(self) -> dict[str, Any]:
        """What the id is made of."""
        return {
            "schema": SCHEMA,
            "env": self.task.env,
            "env_kwargs": dict(self.task.env_kwargs),
            "components": self.task.components,
            "residual": self.task.residual,
            "method": self.method,
            "algorithm": dict(self.algorithm),
            "settings": dict(self.task.settings),
            "timesteps": self.task.timesteps,
            "seed": self.seed,
        }

    @property
    def id(self) -> str:
        """12 hex digits."""
        return cell_id(self.canonical())

    @property
    def label(self) -> str:
        """For people."""
        return f"{self.task.name}, {self.method}, seed {self.seed}"


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
        _check_keys(
            given, _KEYS, {"name", "methods", "seeds", "minutes", "tasks"}, f"Study '{name}'"
        )
        methods = tuple(named(given["methods"]))
        purpose = given.get("purpose", "study")
        manifest = cls(
            name=name,
            purpose=purpose,
            question=str(given.get("question", "")),
            tasks=tuple(_tasks(given["tasks"], given.get("settings") or {})),
            methods=methods,
            seeds=_seeds(given["seeds"], purpose, name),
            minutes=_positive(given["minutes"], f"Study '{name}': `minutes`"),
            hypotheses=_hypotheses(given.get("hypotheses") or {}, methods),
            looks=tuple(given.get("looks") or ()),
        )
        _check_held_out(manifest)
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
        return {**content, "digest": _digest(content)[:12], "n_cells": n_cells}

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


def cell_id(canonical: Fields) -> str:
    """12 hex digits of the SHA-256 of the canonical JSON, whatever the order of the keys.

    :param canonical: of a cell
    """
    return _digest(canonical)[:12]


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


def draw_configurations(
    factors: Mapping[str, Sequence[Any]], number: int, seed: int, at_least: int = 1
) -> list[dict[str, Any]]:
    """Distinct settings of factors; a larger number begins with those of a smaller one.

    :param factors: possible values by name; None is "not active"
    :param number: how many
    :param seed: of the draw
    :param at_least: so many factors are active
    :raises ValueError: if there are not so many
    """
    every = [dict(zip(factors, row, strict=True)) for row in itertools.product(*factors.values())]
    allowed = [row for row in every if sum(value is not None for value in row.values()) >= at_least]
    if number > len(allowed):
        raise ValueError(
            f"Parameter `number` must be at most {len(allowed)}, the number of distinct "
            f"configurations, found {number}."
        )
    order = np.random.default_rng(seed).permutation(len(allowed))[:number]
    return [allowed[index] for index in order]


def _load_yaml(text: str, name: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise ImportError("Studies need PyYAML: pip install 'sb3_gcr[study]'") from error
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"'{name}' must be YAML: {error}") from error


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _tasks(given: Any, shared: Fields) -> Iterator[Task]:
    """Configurations of the tasks, which are a mapping in a file and a list where written out."""
    check_names(shared, "The manifest")
    if isinstance(given, list):
        given = {task["name"]: {k: v for k, v in task.items() if k != "name"} for task in given}
    if not isinstance(given, Mapping) or not given:
        raise ValueError(f"`tasks` must map names to tasks, found {given!r}.")
    for name, task in given.items():
        where = f"Task '{name}'"
        _check_keys(task, _TASK_KEYS, {"env", "timesteps"}, where)
        for label, env_kwargs, own in _variants(name, task):
            settings = {**shared, **(task.get("settings") or {}), **own}
            yield Task(
                name=label,
                env=task["env"],
                env_kwargs=env_kwargs,
                components=task.get("components"),
                residual=task.get("residual"),
                settings=check_settings(settings, where),
                timesteps=int(_positive(task["timesteps"], f"{where}: `timesteps`")),
            )


def _variants(name: str, task: Fields) -> Iterator[tuple[str, dict[str, Any], Fields]]:
    """Name, arguments and own settings of each drawn configuration in each variant."""
    drawn: list[dict[str, Any]] = [{}]
    if task.get("draw"):
        drawn = draw_configurations(**task["draw"])
    for configuration in drawn:
        active = [f"{key}={value}" for key, value in configuration.items() if value is not None]
        for variant, changes in (task.get("variants") or {"": {}}).items():
            label = " ".join([name, *active, *([variant] if variant else [])])
            env_kwargs = {**(task.get("env_kwargs") or {}), **configuration}
            yield (
                label,
                {**env_kwargs, **(changes.get("env_kwargs") or {})},
                (changes.get("settings") or {}),
            )


def _seeds(given: Any, purpose: str, name: str) -> tuple[int, ...]:
    if purpose not in SEEDS:
        raise ValueError(
            f"Study '{name}': `purpose` must be one of {list(SEEDS)}, found {purpose!r}."
        )
    first, end = SEEDS[purpose]
    seeds = tuple(range(first, first + given)) if isinstance(given, int) else tuple(given)
    wrong = [seed for seed in seeds if not isinstance(seed, int) or not first <= seed < end]
    if wrong or not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(
            f"Study '{name}': `seeds` must be a number or distinct seeds from {first} to "
            f"{end - 1}, those of a {purpose}, found {given!r}."
        )
    return seeds


def _hypotheses(given: Fields, methods: Sequence[str]) -> Fields:
    for name, hypothesis in given.items():
        where = f"Hypothesis '{name}'"
        _check_keys(hypothesis, _HYPOTHESIS_KEYS, _HYPOTHESIS_KEYS, where)
        unknown = [one for one in hypothesis["contrast"] if one not in methods]
        if unknown:
            raise ValueError(
                f"{where}: `contrast` must name methods of the study, {list(methods)}, found "
                f"{unknown}."
            )
    return given


def _check_held_out(manifest: Manifest) -> None:
    """No tuning on what the study is about.

    :raises ValueError: for a held-out task in a tuning manifest
    """
    if manifest.purpose != "tuning":
        return
    for task in manifest.tasks:
        name = task.env.rsplit("/", 1)[-1]
        has_objective = "MO-v" in name and any(v is not None for v in task.env_kwargs.values())
        if name.startswith(HELD_OUT) or has_objective:
            raise ValueError(
                f"Task '{task.name}' is held out from tuning: names that begin with "
                f"{list(HELD_OUT)}, and objectives of an MO env."
            )


def _check_keys(given: Any, known: set[str], needed: set[str], where: str) -> None:
    if not isinstance(given, Mapping):
        raise ValueError(f"{where} must map names to values, found {given!r}.")
    unknown = sorted(set(given) - known)
    if unknown:
        raise ValueError(f"{where}: unknown keys {unknown}; valid choices are {sorted(known)}.")
    missing = sorted(needed - set(given))
    if missing:
        raise ValueError(f"{where} lacks {missing}.")


def _positive(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise ValueError(f"{where} must be a number above 0, found {value!r}.")
    return value
