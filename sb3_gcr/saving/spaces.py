"""Observation and action spaces as plain JSON, and what differs between two of them."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces


def describe_spaces(
    observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> dict[str, Any]:
    """The spaces of a model or an env as JSON.

    :param observation_space: of it
    :param action_space: of it
    """
    return {
        "observation_space": describe_space(observation_space),
        "action_space": describe_space(action_space),
    }


def describe_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """An observation or action space as JSON.

    :param space: one that SB3 knows; of others only what they print
    """
    kind = type(space).__name__
    if isinstance(space, spaces.Dict):
        return {"type": kind, "spaces": {key: describe_space(item) for key, item in space.items()}}
    if isinstance(space, spaces.Box):
        bounds = {"low": _shorten(space.low), "high": _shorten(space.high)}
        return {
            "type": kind,
            "shape": list(space.shape),
            "dtype": np.dtype(space.dtype).name,
            **bounds,
        }
    if isinstance(space, spaces.Discrete):
        return {"type": kind, "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {"type": kind, "nvec": space.nvec.tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {
            "type": kind,
            "n": list(space.n) if isinstance(space.n, tuple | list) else int(space.n),
        }
    return {"type": kind, "text": repr(space)}


def _shorten(bound: Any) -> Any:
    """A bound that is the same everywhere as one number."""
    values = np.unique(bound)
    return float(values[0]) if values.size == 1 else bound.tolist()


def find_differences(saved: Any, found: Any, name: str) -> list[str]:
    """What differs between two descriptions, a line for each entry.

    :param saved: from the file
    :param found: of the env
    :param name: what is described
    """
    if (
        isinstance(saved, dict)
        and isinstance(found, dict)
        and saved.get("type") == found.get("type")
    ):
        keys = {**saved, **found}
        pairs = [
            (saved.get(key, "missing"), found.get(key, "missing"), f"{name}.{key}") for key in keys
        ]
        return [line for pair in pairs for line in find_differences(*pair)]
    if isinstance(saved, dict) and isinstance(found, dict):
        return find_differences(saved["type"], found["type"], f"{name}.type")
    return (
        []
        if saved == found
        else [f"{name} is {reprlib.repr(saved)} in the file and {reprlib.repr(found)} in the env"]
    )


def check_spaces(
    saved: Mapping[str, Any], observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> None:
    """Refuse an env that the model in a file does not fit.

    :param saved: descriptions of the model's spaces
    :param observation_space: of the env
    :param action_space: of the env
    :raises ValueError: says what differs
    """
    found = describe_spaces(observation_space, action_space)
    differences = [
        line for name in found for line in find_differences(saved[name], found[name], name)
    ]
    if differences:
        raise ValueError(
            "Parameter `env` must have the spaces of the saved model, found others: "
            f"{'; '.join(differences)}."
        )
