"""Writes what pages take from the code, between `<!-- generated: NAME -->` and `<!-- end -->`, the parameter
files in `params/`, and the wire protocol's C header. No Sphinx here, and no ROS.

    python docs/generated.py

A test holds the pages and the code together.
"""

from __future__ import annotations

import ast
import enum
import re
import textwrap
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import typer
from typer.cli import get_docs_for_click

from uwb_mitigation.commands import cli
from uwb_mitigation.link import layout
from uwb_mitigation.link.layout import Layout, MessageType
from uwb_mitigation.nodes.parameter_tables import TABLES

PAGES = Path(__file__).resolve().parent
REPOSITORY = PAGES.parent
PACKAGE = REPOSITORY / "uwb_mitigation"
MESSAGES = REPOSITORY / "msg_defs" / "msg"
PARAMETERS = REPOSITORY / "params"
C_HEADER = REPOSITORY / "firmware" / "src" / "uwb_protocol.h"

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
    """Every page with marks, every parameter file, and the C header, and its text as it should be."""
    pages = {path: path.read_text(encoding="utf-8") for path in sorted(PAGES.glob("*.md"))}
    texts = {path: fill(page) for path, page in pages.items() if _MARKED.search(page)}
    texts |= {PARAMETERS / f"{node}.yaml": parameter_file(node) for node in TABLES}
    return texts | {C_HEADER: c_header()}


def parameter_file(node: str) -> str:
    """A ROS parameter file that holds every parameter at its default, with its meaning."""
    lines = [f"# Parameters of the {node} node, at their defaults.", "/**:", "  ros__parameters:"]
    for row in TABLES[node]:
        lines += [f"    # {line}" for line in textwrap.wrap(f"{row.description} ({row.valid})", 100)]
        # What the user has to say is shown, and left out.
        lines.append(
            f"    {'' if row.filed else '# '}{row.name}: {row.default_text if row.filed else ''}".rstrip()
        )
    return "\n".join(lines) + "\n"


def parameters() -> str:
    """The parameters of every node: a table each."""
    lines: list[str] = []
    for node, table in TABLES.items():
        lines += [
            f"## `{node}`",
            "",
            "| name | default | unit | valid | changes live | meaning |",
            "|---|---|---|---|---|---|",
        ]
        lines += [
            f"| `{row.name}` | `{row.default_text}` | {row.unit or '-'} | {row.valid} "
            f"| {'yes' if row.live else 'no'} | {row.description} |"
            for row in table
        ]
        lines.append("")
    return "\n".join(lines)


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


_WIRE_TYPES = {"B": "u8", "H": "u16", "I": "u32", "Q": "u64", "i": "i32", "f": "f32"}


def wire_layout(table: Layout) -> str:
    """One header or payload of the wire protocol: its type, its length and its fields."""
    number = f"Type {MessageType[table.name].value}; " if table.name in MessageType.__members__ else ""
    if not table.fields:
        return f"{number}no payload."
    tail = f", then {table.tail}" if table.tail else ""
    lines = [
        f"{number}{table.packing().size} bytes{tail}.",
        "",
        "| byte | type | field | meaning |",
        "|---|---|---|---|",
    ]
    for field in table.fields:
        if field.name in table.offsets():
            kind = _WIRE_TYPES.get(field.code) or f"{field.code[:-1]} bytes"
            lines.append(f"| {table.offsets()[field.name]} | {kind} | `{field.name}` | {field.meaning} |")
    return "\n".join(lines)


def wire_values(*kinds: type[enum.IntEnum]) -> str:
    """What the values of enumerations mean."""
    lines = ["| value | name |", "|---|---|"]
    return "\n".join(lines + [f"| {member.value} | {member.name} |" for kind in kinds for member in kind])


def wire_limits() -> str:
    """How long the parts of a frame may be."""
    return f"""\
| limit | bytes |
|---|---|
| payload | {layout.MAX_PAYLOAD_BYTES} |
| header, payload and CRC | {layout.MAX_FRAME_BYTES} |
| the same after COBS, without delimiters | {layout.MAX_ENCODED_BYTES} |

| limit | int16 values |
|---|---|
| samples of a RANGE_CIR ({layout.MAX_SAMPLES // 2} complex ones) | {layout.MAX_SAMPLES} |"""


def layers() -> str:
    """The package's parts, each layer above what it may import, as the contract in pyproject.toml has them."""
    return "\n".join(["```text", *(layer.replace(" |", ",") for layer in _layers()), "```"])


def parts() -> str:
    """What lives in each part, as its own docstring says."""
    lines = ["| part | what lives there |", "|---|---|"]
    for name in (name for layer in _layers() for name in re.findall(r"\w+", layer)):
        folder = (PACKAGE / name).is_dir()
        module = PACKAGE / name / "__init__.py" if folder else PACKAGE / f"{name}.py"
        told = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
        about = " ".join(told.partition("\n\n")[0].split()).replace("|", "\\|")
        lines.append(f"| `{name}{'/' if folder else '.py'}` | {about} |")
    return "\n".join(lines)


def _layers() -> list[str]:
    from importlinter.api import read_configuration  # no need of what else is here

    contracts = read_configuration(str(REPOSITORY / "pyproject.toml"))["contracts_options"]
    (found,) = (contract["layers"] for contract in contracts if contract["type"] == "layers")
    return [str(layer) for layer in found]


_C_TYPES = {"B": "uint8_t", "H": "uint16_t", "I": "uint32_t", "Q": "uint64_t", "i": "int32_t", "f": "float"}


def c_header() -> str:
    """The wire protocol as the C header `uwb_protocol.h`: constants, structs, and assertions on their layout."""
    lines = [
        "/* Wire protocol between board and host: docs/protocol.md.",
        "   Generated by docs/generated.py; do not edit. */",
        "#ifndef UWB_PROTOCOL_H",
        "#define UWB_PROTOCOL_H",
        "",
        "#include <stdint.h>",
        "",
        "#ifdef __cplusplus",
        "#define UWB_STATIC_ASSERT(condition) static_assert(condition, #condition)",
        "#elif __STDC_VERSION__ >= 201112L",
        "#define UWB_STATIC_ASSERT(condition) _Static_assert(condition, #condition)",
        "#else",
        "#define UWB_STATIC_ASSERT(condition) extern char uwb_static_assertion[(condition) ? 1 : -1]",
        "#endif",
        "",
        f"#define UWB_PROTOCOL_VERSION {layout.PROTOCOL_VERSION}",
        f"#define UWB_HEADER_BYTES {layout.HEADER_BYTES}",
        f"#define UWB_CRC_BYTES {layout.CRC_BYTES}",
        f"#define UWB_MAX_SAMPLES {layout.MAX_SAMPLES}",
        f"#define UWB_MAX_PAYLOAD_BYTES {layout.MAX_PAYLOAD_BYTES}",
        f"#define UWB_MAX_FRAME_BYTES {layout.MAX_FRAME_BYTES}",
        f"#define UWB_MAX_ENCODED_BYTES {layout.MAX_ENCODED_BYTES}",
        f"#define UWB_MAX_ANCHORS {layout.MAX_ANCHORS}",
        f"#define UWB_MAX_OFFSETS {layout.MAX_OFFSETS}",
        "",
    ]
    for prefix, members in (
        ("TYPE", MessageType),
        ("FLAG", layout.Flag),
        ("MODE", layout.Mode),
        ("ROLE", layout.Role),
        ("RADIO_STATE", layout.RadioState),
        ("OFFSET_OF", layout.OffsetOf),
        ("LOG_LEVEL", layout.LogLevel),
    ):
        lines += [f"#define UWB_{prefix}_{member.name} {member.value}" for member in members]
        lines.append("")
    for table in (layout.HEADER, layout.RADIO_ANCHOR, layout.OFFSET, *layout.PAYLOADS.values()):
        if table.fields:
            lines += _c_struct(table)
    lines += ["#endif", ""]
    return "\n".join(lines)


def _c_struct(table: Layout) -> list[str]:
    name = f"uwb_{table.name.lower()}_t"
    lines = ["typedef struct {"]
    for field in table.fields:
        if field.code[:-1]:
            element = "char" if field.code.endswith("s") else "uint8_t"
            member = f"{element} {field.name}[{field.code[:-1]}];"
        else:
            member = f"{_C_TYPES[field.code]} {field.name};"
        lines.append(f"    {member} /* {field.meaning} */" if field.meaning else f"    {member}")
    if table.tail:
        lines.append(f"    /* then {table.tail} */")
    # The size is the sum of the sizes of the fields: no padding, so that the offsets are right as well.
    return [*lines, f"}} {name};", f"UWB_STATIC_ASSERT(sizeof({name}) == {table.packing().size});", ""]


PARTS = {
    "messages": messages,
    "parameters": parameters,
    "commands": commands,
    "layers": layers,
    "parts": parts,
    "wire_limits": wire_limits,
    "wire_modes": partial(wire_values, layout.Mode),
    "wire_roles": partial(wire_values, layout.Role),
    "wire_radio_states": partial(wire_values, layout.RadioState),
    "wire_offset_of": partial(wire_values, layout.OffsetOf),
    "wire_log_levels": partial(wire_values, layout.LogLevel),
} | {
    f"wire_{each.name}": partial(wire_layout, each)
    for each in (layout.HEADER, layout.RADIO_ANCHOR, layout.OFFSET, *layout.PAYLOADS.values())
}


if __name__ == "__main__":
    for path, text in files().items():
        path.write_text(text, encoding="utf-8")
        print(path)
