"""docs/protocol.md says what the table says.

`python test/test_link_document.py` prints the tables of the page.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from uwb_mitigation.link import layout
from uwb_mitigation.link.layout import HEADER, PAYLOADS, Layout, LogLevel, MessageType, Mode

PAGE = Path(__file__).parent.parent / "docs" / "protocol.md"

C_NAMES = {"B": "u8", "H": "u16", "I": "u32", "Q": "u64", "i": "i32", "f": "f32", "16s": "16 bytes"}


def rows(table: Layout) -> Iterator[str]:
    codes = {field.name: field for field in table.fields}
    for name, offset in table.offsets().items():
        field = codes[name]
        yield f"| {offset} | {C_NAMES[field.code]} | `{name}` | {field.meaning} |"


@pytest.mark.parametrize("table", [HEADER, *PAYLOADS.values()], ids=lambda table: table.name)
def test_every_field_stands_in_the_page_at_its_offset(table):
    page = PAGE.read_text()
    at = page.index("### HEADER" if table is HEADER else f"### {table.name} (")
    section = page[at : page.find("\n##", at + 4)]

    assert [line for line in section.splitlines() if line.startswith("| ") and "`" in line] == list(
        rows(table)
    )
    if table.fields:
        assert f"{table.packing().size} bytes" in section


@pytest.mark.parametrize("kind", MessageType)
def test_every_type_stands_in_the_page_with_its_number(kind):
    assert f"### {kind.name} ({kind.value})" in PAGE.read_text()


@pytest.mark.parametrize(
    "number",
    [layout.MAX_PAYLOAD_BYTES, layout.MAX_FRAME_BYTES, layout.MAX_ENCODED_BYTES, layout.MAX_SAMPLES],
)
def test_every_limit_stands_in_the_page(number):
    assert f"| {number} |" in PAGE.read_text()


@pytest.mark.parametrize("member", [*Mode, *LogLevel])
def test_every_value_of_an_enumeration_stands_in_the_page(member):
    assert f"{member.value} {member.name}" in PAGE.read_text()


if __name__ == "__main__":
    for each in (HEADER, *PAYLOADS.values()):
        print(f"### {each.name}\n\n| byte | type | field | meaning |\n|---|---|---|---|")
        print("\n".join(rows(each)), "\n")
