"""The sections of a report on a comparison: blocks made of frames, in the order of the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sb3_gcr.study import answers, figures, tables
from sb3_gcr.study.collected import Failure
from sb3_gcr.study.conclusions import Conclusions
from sb3_gcr.study.contrasts import Contrast
from sb3_gcr.study.frames import Frames, short
from sb3_gcr.study.page import Block, Code, Heading, Picture, Pictures, Table, Text
from sb3_gcr.study.words import called, change, ends, number, p_value

if TYPE_CHECKING:
    pass

DASH = "–"
UNIT_NOTE = (
    "A difference in % is a share of what the baseline gains over random actions. The bar for "
    "'no difference that matters' is 5 %. The headline is one comparison; p of all others is "
    "Holm-corrected."
)


def answer_section(found: Conclusions) -> list[Block]:
    """The verdict in sentences, and what to be careful about."""
    lead = -1 if found.hypotheses else 1
    sentences = [
        Text(one, "lead" if i == lead else "answer") for i, one in enumerate(found.sentences)
    ]
    return [*sentences, *(Text(one, "warning") for one in found.warnings)]


def hypothesis_section(found: Conclusions) -> list[Block]:
    """The registered hypotheses beside their rules."""
    if not found.hypotheses:
        return []
    head = ["", "claim", "supported if", "refuted if", "status", "difference", "95 % interval"]
    head += ["n", "look", "p", "p (Holm)", "better in", "E"]
    rows = []
    for one in found.hypotheses:
        c = one.contrast
        rows.append(
            [
                one.name,
                one.claim,
                *one.rules,
                one.status,
                change(c.estimate, c.relative) if c else DASH,
                ends(c) if c and c.has_interval else DASH,
                str(one.n),
                str(one.look) if one.look else DASH,
                p_value(one.p),
                p_value(one.holm) if one.look else DASH,
                f"{c.better} of {c.pairs}" if c else DASH,
                number(one.evidence.e) if one.evidence else DASH,
            ]
        )
    caption = (
        "p is that of the sign permutation (Welch's where the units are seeds) at the last "
        "registered look, times the number of looks; E may be looked at any time and rejects at 20."
    )
    return [
        Heading("The hypotheses"),
        Text(found.registration),
        Table(head, rows, caption, words=5),
    ]


def failure_section(failures: Sequence[Failure], command: str) -> list[Block]:
    """Each failed cell with its error and the command that repeats it."""
    if not failures:
        return []
    head = ["cell", "method", "seed", "env", "attempts", "error", "repeat it with"]
    rows = [
        [
            one.id,
            one.method,
            str(one.seed),
            one.env,
            str(one.attempts),
            one.error.strip().splitlines()[-1] if one.error.strip() else "",
            f"{command} {one.id}",
        ]
        for one in failures
    ]
    logs = [Code(f"end of the log of {one.id}", one.log_tail) for one in failures if one.log_tail]
    return [Heading("Failed runs"), Table(head, rows, words=7), *logs]


def contrast_section(found: Conclusions) -> list[Block]:
    """The contrasts as pictures and as a table."""
    if found.who is None:
        return []
    groups = {name: one for name, one in found.by_configuration.items() if one.contrasts}
    if found.overall is not None and found.overall.contrasts:
        groups = {"all configurations": found.overall} | groups
    if not groups:
        return []
    name, first = next(iter(groups.items()))
    labels = [contrast_label(one) for one in first.contrasts]
    blocks: list[Block] = [Heading("How much, and how certain"), Text(UNIT_NOTE, "note")]
    if any(one.relative for one in first.contrasts):
        figure = figures.forest(first.contrasts, labels)
        caption = (
            f"Differences on {short(name)}, the headline on top; the band is the margin of 5 %."
        )
        blocks.append(
            Pictures([Picture("differences", figure, caption), *_by_configuration(found)])
        )
    rows = [
        contrast_row(name, one, i == 0)
        for name, group in groups.items()
        for i, one in enumerate(group.contrasts)
    ]
    head = [
        "configuration",
        "comparison",
        "verdict",
        "n",
        "baseline",
        "method",
        "difference",
        "95 % interval",
        "p",
        "better in",
    ]
    table = Table(head, rows, words=3, caption="Every comparison.", folded=len(rows) > 40)
    return [*blocks, table if len(groups) > 1 else without_first(table)]


def _by_configuration(found: Conclusions) -> list[Picture]:
    """The headline of each configuration, where there are several."""
    headlines = {
        name: one.headline
        for name, one in found.by_configuration.items()
        if one.headline is not None and one.headline.relative
    }
    if len(found.by_configuration) < 2 or not headlines:
        return []
    labels = [short(name) for name in headlines]
    figure = figures.forest(list(headlines.values()), labels)
    first = next(iter(headlines.values()))
    caption = f"{contrast_label(first)} on each configuration, return over training."
    return [Picture("differences_by_configuration", figure, caption)]


def without_empty(table: Table) -> Table:
    """The table without the columns of numbers that have none."""
    kept = [
        i
        for i in range(len(table.head))
        if i < table.words or any(row[i] != DASH for row in table.rows)
    ]
    return table._replace(
        head=[table.head[i] for i in kept], rows=[[row[i] for i in kept] for row in table.rows]
    )


def without_first(table: Table) -> Table:
    """The table without its first column, which says the same in every row."""
    rows = [row[1:] for row in table.rows]
    return table._replace(head=table.head[1:], rows=rows, words=table.words - 1)


def contrast_label(one: Contrast) -> str:
    """A contrast in a picture."""
    metric = "" if one.metric == tables.TRAINING else ", final"
    return f"{called(one.method)} − {called(one.baseline)}{metric}"


def contrast_row(configuration: str, one: Contrast, is_headline: bool) -> list[str]:
    """A contrast as a row of the table."""
    found = (
        answers.verdict(one.low, one.high, one.margin) if is_headline else answers.secondary(one)
    )
    test = f" {one.kind}" if is_headline else " Holm"
    return [
        short(configuration),
        contrast_label(one),
        found.value,
        f"{one.n_baseline}, {one.n_method}",
        number(one.means[0], 4),
        number(one.means[1], 4),
        change(one.estimate, one.relative),
        ends(one) if one.has_interval else DASH,
        p_value(one.holm) + (test if one.has_interval else ""),
        f"{one.better} of {one.pairs}",
    ]


def method_section(data: Frames, found: Conclusions) -> list[Block]:
    """Means of each method."""
    table = tables.method_table(data.cells, found.methods)
    columns = ["return over training", "sd", "final return", "sd of final"]
    columns += ["conflicting pairs", "conflict rate", "failed share", "dominance share"]
    columns = [name for name in columns if table[name].notna().any()]
    rows = [
        [short(row["configuration"]), called(row["method"]), str(row["n"])]
        + [number(row[name], 4) for name in columns]
        for _, row in table.iterrows()
    ]
    head = ["configuration", "method", "n", *columns]
    many = len(rows) > 24
    caption = "Means over the seeds, sd between them."
    shown = Table(head, rows, caption, words=2, folded=many)
    several = data.cells["configuration"].nunique() > 1
    return [Heading("The methods"), shown if several else without_first(shown)]


def cell_section(data: Frames) -> list[Block]:
    """Every cell with its main numbers, as they are in its file."""
    columns = ["return_training", "return_final", "random_return", "conflict_count", "wall_s"]
    rows = [
        [row["id"], short(row["configuration"]), row["method"], str(row["seed"])]
        + [DASH if math.isnan(row[name]) else f"{row[name]:.6g}" for name in columns]
        + [str(row["git"] or DASH)[:10], str(row["digest"] or DASH)[:12]]
        for _, row in data.cells.iterrows()
    ]
    head = ["cell", "configuration", "method", "seed", *columns, "git", "digest"]
    return [
        Heading("The cells"),
        Table(head, rows, f"All {len(rows)} finished cells.", words=3, folded=True),
    ]
