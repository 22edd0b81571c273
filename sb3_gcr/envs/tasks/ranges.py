"""Objectives that pay inside a range."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def choose_ranges(
    ranges: Mapping[str, tuple[tuple[float, float], ...]], chosen: Mapping[str, int | None]
) -> dict[str, tuple[float, float]]:
    """The bounds of the chosen objectives.

    :param ranges: all ranges by objective
    :param chosen: index of a range by objective, or None
    :raises ValueError: for an index that is not there
    """
    for name, index in chosen.items():
        if index is not None and (isinstance(index, bool) or index not in range(len(ranges[name]))):
            raise ValueError(
                f"Parameter `{name}` must be None or the index of one of "
                f"{dict(enumerate(ranges[name]))}, found {index!r}."
            )
    return {name: ranges[name][index] for name, index in chosen.items() if index is not None}


def inside(values: Array, bounds: tuple[float, float]) -> NDArray[np.bool_]:
    """Whether each value is in a range; NaN is in none.

    :param values: any shape
    :param bounds: lower one included, upper one excluded
    """
    return (bounds[0] <= values) & (values < bounds[1])
