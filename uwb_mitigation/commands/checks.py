"""What commands check before the work, not after it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from uwb_mitigation.errors import MissingDependencyError, ParameterError


@contextmanager
def needs_torch() -> Iterator[None]:
    """Around imports: say which command installs torch where it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise MissingDependencyError("training needs torch", valid="run `make setup-training`") from error


def check_output(output: Path) -> None:
    """Refuse a place that no bundle can be written to.

    Raises:
        ParameterError: it is one.
    """
    if output.suffix != ".onnx" or output.is_dir() or not output.resolve().parent.is_dir():
        raise ParameterError(
            "not a place for a bundle", where=str(output), valid="a file .onnx in a folder that exists"
        )
