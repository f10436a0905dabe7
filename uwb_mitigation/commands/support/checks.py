"""Checks of arguments before a command starts its work."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from uwb_mitigation.errors import ParameterError

ScalingName = Literal["preamble", "max"]
"""Values of `Scaling`, which takes long to import."""

OffsetsOption = Annotated[
    str | None,
    typer.Option(
        "--offsets",
        metavar="M|FILE",
        help="Range offsets of the radios due to antenna delays: metres, or a file written by `uwb-mitigation offset`.",
    ),
]


def output_option(metavar: str, description: str) -> Any:
    """Return the option `-o` for what a command writes."""
    return typer.Option("-o", "--output", metavar=metavar, help=description)


def check_replaceable(files: Iterable[Path], force: bool) -> None:
    """Raise a ParameterError if one of the files exists, unless `force` is set."""
    for file in files:
        if file.exists() and not force:
            raise ParameterError("exists already", where=str(file), valid="--force replaces it")


def check_output(output: Path, force: bool = True, suffix: str = ".onnx") -> None:
    """Check that a file with a suffix can be written to a path, with `force` also over an existing file.

    Raises:
        ParameterError: it cannot.
    """
    if (suffix and output.suffix != suffix) or output.is_dir() or not output.resolve().parent.is_dir():
        valid = f"a file {suffix} in an existing folder" if suffix else "a file in an existing folder"
        raise ParameterError("cannot be written", where=str(output), valid=valid)
    check_replaceable([output], force)
