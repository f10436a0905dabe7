"""Sphinx's configuration, for `make docs`: the pages are the repository's Markdown files, where they stand."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import scipy.stats  # noqa: F401 - Before autodoc mocks torch: on import, scipy tests whether classes are torch's.
from sphinx.application import Sphinx

import uwb_mitigation

project = "uwb_mitigation"
author = "uwb_mitigation maintainers"
release = uwb_mitigation.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = ["docs/*.md", "docs/api/*.rst", "models/*.md", "firmware/README.md"]
# Folders that hold no page, so that they are not searched.
exclude_patterns = [".[a-z]*", "build", "install", "log", "test", "uwb_mitigation", "requirements"]
highlight_language = "text"
# Anchors as GitHub makes them, so that a link works in both places.
myst_heading_anchors = 4

html_theme = "furo"
html_title = f"uwb_mitigation {release}"
html_copy_source = False
html_show_copyright = False
html_static_path = ["style"]
html_css_files = ["tables.css"]
html_extra_path = ["site"]  # sends the reader of the top folder to docs/index.html

# The API, from docstrings: Google's sections, names in single backticks.
templates_path = [str(Path(__file__).resolve().parent / "templates")]
default_role = "code"
autodoc_member_order = "bysource"
# The goal `docs` does not install these. What is installed is not mocked: scipy tests whether classes are torch's.
autodoc_mock_imports = [name for name in ("torch", "distributed", "matplotlib") if find_spec(name) is None]
napoleon_use_ivar = True  # else an attribute that has a docstring of its own is described twice
napoleon_attr_annotations = False  # a class shows them in its signature
# Annotations name types of libraries, whose pages are elsewhere.
nitpick_ignore_regex = [("py:.*", ".*")]

# External links, for `make docs-links`.
linkcheck_ignore = [r"http://localhost.*"]
linkcheck_timeout = 20


def as_rst(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """What docstrings here write as Markdown does, as reStructuredText has it.

    One that begins with its attributes has them at the margin, once its quotes are off: no section yet. An indented
    block below a paragraph is an example.
    """
    if lines and lines[0] == "Attributes:" and not lines[1].startswith(" "):
        lines[1:] = [f"    {line}" for line in lines[1:]]
    for at in range(len(lines) - 2, 0, -1):
        above, gap, below = lines[at - 1 : at + 2]
        if above and not above.startswith(" ") and not gap and below.startswith("    "):
            lines[at:at] = ["", "::"]


def setup(app: Sphinx) -> None:
    app.connect("autodoc-process-docstring", as_rst, priority=400)  # before napoleon
