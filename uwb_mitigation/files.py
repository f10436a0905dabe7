"""Reading files up to a maximum size, and atomic writing; the version that files state."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from uwb_mitigation.errors import UwbMitigationError

VERSION = "0.1.0"
"""Version of this package; files that it writes state it."""


@contextlib.contextmanager
def os_errors(kind: type[UwbMitigationError], what: str, where: object, valid: str = "") -> Iterator[None]:
    """Raise an error of type `kind` for an OSError of the block: what happened, and the reason."""
    try:
        yield
    except OSError as error:
        raise kind(f"{what}: {error.strerror}", where=where, valid=valid) from error


def read_bounded(path: Path, limit: int, error: type[UwbMitigationError], valid: str = "") -> bytes:
    """Return the content of a file of at most `limit` bytes.

    Args:
        path: the file.
        limit: maximum size, bytes.
        error: type of the error to raise.
        valid: text for `valid` of the error.

    Raises:
        UwbMitigationError: of the type `error`: the file is missing, unreadable, empty or larger.
    """
    with os_errors(error, "cannot be read", path, valid):
        if not path.is_file():
            raise error("no such file", where=path, valid=valid)
        with path.open("rb") as stream:
            data = stream.read(limit + 1)
    if not data:
        raise error("the file is empty", where=path, valid=valid)
    if len(data) > limit:
        raise error(f"more than {limit} bytes", where=path, valid=valid)
    return data


def partial_path(path: Path) -> Path:
    """Return the temporary path for the content of `path` until it is complete."""
    return path.with_name(path.name + ".part")


def write_atomically(
    path: Path, content: str | bytes, error: type[UwbMitigationError] = UwbMitigationError
) -> None:
    """Write a file atomically: on any error, or if another process writes it too, no partial file remains.

    Links are followed. Devices and pipes are written to instead of being replaced.

    Raises:
        UwbMitigationError: of the type `error`: the file cannot be written.
    """
    write_all_atomically({path: content}, error)


def write_all_atomically(
    contents: Mapping[Path, str | bytes], error: type[UwbMitigationError] = UwbMitigationError
) -> None:
    """Write files that belong together like `write_atomically`; none is replaced before all are written.

    Raises:
        UwbMitigationError: of the type `error`: one of them cannot be written, and all are unchanged; or one cannot be
            replaced (another user's file in a folder like /tmp), and only those before it are new.
    """
    partials: dict[Path, Path] = {}
    path = Path()
    try:
        for path, content in contents.items():
            data = content.encode() if isinstance(content, str) else content
            target = path.resolve()
            if target.exists() and not target.is_file():
                target.write_bytes(data)
                continue
            partials[target] = partial_path(target.with_name(f"{target.name}.{os.getpid()}"))
            partials[target].write_bytes(data)
        for path, partial in partials.items():
            partial.replace(path)
    except (OSError, RuntimeError) as problem:  # a cycle of links is a RuntimeError before Python 3.13
        reason = getattr(problem, "strerror", None) or problem
        raise error(f"cannot be written: {reason}", where=path) from problem
    finally:
        for partial in partials.values():
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
