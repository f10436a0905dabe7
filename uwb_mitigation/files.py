"""Files that are read up to a ceiling, and files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path

from uwb_mitigation.errors import UwbMitigationError


def read_bounded(path: Path, limit: int, error: type[UwbMitigationError], valid: str = "") -> bytes:
    """The content of a file of at most `limit` bytes.

    Args:
        error: what to raise.
        valid: what to say that would be valid.

    Raises:
        UwbMitigationError: as `error`: the file is absent, cannot be read, is empty or is larger.
    """
    try:
        if not path.is_file():
            raise error("no such file", where=str(path), valid=valid)
        with path.open("rb") as stream:
            data = stream.read(limit + 1)
    except OSError as problem:
        raise error(f"cannot be read: {problem.strerror}", where=str(path), valid=valid) from problem
    if not data:
        raise error("the file is empty", where=str(path), valid=valid)
    if len(data) > limit:
        raise error(f"more than {limit} bytes", where=str(path), valid=valid)
    return data


def partial_of(path: Path) -> Path:
    """Where the content of `path` is until it is whole."""
    return path.with_name(path.name + ".part")


def write_whole(
    path: Path, content: str | bytes, error: type[UwbMitigationError] = UwbMitigationError
) -> None:
    """Write a file, or leave what was there: whatever fails, and whichever process writes it too.

    A link is followed, and a device or pipe written to rather than replaced.

    Raises:
        UwbMitigationError: as `error`: the file cannot be written.
    """
    write_together({path: content}, error)


def write_together(
    contents: Mapping[Path, str | bytes], error: type[UwbMitigationError] = UwbMitigationError
) -> None:
    """Write files that belong together, each as `write_whole` does; none takes its place before all are written.

    Raises:
        UwbMitigationError: as `error`: one of them cannot be written, and all are as they were; or it was written whole
            but may not take its place (another user's file in a folder like /tmp), and only those before it are new.
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
            partials[target] = partial_of(target.with_name(f"{target.name}.{os.getpid()}"))
            partials[target].write_bytes(data)
        for path, partial in partials.items():
            partial.replace(path)
    except (OSError, RuntimeError) as problem:  # a circle of links is a RuntimeError before Python 3.13
        reason = getattr(problem, "strerror", None) or problem
        raise error(f"cannot be written: {reason}", where=str(path)) from problem
    finally:
        for partial in partials.values():
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
