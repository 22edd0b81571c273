"""Every range of every objective pays for some motion, and the docs have the table."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco.batch")

from examples.reachability import table

DOCS = (Path(__file__).parents[1] / "docs/tasks.md").read_text()


@pytest.mark.parametrize(("task", "n_components"), [("HumanoidMO", 4), ("ThrowingMO", 6)])
def test_every_range_can_be_reached(task: str, n_components: int) -> None:
    rows = table(task)
    assert len(rows) == 5 * n_components
    for objective, bounds, paid, _ in rows:
        assert paid > 0, (objective, bounds)
        assert f"| `{objective}` | {bounds} |" in DOCS
