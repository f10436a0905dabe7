"""The documentation points at things that are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from conftest import REPOSITORY

PAGES = sorted(
    path
    for pattern in ("*.md", "docs/*.md", "models/*.md", "firmware/**/*.md")
    for path in REPOSITORY.glob(pattern)
)


def links(page: Path) -> list[str]:
    """Targets of a page's links, code left out."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    prose = [line for line in text.splitlines() if not line.startswith("    ")]
    return re.findall(r"\]\(([^)\s#]+)", "\n".join(prose))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_between_pages_lead_somewhere(page: Path):
    local = [target for target in links(page) if not re.match(r"[a-z]+:", target)]
    assert [target for target in local if not (page.parent / target).exists()] == []


def test_every_page_of_the_documentation_can_be_reached():
    read: set[Path] = set()
    waiting = [REPOSITORY / "README.md"]
    while waiting:
        page = waiting.pop()
        if page in read or page.suffix != ".md" or not page.is_file():
            continue
        read.add(page)
        waiting += [(page.parent / target).resolve() for target in links(page) if "://" not in target]
    assert {page for page in PAGES if page.parent.name == "docs"} <= read


def test_no_page_holds_a_placeholder():
    bare = re.compile(r"^[A-Z]{4,}$", re.MULTILINE)
    assert [page.name for page in PAGES if bare.search(page.read_text(encoding="utf-8"))] == []
