"""The report of a study: from cells made of numbers to tables, pictures and a page."""

from __future__ import annotations

import builtins
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.studies import LEVELS, Result, cosines, error, result, write_study

pd = pytest.importorskip("pandas")
pytest.importorskip("matplotlib")

from matplotlib.figure import Figure  # noqa: E402

from sb3_gcr.study import figures, paper_figures, paper_tables, report, tables  # noqa: E402
from sb3_gcr.study.collected import collected  # noqa: E402
from sb3_gcr.study.conclusions import conclude  # noqa: E402
from sb3_gcr.study.frames import Frames, frames, short  # noqa: E402
from sb3_gcr.study.page import (  # noqa: E402
    Block,
    Code,
    Heading,
    Pictures,
    Table,
    Text,
    to_html,
    to_markdown,
)

METHODS = ("ppo", "multi_head", "gcr")
#: Returns over training of two seeds; GCRPPO is 12 % above PPO, the heads alone 1 %.
RETURNS = {"ppo": (99.0, 101.0), "multi_head": (100.0, 102.0), "gcr": (111.0, 113.0)}


def all_cells() -> list[Result]:
    return [
        result(method, seed, value)
        for method, values in RETURNS.items()
        for seed, value in enumerate(values)
    ]


class Page(HTMLParser):
    """The tables, paragraphs and addresses of a page."""

    def __init__(self, text: str):
        super().__init__()
        self.tables: list[list[list[str]]] = []
        self.paragraphs: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self._open = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [
            str(value) for name, value in attrs if name in ("src", "href", "xlink:href")
        ]
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self._open = "cell"
        elif tag == "p":
            self.paragraphs.append("")
            self._open = "p"

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th", "p"):
            self._open = ""

    def handle_data(self, data: str) -> None:
        if self._open == "cell":
            self.tables[-1][-1][-1] += data
        elif self._open == "p":
            self.paragraphs[-1] += data

    def table(self, *head: str) -> list[dict[str, str]]:
        """The rows of the first table with these columns, by column."""
        for rows in self.tables:
            if set(head) <= set(rows[0]):
                return [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]
        raise AssertionError(f"no table with {head}")


def blocks_of(folder: Path) -> list[Block]:
    """The report with its figures made and none saved."""
    study = collected(folder)
    data = frames(study.results, study.manifest["tasks"])
    found = conclude(study, data)
    return report.blocks(study, data, found, "sb3-gcr-study cell study.yml")


def rows_of(blocks: list[Block], *head: str) -> list[dict[str, str]]:
    """The rows of the first table with these columns, by column."""
    for block in blocks:
        if isinstance(block, Table) and set(head) <= set(block.head):
            return [dict(zip(block.head, row, strict=True)) for row in block.rows]
    raise AssertionError(f"no table with {head}")


def labels(axis: Any, which: str) -> list[str]:
    return [text.get_text() for text in getattr(axis, f"get_{which}ticklabels")()]


def test_the_answer(tmp_path: Path) -> None:
    """By hand: v = 2 / 2 twice, two degrees of freedom, t = 4.3027. Fieller's ends of 112 / 100
    are 1.0574 and 1.1868, of 112 / 101 1.0472 and 1.1746, of 101 / 100 .9506 and 1.0731; p is
    .0136, .0161 and .553, that of the final return .0136; the last three times 2, 1 and 3.
    """
    folder = write_study(tmp_path, all_cells(), seeds=2)
    assert report.answer(folder).splitlines() == [
        "MyEnv-v0, 500,000 steps, 2 seeds, equal settings.",
        "GCRPPO learns faster than PPO here: return over training +12 % (95 % interval 6 to 19, "
        "Welch), better in 4 of 4 pairs of runs.",
        "The surgery does it: +11 % (5 to 17) over multi_head; of the heads nothing is shown, +1 % "
        "(-5 to 7) over PPO.",
        "Final return: higher (+12 %, 6 to 19).",
        "Regularisers paid for nothing: torque -31 -> -31, action_rate -1 -> -1, joint_limits -1 "
        "-> -1.",
        "2.3 of 10 pairs conflict; most of all speed | torque (cosine -0.40 at the end).",
    ]


def test_half_the_cells_are_interim(tmp_path: Path) -> None:
    folder = write_study(tmp_path, all_cells()[:3], seeds=2)
    first, second = report.answer(folder).splitlines()[:2]
    assert first == "Interim, 3 of 6 runs: MyEnv-v0, 500,000 steps, 0 to 2 seeds, equal settings."
    assert second == "No answer yet: no finished run of GCRPPO."
    assert blocks_of(folder)[0] == Text(first, "answer")


def test_no_cell_has_finished(tmp_path: Path) -> None:
    folder = write_study(tmp_path, [], seeds=2)
    assert report.answer(folder).splitlines()[0] == (
        "Interim, 0 of 6 runs: my_study, 0 seeds, equal settings."
    )
    assert blocks_of(folder)[-1] == Text("No cell has finished yet: there is nothing to show.")


def test_failed_cells_are_named_first(tmp_path: Path) -> None:
    folder = write_study(tmp_path, all_cells()[:-1], [error("gcr", 1)], seeds=2)
    assert report.answer(folder).splitlines()[0] == (
        "MyEnv-v0, 500,000 steps, 1 to 2 seeds, equal settings; 1 of 6 runs failed (GCRPPO with "
        "seed 1)."
    )
    found = blocks_of(folder)
    place = found.index(Heading("Failed runs"))
    (row,) = rows_of(found, "cell", "error")
    assert row["error"] == "ValueError: no <good>"
    assert row["repeat it with"] == "sb3-gcr-study cell study.yml gcr-1"
    assert found[place + 2] == Code("end of the log of gcr-1", "the last lines")


def test_a_cell_that_may_be_tried_again_has_not_failed(tmp_path: Path) -> None:
    once = error("gcr", 1) | {"attempts": 1}
    folder = write_study(tmp_path, all_cells()[:-1], [once], seeds=2)
    assert report.answer(folder).startswith("Interim, 5 of 6 runs: ")


def test_one_seed(tmp_path: Path) -> None:
    folder = write_study(
        tmp_path, [one for one in all_cells() if one["cell"]["seed"] == 0], seeds=1
    )
    lines = report.answer(folder).splitlines()
    assert lines[1] == (
        "Undecided: one seed has no interval, run at least 2. GCRPPO against PPO: return over "
        "training +12 %, better in 1 of 1 pairs of runs."
    )
    assert lines[3] == "Final return: no difference shown (+12 %)."
    assert any(isinstance(block, Pictures) for block in blocks_of(folder))


def test_seeds_without_a_difference_are_a_warning(tmp_path: Path) -> None:
    cells = [result(method, seed, 100.0) for method in METHODS for seed in range(3)]
    lines = report.answer(write_study(tmp_path, cells, seeds=3)).splitlines()
    assert lines[1].startswith("No difference that matters between GCRPPO and PPO here: ")
    assert lines[-3] == (
        "Warning: All 3 runs of PPO on MyEnv-v0 have the same return: does the seed reach the env "
        "and the policy?"
    )


def test_mixed_versions_are_a_warning(tmp_path: Path) -> None:
    cells = all_cells()
    cells[-1]["provenance"]["digest"] = "d2"
    warnings = [
        line
        for line in report.answer(write_study(tmp_path, cells, seeds=2)).splitlines()
        if line.startswith("Warning")
    ]
    assert warnings == [
        "Warning: GCRPPO against PPO on MyEnv-v0 mixes cells of 2 versions of the code (d1: 3, d2: "
        "1): run them again with one version before you trust the difference.",
        "Warning: GCRPPO against multi_head on MyEnv-v0 mixes cells of 2 versions of the code (d1: "
        "3, d2: 1): run them again with one version before you trust the difference.",
    ]


def test_runs_that_nobody_can_repeat_and_runs_without_a_return_are_warnings(tmp_path: Path) -> None:
    cells = all_cells()
    cells[0]["provenance"]["dirty"] = True
    cells[1]["scalars"]["return_training"] = None
    text = report.answer(write_study(tmp_path, cells, seeds=2))
    assert (
        "Warning: 1 of 6 runs were made with changes that are in no commit: nobody else can "
        "repeat them."
    ) in text
    assert (
        "Warning: 1 run has no return over training and cannot be counted: did no episode end?"
    ) in text


def test_a_baseline_that_learns_nothing_is_a_warning(tmp_path: Path) -> None:
    cells = all_cells()
    for one in cells:
        one["scalars"]["random_return"] = 500.0
    lines = report.answer(write_study(tmp_path, cells, seeds=2)).splitlines()
    # t = 4.3027 times the root of 2
    assert lines[1] == (
        "GCRPPO learns faster than PPO here: return over training +12 (95 % interval 5.92 to 18.1, "
        "Welch), better in 4 of 4 pairs of runs."
    )
    assert lines[-1] == (
        "Warning: On MyEnv-v0 the return of PPO over training is not shown to be above that of "
        "random actions: differences are in the return's own unit, without a margin. Give it more "
        "steps."
    )


def test_one_method_is_no_comparison(tmp_path: Path) -> None:
    cells = [one for one in all_cells() if one["cell"]["method"] == "gcr"]
    folder = write_study(tmp_path, cells, methods=["gcr"], seeds=2)
    assert report.answer(folder).splitlines()[1] == "No comparison: the study has one method."
    assert Heading("The cells") in blocks_of(folder)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_study(tmp_path_factory.mktemp("study"), all_cells(), seeds=2)
    report.write(folder)
    return folder


def test_every_number_of_the_cells_is_on_the_page(written: Path) -> None:
    page = Page((written / "report.html").read_text(encoding="utf-8"))
    rows = {row["cell"]: row for row in page.table("cell", "return_training")}
    cells = all_cells()
    assert len(rows) == len(cells)
    for one in cells:
        row = rows[one["id"]]
        assert (row["method"], int(row["seed"])) == (one["cell"]["method"], one["cell"]["seed"])
        for name in ("return_training", "return_final", "random_return", "wall_s"):
            assert float(row[name]) == one["scalars"][name]
        count = one["scalars"]["conflict_count"]
        assert row["conflict_count"] == ("–" if count is None else str(count))


def test_the_tables_of_the_page(written: Path) -> None:
    page = Page((written / "report.html").read_text(encoding="utf-8"))
    rows = page.table("comparison", "verdict")
    assert [(row["comparison"], row["verdict"]) for row in rows] == [
        ("GCRPPO − PPO", "higher"),
        ("GCRPPO − multi_head", "higher"),
        ("multi_head − PPO", "undecided"),
        ("GCRPPO − PPO, final", "higher"),
    ]
    assert [row["p"] for row in rows] == ["0.014 Welch", "0.041 Holm", "0.55 Holm", "0.041 Holm"]
    assert rows[0]["difference"] == "+12\u00a0%"
    assert rows[0]["better in"] == "4 of 4"
    methods = page.table("method", "return over training")
    assert [row["return over training"] for row in methods] == ["100", "101", "112"]
    assert [row["conflicting pairs"] for row in methods] == ["–", "2.3", "2.3"]
    terms = page.table("term", "level", "GCRPPO")
    assert [(row["term"], row["level"]) for row in terms] == [
        ("speed", "task"),
        ("alive", "task"),
        ("torque", "regulariser"),
        ("action_rate", "regulariser"),
        ("joint_limits", "regulariser"),
    ]
    assert (terms[0]["PPO"], terms[0]["GCRPPO"]) == ("100", "112")
    pairs = page.table("pair", "cosine at last")
    assert pairs[0] == {
        "pair": "speed | torque",
        "levels": "0 | 1",
        "cosine at first": "-0.200",
        "cosine at last": "-0.400",
    }
    # 60 s and 30 s for 500,000 steps
    (_, _, runtime) = page.table("method", "collection [s]")
    assert (runtime["collection [s]"], runtime["update [s]"]) == ("12", "6")
    (row,) = page.table("task", "SPC [%]", "P(improvement)")
    # 200 (224 - 200) / (224 + 200)
    assert row["SPC [%]"] == "11.32"
    assert (row["PPO, final"], row["GCRPPO, final"]) == ("200 ± 2.83", "224 ± 2.83")


def test_the_page_needs_nothing_else(written: Path) -> None:
    text = (written / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert all(address.startswith(("#", "data:image/png")) for address in page.addresses)
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert "@import" not in text
    assert "prefers-color-scheme: dark" in text
    assert "width=device-width" in text
    assert page.tags.count("svg") > 5
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    # ink follows the page's colour
    assert "currentColor" in text
    assert "#1d1f25" not in text


def test_the_markdown_has_its_pictures_beside_it(written: Path) -> None:
    text = (written / "report.md").read_text(encoding="utf-8")
    names = re.findall(r"\]\((\S+)\)", text)
    assert names
    assert sorted(names) == sorted(
        str(path.relative_to(written)) for path in (written / "pictures").iterdir()
    )
    assert all((written / name).read_bytes().startswith(b"\x89PNG") for name in names)
    assert "**GCRPPO learns faster than PPO here: return over training +12 %" in text


def test_the_same_cells_make_the_same_page(written: Path, tmp_path: Path) -> None:
    again = write_study(tmp_path / written.name, list(reversed(all_cells())), seeds=2)
    (again / "pictures").mkdir()
    (again / "pictures" / "old.png").write_bytes(b"")
    assert report.write(again).read_text("utf-8") == (written / "report.html").read_text("utf-8")
    assert not (again / "pictures" / "old.png").exists()


def test_a_folder_that_is_no_study(tmp_path: Path) -> None:
    message = (
        f"Parameter `folder` must contain 'study.yml', found none in '{tmp_path}'. Give the folder "
        "that `sb3-gcr-study compare --out` or `sb3-gcr-study run` wrote."
    )
    with pytest.raises(FileNotFoundError, match=f"^{re.escape(message)}$"):
        report.answer(tmp_path)


@pytest.mark.parametrize(
    ("package", "function", "message"),
    [
        ("pandas", report.answer, "Reports need pandas: pip install 'sb3_gcr[study]'"),
        ("pandas", report.write, "Reports need pandas: pip install 'sb3_gcr[study]'"),
        ("matplotlib", report.write, "Reports need matplotlib: pip install 'sb3_gcr[study]'"),
        ("yaml", report.answer, "Studies need PyYAML: pip install 'sb3_gcr[study]'"),
    ],
)
def test_missing_packages(
    package: str, function: Any, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_study(tmp_path, all_cells(), seeds=2)
    original = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == package:
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError) as caught:
        function(folder)
    assert str(caught.value) == message
    monkeypatch.undo()
    assert not (folder / "report.html").exists()


def data_of(cells: list[Result]) -> Frames:
    return frames(cells)


def test_frames_keep_nothing_as_nothing() -> None:
    cells = [result("ppo", 0, 1.0), result("gcr", 0, 2.0)]
    cells[1]["curves"]["return"][0] = None
    data = data_of(cells)
    assert list(data.cells["conflict_count"].isna()) == [True, False]
    assert math.isnan(data.curves[data.curves["method"] == "gcr"]["return"].iloc[0])
    assert len(data.curves) == 100
    assert len(data.term_curves) == 500
    assert data.terms["level"].tolist() == [0, 0, 1, 1, 1] * 2


def test_configurations_are_named_by_what_differs() -> None:
    cells = [
        result("gcr", 0, 1.0, env_kwargs={"energy": 2, "gait": None}),
        result("gcr", 0, 1.0, env_kwargs={"energy": None, "gait": 0}),
        result("gcr", 0, 1.0, settings={"normalize_reward": False}),
    ]
    assert list(data_of(cells).cells["configuration"]) == [
        "MyEnv-v0 energy=2",
        "MyEnv-v0 gait=0",
        "MyEnv-v0 normalize_reward=False",
    ]
    task = {**cells[0]["cell"], "name": "a walker"}
    named = frames(cells, [task]).cells["configuration"]
    assert named.iloc[0] == "a walker"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sb3_gcr/HumanoidMO-v0 energy=2", "HumanoidMO energy=2"),
        ("my_module:MyEnv", "MyEnv"),
        ("HalfCheetah-v5", "HalfCheetah"),
        ("a walker", "a walker"),
    ],
)
def test_short_names(name: str, expected: str) -> None:
    assert short(name) == expected


def test_results_come_in_the_order_of_the_manifest(tmp_path: Path) -> None:
    cells = [
        result(method, seed, 1.0, env=env)
        for env in ("B-v0", "A-v0")
        for method in ("ppo", "gcr")
        for seed in (0, 1)
    ]
    tasks = [
        {key: cells[i]["cell"][key] for key in ("env", "env_kwargs", "settings", "timesteps")}
        for i in (0, 4)
    ]
    folder = write_study(tmp_path, cells[::-1], methods=["ppo", "gcr"], tasks=tasks, seeds=2)
    assert [one["id"] for one in collected(folder).results] == [one["id"] for one in cells]


@pytest.mark.parametrize(
    ("methods", "expected"),
    [
        (["ppo", "multi_head", "gcr"], ("ppo", "gcr", "multi_head", ())),
        (["gcr", "ppo"], ("ppo", "gcr", None, ())),
        (["ppo", "guaranteed", "gcr"], ("ppo", "gcr", None, ("guaranteed",))),
        (["multi_head", "levels"], ("multi_head", "levels", None, ())),
        (["ppo", "multi_head"], ("ppo", "multi_head", None, ())),
        (["gcr", "gcr_inverted"], ("gcr", "gcr_inverted", None, ())),
    ],
)
def test_who_is_compared_with_whom(methods: list[str], expected: tuple[Any, ...]) -> None:
    assert tables.roles(methods) == expected


def test_curves_can_be_read_back() -> None:
    data = data_of(all_cells())
    (axis,) = figures.learning_curves(data.curves, METHODS).axes
    thick = {line.get_label(): line for line in axis.lines if line.get_linewidth() == 2.0}
    assert list(thick) == ["PPO", "multi_head", "GCRPPO"]
    # the last window of a straight line with mean 112: 112 * 2 * 49.5 / 50
    assert thick["GCRPPO"].get_ydata()[-1] == pytest.approx(221.76)
    assert thick["GCRPPO"].get_xdata()[-1] == 500_000
    thin = [line for line in axis.lines if line.get_linewidth() == 0.6]
    assert len(thin) == 6
    assert len(axis.collections) == 3
    assert axis.get_xlabel() == "env steps"


def test_no_band_around_one_seed() -> None:
    data = data_of([result("gcr", 0, 10.0)])
    line = figures.band(data.curves, "return")
    assert line.mean[-1] == pytest.approx(19.8)
    assert np.isnan(line.low).all()


def test_methods_without_conflicts_are_not_in_the_picture_of_conflicts() -> None:
    data = data_of(all_cells())
    (axis,) = figures.learning_curves(data.curves, METHODS, "conflict_rate").axes
    _, names = axis.get_legend_handles_labels()
    assert names == ["multi_head", "GCRPPO"]


def test_bars_of_the_terms_can_be_read_back() -> None:
    data = data_of(all_cells())
    axes = figures.term_bars(data.terms, METHODS).axes
    assert [axis.get_ylabel() for axis in axes] == [
        "speed\ntask",
        "alive\ntask",
        "torque\nregulariser",
        "action_rate\nregulariser",
        "joint_limits\nregulariser",
    ]
    assert [bar.get_width() for bar in axes[0].patches] == [100.0, 101.0, 112.0]
    assert [bar.get_width() for bar in axes[2].patches] == [-31.0] * 3


def test_the_differences_can_be_read_back() -> None:
    data = data_of(all_cells())
    who = tables.roles(METHODS)
    assert who is not None
    found = tables.compared(data.cells, who)
    (axis,) = figures.forest(found.contrasts, ["a", "b", "c", "d"]).axes
    dots = [line.get_xdata()[0] for line in axis.lines if line.get_marker() == "o"]
    assert dots == pytest.approx([12.0, 100 * 11 / 101, 1.0, 12.0])
    assert labels(axis, "y") == ["a", "b", "c", "d"]


def test_the_cells_of_a_cosine_matrix_can_be_read_back() -> None:
    found = tables.mean_cosines([result("gcr", 0, 1.0), result("gcr", 1, 1.0)])
    assert found is not None
    assert (found.kind, found.n) == ("minibatch", 2)
    axis = figures.cosine_matrix(found.names, found.last, "last").axes[0]
    texts = [text.get_text() for text in axis.texts]
    assert texts[:5] == ["1.00", "0.10", "-0.40", "0.10", "0.10"]
    assert labels(axis, "x") == labels(axis, "y") == list(LEVELS)


def test_cells_without_cosines_and_without_some_of_them() -> None:
    one = result("gcr", 0, 1.0)
    one["cosines"]["last"][0][2] = None
    found = tables.mean_cosines([one, result("ppo", 0, 1.0)])
    assert found is not None
    assert math.isnan(found.last[0, 2])
    assert len(figures.cosine_matrix(found.names, found.last, "last").axes[0].texts) == 24
    assert tables.mean_cosines([result("ppo", 0, 1.0)]) is None


def test_the_kind_of_the_cosines_is_on_the_page(tmp_path: Path) -> None:
    cells = all_cells()
    for one in cells[2:]:
        one["cosines"] = cosines("unbiased")
    folder = write_study(tmp_path, cells, seeds=2)
    captions = [
        picture.caption
        for block in blocks_of(folder)
        if isinstance(block, Pictures)
        for picture in block.pictures
        if "cosines" in picture.name
    ]
    assert len(captions) == 2
    assert all("under GCRPPO, unbiased: " in caption for caption in captions)


def test_the_runtime_is_stacked() -> None:
    table = tables.runtime_table(data_of(all_cells()).cells, METHODS)
    (axis,) = figures.runtime_bars(table, METHODS).axes
    assert [bar.get_width() for bar in axis.patches] == [12.0, 12.0, 12.0, 4.0, 6.0, 6.0]
    assert [bar.get_x() for bar in axis.patches[3:]] == [12.0, 12.0, 12.0]
    assert labels(axis, "y") == ["PPO", "multi_head", "GCRPPO"]


def objectives_study() -> list[Result]:
    """Four configurations of two objectives: GCRPPO wins at energy 0 and nowhere else."""
    cells = []
    for energy, gait in ((0, None), (0, 1), (4, 1), (None, 1)):
        won = energy == 0
        for method, value in (("ppo", 100.0), ("gcr", 110.0 if won else 90.0)):
            cells.append(
                result(
                    method,
                    0,
                    value,
                    env="sb3_gcr/HumanoidMO-v0",
                    env_kwargs={"energy": energy, "gait": gait},
                    conflicts=5.0 if won else 1.0 + (gait or 0) + (energy or 0),
                )
            )
    return cells


def test_the_win_tables() -> None:
    data = data_of(objectives_study())
    wins = paper_tables.win_frame(data.cells, data.factors, "ppo", "gcr")
    table = paper_tables.win_table(wins)
    energy, gait = table.to_dict("records")
    assert [energy[key] for key in (0, 1, 4, "NA", "active")] == [
        (2, 2),
        (0, 0),
        (0, 1),
        (0, 1),
        (2, 3),
    ]
    assert [gait[key] for key in (1, "NA", "active")] == [(1, 3), (1, 1), (1, 3)]
    assert paper_tables.win_cell((2, 2)) == "100 % (2), 34 to 100"
    assert paper_tables.win_cell((0, 0)) == "– (0)"
    # Fisher on 2 of 3 against 0 of 1: all tables with these margins are at least as likely
    assert energy["fisher"] == pytest.approx(1.0)


def test_the_cells_of_the_heat_maps_can_be_read_back() -> None:
    data = data_of(objectives_study())
    wins = paper_tables.win_frame(data.cells, data.factors, "ppo", "gcr")
    axis = paper_figures.win_heat_map(paper_tables.win_table(wins)).axes[0]
    assert labels(axis, "x") == ["L0", "L1", "L2", "L3", "L4", "NA"]
    assert labels(axis, "y") == ["energy", "gait"]
    assert [text.get_text() for text in axis.texts[:6]] == [
        "100 %\n(2)",
        "(0)",
        "(0)",
        "(0)",
        "0 %\n(1)",
        "0 %\n(1)",
    ]
    assert len([one for one in axis.patches if one.get_hatch()]) == 3 + 4
    pairs = paper_figures.pair_heat_map(paper_tables.objective_pairs(wins)).axes[0]
    assert [text.get_text() for text in pairs.texts] == ["50 %\n(2)"]
    assert (labels(pairs, "x"), labels(pairs, "y")) == (["energy"], ["gait"])


def test_what_is_no_level_is_no_objective() -> None:
    factors = pd.DataFrame(
        {"env": ["a", "a"], "energy": [2, None], "fast": [True, False], "scale": [0.5, 1.0]},
        dtype=object,
    )
    assert paper_tables.objectives(factors) == ["energy"]


def test_scaling_with_conflict() -> None:
    data = data_of(objectives_study())
    table = paper_tables.table_1(data.cells, "ppo", "gcr")
    assert list(table["conflict_count"]) == [5.0, 5.0, 6.0, 2.0]
    # 200 * 20 / 420 and 200 * -20 / 380
    assert list(table["spc"]) == pytest.approx([9.5238, 9.5238, -10.5263, -10.5263], abs=1e-4)
    found = paper_tables.scaling(table, "conflict_count")
    assert found is not None
    figure = paper_figures.scaling_figure(found, None)
    dots = next(line for line in figure.axes[0].lines if line.get_marker() == "o")
    assert list(dots.get_xdata()) == [5.0, 5.0, 6.0, 2.0]
    assert figure.axes[0].get_xlabel() == "conflicting pairs of terms"
    assert paper_tables.scaling(table.head(2), "conflict_count") is None


def test_the_papers_own_tasks_are_recomputed() -> None:
    table = paper_tables.paper_table_1()
    humanoid = table[table["task"] == "Humanoid"].iloc[0]
    assert humanoid["spc"] == pytest.approx(17.55, abs=0.005)
    assert humanoid["printed_spc"] == 19.24
    assert humanoid["holm"] == pytest.approx(0.0032, abs=5e-5)
    rate = paper_tables.scaling(table.assign(spc=table["printed_spc"]), "conflict_rate")
    assert rate is not None
    assert rate.correlation.rho == pytest.approx(0.758, abs=5e-4)


def test_families() -> None:
    table = pd.DataFrame({"spc": [1.0, 2.0, 9.0], "signs_differ": [False, False, True]})
    families = pd.Series(["mo", "mo", "single"])
    rows = paper_tables.table_4(table, families)
    assert list(rows["family"]) == ["mo", "single", "overall"]
    assert list(rows["mean"]) == [1.5, 9.0, 4.0]
    assert list(rows["median"]) == [1.5, 9.0, 2.0]
    assert list(rows["signs_differ"]) == [0, 1, 1]
    assert math.isnan(rows["low"].iloc[1])


def test_the_paper_has_a_nearest_task() -> None:
    row = paper_tables.nearest("envpool/G1JoystickRoughTerrain-v1")
    assert row is not None
    assert row.task == "Velocity-Rough-G1"
    assert paper_tables.nearest("HalfCheetah-v5") is None


def with_hypotheses(folder: Path, registered: dict[str, Any] | None) -> Path:
    import yaml

    path = folder / "study.yml"
    manifest = yaml.safe_load(path.read_text())
    manifest["hypotheses"] = {
        "H1": {
            "claim": "Surgery helps.",
            "contrast": ["gcr", "ppo"],
            "metric": "return_training",
            "unit": "configuration",
            "supported": "Holm p < 0.05 and a mean above 0",
            "refuted": "the interval lies below +5 %",
        }
    }
    manifest["looks"] = [3, 6]
    manifest["registered"] = registered
    path.write_text(yaml.safe_dump(manifest))
    return folder


def objectives_folder(folder: Path) -> Path:
    cells = objectives_study()
    for one in cells:
        one["provenance"]["started"] = "2030-01-02T00:00:00Z"
    tasks = [
        {key: one["cell"][key] for key in ("env", "env_kwargs", "settings", "timesteps")}
        for one in cells[::2]
    ]
    return write_study(folder, cells, methods=["ppo", "gcr"], tasks=tasks, seeds=1)


@pytest.mark.parametrize(
    ("registered", "sentence"),
    [
        (
            None,
            "The hypotheses are in no commit: nothing shows that they came before the cells.",
        ),
        (
            {"commit": "0123456789abcdef", "date": "2030-01-01T02:00:00+02:00", "changed": False},
            "The hypotheses were committed in 0123456789 on 2030-01-01 00:00 UTC, before the first "
            "cell (2030-01-02 00:00 UTC).",
        ),
        (
            {"commit": "0123456789abcdef", "date": "2030-01-03T00:00:00Z", "changed": False},
            "The hypotheses were committed in 0123456789 on 2030-01-03 00:00 UTC, which is LATER "
            "than the first cell (2030-01-02 00:00 UTC).",
        ),
        (
            {"commit": "0123456789abcdef", "date": "2030-01-01T00:00:00Z", "changed": True},
            "The hypotheses were committed in 0123456789 on 2030-01-01 00:00 UTC, but the study "
            "was started with a file that DIFFERS from that commit.",
        ),
    ],
)
def test_the_commit_of_the_hypotheses(
    registered: dict[str, Any] | None, sentence: str, tmp_path: Path
) -> None:
    from sb3_gcr.study.registration import registration

    folder = with_hypotheses(objectives_folder(tmp_path), registered)
    assert registration(collected(folder)) == sentence


def test_a_study_of_configurations(tmp_path: Path) -> None:
    """Differences .1, .1, -.1, -.1: the look at 3 has mean 1/30, and 6 of 8 signs are as extreme,
    times two looks. Two wins of four: E = 16 / 30.
    """
    folder = with_hypotheses(objectives_folder(tmp_path), None)
    lines = report.answer(folder).splitlines()
    assert lines[:3] == [
        "4 configurations of sb3_gcr/HumanoidMO-v0, 500,000 steps, 1 seed, equal settings.",
        "H1, open: Surgery helps. GCRPPO over PPO 0 % (-18 to 18, Student) in 4 configurations, "
        "Holm p 1 at the look of 3, better in 2 of 4 (E = 0.533).",
        "Undecided. GCRPPO against PPO: return over training 0 % (95 % interval -18 to 18, "
        "Student), better in 2 of 4 configurations.",
    ]
    found = blocks_of(folder)
    (row,) = rows_of(found, "claim", "status", "look")
    assert (row["look"], row["n"], row["E"]) == ("3", "4", "0.533")
    rows = rows_of(found, "objective", "L0")
    assert rows[0]["L0"] == "100 % (2), 34 to 100"
    families = rows_of(found, "family", "IQM")
    assert [row["family"] for row in families] == [
        "HumanoidMO",
        "overall",
        "the paper's 13 tasks",
    ]
    scaling = rows_of(found, "against", "Spearman ρ")
    assert [row["whose"] for row in scaling].count("the paper") == 3


def test_a_page_escapes_what_it_shows() -> None:
    blocks = [
        Heading("<b>"),
        Text("a <i> -> 5 %", "lead"),
        Text("careful & slow", "warning"),
        Table(["a|b"], [["<td>"]], "c_d"),
        Code("log <1>", "x < y"),
    ]
    html = to_html("<title>", blocks)
    assert "<h2>&lt;b&gt;</h2>" in html
    assert '<p class="lead">a &lt;i&gt; → 5\u00a0%</p>' in html
    assert '<p class="warning">careful &amp; slow</p>' in html
    assert '<td class="word">&lt;td&gt;</td>' in html
    assert "<pre>x &lt; y</pre>" in html
    text = to_markdown("t", blocks)
    assert "**a \\<i\\> -\\> 5 %**" in text
    assert "> **Warning.** careful & slow" in text
    assert "| a\\|b |\n| --- |\n| \\<td\\> |" in text


def test_colours_stay_with_their_methods() -> None:
    from sb3_gcr.study.drawing import looks

    assert looks(["gcr", "ppo"])["gcr"] == looks(["ppo", "multi_head", "gcr", "x"])["gcr"]
    many = looks([f"method {i}" for i in range(8)])
    assert len(set(many.values())) == 8


def test_figures_are_no_pyplot_figures() -> None:
    figure = figures.learning_curves(data_of(all_cells()).curves, METHODS)
    assert type(figure) is Figure
    assert "pyplot" not in str(type(figure.canvas.manager))


def dosed(weights: tuple[float, ...], gains: tuple[float, ...]) -> list[Result]:
    """GCRPPO's gains over the heads, which return 100, at growing weights and conflicts."""
    cells = []
    for weight, gain in zip(weights, gains, strict=True):
        for seed, off in enumerate((-0.01, 0.0, 0.01)):
            for method, value in (("multi_head", 100.0), ("gcr", 100.0 * (1 + gain + off))):
                cells.append(
                    result(
                        method,
                        seed,
                        value,
                        env_kwargs={"regulariser_weight": weight},
                        conflicts=float(weight),
                    )
                )
    return cells


@pytest.mark.parametrize(
    ("gains", "status", "numbers"),
    [
        ((0.0, 0.1, 0.3), "supported", "+15 % for three times the dose (12 to 18)"),
        ((0.01, 0.01, 0.01), "refuted", "0 % for three times the dose (-0.9 to 0.9)"),
        ((0.3, 0.1, 0.0), "open", "-15 % for three times the dose (-18 to -12)"),
    ],
)
def test_the_rule_of_slopes(gains: tuple[float, ...], status: str, numbers: str) -> None:
    """By hand, first case: x is 0, 1, 2 thrice, the slope .15, its error sqrt(.0056 / 7 / 6),
    and t of 7 is 2.3646.
    """
    from sb3_gcr.study.rules import slopes_rule

    data = data_of(dosed((1, 3, 9), gains))
    found, sentence = slopes_rule(data.cells, data.factors, "multi_head", "gcr", "return_training")
    assert found == status
    assert numbers in sentence
    assert sentence.endswith("from 9 pairs of runs.")


@pytest.mark.parametrize(
    ("raw", "scaled", "status"),
    [
        ((0.4, 0.42), (0.1, 0.1), "supported"),
        ((0.3, 0.34), (0.2, 0.3), "refuted"),
        ((0.02, 0.6), (0.1, 0.1), "open"),
    ],
)
def test_the_rule_of_two_variants(
    raw: tuple[float, float], scaled: tuple[float, float], status: str
) -> None:
    from sb3_gcr.study.rules import variants_rule
    from sb3_gcr.study.scores import scaled as scores_of

    cells = [
        result(
            method,
            0,
            100.0 * (1 + (gain if method == "multi_head" else 0)),
            env_kwargs={"energy": energy},
            settings={"normalize_reward": is_scaled},
        )
        for is_scaled, gains in ((False, raw), (True, scaled))
        for energy, gain in enumerate(gains)
        for method in ("ppo", "multi_head")
    ]
    data = data_of(cells)
    who = tables.roles(["ppo", "multi_head"])
    assert who is not None
    found, sentence = variants_rule(
        scores_of(data.cells, who), data.factors, "ppo", "multi_head", "return_training"
    )
    assert found == status
    assert sentence.startswith(f"Raw gain +{100 * sum(raw) / 2:.0f} %, scaled gain +")
    assert sentence.endswith(" in 2 configurations.")
