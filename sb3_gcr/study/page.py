"""A document of headings, sentences, tables and pictures, as one HTML file or as Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Heading(NamedTuple):
    """A section begins."""

    text: str
    level: int = 2


class Text(NamedTuple):
    """A paragraph; ``kind`` is ``plain``, ``answer``, ``lead`` (the answer in short), ``warning``
    or ``note``.
    """

    text: str
    kind: str = "plain"


class Table(NamedTuple):
    """Rows of words and numbers.

    :param head: titles of the columns
    :param rows: cells as they are shown
    :param caption: what it shows
    :param words: how many columns at the left are words; the others are numbers
    :param folded: whether it opens on demand
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    words: int = 1
    folded: bool = False


class Picture(NamedTuple):
    """A figure with its file name, without ending, and the sentence that says what it shows."""

    name: str
    figure: Figure
    caption: str


class Pictures(NamedTuple):
    """Pictures side by side, as many in a row as there is room for."""

    pictures: Sequence[Picture]


class Code(NamedTuple):
    """Text as it is, folded under a title."""

    title: str
    text: str


#: Letters of a cell that stays on one line.
LONG = 32
#: Where the pictures of the Markdown lie, beside it.
FOLDER = "pictures"

Block: TypeAlias = Heading | Text | Table | Pictures | Code

CSS = """
:root { color-scheme: light dark; --ink: #1d1f24; --paper: #ffffff; --soft: #5d6470;
  --line: #d9dce2; --panel: #f5f6f8; --accent: #c8570b; --warn: #fff3dc; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e6ea; --paper: #15171b; --soft: #a0a7b3; --line: #353a43; --panel: #1e2127;
    --accent: #f0944d; --warn: #3a2d12; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1rem 4rem; max-width: 76rem; color: var(--ink);
  background: var(--paper); font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; margin: 0 0 1rem; line-height: 1.25; }
h2 { font-size: 1.2rem; margin: 2.8rem 0 .6rem; padding-top: .6rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
p { max-width: 46rem; margin: .5rem 0; }
.answers { padding: .8rem 1.1rem; margin: 0 0 1rem; background: var(--panel);
  border-left: 4px solid var(--accent); border-radius: 4px; }
.answers p { max-width: 60rem; }
.answers p + p { margin-top: .6rem; }
.answers .lead { font-size: 1.15rem; font-weight: 600; }
.warning { max-width: none; padding: .6rem 1.1rem; background: var(--warn); border-radius: 4px; }
.note, figcaption { color: var(--soft); font-size: .875rem; }
.wide { overflow-x: auto; margin: .2rem 0 1.2rem; }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem .3rem 0; text-align: right; vertical-align: top;
  border-bottom: 1px solid var(--line); overflow-wrap: normal; }
td { white-space: nowrap; }
th { font-weight: 600; vertical-align: bottom; }
.word { text-align: left; }
td.long { white-space: normal; min-width: 11rem; max-width: 22rem; }
.pictures { display: grid; gap: 1.4rem 2rem; margin: 1rem 0;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 20rem), 1fr)); }
.pictures.one { grid-template-columns: minmax(0, 46rem); }
.pictures.two { grid-template-columns: repeat(auto-fill, minmax(min(100%, 30rem), 1fr)); }
figure { margin: 0; min-width: 0; }
figure svg { display: block; width: 100%; height: auto; }
summary { cursor: pointer; margin: .6rem 0; }
pre { overflow-x: auto; padding: .8rem; background: var(--panel); font-size: .8rem; }
"""


def to_html(title: str, blocks: Sequence[Block]) -> str:
    """One file without any other: styles and pictures are in it.

    :param title: of the page
    :param blocks: in their order; answers that follow each other share a box
    """
    body = [f"<h1>{escape(title)}</h1>"]
    n_pictures = 0
    answers: list[str] = []
    for block in [*blocks, Text("", "end")]:
        if isinstance(block, Text) and block.kind in ("answer", "lead"):
            lead = ' class="lead"' if block.kind == "lead" else ""
            answers.append(f"<p{lead}>{_words(block.text)}</p>")
            continue
        if answers:
            body.append('<div class="answers">\n' + "\n".join(answers) + "\n</div>")
            answers = []
        body.append(_html(block, n_pictures))
        n_pictures += len(block.pictures) if isinstance(block, Pictures) else 0
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in body if part)
        + "\n</body>\n</html>\n"
    )


def to_markdown(title: str, blocks: Sequence[Block]) -> str:
    """The same document; pictures are files ``pictures/<name>.png`` beside it.

    :param title: of the page
    :param blocks: in their order
    """
    parts = [f"# {title}", *(_markdown(block) for block in blocks)]
    return "\n\n".join(parts) + "\n"


def _html(block: Block, n_before: int) -> str:
    if isinstance(block, Heading):
        return f"<h{block.level}>{escape(block.text)}</h{block.level}>"
    if isinstance(block, Text):
        if block.kind == "end":
            return ""
        kind = "" if block.kind == "plain" else f' class="{block.kind}"'
        return f"<p{kind}>{_words(block.text)}</p>"
    if isinstance(block, Code):
        return (
            f"<details><summary>{escape(block.title)}</summary>"
            f"<pre>{escape(block.text)}</pre></details>"
        )
    if isinstance(block, Table):
        return _html_table(block)
    from sb3_gcr.study.drawing import to_svg

    figures = [
        f"<figure>{to_svg(one.figure, one.caption, n_before + i)}"
        f"<figcaption>{_words(one.caption)}</figcaption></figure>"
        for i, one in enumerate(block.pictures)
    ]
    size = {1: " one", 2: " two", 4: " two"}.get(len(figures), "")
    return f'<div class="pictures{size}">\n' + "\n".join(figures) + "\n</div>"


def _words(text: str) -> str:
    """A sentence that breaks neither before a % sign nor inside an arrow."""
    return escape(text.replace(" %", "\u00a0%").replace("->", "→"))


def _html_table(table: Table) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        marks = [_mark(cell) if i < table.words else "" for i, cell in enumerate(cells)]
        return "".join(
            f"<{tag}{mark}>{_words(cell)}</{tag}>" for cell, mark in zip(cells, marks, strict=True)
        )

    caption = f'<p class="note">{_words(table.caption)}</p>' if table.caption else ""
    head = f"<thead><tr>{row(table.head, 'th')}</tr></thead>"
    rows = "\n".join(f"<tr>{row(cells, 'td')}</tr>" for cells in table.rows)
    inner = f'<div class="wide"><table>{head}\n<tbody>\n{rows}\n</tbody></table></div>'
    if table.folded:
        return f"<details><summary>{_words(table.caption)}</summary>{inner}</details>"
    return caption + inner


def _mark(cell: str) -> str:
    """The class of a cell of words; a long one has several lines."""
    return ' class="word long"' if len(cell) > LONG else ' class="word"'


def _markdown(block: Block) -> str:
    if isinstance(block, Heading):
        return f"{'#' * block.level} {block.text}"
    if isinstance(block, Text):
        words = _marked(block.text)
        return {"warning": f"> **Warning.** {words}", "lead": f"**{words}**"}.get(block.kind, words)
    if isinstance(block, Code):
        return f"{block.title}\n\n```text\n{block.text}\n```"
    if isinstance(block, Table):
        cells = [[_marked(cell) for cell in row] for row in [block.head, *block.rows]]
        rule = ["---" if i < block.words else "---:" for i in range(len(block.head))]
        lines = [f"| {' | '.join(row)} |" for row in [cells[0], rule, *cells[1:]]]
        return "\n".join([*([_marked(block.caption), ""] if block.caption else []), *lines])
    return "\n\n".join(
        f"![{_marked(one.caption)}]({FOLDER}/{one.name}.png)\n\n*{_marked(one.caption)}*"
        for one in block.pictures
    )


def _marked(text: str) -> str:
    """Text in which Markdown finds nothing to interpret."""
    return re.sub(r"([|*_<>\[\]`\\])", r"\\\1", text).replace("\n", " ")
