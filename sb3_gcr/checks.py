"""Checks of arguments: an error names the parameter, what it must be and what was found."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import numpy as np


def check_number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: bool = False,
    integer: bool = False,
    optional: bool = False,
) -> None:
    """Refuse what is no number, or lies outside its range.

    :param name: of the parameter
    :param value: what was given
    :param low: smallest valid number
    :param high: largest valid number
    :param above: whether ``low`` itself is not valid
    :param integer: whether it must be an integer
    :param optional: whether None is valid
    :raises TypeError: for text and other things that are no number
    :raises ValueError: for a number outside the range, NaN included
    """
    if value is None and optional:
        return
    kind = "an integer" if integer else "a number"
    expected = f"{kind}{_range(low, high, above)}{' or None' if optional else ''}"
    message = f"Parameter `{name}` must be {expected}, found {value!r}."
    if isinstance(value, str):
        raise TypeError(f"{message}{text_hint(value)}")
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise TypeError(message)
    whole = not integer or isinstance(value, int | np.integer)
    inside = (low < value if above else low <= value) and value <= high
    if not (whole and inside):
        raise ValueError(message)


def check_choice(name: str, value: Any, choices: Collection[str], optional: bool = False) -> None:
    """Refuse what is none of the choices.

    :param name: of the parameter
    :param value: what was given
    :param choices: valid values
    :param optional: whether None is valid
    :raises ValueError: lists the choices
    """
    if (value is None and optional) or (isinstance(value, str) and value in choices):
        return
    listed = [repr(choice) for choice in choices]
    if optional:
        listed.append("None")
    expected = f"{', '.join(listed[:-1])} or {listed[-1]}"
    raise ValueError(f"Parameter `{name}` must be {expected}, found {value!r}.")


def _range(low: float, high: float, above: bool) -> str:
    if high < math.inf:
        return f" {'above' if above else 'from'} {low:g} {'and up to' if above else 'to'} {high:g}"
    if low > -math.inf:
        return f" {'>' if above else '≥'} {low:g}"
    return ""


def text_hint(value: Any) -> str:
    """What to add to an error about a number that is written as text; nothing for others.

    :param value: what was given
    """
    is_text = isinstance(value, str) and _is_number(value)
    return " That is text: YAML needs a dot in 1.0e-2." if is_text else ""


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
