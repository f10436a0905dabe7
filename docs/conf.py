"""Configuration of Sphinx for `make docs`.

The pages are the Markdown files of the repository. The reference pages are generated when this file is read.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import generated
from sphinx.application import Sphinx

import uwb_mitigation

DOCS = Path(__file__).resolve().parent

generated.write_reference()

project = "uwb_mitigation"
author = "uwb_mitigation maintainers"
release = uwb_mitigation.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
root_doc = "docs/index"
include_patterns = [
    "docs/index.md",
    "docs/tutorials/*.md",
    "docs/guides/*.md",
    "docs/reference/**",
    "docs/background/*.md",
    "models/*.md",
    "firmware/README.md",
    "benchmarks/equipment/dw1000_model/chip/README.md",
]
# Sphinx does not need to search these folders.
exclude_patterns = [".[a-z]*", "build", "install", "log", "test", "uwb_mitigation", "requirements"]
highlight_language = "text"
# Use the same anchors as GitHub, so that links work in both places.
myst_heading_anchors = 4
# The copy button leaves out prompts and printed output.
copybutton_prompt_text = "$ "

html_theme = "furo"
html_title = f"uwb_mitigation {release}"
html_copy_source = False
html_show_copyright = False
html_static_path = ["style"]
html_css_files = ["pages.css"]
html_extra_path = ["site"]  # redirects from the top folder to docs/index.html
# Ranks guides above the API reference in the results of a search.
html_search_scorer = str(DOCS / "style" / "scorer.js")

# The API reference is generated from docstrings in Google style, with names in single backticks.
default_role = "code"
autodoc_member_order = "bysource"
napoleon_use_ivar = True  # otherwise attributes with docstrings are listed twice
napoleon_attr_annotations = False  # the signature of the class shows the types
# Annotations contain types of other libraries, which have no pages here.
nitpick_ignore_regex = [("py:.*", ".*")]

# External links, for `make docs-links`.
linkcheck_ignore = [r"http://localhost.*"]
linkcheck_timeout = 20


def as_rst(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Convert Markdown in docstrings to reStructuredText.

    An indented block below a paragraph is a code example: insert `::`.
    """
    for at in range(len(lines) - 2, 0, -1):
        above, gap, below = lines[at - 1 : at + 2]
        if above and not above.startswith(" ") and not gap and below.startswith("    "):
            lines[at:at] = ["", "::"]


def setup(app: Sphinx) -> None:
    """Register the conversion of docstrings."""
    app.connect("autodoc-process-docstring", as_rst, priority=400)  # before napoleon
