"""The report of a run, from a log written by hand."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from sb3_gcr import RewardSpec
from sb3_gcr.logs.report import write_report
from sb3_gcr.logs.shown import CosineTable

SPEC = RewardSpec(("run", "save"), (0, 1))


def test_table_and_pictures(tmp_path: Path) -> None:
    columns = ["time/total_timesteps", "rollout/ep_rew_mean", "gcr/conflict_rate"]
    columns += [
        f"{key}/{name}"
        for name in SPEC.names
        for key in ("rollout/ep_rew", "gcr/weight", "gcr/in_conflict")
    ]
    rows = [
        [100, 1, "", 3, "", "", -2, "", ""],
        [200, 2, 0.5, 4, 1.5, 0.25, -2.5, 1, 1],
        [300, 3, 0.7, 6, 2.5, 0.75, -3, 1, 1],
    ]
    (tmp_path / "progress.csv").write_text(
        "\n".join(",".join(map(str, row)) for row in [columns, *rows]) + "\n"
    )
    table = CosineTable(str(tmp_path), SPEC)
    for step, cosine in ((200, -0.5), (300, 0.25)):
        table.append(step, np.array([[1.0, cosine], [cosine, 1.0]]))
    assert (tmp_path / "cosines.csv").read_text().splitlines() == [
        "time/total_timesteps,run | save",
        "200,-0.5",
        "300,0.25",
    ]
    report = write_report(tmp_path, SPEC)
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in report.table.splitlines()
        if "|" in line
    ]
    assert cells == [
        ["component", "level", "return at start", "return at end", "mean weight", "in conflict"],
        ["run", "task", "3.0", "6.0", "2.00", "50%"],
        ["save", "regulariser", "-2.0", "-3.0", "1.00", "100%"],
    ]
    assert [path.name for path in report.pictures] == [
        "returns.png",
        "cosines.png",
        "conflicts.png",
    ]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in report.pictures)


def test_a_folder_without_a_log(tmp_path: Path) -> None:
    message = (
        f"Parameter `folder` must contain 'progress.csv', found none in '{tmp_path}'. "
        'Train with `model.set_logger(configure(folder, ["csv", ...]))` for at least one update.'
    )
    with pytest.raises(FileNotFoundError, match=f"^{re.escape(message)}$"):
        write_report(tmp_path, SPEC)


def test_a_log_that_ends_before_the_first_update(tmp_path: Path) -> None:
    (tmp_path / "progress.csv").write_text("time/total_timesteps\n64\n")
    (tmp_path / "cosines.csv").write_text("time/total_timesteps,run|save\n64,0\n")
    with pytest.raises(
        ValueError,
        match=r"must contain the log of at least two rollouts .* found none of \['gcr/weight/run'",
    ):
        write_report(tmp_path, SPEC)
