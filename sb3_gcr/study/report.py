"""The report of a study: what its finished cells say, as a page, as Markdown, and in sentences.

It reads files and runs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_gcr.study.collected import Collected, collected
from sb3_gcr.study.conclusions import Conclusions, conclude
from sb3_gcr.study.drawing import to_png
from sb3_gcr.study.frames import Frames, frames
from sb3_gcr.study.page import FOLDER, Block, Heading, Pictures, Text, to_html, to_markdown

PAGE, MARKDOWN = "report.html", "report.md"


def answer(folder: str | Path) -> str:
    """The answer in sentences, for the terminal, and what to be careful about.

    :param folder: of a study
    :raises FileNotFoundError: if it is none
    :raises ImportError: if pandas or PyYAML is missing
    """
    study = collected(folder)
    data = frames(study.results, study.manifest.get("tasks") or [])
    found = conclude(study, data)
    warnings = [f"Warning: {one}" for one in found.warnings]
    return "\n".join([*found.sentences, *warnings])


def write(folder: str | Path) -> Path:
    """Write ``report.html``, which needs no other file, and ``report.md`` with ``pictures/``.

    :param folder: of a study
    :return: the page
    :raises FileNotFoundError: if it is no study
    :raises ImportError: if pandas, matplotlib or PyYAML is missing
    """
    folder = Path(folder)
    study = collected(folder)
    data = frames(study.results, study.manifest.get("tasks") or [])
    found = conclude(study, data)
    parts = blocks(study, data, found, f"sb3-gcr-study cell {folder / 'study.yml'}")
    page = folder / PAGE
    page.write_text(to_html(study.name, parts), encoding="utf-8")
    (folder / MARKDOWN).write_text(to_markdown(study.name, parts), encoding="utf-8")
    _write_pictures(folder / FOLDER, parts)
    return page


def _write_pictures(folder: Path, parts: Sequence[Block]) -> None:
    """One PNG a picture, in place of those of an earlier report."""
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.png"):
        old.unlink()
    for block in parts:
        if isinstance(block, Pictures):
            for picture in block.pictures:
                to_png(picture.figure, folder / f"{picture.name}.png")


def blocks(study: Collected, data: Frames, found: Conclusions, command: str) -> list[Block]:
    """The report as blocks, the answer first.

    :param study: the folder
    :param data: its frames
    :param found: what they say
    :param command: that repeats a cell, without the cell's id
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError("Reports need matplotlib: pip install 'sb3_gcr[study]'") from error
    from sb3_gcr.study import detail_sections, paper_sections, sections

    parts = sections.answer_section(found)
    parts += sections.hypothesis_section(found)
    parts += sections.failure_section(study.failures, command)
    if data.cells.empty:
        return [*parts, Text("No cell has finished yet: there is nothing to show.")]
    parts += sections.contrast_section(found)
    parts += sections.method_section(data, found)
    details = detail_sections.detail_sections(study, data, found)
    papers = paper_sections.paper_section(study, data, found)
    # With many configurations what they come to together is what is looked for first.
    several = data.cells["configuration"].nunique() > detail_sections.MOST_IN_FULL
    parts += papers + details if several else details + papers
    parts += sections.cell_section(data)
    return [*parts, Heading("Where the numbers come from"), Text(_source(study), "note")]


def _source(study: Collected) -> str:
    return (
        f"{len(study.results)} files cells/<id>/result.json of the study {study.name}; this page "
        "was made from them alone and holds nothing else. Statistics: Welch's intervals on seeds, "
        "Student's on configurations, Holm's correction; sb3_gcr.study.statistics has each with "
        "its equation and source."
    )
