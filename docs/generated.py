"""Generate the reference pages (not committed), the parameter files and the C header of the wire protocol.

    python docs/generated.py

`make docs` calls `write_reference`. Each page is a template in `docs/templates/reference`, in which the lines
`<!-- generated: NAME -->` are replaced by text from the code. This module imports neither Sphinx nor ROS.
"""

from __future__ import annotations

import ast
import enum
import inspect
import re
import textwrap
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import typer
from typer.cli import get_docs_for_click

import uwb_mitigation
from uwb_mitigation.commands import cli
from uwb_mitigation.nodes.support.parameter_tables import ALL_TABLES, TABLES
from uwb_mitigation.radios.settings import MAX_ANCHORS, RadioState, Role
from uwb_mitigation.radios.wire import layout
from uwb_mitigation.radios.wire.layout import Layout, MessageType

DOCS = Path(__file__).resolve().parent
TEMPLATES = DOCS / "templates" / "reference"
REFERENCE = DOCS / "reference"
REPOSITORY = DOCS.parent
PACKAGE = REPOSITORY / "uwb_mitigation"
MESSAGES = REPOSITORY / "msg_defs" / "msg"
PARAMETERS = REPOSITORY / "params"
C_HEADER = REPOSITORY / "firmware" / "src" / "uwb_protocol.h"

_MARK = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)
_LISTS = re.compile(r"^\*\*Commands\*\*:\n\n(?:\* .*\n)+\n*", re.MULTILINE)
_FIELD = re.compile(r"(?P<type>\S+) +(?P<name>\w+)(?: *= *(?P<value>\S+))?(?: +# (?P<meaning>.*))?")


def fill(template: str) -> str:
    """Return the template with every mark replaced.

    Raises:
        KeyError: a mark has an unknown name.
    """
    return _MARK.sub(lambda mark: PARTS[mark[1]]().strip(), template)


def reference() -> dict[Path, str]:
    """Return the path and the text of every reference page."""
    pages = {
        REFERENCE / template.name: fill(template.read_text(encoding="utf-8"))
        for template in sorted(TEMPLATES.glob("*.md"))
    }
    return pages | {REFERENCE / "commands" / f"{name}.md": command_page(name) for name in _command_names()}


def committed_files() -> dict[Path, str]:
    """Return the path and the text of every parameter file and of the C header."""
    texts = {PARAMETERS / f"{node}.yaml": parameter_file(node) for node in TABLES}
    return texts | {C_HEADER: c_header()}


def write_reference() -> None:
    """Write the reference pages, and delete those of commands and modules that no longer exist.

    A page whose text has not changed keeps its modification time.
    """
    pages = reference()
    for old in set(REFERENCE.glob("*.md")) | set(REFERENCE.glob("commands/*.md")):
        if old not in pages:
            old.unlink()
    for path, text in pages.items():
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")


def parameter_file(node: str) -> str:
    """Return a ROS parameter file with every parameter of a node at its default."""
    lines = [f"# Parameters of the {node} node, at their defaults.", "/**:", "  ros__parameters:"]
    for row in TABLES[node]:
        lines += [f"    # {line}" for line in textwrap.wrap(f"{row.description} ({row.valid})", 100)]
        # A parameter without a useful default is a comment.
        lines.append(
            f"    {'' if row.filed else '# '}{row.name}: {row.default_text if row.filed else ''}".rstrip()
        )
    return "\n".join(lines) + "\n"


def parameters() -> str:
    """Return a section with a table of parameters for each node."""
    lines: list[str] = []
    for node, table in ALL_TABLES.items():
        lines += [
            f"## Parameters of `{node}`",
            "",
            "| name | default | unit | valid | live | meaning |",
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
    """Return a section for each message of the interface package."""
    return "\n".join(line for path in sorted(MESSAGES.glob("*.msg")) for line in _message(path))


def _message(path: Path) -> Iterator[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [_FIELD.fullmatch(line) for line in lines if line and not line.startswith("#")]
    if None in rows:
        raise ValueError(f"{path}: not a field definition")
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


def thresholds() -> str:
    """Return the rows of the table of warnings of the mitigator."""
    # Importing the module would need ROS.
    source = ast.parse((PACKAGE / "nodes" / "support" / "mitigator_health.py").read_text(encoding="utf-8"))
    calls = [node.value for node in source.body if isinstance(node, ast.Assign)]
    rows = [
        [ast.literal_eval(argument) for argument in call.args]
        for call in calls
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "Threshold"
    ]
    if not rows:
        raise ValueError("nodes/support/mitigator_health.py defines no thresholds")
    return "\n".join(f"| WARN | {fact} above {limit:g} | {text} |" for fact, limit, text in rows)


@cache
def _commands() -> dict[str, Any]:
    """Return all commands and groups of commands, {name: command}."""
    return dict(typer.main.get_command(cli.app).commands)  # type: ignore[attr-defined]


def command_list() -> str:
    """Return tables of all commands by topic with links to their pages, and their table of contents."""
    lines: list[str] = []
    for topic, names in cli.PANELS.items():
        lines += ["", f"## {topic}", "", "| command | purpose |", "|---|---|"]
        for name in names:
            about = (_commands()[name].help or "").partition("\n")[0]
            lines.append(f"| [`{name}`](commands/{name}.md) | {about} |")
    lines += ["", "```{toctree}", ":hidden:", "", *(f"commands/{name}" for name in _command_names()), "```"]
    return "\n".join(lines)


def _command_names() -> list[str]:
    return [name for names in cli.PANELS.values() for name in names]


def command_page(name: str) -> str:
    """Return the page of a command or of a group of commands, with all options as in `--help`."""
    command = _commands()[name]
    text = get_docs_for_click(
        obj=command, ctx=typer.Context(command, info_name=name), name=name, call_prefix="uwb-mitigation"
    )
    # Each command of a list has a section of its own, with the full text.
    text = _LISTS.sub("", text)
    text = re.sub(r"^## (?!`)", "### ", text, flags=re.MULTILINE)
    return text.strip() + "\n"


_WIRE_TYPES = {"B": "u8", "H": "u16", "I": "u32", "Q": "u64", "i": "i32", "f": "f32"}


def wire_layout(table: Layout) -> str:
    """Return type, length and table of fields of a header or payload of the wire protocol."""
    number = f"Type {MessageType[table.name].value}; " if table.name in MessageType.__members__ else ""
    if not table.fields:
        return f"{number}no payload."
    tail = f", then {table.tail}" if table.tail else ""
    lines = [
        f"{number}{table.as_struct().size} bytes{tail}.",
        "",
        "| byte | type | field | meaning |",
        "|---|---|---|---|",
    ]
    for field in table.fields:
        if field.name in table.offsets():
            kind = _WIRE_TYPES.get(field.code) or f"{field.code[:-1]} bytes"
            lines.append(f"| {table.offsets()[field.name]} | {kind} | `{field.name}` | {field.description} |")
    return "\n".join(lines)


def wire_values(*kinds: type[enum.IntEnum]) -> str:
    """Return a table of the values of enumerations."""
    lines = ["| value | name |", "|---|---|"]
    return "\n".join(lines + [f"| {member.value} | {member.name} |" for kind in kinds for member in kind])


def wire_limits() -> str:
    """Return a table of the maximum lengths of the parts of a frame."""
    return f"""\
| limit | bytes |
|---|---|
| payload | {layout.MAX_PAYLOAD_BYTES} |
| header, payload and CRC | {layout.MAX_FRAME_BYTES} |
| the same after COBS, without delimiters | {layout.MAX_ENCODED_BYTES} |

| limit | int16 values |
|---|---|
| samples of a RANGE_CIR ({layout.MAX_SAMPLES // 2} complex ones) | {layout.MAX_SAMPLES} |"""


def api() -> str:
    """Return directives of autodoc for the public names."""
    lines = ["```{eval-rst}"]
    for name in uwb_mitigation.__all__:
        value = getattr(uwb_mitigation, name)
        kind = "function" if inspect.isfunction(value) else "class"
        lines += [
            f".. auto{kind}:: uwb_mitigation.{name}",
            *["   :members:", "   :inherited-members: int, Exception, ABC"][: 2 * (kind == "class")],
            "",
        ]
    return "\n".join([*lines, "```"])


_C_TYPES = {"B": "uint8_t", "H": "uint16_t", "I": "uint32_t", "Q": "uint64_t", "i": "int32_t", "f": "float"}


def c_header() -> str:
    """The wire protocol as the C header `uwb_protocol.h`: constants, structs, and assertions on their layout."""
    lines = [
        "/* Wire protocol between board and host: docs/reference/protocol.md.",
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
        f"#define UWB_MAX_ANCHORS {MAX_ANCHORS}",
        f"#define UWB_MAX_OFFSETS {layout.MAX_OFFSETS}",
        "",
    ]
    for prefix, members in (
        ("TYPE", MessageType),
        ("FLAG", layout.Flag),
        ("MODE", layout.Mode),
        ("ROLE", Role),
        ("RADIO_STATE", RadioState),
        ("OFFSET_SCOPE", layout.OffsetScope),
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
        lines.append(f"    {member} /* {field.description} */" if field.description else f"    {member}")
    if table.tail:
        lines.append(f"    /* then {table.tail} */")
    # The size is the sum of the sizes of the fields: no padding, so that the offsets are right as well.
    return [*lines, f"}} {name};", f"UWB_STATIC_ASSERT(sizeof({name}) == {table.as_struct().size});", ""]


PARTS = {
    "messages": messages,
    "parameters": parameters,
    "thresholds": thresholds,
    "command_list": command_list,
    "api": api,
    "wire_limits": wire_limits,
    "wire_modes": partial(wire_values, layout.Mode),
    "wire_roles": partial(wire_values, Role),
    "wire_radio_states": partial(wire_values, RadioState),
    "wire_offset_scope": partial(wire_values, layout.OffsetScope),
    "wire_log_levels": partial(wire_values, layout.LogLevel),
} | {
    f"wire_{each.name}": partial(wire_layout, each)
    for each in (layout.HEADER, layout.RADIO_ANCHOR, layout.OFFSET, *layout.PAYLOADS.values())
}


if __name__ == "__main__":
    write_reference()
    for path, text in committed_files().items():
        path.write_text(text, encoding="utf-8")
