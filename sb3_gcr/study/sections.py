"""The sections of a report on a comparison: blocks made of frames, in the order of the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sb3_gcr.rewards.spec import level_label
from sb3_gcr.study import answers, figures, tables
from sb3_gcr.study.answers import number, p_value, percent
from sb3_gcr.study.collected import Collected, Failure
from sb3_gcr.study.conclusions import Conclusions
from sb3_gcr.study.contrasts import Contrast
from sb3_gcr.study.frames import Frames, short
from sb3_gcr.study.page import Block, Code, Heading, Picture, Pictures, Table, Text
from sb3_gcr.study.store import Record

if TYPE_CHECKING:
    import pandas as pd

#: Configurations up to this number are shown with all their terms.
MOST_IN_FULL = 2
#: Configurations beyond this number have no pictures of their own.
MOST_DETAILED = 13
#: Curves of single terms beyond this number would not be looked at.
MOST_TERMS = 16
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
                answers.change(c.estimate, c.relative) if c else DASH,
                answers.ends(c) if c and c.has_interval else DASH,
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


def without_first(table: Table) -> Table:
    """The table without its first column, which says the same in every row."""
    rows = [row[1:] for row in table.rows]
    return table._replace(head=table.head[1:], rows=rows, words=table.words - 1)


def contrast_label(one: Contrast) -> str:
    """A contrast in a picture."""
    metric = "" if one.metric == tables.TRAINING else ", final"
    return f"{answers.called(one.method)} − {answers.called(one.baseline)}{metric}"


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
        answers.change(one.estimate, one.relative),
        answers.ends(one) if one.has_interval else DASH,
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
        [short(row["configuration"]), answers.called(row["method"]), str(row["n"])]
        + [number(row[name], 4) for name in columns]
        for _, row in table.iterrows()
    ]
    head = ["configuration", "method", "n", *columns]
    many = len(rows) > 24
    caption = "Means over the seeds, sd between them."
    shown = Table(head, rows, caption, words=2, folded=many)
    several = data.cells["configuration"].nunique() > 1
    return [Heading("The methods"), shown if several else without_first(shown)]


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
        blocks += conflict_blocks(part, results, found, f"{index}_")
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
    sentence = answers.regularisers(_paid(table))
    blocks += [Heading("What the regularisers paid", 3), Text(sentence)]
    before, after = answers.called(found.who.baseline), answers.called(found.who.main)
    head = ["term", "level", before, after, "difference", "95 % interval", "p (Holm)"]
    rows = [_term_row(row) for row in table.itertuples()]
    caption = (
        f"Final return per term. Differences in % are shares of {before}'s return of the term."
    )
    return [*blocks, Table(head, rows, caption, words=2)]


def _paid(table: pd.DataFrame) -> list[answers.Paid]:
    from sb3_gcr.study.conclusions import paid

    return paid(table)


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
        answers.change(row.estimate, relative),
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
            f"Cosines between the terms' gradients under {answers.called(method)}, {kind}; mean of "
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
        [short(row.configuration), answers.called(row.method), str(row.n)]
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
