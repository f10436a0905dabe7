"""Sphinx's configuration, for `make docs`: the pages are the repository's Markdown files, where they stand."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import uwb_mitigation

project = "uwb_mitigation"
author = "uwb_mitigation maintainers"
release = uwb_mitigation.__version__

extensions = ["myst_parser"]
root_doc = "docs/index"
include_patterns = ["docs/*.md", "models/*.md", "firmware/README.md"]
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

# External links, for `make docs-links`.
linkcheck_ignore = [r"http://localhost.*"]
linkcheck_timeout = 20
