"""Numbers and names as people put them into an info: nested, as vectors, as tensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.rewards.spec import Level

#: Levels by info key; a key that holds a vector or a dictionary maps to those of its entries.
Components = Mapping[str, "Level | Components"]


def leaves(components: Components) -> Iterator[tuple[str, Level]]:
    """Names and levels in order, those inside dictionaries and vectors too.

    :param components: levels by info key
    """
    for name, level in components.items():
        if isinstance(level, Mapping):
            yield from leaves(level)
        else:
            yield name, level


def as_array(value: Any, where: str) -> NDArray[np.float64]:
    """Real numbers as an array, of any shape.

    :param value: numbers of Python or NumPy, or tensors, also with a gradient or on another device
    :param where: how a sentence calls it, such as ``info["effort"]``
    :raises ValueError: for anything that is not made of real numbers; says what it is
    """
    if isinstance(value, Mapping):
        raise ValueError(
            f"{where} must be a number, found a dictionary with the keys {_keys(value)}: name the "
            'levels of its entries, as in `components={"key": {"entry": level}}`.'
        )
    if isinstance(value, str | bytes):
        raise ValueError(f"{where} must be a number, found the text {value!r}.")
    if hasattr(value, "detach"):
        value = value.detach().cpu()
        value = value if value.is_complex() else value.double()  # NumPy knows no bfloat16
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            if array.dtype.kind != "O" or None in array.ravel().tolist():
                raise TypeError
            array = array.astype(float)  # fractions and decimals
        return np.asarray(array, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{where} must be a real number, found {value!r}.") from None


def as_vector(value: Any, where: str, length: int) -> NDArray[np.float64]:
    """Real numbers as an array of shape (``length``,).

    :param value: a number where ``length`` is 1, or a row of numbers
    :param where: how a sentence calls it
    :param length: how many are wanted
    :raises ValueError: for other shapes
    """
    array = np.atleast_1d(as_array(value, where))
    if array.shape != (length,):
        raise ValueError(f"{where} must have shape ({length},), found {array.shape}.")
    return array


def look_up(source: Mapping[Any, Any], path: str) -> list[Any]:
    """What a dictionary holds under a key, or under a path of keys, ``"outer/inner"``.

    :param source: a dictionary, perhaps of dictionaries
    :param path: a key, or keys with slashes between them
    :return: the value in a list, or nothing where there is none
    """
    if path in source:
        return [source[path]]
    for index, character in enumerate(path):
        inner = source.get(path[:index]) if character == "/" else None
        if isinstance(inner, Mapping):
            found = look_up(inner, path[index + 1 :])
            if found:
                return found
    return []


def collect(
    components: Components, source: Mapping[Any, Any], where: str, vector_weights: Any = None
) -> list[float]:
    """The value of each component, in order.

    :param components: levels by key of ``source``
    :param source: where the terms are
    :param where: how a sentence calls it, such as ``info``
    :param vector_weights: what vectors are multiplied by: one weight for each entry, or weights by
        name
    :raises ValueError: for a component that is missing or is no number; names it
    """
    values: list[float] = []
    for key, level in components.items():
        found = look_up(source, key)
        if not found:
            raise ValueError(_missing(key, source, where))
        if isinstance(found[0], float | np.floating) and not isinstance(level, Mapping):
            values.append(float(found[0]))  # nearly always
            continue
        place = f'`{where}["{key}"]`'
        if not isinstance(level, Mapping):
            values.extend(as_vector(found[0], place, 1))
        elif isinstance(found[0], Mapping):
            values.extend(collect(level, found[0], f'{where}["{key}"]'))
        else:
            vector = as_vector(found[0], place, len(level))
            if vector_weights is not None:
                vector = vector * _weights_of(vector_weights, level, place)
            values.extend(vector)
    return values


def _weights_of(weights: Any, level: Components, place: str) -> NDArray[np.float64]:
    """``info["reward_weights"]`` for the entries of one vector."""
    where = '`info["reward_weights"]`'
    if isinstance(weights, Mapping):
        return np.array(collect(dict.fromkeys(level, 0), weights, 'info["reward_weights"]'))
    array = np.atleast_1d(as_array(weights, where))
    if array.shape != (len(level),):
        raise ValueError(
            f"{where} must have one weight for each entry of {place}, found {array.shape} for "
            f"{len(level)}. Parameter `weights` takes them by name instead."
        )
    return array


def _missing(key: str, source: Mapping[Any, Any], where: str) -> str:
    """The sentence about a component that is not there, and where else it is."""
    message = (
        f"Reward component '{key}' is missing: parameter `components` must name keys of `{where}`, "
        f"found only {_keys(source)}."
    )
    for outer, inner in source.items():
        if isinstance(inner, Mapping) and key in inner:
            return f'{message} It is in `{where}["{outer}"]`.'
    return message


def _keys(source: Mapping[Any, Any]) -> list[str]:
    return sorted(map(str, source))
