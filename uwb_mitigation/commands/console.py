"""What every sub-command shares: where tables, progress and JSON results go."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uwb_mitigation.errors import UwbMitigationError

JsonOption = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Also write the result to FILE as JSON."),
]

# Results go to standard output, progress to standard error, so that a pipe carries results alone.
# rich leaves colours and cursor movement out where a stream is not a terminal.
out = Console()
err = Console(stderr=True)


def progress() -> Progress:
    """A progress bar with elapsed and remaining time, on standard error where that is a terminal."""
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


def write_json(path: Path | None, result: Mapping[str, Any]) -> None:
    """Write `result` to `path`, whole or not at all; do nothing without a path.

    Raises:
        UwbMitigationError: the file cannot be written.
    """
    if path is None:
        return
    partial = path.with_name(path.name + ".part")
    try:
        partial.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise UwbMitigationError(
            f"cannot write the result: {error.strerror}", where=str(path)
        ) from error
