"""Draws docs/architecture.svg: which part of the package imports which.

    python docs/diagram.py

The arrows come from the imports themselves. An import that follows from others (a imports b, b imports c,
so a may import c) has no arrow of its own; two parts that import each other share one. Only where a part
stands is decided here.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGE = HERE.parent / "uwb_mitigation"
PICTURE = HERE / "architecture.svg"

# Column, row, and what the part is about.
PARTS = {
    "commands": (1.5, 0, "the command line"),
    "installation": (1.5, 1, "what is installed"),
    "processing": (0, 2, "bags in bulk"),
    "nodes": (3, 1, "ROS 2: imports rclpy"),
    "training": (2, 2, "imports torch"),
    "firmware_export": (3, 2, "int8 model to C"),
    "evaluation": (2, 3, "metrics, splits, tables"),
    "dataset": (1, 4, "labelled inputs"),
    "mitigation": (2, 4, "range in, corrected out"),
    "link": (3, 4, "a board's protocol"),
    "bag": (0, 5, "MCAP, CDR"),
    "sources": (1, 5, "recordings, simulator"),
    "model": (2, 5, "bundle, int8 arithmetic"),
    "simulation": (1, 6, "channel and radio"),
    "preprocessing": (2, 6, "CIR to network input"),
    "measurement": (1.5, 7, "what a range is"),
}
EVERYWHERE = {"errors"}
"""Imported by all, and not drawn."""

COLUMN, ROW, WIDTH, HEIGHT = 200, 92, 168, 48


def imports(package: Path = PACKAGE) -> set[tuple[str, str]]:
    """Pairs (part, part it imports), wherever in a file the import stands. `cli.py` belongs to the commands."""
    found = set()
    for path in package.rglob("*.py"):
        part = _part(path.relative_to(package).parts[0].removesuffix(".py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            found |= {(part, _part(name)) for name in _names(node)}
    return {(a, b) for a, b in found if a != b and not {a, b} & (EVERYWHERE | {"__init__"})}


def _part(name: str) -> str:
    return "commands" if name == "cli" else name


def _names(node: ast.AST) -> Iterator[str]:
    """The first name below the package of every import in a node."""
    modules: list[str] = []
    if isinstance(node, ast.Import):
        modules = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom) and node.module:
        modules = [f"{node.module}.{alias.name}" for alias in node.names]
    for module in modules:
        package, _, rest = module.partition(".")
        if package == PACKAGE.name and rest and not rest.startswith("__"):
            yield rest.partition(".")[0]


def arrows(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The pairs that do not follow from the others."""
    return {pair for pair in pairs if pair[1] not in _reached(pair[0], pairs - {pair})}


def _reached(start: str, pairs: set[tuple[str, str]]) -> set[str]:
    reached: set[str] = set()
    waiting = [start]
    while waiting:
        at = waiting.pop()
        further = {b for a, b in pairs if a == at} - reached
        reached |= further
        waiting += further
    return reached


def svg() -> str:
    """The picture."""
    drawn = arrows(imports())
    width = max(x for x, _, _ in PARTS.values()) * COLUMN + WIDTH + 20
    height = max(y for _, y, _ in PARTS.values()) * ROW + HEIGHT + 20
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" font-family="sans-serif" '
        'role="img" aria-label="Parts of the package, and which imports which">',
        '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
        'orient="auto-start-reverse"><path d="M0 1 10 5 0 9z" fill="#456"/></marker></defs>',
        f'<rect width="{width:g}" height="{height:g}" rx="8" fill="#fff"/>',
    ]
    for a, b in sorted(drawn):
        if (b, a) not in drawn:
            lines.append(_arrow(a, b, 'marker-end="url(#tip)"'))
        elif a < b:
            lines.append(_arrow(a, b, 'marker-start="url(#tip)" marker-end="url(#tip)"'))
    for name, (_, _, about) in PARTS.items():
        x, y = _centre(name)
        lines += [
            f'<rect x="{x - WIDTH / 2:g}" y="{y - HEIGHT / 2:g}" width="{WIDTH}" height="{HEIGHT}" rx="6" '
            'fill="#eef3fa" stroke="#456"/>',
            f'<text x="{x:g}" y="{y - 3:g}" text-anchor="middle" font-size="15" font-weight="bold" '
            f'fill="#123">{name}</text>',
            f'<text x="{x:g}" y="{y + 15:g}" text-anchor="middle" font-size="12.5" fill="#345">{about}</text>',
        ]
    return "\n".join([*lines, "</svg>\n"])


def _centre(name: str) -> tuple[float, float]:
    x, y, _ = PARTS[name]
    return x * COLUMN + WIDTH / 2 + 10, y * ROW + HEIGHT / 2 + 10


def _arrow(a: str, b: str, tips: str) -> str:
    (x1, y1), (x2, y2) = _centre(a), _centre(b)
    if y1 == y2:
        side = WIDTH / 2 if x2 > x1 else -WIDTH / 2
        x1, x2 = x1 + side, x2 - side
    else:
        side = HEIGHT / 2 if y2 > y1 else -HEIGHT / 2
        y1, y2 = y1 + side, y2 - side
    line = f'<path d="M{x1:g} {y1:g} {x2:g} {y2:g}" fill="none" stroke="#456" stroke-width="1.5"'
    return f'{line} {tips} data-from="{a}" data-to="{b}"/>'


if __name__ == "__main__":
    PICTURE.write_text(svg(), encoding="utf-8")
    print(PICTURE)
