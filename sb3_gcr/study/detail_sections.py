"""The sections of a report on one configuration: curves, terms, conflicts and runtime."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sb3_gcr.rewards.spec import level_label
from sb3_gcr.study import answers, figures, tables
from sb3_gcr.study.collected import Collected
from sb3_gcr.study.conclusions import Conclusions, paid
from sb3_gcr.study.frames import Frames, short
from sb3_gcr.study.page import Block, Heading, Picture, Pictures, Table, Text
from sb3_gcr.study.sections import DASH, without_first
from sb3_gcr.study.store import Record
from sb3_gcr.study.words import called, change, number, p_value, percent

if TYPE_CHECKING:
    import pandas as pd

#: Configurations up to this number are shown with all their terms.
MOST_IN_FULL = 2
#: Configurations beyond this number have no pictures of their own.
MOST_DETAILED = 13
#: Curves of single terms beyond this number would not be looked at.
MOST_TERMS = 16


def detail_sections(study: Collected, data: Frames, found: Conclusions) -> list[Block]:
    """Curves, terms, conflicts and runtime of each configuration; where there are many, curves and
    matrices alone.
    """
    names = list(dict.fromkeys(data.cells["configuration"]))
    in_full = len(names) <= MOST_IN_FULL
    blocks: list[Block] = []
    for index, name in enumerate(names[:MOST_DETAILED]):
        part = Frames(
            _only(data.cells, name),
            _only(data.terms, name),
            _only(data.curves, name),
            _only(data.term_curves, name),
            data.factors,
        )
        ids = set(part.cells["id"])
        results = [result for result in study.results if result["id"] in ids]
        blocks.append(Heading(name))
        blocks += curve_blocks(part, found, f"{index}_")
        if in_full:
            blocks += term_blocks(part, found, f"{index}_")
        conflicts = conflict_blocks(part, results, found, f"{index}_")
        blocks += conflicts if in_full else conflicts[:2]
        if in_full:
            blocks += runtime_blocks(part, found, f"{index}_")
    if len(names) > MOST_DETAILED:
        rest = ", ".join(short(name) for name in names[MOST_DETAILED:])
        blocks.append(Text(f"Without pictures of their own: {rest}.", "note"))
    if not in_full:
        blocks += [Heading("Runtime"), runtime_table(data, found)]
    return blocks


def _only(frame: pd.DataFrame, configuration: str) -> pd.DataFrame:
    return frame[frame["configuration"] == configuration]


def curve_blocks(data: Frames, found: Conclusions, prefix: str) -> list[Block]:
    """Return and conflicts over training."""
    pictures = []
    if data.curves["return"].notna().any():
        figure = figures.learning_curves(data.curves, found.methods)
        caption = (
            "Return over training: thick is the mean, thin the seeds, the band a 95 % interval."
        )
        pictures.append(Picture(f"{prefix}curves", figure, caption))
    if data.curves["conflict_rate"].notna().any():
        figure = figures.learning_curves(
            data.curves, found.methods, "conflict_rate", "share of pairs that conflict"
        )
        caption = "How many pairs of terms conflict over training."
        pictures.append(Picture(f"{prefix}conflict_rate", figure, caption))
    return [Pictures(pictures)] if pictures else []


def term_blocks(data: Frames, found: Conclusions, prefix: str) -> list[Block]:
    """Return per term, and what the regularisers paid."""
    if data.terms["final"].notna().sum() == 0:
        return []
    blocks: list[Block] = [Heading("Return per term", 3)]
    figure = figures.term_bars(data.terms, found.methods)
    caption = (
        "Each term of the reward under the final policy, on its own scale, with 95 % interval."
    )
    blocks.append(Pictures([Picture(f"{prefix}terms", figure, caption)]))
    names = list(dict.fromkeys(data.term_curves["term"]))
    if 0 < len(names) <= MOST_TERMS:
        pictures = []
        for i, name in enumerate(names):
            own = data.term_curves[data.term_curves["term"] == name]
            drawn = figures.learning_curves(
                own, found.methods, ylabel="", size=(3.6, 2.5), title=name
            )
            pictures.append(Picture(f"{prefix}term_{i}", drawn, f"{name} over training."))
        blocks.append(Pictures(pictures))
    if found.who is None:
        return blocks
    table = tables.term_table(data.terms, found.who.baseline, found.who.main)
    if table.empty:
        return blocks
    sentence = answers.regularisers(paid(table))
    blocks += [Heading("What the regularisers paid", 3), Text(sentence)]
    before, after = called(found.who.baseline), called(found.who.main)
    head = ["term", "level", before, after, "difference", "95 % interval", "p (Holm)"]
    rows = [_term_row(row) for row in table.itertuples()]
    caption = (
        f"Final return per term. Differences in % are shares of {before}'s return of the term."
    )
    return [*blocks, Table(head, rows, caption, words=2)]


def _term_row(row: Any) -> list[str]:
    relative = bool(row.relative)
    interval = DASH
    if not math.isnan(row.low):
        show = percent if relative else number
        interval = f"{show(row.low)} to {show(row.high)}"
    level = DASH if math.isnan(row.level) else level_label(int(row.level))
    return [
        row.term,
        level,
        number(row.before, 4),
        number(row.after, 4),
        change(row.estimate, relative),
        interval,
        p_value(row.holm),
    ]


def conflict_blocks(
    data: Frames, results: Sequence[Any], found: Conclusions, prefix: str
) -> list[Block]:
    """Cosine matrices and pairs of the main method, or of the first that has them."""
    order = [found.who.main] if found.who else []
    for method in [*order, *(name for name in found.methods if name not in order)]:
        own = [result for result in results if result["cell"]["method"] == method]
        cosines = tables.mean_cosines(own)
        if cosines is None:
            continue
        kind = {
            "unbiased": "unbiased: of gradients whose noise is averaged out",
            "minibatch": "of minibatches, whose noise makes them smaller than they are",
        }.get(cosines.kind, cosines.kind)
        caption = (
            f"Cosines between the terms' gradients under {called(method)}, {kind}; mean of "
            f"{cosines.n} {'run' if cosines.n == 1 else 'runs'}. Red pairs conflict."
        )
        matrices = [
            Picture(
                f"{prefix}cosines_{when}",
                figures.cosine_matrix(cosines.names, matrix, f"{when} tenth of the updates"),
                f"{when.capitalize()} tenth of the updates. {caption}",
            )
            for when, matrix in (("first", cosines.first), ("last", cosines.last))
        ]
        levels: Record = next((result["levels"] for result in own if result.get("levels")), {})
        pairs = tables.pair_table(cosines, levels)
        figure = figures.pair_bars(pairs)
        bars = Picture(f"{prefix}pairs", figure, "Who conflicts with whom: the most opposed pairs.")
        rows = [
            [row.pair, row.levels, f"{row.first:.3f}", f"{row.last:.3f}"]
            for row in pairs.itertuples()
        ]
        head = ["pair", "levels", "cosine at first", "cosine at last"]
        table = Table(head, rows, "All pairs.", words=2, folded=len(rows) > 10)
        return [
            Heading("Who conflicts with whom", 3),
            Pictures(matrices),
            Pictures([bars]),
            table,
        ]
    return [Text("No cosines: no cell of two or more terms kept them.", "note")]


def runtime_table(data: Frames, found: Conclusions) -> Table:
    """What a run costs, in numbers."""
    table = tables.runtime_table(data.cells, found.methods)
    rows = [
        [short(row.configuration), called(row.method), str(row.n)]
        + [number(value) for value in (row.collect, row.update, row.wall, row.cpu, row.memory)]
        for row in table.itertuples()
    ]
    head = ["configuration", "method", "n", "collection [s]", "update [s]", "wall [s]", "CPU [s]"]
    caption = (
        "For 100,000 steps, means of the cells; comparable only where the cells ran alone. Memory "
        "is the largest."
    )
    shown = Table([*head, "memory [MB]"], rows, caption, words=2, folded=len(rows) > 24)
    return shown if table["configuration"].nunique() > 1 else without_first(shown)


def runtime_blocks(data: Frames, found: Conclusions, prefix: str) -> list[Block]:
    """What a run of one configuration costs."""
    blocks: list[Block] = [Heading("Runtime", 3)]
    table = tables.runtime_table(data.cells, found.methods)
    if table["collect"].notna().any() or table["update"].notna().any():
        figure = figures.runtime_bars(table, found.methods)
        caption = "Collection and update, stacked."
        blocks.append(Pictures([Picture(f"{prefix}runtime", figure, caption)]))
    return [*blocks, runtime_table(data, found)]
