"""Every range of every objective pays for some motion, and the docs have the table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("mujoco.batch")

from examples.reachability import table

DOCS = (Path(__file__).parents[1] / "docs/tasks.md").read_text(encoding="utf-8")


def section_of(task: str) -> str:
    """The last section of the page that has the task in its heading."""
    sections = re.split(r"^#+ ", DOCS, flags=re.M)
    return next(text for text in reversed(sections) if task in text.splitlines()[0])


@pytest.mark.parametrize(
    ("task", "n_objectives"),
    [
        ("HumanoidMO", 4),
        ("ThrowingMO", 6),
        ("Walker2dMO", 4),
        ("HopperMO", 4),
        ("HalfCheetahMO", 4),
    ],
)
def test_every_range_can_be_reached(task: str, n_objectives: int) -> None:
    section = section_of(task)
    rows = table(task)
    assert len(rows) == 5 * n_objectives
    for objective, bounds, paid, _ in rows:
        assert paid > 0, (objective, bounds)
        assert f"| `{objective}` | {bounds} |" in section
