"""The paper's tables and pictures, made of a study's cells where it has them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pandas as pd

from sb3_gcr.study import paper, paper_figures, paper_tables
from sb3_gcr.study.collected import Collected
from sb3_gcr.study.conclusions import Conclusions
from sb3_gcr.study.frames import Frames, short
from sb3_gcr.study.page import Block, Heading, Picture, Pictures, Table, Text
from sb3_gcr.study.sections import DASH, without_empty
from sb3_gcr.study.store import Record
from sb3_gcr.study.words import called, number, p_value, percent

if TYPE_CHECKING:
    from collections.abc import Sequence

#: A table with more rows opens on demand.
MOST_ROWS = 20


def paper_section(study: Collected, data: Frames, found: Conclusions) -> list[Block]:
    """All of the paper's items; a line says which of them this study has no cells for."""
    if found.who is None or data.cells.empty:
        return []
    table = paper_tables.table_1(data.cells, found.who.baseline, found.who.main)
    if table.empty:
        return []
    blocks: list[Block] = [
        Heading("The paper's tables, from these cells"),
        Text(
            "The paper is arXiv:2509.14816: other simulators, other rewards, ten seeds. Its column "
            "is that of its nearest task and no target.",
            "note",
        ),
    ]
    components = _components(study.results, data, found.who.main)
    table["components"] = table["configuration"].map(components)
    blocks += table_1_blocks(table, found)
    wins = win_blocks(data, found)
    blocks += wins or [
        Text("Tables 2 and 3 and the heat maps need multi-objective configurations.", "note")
    ]
    families = _families(data, table)
    if len(table) > 1:
        blocks += table_4_blocks(table, families)
    else:
        blocks.append(Text("Table 4 needs more than one configuration.", "note"))
    return blocks + scaling_blocks(table)


def _components(results: Sequence[Record], data: Frames, method: str) -> dict[str, int]:
    """K of each configuration, from the levels of the main method's cells."""
    names = data.cells.set_index("id")["configuration"].to_dict()
    return {
        names[one["id"]]: len(one["levels"])
        for one in results
        if one["cell"]["method"] == method and one.get("levels")
    }


def _families(data: Frames, table: pd.DataFrame) -> pd.Series:
    """The env of configurations that share one, else "single tasks"."""
    envs = table["configuration"].map(data.factors["env"])
    counts = envs.value_counts()
    return envs.map(lambda env: short(env) if counts[env] > 1 else "single tasks")


def table_1_blocks(table: pd.DataFrame, found: Conclusions) -> list[Block]:
    """Table 1, ours, and the paper's as it comes out of its own numbers."""
    assert found.who is not None
    before, after = called(found.who.baseline), called(found.who.main)
    head = [
        "task",
        "n",
        f"{before}, final",
        "max",
        f"{after}, final",
        "max",
        "SPC [%]",
        "difference, 95 % interval",
        "p (Holm)",
        "P(improvement)",
        f"{before}, training",
        f"{after}, training",
        "conflicts",
        "rate",
        "failed share",
        "the paper's task",
        "its SPC",
        "its conflicts",
    ]
    rows = [_table_1_row(row) for row in table.itertuples()]
    note = (
        "Table 1: mean ± sd of the final return. SPC = 200 (b − a) / (|a| + |b|), marked * where "
        "the signs differ, which makes it ±200 whatever the sizes."
    )
    theirs = paper_tables.paper_table_1()
    paper_head = ["task", before, after, "SPC [%]", "printed", "95 % interval [%]", "p", "p (Holm)"]
    paper_head += ["conflicts", "rate", "K"]
    paper_rows = [_paper_row(row) for row in theirs.itertuples()]
    paper_note = (
        f"The paper's Table 1 ({paper.SEEDS} seeds), with SPC, Welch's interval and p recomputed "
        "from its means and deviations."
    )
    return [
        without_empty(Table(head, rows, note, folded=len(rows) > MOST_ROWS)),
        Table(paper_head, paper_rows, paper_note, folded=True),
    ]


def _table_1_row(row: Any) -> list[str]:
    interval = DASH
    if not math.isnan(row.low):
        show = percent if row.relative else number
        unit = " %" if row.relative else ""
        estimate = show(row.estimate)
        interval = f"{estimate}{unit}, {show(row.low)} to {show(row.high)}"
    return [
        short(row.configuration),
        str(row.n),
        _spread(row.mean_baseline, row.sd_baseline),
        number(row.max_baseline, 4),
        _spread(row.mean_method, row.sd_method),
        number(row.max_method, 4),
        f"{row.spc:.2f}{'*' if row.signs_differ else ''}",
        interval,
        p_value(row.holm),
        number(row.improvement, 2),
        number(row.training_baseline, 4),
        number(row.training_method, 4),
        number(row.conflict_count),
        number(row.conflict_rate, 2),
        number(row.failed_share, 2),
        row.paper_task or DASH,
        DASH if math.isnan(row.paper_spc) else f"{row.paper_spc:.2f}",
        number(row.paper_conflicts),
    ]


def _spread(mean: float, sd: float) -> str:
    return number(mean, 4) if math.isnan(sd) else f"{number(mean, 4)} ± {number(sd)}"


def _paper_row(row: Any) -> list[str]:
    return [
        row.task,
        _spread(row.mean_baseline, row.sd_baseline),
        _spread(row.mean_method, row.sd_method),
        f"{row.spc:.2f}",
        f"{row.printed_spc:.2f}",
        f"{percent(row.low)} to {percent(row.high)}",
        p_value(row.p),
        p_value(row.holm),
        number(row.conflict_count),
        number(row.conflict_rate, 2),
        str(row.components),
    ]


def win_blocks(data: Frames, found: Conclusions) -> list[Block]:
    """Tables 2 and 3 with their heat maps, one of each env with objectives."""
    assert found.who is not None
    blocks: list[Block] = []
    for (env, variant), factors in data.factors.groupby(["env", "variant"], sort=False):
        own = factors.dropna(axis=1, how="all")
        cells = data.cells[data.cells["configuration"].isin(factors.index)]
        wins = paper_tables.win_frame(cells, own, found.who.baseline, found.who.main)
        if wins.empty or not paper_tables.objectives(own):
            continue
        name = " ".join([short(str(env)), *([str(variant)] if variant else [])])
        table = paper_tables.win_table(wins)
        total = int(wins["won"].sum())
        columns: list[int | str] = [*paper_tables.LEVELS, paper_tables.ABSENT, "active"]
        head = ["objective", *(f"L{one}" if isinstance(one, int) else one for one in columns)]
        rows = [
            [row["objective"]]
            + [paper_tables.win_cell(row[column]) for column in columns]
            + [p_value(row["fisher"])]
            for _, row in table.iterrows()
        ]
        caption = (
            f"{name}: {called(found.who.main)} wins {total} of {len(wins)} configurations."
            f"{_paper_wins(name)} Win rate (configurations), Wilson's 95 % interval; NA: objective "
            "absent."
        )
        blocks.append(Table([*head, "p active against NA (Fisher)"], rows, caption))
        pictures = [
            Picture(
                f"wins_{name.replace(' ', '_')}",
                paper_figures.win_heat_map(table),
                f"{name}: share of wins by objective and level (configurations).",
            )
        ]
        pairs = paper_tables.objective_pairs(wins)
        if not pairs.empty:
            pictures.append(
                Picture(
                    f"wins_of_pairs_{name.replace(' ', '_')}",
                    paper_figures.pair_heat_map(pairs),
                    f"{name}: share of wins where both objectives are active (configurations).",
                )
            )
        blocks.append(Pictures(pictures))
    return blocks


def _paper_wins(name: str) -> str:
    """What the paper counted in its family of that name."""
    for family in paper.FAMILIES:
        if name.lower().startswith(family.name):
            return f" The paper: {family.wins} of {family.configurations}."
    return ""


def table_4_blocks(table: pd.DataFrame, families: pd.Series) -> list[Block]:
    """Table 4: the change by family and overall, the paper's thirteen tasks below."""
    theirs = paper_tables.paper_table_1().assign(signs_differ=False)
    ours = paper_tables.table_4(table, families)
    everywhere = pd.Series("the paper's 13 tasks", index=theirs.index)
    both = pd.concat([ours, paper_tables.table_4(theirs, everywhere).head(1)])
    head = ["family", "n", "mean SPC [%]", "95 % interval", "median", "IQM", "its interval"]
    rows = [
        [
            row.family,
            str(row.n),
            f"{row.mean:.2f}",
            _range(row.low, row.high),
            f"{row.median:.2f}",
            DASH if math.isnan(row.iqm) else f"{row.iqm:.2f}",
            _range(row.iqm_low, row.iqm_high),
            str(row.signs_differ),
        ]
        for row in both.itertuples()
    ]
    caption = (
        "Table 4: symmetric percentage change of the final return. The interval of the mean is "
        "Student's over configurations, that of the interquartile mean a seeded bootstrap."
    )
    return [Table([*head, "signs differ"], rows, caption)]


def _range(low: float, high: float) -> str:
    return DASH if math.isnan(low) else f"{low:.2f} to {high:.2f}"


def scaling_blocks(table: pd.DataFrame) -> list[Block]:
    """The scaling figure in its three versions, with the paper's tasks in grey."""
    measures = ("conflict_count", "conflict_rate", "components")
    if not any(paper_tables.scaling(table, what) for what in measures):
        missing = "The scaling figure needs three configurations with different conflicts."
        return [Text(missing, "note")]
    theirs = paper_tables.paper_table_1()
    pictures = []
    rows = []
    for what in measures:
        mine = paper_tables.scaling(table, what)
        other = paper_tables.scaling(theirs, what)
        pictures.append(
            Picture(
                f"scaling_{what}",
                paper_figures.scaling_figure(mine, other),
                f"Change against {paper_figures.MEASURES[what]}.",
            )
        )
        names = {"these cells": (mine, table), "the paper": (other, theirs)}
        rows += [
            _scaling_row(what, name, one, frame)
            for name, (one, frame) in names.items()
            if one is not None
        ]
    head = [
        "against",
        "whose",
        "n",
        "Spearman ρ",
        "p",
        "slope",
        "95 % interval",
        "largest residual",
    ]
    caption = "Does the change grow with conflict? Permutation p; least squares."
    return [
        Heading("Conflict and gain", 3),
        Pictures(pictures),
        Table(head, rows, caption, words=2),
    ]


def _scaling_row(what: str, name: str, one: paper_tables.Scaling, frame: pd.DataFrame) -> list[str]:
    residuals = one.line.residuals
    worst = int(abs(residuals).argmax())
    labels = frame.dropna(subset=[what, "spc"])
    column = "configuration" if "configuration" in labels else "task"
    return [
        paper_figures.MEASURES[what],
        name,
        str(len(one.x)),
        f"{one.correlation.rho:.3f}",
        p_value(one.correlation.p),
        number(one.line.slope),
        f"{number(one.line.low)} to {number(one.line.high)}",
        f"{residuals[worst]:+.2f} ({short(str(labels[column].iloc[worst]))})",
    ]
