"""What the reward is made of: the names of its components and their priority levels."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

#: Words for priority levels; any integer from 0 (highest priority) on is a level too.
LEVEL_WORDS = {"task": 0, "regulariser": 1, "regularizer": 1}


#: Info key of the components, and of the sentence that says why there are none.
COMPONENTS_KEY = "reward_components"
ERROR_KEY = "reward_components_error"

Level = str | int


@dataclass(frozen=True)
class RewardSpec:
    """Names of the K reward components and their priority levels.

    :param names: unique and not empty, in the order of the reward vector
    :param levels: one integer per name: 0 = task, 1 = regulariser, more allowed; 0 is the highest
        priority
    :raises ValueError: for empty, duplicate or unequally many names and levels, and negative levels
    :raises TypeError: for names that are not strings and levels that are not integers
    """

    names: tuple[str, ...]
    levels: tuple[int, ...]

    def __post_init__(self) -> None:
        for parameter in ("names", "levels"):
            given = getattr(self, parameter)
            if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray):
                raise TypeError(f"Parameter `{parameter}` must be a sequence, found {given!r}.")
        names = tuple(self.names)
        if not names:
            raise ValueError(
                "Parameter `names` must name at least one reward component, found none."
            )
        for name in names:
            if not isinstance(name, str):
                raise TypeError(f"Parameter `names` must contain strings, found {name!r}.")
            if not name:
                raise ValueError(
                    f"Parameter `names` must not contain an empty name, found {list(names)}."
                )
            if set(name) & set(',"\r\n'):  # SB3 writes names into CSV files as they are
                raise ValueError(
                    "Parameter `names` must not contain commas, quotes or line breaks, found "
                    f"{name!r}."
                )
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise ValueError(
                f"Parameter `names` must be unique, found {duplicates} more than once in "
                f"{list(names)}."
            )
        _refuse_folders(names)
        if len(self.levels) != len(names):
            raise ValueError(
                f"Parameter `levels` must have one level for each of the {len(names)} names, found "
                f"{len(self.levels)}."
            )
        object.__setattr__(self, "names", names)
        object.__setattr__(
            self,
            "levels",
            tuple(parse_level(level, name) for name, level in zip(names, self.levels, strict=True)),
        )

    @classmethod
    def from_dict(cls, components: Mapping[str, Level]) -> RewardSpec:
        """Build a spec from ``{name: "task" | "regulariser" | level}``; "regularizer" is the same
        word.

        :param components: levels by name, in the order of the reward vector
        :raises ValueError: for an unknown level word
        """
        if not isinstance(components, Mapping):
            raise TypeError(
                f"Parameter `components` must map names to levels, found {components!r}."
            )
        return cls(
            tuple(components), tuple(parse_level(level, name) for name, level in components.items())
        )

    def to_dict(self) -> dict[str, int]:
        """Levels by name, in order."""
        return dict(zip(self.names, self.levels, strict=True))

    @property
    def return_keys(self) -> tuple[str, ...]:
        """Info keys under which our envs report the return of each component, for Monitor's
        ``info_keywords``.
        """
        return tuple(f"r_{name}" for name in self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[tuple[str, int]]:
        return iter(zip(self.names, self.levels, strict=True))

    def __str__(self) -> str:
        return ", ".join(f"{name} ({level_label(level)})" for name, level in self)


def _refuse_folders(names: tuple[str, ...]) -> None:
    """Refuse a name that is the folder of another: loggers make a file or a folder of each key."""
    for folder in names:
        for name in names:
            if name.startswith(f"{folder}/"):
                raise ValueError(
                    f"Parameter `names` must not contain a name that is the folder of another: "
                    f"found {folder!r} and {name!r}, which loggers cannot both write. Rename one."
                )


def parse_level(level: Any, name: str) -> int:
    """The integer behind a level word or integer.

    :param level: a word of ``LEVEL_WORDS`` or an integer ≥ 0
    :param name: the component that it belongs to, for the error
    :raises ValueError: for an unknown word or a negative level
    :raises TypeError: for anything else
    """
    choices = f"valid choices are {sorted(LEVEL_WORDS)} and integers from 0 (highest priority) on"
    if isinstance(level, str):
        if level not in LEVEL_WORDS:
            raise ValueError(f"Unknown level {level!r} of reward component '{name}': {choices}.")
        return LEVEL_WORDS[level]
    try:
        if isinstance(level, bool | np.bool_):
            raise TypeError
        value = operator.index(level)
    except TypeError:
        raise TypeError(
            f"The level of reward component '{name}' must be an integer or a word, found "
            f"{level!r}: {choices}."
        ) from None
    if value < 0:
        raise ValueError(
            f"The level of reward component '{name}' must not be negative, found {value}: "
            f"{choices}."
        )
    return value


def level_label(level: int) -> str:
    """What people call a level: "task", "regulariser", "level 2" …"""
    return {0: "task", 1: "regulariser"}.get(level, f"level {level}")


#: The spec of a reward that nobody has taken apart.
SCALAR_REWARD = RewardSpec(("reward",), (0,))
