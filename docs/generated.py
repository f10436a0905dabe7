"""Writes what pages take from the code, between `<!-- generated: NAME -->` and `<!-- end -->`. No Sphinx here.

    python docs/generated.py

A test holds the pages and the code together.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import typer
from typer.cli import get_docs_for_click

from uwb_mitigation import cli

PAGES = Path(__file__).resolve().parent
MESSAGES = PAGES.parent / "msg_defs" / "msg"

_MARKED = re.compile(r"^(<!-- generated: (\w+) -->\n).*?^(<!-- end -->)$", re.MULTILINE | re.DOTALL)
_LISTS = re.compile(r"^\*\*Commands\*\*:\n\n(?:\* .*\n)+\n*", re.MULTILINE)
_FIELD = re.compile(r"(?P<type>\S+) +(?P<name>\w+)(?: *= *(?P<value>\S+))?(?: +# (?P<meaning>.*))?")


def fill(page: str) -> str:
    """The page with what its marks name between them.

    Raises:
        KeyError: nothing has such a name.
    """
    return _MARKED.sub(lambda part: f"{part[1]}\n{PARTS[part[2]]().strip()}\n\n{part[3]}", page)


def files() -> dict[Path, str]:
    """Every page with marks, and its text as it should be."""
    pages = {path: path.read_text(encoding="utf-8") for path in sorted(PAGES.glob("*.md"))}
    return {path: fill(page) for path, page in pages.items() if _MARKED.search(page)}


def messages() -> str:
    """Every message of the interface package: a section each."""
    return "\n".join(line for path in sorted(MESSAGES.glob("*.msg")) for line in _message(path))


def _message(path: Path) -> Iterator[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [_FIELD.fullmatch(line) for line in lines if line and not line.startswith("#")]
    if None in rows:
        raise ValueError(f"{path}: a line that is no field")
    yield f"## {path.stem}\n"
    yield " ".join(line.removeprefix("# ") for line in lines if line.startswith("#")) + "\n"
    fields = [row for row in rows if row and not row["value"]]
    constants = [row for row in rows if row and row["value"]]
    yield "| field | type | meaning |\n|---|---|---|"
    yield from (f"| `{row['name']}` | `{row['type']}` | {row['meaning']} |" for row in fields)
    if constants:
        yield "\n| constant | value | meaning |\n|---|---|---|"
        yield from (f"| `{row['name']}` | {row['value']} | {row['meaning'] or ''} |" for row in constants)
    yield ""


def commands() -> str:
    """Every command with its options, as `--help` has them."""
    command = typer.main.get_command(cli.app)
    text = get_docs_for_click(obj=command, ctx=typer.Context(command), name="uwb-mitigation")
    # Sections follow for all that the lists name, in words that were not cut short.
    sections = _LISTS.sub("", text)
    return sections[sections.index("\n## ") :]


PARTS = {"messages": messages, "commands": commands}


if __name__ == "__main__":
    for path, text in files().items():
        path.write_text(text, encoding="utf-8")
        print(path)
