"""Checks of arguments: what passes, what does not, and in what words."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from sb3_gcr.checks import check_choice, check_flag, check_number, text_hint


@pytest.mark.parametrize(
    ("value", "kwargs"),
    [
        (0, {}),
        (-1.5, {}),
        (np.float32(0.5), {"low": 0.5}),
        (np.int64(3), {"low": 3, "high": 3, "integer": True}),
        (np.inf, {"low": 0}),
        (None, {"low": 0, "optional": True}),
        (len, {"low": 0, "schedule": True}),
        (1e-9, {"low": 0, "above": True}),
    ],
)
def test_valid_numbers(value: Any, kwargs: Any) -> None:
    check_number("x", value, **kwargs)


@pytest.mark.parametrize(
    ("value", "kwargs", "error", "expected"),
    [
        (np.nan, {}, ValueError, "a number"),
        (0, {"low": 0, "above": True}, ValueError, "a number > 0"),
        (-1, {"low": 0}, ValueError, "a number ≥ 0"),
        (2, {"low": 0, "high": 1}, ValueError, "a number from 0 to 1"),
        (0, {"low": 0, "high": 1, "above": True}, ValueError, "a number above 0 and up to 1"),
        (1.0, {"low": 1, "integer": True}, ValueError, "an integer ≥ 1"),
        (None, {}, TypeError, "a number"),
        (False, {}, TypeError, "a number"),
        (1j, {}, TypeError, "a number"),
        (len, {}, TypeError, "a number"),
        (0, {"low": 1, "optional": True}, ValueError, "a number ≥ 1 or None"),
        (0, {"low": 1, "schedule": True}, ValueError, "a number ≥ 1 or a schedule"),
        (
            0,
            {"low": 1, "schedule": True, "optional": True},
            ValueError,
            "a number ≥ 1, a schedule or None",
        ),
    ],
)
def test_invalid_numbers(value: Any, kwargs: Any, error: Any, expected: str) -> None:
    message = f"Parameter `x` must be {expected}, found {value!r}."
    with pytest.raises(error, match=f"^{re.escape(message)}$"):
        check_number("x", value, **kwargs)


def test_text_that_looks_like_a_number_gets_a_hint() -> None:
    assert text_hint("1e-2") == " That is text: YAML needs a dot in 1.0e-2."
    assert text_hint("auto") == text_hint(0.01) == ""


def test_choices() -> None:
    check_choice("x", "b", ("a", "b"))
    check_choice("x", None, ("a", "b"), optional=True)
    for value, optional, expected in (
        ("c", False, "'a' or 'b'"),
        (None, False, "'a' or 'b'"),
        (["a"], True, "'a', 'b' or None"),
    ):
        message = f"Parameter `x` must be {expected}, found {value!r}."
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            check_choice("x", value, ("a", "b"), optional=optional)


def test_flags() -> None:
    check_flag("x", False)
    check_flag("x", np.bool_(True))
    for value in ("False", 0, None):
        message = f"Parameter `x` must be True or False, found {value!r}."
        with pytest.raises(TypeError, match=f"^{re.escape(message)}$"):
            check_flag("x", value)
