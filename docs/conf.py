"""Settings of Sphinx: ``make doc`` builds the site in docs/_build/html."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes

sys.path.insert(0, str(Path(__file__).parents[1]))

import sb3_gcr

project = "sb3_gcr"
author = "The sb3_gcr authors"
copyright = "2026, the sb3_gcr authors"
version = release = sb3_gcr.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx-mathjax-offline",  # brings MathJax, so that equations show without network
    "sphinx_copybutton",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "inventories"]

# GitHub's Markdown: $formulas$, and links to headings such as tasks.md#throwingmo. The glossary has
# definitions.
myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 3

# Types stand beside the parameters, where the docstrings explain them; defaults as they are written
# in the source.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_type_aliases = {
    **dict.fromkeys(("Array", "FloatArray", "Levels", "NDArray"), "~numpy.ndarray"),
    "Resolver": "~sb3_gcr.resolvers.Resolver",
}
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True

# Type variables, and bases that nobody uses by themselves, have no page.
nitpick_ignore = [
    ("py:class", "sb3_gcr.buffers.ComponentBuffer"),
    ("py:class", "sb3_gcr.update.ConflictResolution"),
    ("py:class", "sb3_gcr.gcrppo.SelfGCRPPO"),
    ("py:class", "sb3_gcr.advantages.ArrayT"),
]
# Every reference to a name of ours must resolve. Those of other projects do where a file in
# inventories/ lists them: short files of our own, in Sphinx' oldest and readable format, because a
# build must not depend on the network.
nitpick_ignore_regex = [("py:.*", r"(?!sb3_gcr).*")]
intersphinx_mapping = {
    name: (url, f"inventories/{name}.inv")
    for name, url in {
        "python": "https://docs.python.org/3/",
        "numpy": "https://numpy.org/doc/stable/",
        "torch": "https://docs.pytorch.org/docs/stable/",
        "gymnasium": "https://gymnasium.farama.org/",
        "stable_baselines3": "https://stable-baselines3.readthedocs.io/en/master/",
    }.items()
}

# Furo and not SB3's sphinx_rtd_theme: wide tables scroll by themselves in a narrow window, and it
# has a dark mode.
html_theme = "furo"
# Module names in code must not look like links.
pygments_dark_style = "github-dark"
html_title = f"sb3_gcr {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
# Prompts and outputs are not part of what the copy button copies.
copybutton_exclude = ".linenos, .gp, .go"


def _escape_bars(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Norms such as |g_i| are no substitutions."""
    lines[:] = [line.replace("|", "\\|") for line in lines]


def _shorten_diffs(app: Any, doctree: nodes.document) -> None:
    """The head of a diff has names of files, and not where they lie on this machine."""
    for block in doctree.findall(nodes.literal_block):
        if block.rawsource.startswith("--- /"):
            text = re.sub(r"(?m)^(---|\+\+\+) /\S*/(\S+)", r"\1 \2", block.rawsource)
            block.rawsource, block[:] = text, [nodes.Text(text)]


def setup(app: Any) -> None:
    """Sphinx calls this."""
    app.connect("doctree-read", _shorten_diffs)
    app.connect("autodoc-process-docstring", _escape_bars)
