"""Output of the sub-commands: tables, progress and JSON results."""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table as RichTable

from uwb_mitigation.errors import UwbMitigationError
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


def print_line(text: str) -> None:
    """Print a line without highlighted numbers or line breaks."""
    out.print(text, markup=False, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print a warning on standard error."""
    err.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)


def show_table(
    title: str,
    columns: Iterable[str],
    rows: Sequence[Iterable[object]],
    bold_row: str = "",
    *,
    left: int = 1,
    max_rows: int = MAX_ROWS,
) -> None:
    """Print the first rows of a table; numbers have three decimals.

    Args:
        title: title above the table; may be empty.
        columns: heads of the columns.
        rows: cells of each row.
        bold_row: the row with this name is bold.
        left: the number of left-aligned columns; the others are right-aligned.
        max_rows: maximum number of rows.
    """
    table = ConsoleTable(title=title, title_justify="left")
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number < left else "right")
    for row in rows[:max_rows]:
        cells = [f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in row]
        table.add_row(*cells, style="bold" if bold_row and bold_row in cells else None)
    out.print(table)
    if len(rows) > max_rows:
        print_line(f"and {len(rows) - max_rows} more rows")


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
def share_bar(name: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar with remaining time; yield a function that sets the completed fraction."""
    with progress() as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda share: bar.update(task, completed=share)


@contextlib.contextmanager
def step_bar(name: str, steps: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar with remaining time; yield a function to call after each step."""
    with progress() as bar:
        task = bar.add_task(name, total=steps)
        yield lambda: bar.advance(task)


@contextlib.contextmanager
def stage_bars() -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar for each stage in turn; yield a function that sets name and completed fraction."""
    with progress() as bar:
        tasks: dict[str, TaskID] = {}

        def on_progress(stage: str, share: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=1.0)
            bar.update(tasks[stage], completed=share)

        yield on_progress


@contextlib.contextmanager
def reading() -> Iterator[Callable[[], None]]:
    """Show a progress bar of unknown length; yield a function to call after each range."""
    with progress() as bar:
        task, ranges = bar.add_task("reading", total=None), itertools.count(1)

        def on_record() -> None:
            if (count := next(ranges)) % 100 == 0:
                bar.update(task, description=f"reading: {count} ranges")

        yield on_record


def show_skipped(skipped: Mapping[str, int]) -> None:
    """Print the number of skipped ranges by reason, {reason: count}."""
    for reason, count in skipped.items():
        err.print(f"skipped: {count} x {reason}", markup=False)


def write_json(path: Path | None, result: Mapping[str, Any]) -> None:
    """Write `result` to `path` atomically; do nothing without a path.

    Raises:
        UwbMitigationError: the file cannot be written.
    """
    if path is None:
        return
    try:
        text = json.dumps(result, indent=2, allow_nan=False) + "\n"
    except ValueError as error:
        raise UwbMitigationError(f"cannot write the result: {error}", where=str(path)) from error
    write_atomically(path, text)


def _check_json_target(path: Path | None) -> Path | None:
    """Refuse a path that cannot be written, before the work begins."""
    if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise typer.BadParameter(f"{path} is a folder, or its folder does not exist")
    return path


JsonOption = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        callback=_check_json_target,
        help="Also write the result to FILE as JSON.",
    ),
]
