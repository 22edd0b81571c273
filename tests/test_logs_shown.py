"""The table of components, the file of cosines and its picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger, configure

from sb3_gcr import GCRPPO, RewardSpec
from sb3_gcr.conflicts.estimators import Estimate
from sb3_gcr.logs.report import write_report
from sb3_gcr.logs.shown import (
    CosineTable,
    component_table,
    cosine_figure,
    format_table,
    log_cosines,
    pair_names,
)
from tests.envs import SPEC, Env
from tests.training import SMALL, exactly

THREE = RewardSpec(("run", "jump", "save"), (0, 0, 1))
MATRIX = np.array([[1.0, -0.5, 0.25], [-0.5, 1.0, 1 / 3], [0.25, 1 / 3, 1.0]])
NONE = np.full((3, 3), np.nan)
UNBIASED = Estimate(NONE, NONE, NONE.diagonal())
PAIR = Estimate(NONE[:2, :2], NONE[:2, :2], NONE.diagonal()[:2])
HEAD = "time/total_timesteps,run | jump,run | save,jump | save"


OPENED: list[Logger] = []


@pytest.fixture(autouse=True)
def close_loggers() -> Iterator[None]:
    yield
    while OPENED:
        OPENED.pop().close()


def open_logger(folder: Path) -> Logger:
    OPENED.append(configure(str(folder), ["csv"]))
    return OPENED[-1]


def rows(folder: Path) -> list[str]:
    return (folder / "cosines.csv").read_text().splitlines()


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_words_are_left_and_numbers_right() -> None:
    table = format_table([["name", "level", "return"], ["go", "task", "1"], ["stay", "2", "-100"]])
    assert table.splitlines() == [
        "-------------------------",
        "| name | level | return |",
        "-------------------------",
        "| go   | task  |      1 |",
        "| stay | 2     |   -100 |",
        "-------------------------",
    ]


def test_component_table_leaves_missing_figures_blank() -> None:
    values = {"rollout/ep_rew/run": 12.345, "gcr/weight/save": 1.0}
    lines = component_table(RewardSpec(("run", "save"), (0, 1)), values).splitlines()
    run, save = (line for line in lines if line.startswith(("| run", "| save")))
    assert cells(run) == ["run", "task", "12.3", "", "", "", ""]
    assert cells(save) == ["save", "regulariser", "", "1", "", "", ""]


def test_names_that_look_alike_do_not_break_the_table() -> None:
    spec = RewardSpec(
        tuple(f"a_very_long_name_that_is_cut_in_the_table_{i}" for i in range(3)), (0, 0, 1)
    )
    GCRPPO("MlpPolicy", make_vec_env(lambda: Env(spec), 1), verbose=1, **SMALL).learn(64)


def test_a_row_for_each_update(tmp_path: Path) -> None:
    assert pair_names(THREE) == ["run | jump", "run | save", "jump | save"]
    table = CosineTable(str(tmp_path), THREE)
    table.append(64, MATRIX)
    table.append(128, -MATRIX)
    assert rows(tmp_path) == [HEAD, "64,-0.5,0.25,0.333333", "128,0.5,-0.25,-0.333333"]


def test_a_table_begins_anew_with_its_logger_and_goes_on_with_it(tmp_path: Path) -> None:
    for _ in range(2):
        logger = open_logger(tmp_path)
        for step in (64, 128):
            log_cosines(logger, THREE, step, MATRIX, UNBIASED, as_picture=False)
        assert len(rows(tmp_path)) == 3
    assert len([f for f in logger.output_formats if isinstance(f, CosineTable)]) == 1
    # another model's components in the same folder, with a logger of its own
    two = RewardSpec(("run", "save"), (0, 1))
    log_cosines(open_logger(tmp_path), two, 64, MATRIX[:2, :2], PAIR, as_picture=False)
    assert rows(tmp_path) == ["time/total_timesteps,run | save", "64,-0.5"]


def test_two_models_with_one_logger_are_refused_by_name(tmp_path: Path) -> None:
    logger = open_logger(tmp_path)
    CosineTable.of(logger, THREE)
    message = (
        "A logger's 'cosines.csv' must have the components of the model, ['run', 'save'], found "
        f"['run', 'jump', 'save'] in '{tmp_path}'. Give the model a logger of its own: "
        "`model.set_logger(configure(...))`."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        CosineTable.of(logger, RewardSpec(("run", "save"), (0, 1)))
    assert rows(tmp_path) == [HEAD]


def test_a_logger_without_folder_has_no_table(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    logger = Logger(None, [])
    assert CosineTable.of(logger, THREE) is None
    log_cosines(logger, THREE, 64, MATRIX, UNBIASED, as_picture=True)
    assert not list(tmp_path.iterdir())


def train(folder: Path, spec: RewardSpec = SPEC, timesteps: int = 96) -> Any:
    model = GCRPPO("MlpPolicy", make_vec_env(lambda: Env(spec), 1, seed=0), **SMALL)
    model.set_logger(open_logger(folder))
    return model.learn(timesteps)


def test_a_run_that_goes_on_has_one_log_and_one_report(tmp_path: Path) -> None:
    model = train(tmp_path)
    model.learn(64, reset_num_timesteps=False)
    cosines = pd.read_csv(tmp_path / "cosines.csv")
    assert cosines["time/total_timesteps"].tolist() == [32, 64, 96, 128, 160]
    progress = pd.read_csv(tmp_path / "progress.csv")
    assert progress["time/total_timesteps"].tolist() == [32, 64, 96, 128, 160]
    report = write_report(tmp_path, model.reward_spec)
    assert [path.name for path in report.pictures] == [
        "returns.png",
        "cosines.png",
        "conflicts.png",
    ]


@pytest.mark.parametrize(
    "names",
    [("go", "stay"), ("go", "stay", "rest", "more"), ("a", "b", "c"), ("go", "save", "stay")],
)
def test_another_run_in_the_same_folder_begins_anew(tmp_path: Path, names: Any) -> None:
    """Fewer terms, more, others, and the same in another order."""
    train(tmp_path, timesteps=160)
    spec = RewardSpec(names, tuple(range(len(names))))
    model = train(tmp_path, spec)
    cosines = pd.read_csv(tmp_path / "cosines.csv")
    assert list(cosines.columns[1:]) == pair_names(spec)
    assert cosines["time/total_timesteps"].tolist() == [32, 64, 96]
    assert f"| {names[0]}" in write_report(tmp_path, model.reward_spec).table


def test_a_report_names_a_file_of_other_components(tmp_path: Path) -> None:
    train(tmp_path)
    CosineTable(str(tmp_path), THREE).append(64, MATRIX)
    message = (
        "Parameter `folder` must contain a 'cosines.csv' with the columns ['go | stay', "
        "'go | save', 'stay | save'] and at least one update, found ['run | jump', 'run | save', "
        f"'jump | save'] and 1 updates in '{tmp_path}'."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        write_report(tmp_path, SPEC)
    assert not list(tmp_path.glob("*.png"))
    CosineTable(str(tmp_path), SPEC)
    with pytest.raises(ValueError, match=r"found .* and 0 updates"):
        write_report(tmp_path, SPEC)


class Figures(KVWriter):
    """Keeps the keys that a logger is given."""

    def __init__(self) -> None:
        self.keys: set[str] = set()

    def write(self, key_values: Any, key_excluded: Any, step: int = 0) -> None:
        self.keys |= set(key_values)

    def close(self) -> None: ...


def test_the_logger_of_others_is_not_disturbed() -> None:
    """A table writes nothing of its own into what a logger dumps."""
    figures = Figures()
    logger = Logger(None, [figures])
    log_cosines(logger, THREE, 64, MATRIX, UNBIASED, as_picture=True)
    logger.dump()
    assert figures.keys == set()


def test_a_picture_has_a_matrix_for_each_title() -> None:
    figure = cosine_figure(THREE, {"start": MATRIX, "end": -MATRIX})
    start, end, bar = figure.axes
    assert [axis.get_title() for axis in (start, end)] == ["start", "end"]
    assert [text.get_text() for text in start.texts[:3]] == ["1.00", "-0.50", "0.25"]
    assert [label.get_text() for label in end.get_yticklabels()] == ["run", "jump", "save"]
    assert bar.get_ylabel() == "cosine between gradients"
