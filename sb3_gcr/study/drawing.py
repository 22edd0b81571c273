"""How the figures of a report look, and how they become SVG for a page and PNG for a file."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Text and lines; in SVG they become the colour of the page's text, light or dark.
INK = "#1d1f25"
#: Colours that can be seen on white and on black, and how each is drawn without colour.
COLOURS = ("#858b94", "#3b82d0", "#d9730d", "#2f9e63", "#a06bd6", "#c94f7c", "#8a7a2c", "#2a9aa8")
DASHES = ("-", "--", "-", "-.", ":", "--", "-.", ":")
#: Methods that always look alike; others take what is left, in their order.
PLACES = {"ppo": 0, "multi_head": 1, "gcr": 2, "gcrppo": 2, "guaranteed": 3, "levels": 4}
STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": INK,
    "grid.alpha": 0.15,
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "sb3_gcr",
}


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib with the style of the report.

    :raises ImportError: if matplotlib is missing
    """
    try:
        from matplotlib import rc_context
    except ImportError as error:
        raise ImportError("Reports need matplotlib: pip install 'sb3_gcr[study]'") from error
    with rc_context(STYLE):
        yield


def blank(width: float = 5.2, height: float = 3.3) -> tuple[Figure, Axes]:
    """A figure with one pair of axes, inside :func:`house_style`.

    :param width: in inches; a column of the page is about five wide
    :param height: in inches
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axis = figure.subplots()
    axis.grid(True)
    axis.set_axisbelow(True)
    return figure, axis


def curve_axes(width: float, height: float) -> tuple[Figure, Axes]:
    """As :func:`blank`, with margins in inches that fit every curve: a page has many of them, and a
    layout that is worked out takes as long as the drawing.

    :param width: in inches
    :param height: in inches
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(
        left=0.72 / width, right=1 - 0.2 / width, bottom=0.5 / height, top=1 - 0.5 / height
    )
    axis = figure.subplots()
    axis.grid(True)
    axis.set_axisbelow(True)
    return figure, axis


def looks(methods: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and dashes of each method.

    :param methods: in the order of the study
    """
    taken = {PLACES[name] for name in methods if name in PLACES}
    free = [place for place in range(len(COLOURS)) if place not in taken]
    places = {}
    for name in methods:
        if name in PLACES:
            places[name] = PLACES[name]
        else:
            places[name] = free.pop(0) if free else 0
    return {name: (COLOURS[place], DASHES[place]) for name, place in places.items()}


def to_svg(figure: Figure, title: str, index: int) -> str:
    """The figure as an element of a page, as wide as there is room for.

    :param figure: made inside :func:`house_style`
    :param title: for those who cannot see it
    :param index: its place in the page, which keeps its names apart from those of other figures
    """
    buffer = io.StringIO()
    with house_style():
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    figure.set_layout_engine("none")  # laid out now; a PNG of it need not do it again
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = svg.replace(INK, "currentColor")
    svg = re.sub(r'\bid="', f'id="p{index}-', svg)
    svg = re.sub(r'href="#', f'href="#p{index}-', svg)
    svg = re.sub(r"url\(#", f"url(#p{index}-", svg)
    width = figure.get_figwidth() * 96.0
    opening = f'<svg role="img" aria-label="{escape(title)}" style="max-width: {width:.0f}px"'
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    return svg.replace("<svg", opening, 1).strip()


def to_png(figure: Figure, path: Path) -> None:
    """The figure as a file, on white.

    :param figure: made inside :func:`house_style`
    :param path: of the file
    """
    with house_style():
        figure.savefig(path, dpi=120, facecolor="white", metadata={"Software": None})
