"""Output of the sub-commands: tables, progress and JSON results."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import itertools
import json
import math
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table as RichTable

from uwb_mitigation.errors import format_id
from uwb_mitigation.files import write_atomically

MAX_ROWS = 40


class ConsoleTable(RichTable):
    """A table that wraps long words; rich would truncate them in a narrow terminal."""

    def add_column(self, *arguments: Any, **options: Any) -> None:
        """Add a column that wraps long values."""
        super().add_column(*arguments, **{"overflow": "fold", **options})


# Results go to standard output, progress to standard error, so that a pipe contains only results.
# rich omits colours and cursor movement if a stream is not a terminal.
out = Console()
err = Console(stderr=True)


def exit_on_sigterm() -> None:
    """Let SIGTERM raise SystemExit, so that unfinished output is removed."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))


def print_line(text: str) -> None:
    """Print a line without highlighted numbers or line breaks."""
    out.print(text, markup=False, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print a warning on standard error."""
    err.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)


def show_table(
    title: str,
    columns: Mapping[str, str] | Iterable[str],
    rows: Sequence[Any],
    bold_row: str = "",
    *,
    left: int = 1,
    max_rows: int = MAX_ROWS,
    optional: Sequence[str] = (),
) -> None:
    """Print the first rows of a table.

    Args:
        title: title above the table; may be empty.
        columns: {title with unit: "KEY" or "KEY:FORMAT"}: KEY is an attribute or key of each row, with dots for nested
            ones; FORMAT is a format specification, or `id` for ids. Numbers are right-aligned, and unknown values (None,
            NaN) are shown as "-". Or only the titles, if each row is a sequence of cells.
        rows: the rows of the result that `write_json` writes, too; or sequences of cells.
        bold_row: the row with this name is bold.
        left: with titles only: the number of left-aligned columns.
        max_rows: maximum number of rows.
        optional: titles of columns that are omitted, the last one first, until the table fits the terminal.
    """
    titles = list(columns)
    if isinstance(columns, Mapping):
        keys = [key.partition(":") for key in columns.values()]
        shown = [[_cell(_value(row, key), form) for key, _, form in keys] for row in rows[:max_rows]]
        is_left = [form in ("", "id") for _, _, form in keys]
    else:
        shown = [[_cell(cell, "") for cell in row] for row in rows[:max_rows]]
        is_left = [number < left for number in range(len(titles))]

    def build(omitted: Sequence[str]) -> ConsoleTable:
        table = ConsoleTable(title=escape(title), title_justify="left")
        selected = [number for number, name in enumerate(titles) if name not in omitted]
        for number in selected:
            table.add_column(titles[number], justify="left" if is_left[number] else "right")
        for cells in shown:
            bold = "bold" if bold_row and bold_row in cells else None
            table.add_row(*(escape(cells[number]) for number in selected), style=bold)
        return table

    omitted: list[str] = []
    # Rich limits the measured width to that of the options.
    unlimited = out.options.update_width(10_000)
    while len(omitted) < len(optional) and (
        out.measure(build(omitted), options=unlimited).maximum > out.width
    ):
        omitted.insert(0, optional[-1 - len(omitted)])
    out.print(build(omitted))
    if len(rows) > max_rows:
        print_line(f"and {len(rows) - max_rows} more rows")
    if omitted:
        print_line(f"In wider terminals and with --json: {'; '.join(omitted)}")


def _value(row: Any, key: str) -> Any:
    for name in key.split("."):
        row = row.get(name) if isinstance(row, Mapping) else getattr(row, name)
    return row


def _cell(value: Any, form: str) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if form == "id":
        return format_id(value)
    if isinstance(value, enum.Enum):
        value = to_json(value)
    return format(value, form or (".3f" if isinstance(value, float) else ""))


def progress() -> Progress:
    """Return a progress bar with elapsed and remaining time, on standard error if it is a terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f}%"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=err,
        transient=True,
        disable=not err.is_terminal,
    )


@contextlib.contextmanager
def step_bar(name: str, steps: int | None = None) -> Iterator[Callable[[], None]]:
    """Show a progress bar with remaining time if the number of steps is known; yield a function to call after each."""
    with progress() as bar:
        task = bar.add_task(name, total=steps)
        yield lambda: bar.advance(task)


@contextlib.contextmanager
def stage_bars() -> Iterator[Callable[[str, float | None], None]]:
    """Show a progress bar for each stage in turn; yield a function that sets name and completed fraction, None: unknown."""
    with progress() as bar:
        tasks: dict[str, TaskID] = {}

        def on_progress(stage: str, fraction: float | None) -> None:
            if stage not in tasks:
                for earlier in tasks.values():
                    bar.update(earlier, total=1.0, completed=1.0)
                tasks[stage] = bar.add_task(stage, total=None if fraction is None else 1.0)
            bar.update(tasks[stage], completed=fraction)

        yield on_progress


@contextlib.contextmanager
def counting(name: str = "reading", total: int | None = None) -> Iterator[Callable[..., Iterator[Any]]]:
    """Show a progress bar of records; yield a function that passes records on and counts them."""
    with progress() as bar:
        task, numbers = bar.add_task(name, total=total), itertools.count(1)

        def counted(records: Iterable[Any]) -> Iterator[Any]:
            for record in records:
                if (count := next(numbers)) % 100 == 0:
                    bar.update(task, completed=count, description=f"{name}: {count} ranges")
                yield record

        yield counted


def show_skipped(skipped: Mapping[str, int]) -> None:
    """Print the number of skipped ranges by reason, {reason: count}."""
    for reason, count in skipped.items():
        err.print(f"skipped: {count} x {reason}", markup=False)


def to_json(value: Any) -> Any:
    """Return a result as JSON values.

    Dataclasses and named tuples become objects with their public fields, or what their method `as_json` returns; arrays
    become lists, paths and errors text, enumerations their names (text values: their values), tuples as keys `A-B`.
    Numbers that are not finite become null.
    """
    if isinstance(value, enum.Enum):
        return value.value if isinstance(value.value, str) else value.name
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "as_json"):
        return to_json(value.as_json())
    if hasattr(value, "_asdict"):
        return to_json(value._asdict())
    if dataclasses.is_dataclass(value):
        names = (field.name for field in dataclasses.fields(value))
        return {name: to_json(getattr(value, name)) for name in names if not name.startswith("_")}
    if isinstance(value, Mapping):
        return {_json_key(key): to_json(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return to_json(value.tolist())
    if isinstance(value, Path | Exception):
        return str(value)
    return [to_json(item) for item in value]


def _json_key(key: Any) -> str:
    return "-".join(map(str, key)) if isinstance(key, tuple) else str(to_json(key))


def write_json(path: Path | None, *results: object) -> None:
    """Write one or more results, whose keys are merged, to `path` atomically; do nothing without a path.

    A command computes one result, shows it with `show_table`, and gives the same object to this function:

        result = summary_of(recording)  # a frozen dataclass whose fields are the keys of the JSON file
        show_table("Pairs", {"anchor": "anchor_id:id", "mean range, m": "mean_range_m:.3f"}, result.by_pair)
        write_json(json, result, {"output": output})

    Raises:
        UwbMitigationError: the file cannot be written.
    """
    if path is None:
        return
    merged = {key: value for result in results for key, value in to_json(result).items()}
    write_atomically(path, json.dumps(merged, indent=2, allow_nan=False) + "\n")


def _check_json_target(path: Path | None) -> Path | None:
    """Refuse a path that cannot be written, before the work begins."""
    if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise typer.BadParameter(f"{path} is a folder, or its folder does not exist")
    return path


JsonOption = Annotated[
    Path | None,
    typer.Option(
        "--json", metavar="FILE", callback=_check_json_target, help="Also write the result as JSON."
    ),
]
