"""Checks of arguments: an error names the parameter, what it must be and what was found."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
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
    schedule: bool = False,
) -> None:
    """Refuse what is no number, or lies outside its range.

    :param name: of the parameter
    :param value: what was given
    :param low: smallest valid number
    :param high: largest valid number
    :param above: whether ``low`` itself is not valid
    :param integer: whether it must be an integer
    :param optional: whether None is valid
    :param schedule: whether a function, as SB3's schedules are, is valid; it is not called
    :raises TypeError: for text and other things that are no number
    :raises ValueError: for a number outside the range, NaN included
    """
    if (value is None and optional) or (schedule and callable(value)):
        return
    choices = [f"{'an integer' if integer else 'a number'}{_range(low, high, above)}"]
    if schedule:
        choices.append("a schedule")
    if optional:
        choices.append("None")
    message = f"Parameter `{name}` must be {_or(choices)}, found {value!r}."
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
    raise ValueError(f"Parameter `{name}` must be {_or(listed)}, found {value!r}.")


def check_flag(name: str, value: Any) -> None:
    """Refuse what is neither True nor False, such as the text "False", which counts as true.

    :param name: of the parameter
    :param value: what was given
    :raises TypeError: says what was found
    """
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"Parameter `{name}` must be True or False, found {value!r}.")


def _or(choices: Sequence[str]) -> str:
    if len(choices) == 1:
        return choices[0]
    return f"{', '.join(choices[:-1])} or {choices[-1]}"


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
