"""What an env reports in random steps: its reward, and all numbers in its infos by place and
name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_gcr.rewards.values import as_array

#: Vectors with more entries are observations rather than terms.
LONGEST_VECTOR = 32
#: What names of terms, or of dictionaries with terms, often contain.
REWARD_WORDS = re.compile(r"rew|rwd|cost|penal|bonus|^r_|_r$", re.IGNORECASE)
#: What names of attributes with weights often contain.
WEIGHT_WORDS = re.compile(r"w(eigh)?ts?|wt|scale|coef|config|cfg", re.IGNORECASE)


@dataclass(frozen=True)
class Group:
    """Numbers that stand in one place at every step.

    :param kind: "info", for a dictionary; "vector", for an array in one; "attribute", for a
        dictionary that the env keeps
    :param path: keys to it with slashes between them, "" for the info itself; or the attribute
    :param names: n names
    :param values: shape (T, n)
    """

    kind: str
    path: str
    names: tuple[str, ...]
    values: NDArray[np.float64]

    def take(self, names: list[str]) -> NDArray[np.float64]:
        """The columns of some names, shape (T, len(names)).

        :param names: in the order that is wanted
        """
        return self.values[:, [self.names.index(name) for name in names]]

    @property
    def reward_like(self) -> list[str]:
        """The names that sound like terms of a reward, by themselves or by where they are."""
        if REWARD_WORDS.search(self.path):
            return list(self.names)
        return [name for name in self.names if REWARD_WORDS.search(name)]


@dataclass(frozen=True)
class Samples:
    """What was seen in T steps.

    :param rewards: shape (T,), or (T, m) where the reward is a vector
    :param starts: whether a step is the first of its episode, shape (T,)
    :param groups: numbers that were there in every step
    :param absent: names that were there in some steps only
    :param told: weights by name that attributes of the env tell, by attribute
    """

    rewards: NDArray[np.float64]
    starts: NDArray[np.bool_]
    groups: list[Group]
    absent: list[str]
    told: dict[str, dict[str, float]]


def sample(env: gym.Env[Any, Any], n_steps: int, seed: int | None) -> Samples:
    """Act at random.

    :param env: an env; it is reset and stepped
    :param n_steps: T
    :param seed: of the env and of the actions
    :raises ValueError: for rewards that are no numbers
    """
    env.action_space.seed(seed)
    env.reset(seed=seed)
    steps: list[dict[tuple[str, str, str], float]] = []
    rewards, starts, is_start = [], [], True
    for _ in range(n_steps):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        rewards.append(as_array(reward, "The reward").ravel())
        starts.append(is_start)
        steps.append(dict(_numbers(env, info)))
        is_start = bool(terminated or truncated)
        if is_start:
            env.reset()
    always = [key for key in steps[0] if all(key in step for step in steps)]
    absent = {key[2] for step in steps for key in step} - {key[2] for key in always}
    return Samples(
        np.squeeze(np.array(rewards), axis=1) if len(rewards[0]) == 1 else np.array(rewards),
        np.array(starts),
        _group(always, steps),
        sorted(absent),
        _told_weights(env),
    )


def _group(
    keys: list[tuple[str, str, str]], steps: list[dict[tuple[str, str, str], float]]
) -> list[Group]:
    places = dict.fromkeys((kind, path) for kind, path, _ in keys)
    groups = []
    for kind, path in places:
        names = tuple(key[2] for key in keys if key[:2] == (kind, path))
        values = np.array([[step[kind, path, name] for name in names] for step in steps])
        finite = np.isfinite(values).all(0)
        names = tuple(name for name, is_finite in zip(names, finite, strict=True) if is_finite)
        if names:
            groups.append(Group(kind, path, names, values[:, finite]))
    return groups


def _numbers(
    env: gym.Env[Any, Any], info: Mapping[Any, Any]
) -> Iterator[tuple[tuple[str, str, str], float]]:
    """All numbers of a step by kind, path and name."""
    yield from _flatten("info", "", info)
    for name, value in _dictionaries(env).items():
        if REWARD_WORDS.search(name):
            yield from _flatten("attribute", name, value)


def _flatten(
    kind: str, path: str, source: Mapping[Any, Any]
) -> Iterator[tuple[tuple[str, str, str], float]]:
    for key, value in source.items():
        inner = f"{path}/{key}" if path else str(key)
        if isinstance(value, Mapping):
            yield from _flatten(kind, inner, value)
            continue
        try:
            array = as_array(value, "")
        except ValueError:
            continue
        if array.size == 1:
            yield (kind, path, str(key)), float(array.ravel()[0])
        elif array.ndim == 1 and array.size <= LONGEST_VECTOR and kind == "info":
            for index, entry in enumerate(array.tolist()):
                yield ("vector", inner, f"{key}_{index}"), entry


def _dictionaries(env: gym.Env[Any, Any]) -> dict[str, Mapping[Any, Any]]:
    """Attributes of the env and of its classes that are dictionaries; no property is called."""
    attributes: dict[str, Any] = {}
    for kind in reversed(type(env.unwrapped).__mro__):
        attributes |= vars(kind)
    attributes |= vars(env.unwrapped)
    return {
        name: value
        for name, value in attributes.items()
        if isinstance(value, Mapping) and not name.startswith("__")
    }


def _told_weights(env: gym.Env[Any, Any]) -> dict[str, dict[str, float]]:
    """Attributes of the env that are dictionaries of numbers, those with the likeliest names
    first.
    """
    found = {}
    for name, value in _dictionaries(env).items():
        numbers = {
            str(key): float(number)
            for key, number in value.items()
            if isinstance(number, int | float | np.number) and not isinstance(number, bool)
        }
        if numbers:
            found[name] = numbers
    return dict(sorted(found.items(), key=lambda item: not WEIGHT_WORDS.search(item[0])))
