"""Names and levels, and the words of their errors."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from sb3_gcr import RewardSpec

LEVELS = (
    "valid choices are ['regulariser', 'regularizer', 'task'] and integers from 0 (highest "
    "priority) on"
)


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def test_spec_from_words_and_integers() -> None:
    spec = RewardSpec.from_dict(
        {"run": "task", "torque": "regulariser", "jerk": "regularizer", "style": 2}
    )
    assert spec == RewardSpec(["run", "torque", "jerk", "style"], np.array([0, 1, 1, 2]))  # type: ignore[arg-type]
    assert spec.to_dict() == {"run": 0, "torque": 1, "jerk": 1, "style": 2}
    assert len(spec) == 4
    assert hash(spec) == hash(RewardSpec(spec.names, spec.levels))
    assert str(spec) == "run (task), torque (regulariser), jerk (regulariser), style (level 2)"
    with pytest.raises(AttributeError):
        spec.names = ("other",)  # type: ignore[misc]


@pytest.mark.parametrize(
    ("names", "levels", "error", "message"),
    [
        (
            [],
            [],
            ValueError,
            "Parameter `names` must name at least one reward component, found none.",
        ),
        (
            ["a", ""],
            [0, 0],
            ValueError,
            "Parameter `names` must not contain an empty name, found ['a', ''].",
        ),
        (["a", 3], [0, 0], TypeError, "Parameter `names` must contain strings, found 3."),
        (
            ["a,b"],
            [0],
            ValueError,
            "Parameter `names` must not contain commas, quotes or line breaks, found 'a,b'.",
        ),
        ("ab", [0, 0], TypeError, "Parameter `names` must be a sequence, found 'ab'."),
        (
            ["a", "b", "a"],
            [0, 0, 1],
            ValueError,
            "Parameter `names` must be unique, found ['a'] more than once in ['a', 'b', 'a'].",
        ),
        (
            ["a", "b"],
            [0],
            ValueError,
            "Parameter `levels` must have one level for each of the 2 names, found 1.",
        ),
        (
            ["a"],
            [0.5],
            TypeError,
            f"The level of reward component 'a' must be an integer or a word, found 0.5: {LEVELS}.",
        ),
        (
            ["a"],
            [True],
            TypeError,
            "The level of reward component 'a' must be an integer or a word, found True: "
            f"{LEVELS}.",
        ),
        (
            ["a"],
            [-1],
            ValueError,
            f"The level of reward component 'a' must not be negative, found -1: {LEVELS}.",
        ),
        (["a"], ["boss"], ValueError, f"Unknown level 'boss' of reward component 'a': {LEVELS}."),
    ],
)
def test_bad_specs(names: Any, levels: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=exactly(message)):
        RewardSpec(names, levels)


def test_from_dict_needs_a_mapping() -> None:
    with pytest.raises(
        TypeError, match=exactly("Parameter `components` must map names to levels, found ['a'].")
    ):
        RewardSpec.from_dict(["a"])  # type: ignore[arg-type]


@pytest.mark.parametrize("names", [("a", "a/b"), ("a/b/c", "x", "a/b")])
def test_a_name_that_is_the_folder_of_another(names: tuple[str, ...]) -> None:
    """Loggers make a file or a folder of a key, and MLflow's cannot make both."""
    folder, inner = sorted((name for name in names if name != "x"), key=len)
    message = (
        "Parameter `names` must not contain a name that is the folder of another: found "
        f"{folder!r} and {inner!r}, which loggers cannot both write. Rename one."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        RewardSpec(names, (0,) * len(names))


def test_names_with_a_slash_are_fine_side_by_side() -> None:
    assert len(RewardSpec(("a/b", "a/c", "ab"), (0, 0, 1))) == 3
