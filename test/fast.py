"""Selection of the test files that `--fast` runs, see `SLOW_MODULES`.

The answer follows from the imports, so that a new test file is classified without a list.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

TESTS = Path(__file__).resolve().parent
SLOW_MODULES = {
    *("rclpy", "torch", "launch", "uwb_mitigation_msgs", "selenium"),
    # They compile the firmware, or start commands.
    *("uwb_mitigation.mitigation.embedded.compiling", "compilers", "command_line"),
    # They simulate and solve many drives.
    *("uwb_mitigation.calibration.self_calibration", "uwb_mitigation.calibration.survey"),
}
SLOW_FIXTURES = {"ros", "browser", "air", "apartment", "apartment_reading", "apartment_imported"}


def is_fast(path: Path) -> bool:
    """Return whether a test file imports no module of `SLOW_MODULES`, directly or indirectly."""
    seen: set[str] = set()
    waiting = list(_imports(path))
    while waiting:
        name = waiting.pop()
        if name in SLOW_MODULES or name.partition(".")[0] in SLOW_MODULES:
            return False
        if name not in seen and (file := _file_of(name)) is not None:
            waiting += _imports(file)
        seen.add(name)
    return True


def _file_of(name: str) -> Path | None:
    """Return the file of a module of this repository."""
    place = TESTS / name if "." not in name else TESTS.parent / name.replace(".", "/")
    return next((file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()), None)


@cache
def _imports(path: Path) -> tuple[str, ...]:
    return tuple(_find_imports(path))


def _find_imports(path: Path) -> Iterator[str]:
    """Return the modules that a file imports; for a test, also imports inside functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree) if path.parent == TESTS else tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.importorskip":
            # A variable names an optional library, not a file of the project.
            yield from (str(argument.value) for argument in node.args if isinstance(argument, ast.Constant))
