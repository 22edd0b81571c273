"""Configurations and cells: what runs, and the id of all that changes its numbers."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_gcr.study.store import SCHEMA

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


def cell_id(canonical: Fields) -> str:
    """12 hex digits of the SHA-256 of the canonical JSON, whatever the order of the keys.

    :param canonical: of a cell
    """
    return digest(canonical)[:12]


def digest(content: Any) -> str:
    """The SHA-256 of the canonical JSON.

    :param content: in JSON's own types, keys in any order
    """
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


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
