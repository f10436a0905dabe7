"""What every sub-command shares: where tables, progress and JSON results go."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uwb_mitigation.errors import UwbMitigationError

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

    A link is followed, and a device or pipe written to rather than replaced.

    Raises:
        UwbMitigationError: the file cannot be written.
    """
    if path is None:
        return
    text = json.dumps(result, indent=2, allow_nan=False) + "\n"
    partial: Path | None = None
    try:
        target = path.resolve()
        if target.exists() and not target.is_file():
            target.write_text(text, encoding="utf-8")
            return
        partial = target.with_name(target.name + ".part")
        partial.write_text(text, encoding="utf-8")
        partial.replace(target)
    except (OSError, RuntimeError, ValueError) as error:
        if partial is not None:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
        reason = getattr(error, "strerror", None) or error
        raise UwbMitigationError(f"cannot write the result: {reason}", where=str(path)) from error


def _check_json_target(path: Path | None) -> Path | None:
    """Refuse a place that cannot hold the result before the work begins, not after."""
    if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise typer.BadParameter(f"{path} is a folder, or lies in one that is not there")
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
