"""Open a recording by its path; the kind of source is detected."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.files import os_errors
from uwb_mitigation.types.source import Source

if TYPE_CHECKING:
    from uwb_mitigation.recordings.mapping.mapped import MappedRecording

ACCEPTED = (
    "an MCAP bag (.mcap, or a folder with metadata.yaml), "
    "DecaRanging logs (.log, .log.xz, or a folder of them), or a folder of a Hanyang run; `data import` "
    "converts DeepUWB's pickle and, with --map, other formats to a bag"
)

_HANYANG_ANCHOR = re.compile(r"A\d{1,4}\.csv(\.xz)?")
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_XZ_MAGIC = b"\xfd7zXZ\x00"
_SQLITE_MAGIC = b"SQLite format 3\x00"


def open_recording(path: Path | str, *, mapping: str = "", cir: Literal["final", "poll"] = "final") -> Source:
    """Return the source for `path`, selected by its content; only logs are recognised by their suffix.

    Args:
        path: a file or folder.
        mapping: mapping file for other formats, or the name of a shipped mapping; empty: a format that is recognised.
        cir: which frame's CIR of a DecaRanging exchange to use: `final` or `poll`.

    Returns:
        An iterable of `Record`, which may be iterated several times. Its attribute `skipped` counts invalid data.

    Raises:
        RecordingError: `path` does not exist, or no source can read it. Iterating raises it, too, after everything before
            the damage.
        ParameterError: the mapping is invalid.
    """
    path = Path(path)
    if mapping:
        return open_mapped(path, mapping)
    with os_errors(RecordingError, "cannot be opened", path, ACCEPTED):
        is_bag = _is_bag(path)
    if is_bag:
        recording: Source = _reader("mcap").McapRecording(path)
        return recording
    if path.is_dir():
        names = {entry.name for entry in path.iterdir()}
        if names & {"trajectory.csv", "trajectory.csv.xz"} and any(map(_HANYANG_ANCHOR.fullmatch, names)):
            return open_mapped(path, "hanyang")
    if path.is_dir() or path.name.endswith((".log", ".log.xz")) or _looks_like_log(path):
        reader = _reader("decaranging")
        log: Source = reader.open_decaranging(path, cir=reader.CirFrame(cir))
        return log
    raise RecordingError("unknown kind of recording", where=path, valid=ACCEPTED)


def open_mapped(path: Path, mapping: str) -> MappedRecording:
    """Return the source for `path` with a mapping file, or with a shipped mapping by its name.

    Raises:
        ParameterError: The mapping is invalid.
        RecordingError: The recording cannot be read with it.
    """
    table = _reader("mapping.mapping").load_mapping(mapping)
    try:
        recording: MappedRecording = _reader("mapping.mapped").MappedRecording(table, path)
    except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError) as error:
        what = f"the values cannot be converted: {type(error).__name__}: {error!s:.200}"
        raise RecordingError(what, where=path, valid=f"values as mapping {mapping} describes") from error
    return recording


def _reader(module: str) -> Any:
    """Return a module of `recordings`; it is imported here, because each format needs other packages."""
    return importlib.import_module(f"uwb_mitigation.recordings.{module}")


def _is_bag(path: Path) -> bool:
    if path.is_dir():
        # A folder of such a name may be a bag itself, but does not make its parent folder a bag.
        names = [entry.name for entry in path.iterdir() if entry.is_file()]
        return any(name == "metadata.yaml" or name.endswith((".mcap", ".db3")) for name in names)
    if path.suffix in (".mcap", ".db3"):
        return True
    return _head(path).startswith((_MCAP_MAGIC, _SQLITE_MAGIC))


def _looks_like_log(path: Path) -> bool:
    head = _head(path)
    return head.startswith(_XZ_MAGIC) or b"DecaRanging" in head


def _head(path: Path) -> bytes:
    if not path.is_file():
        path.stat()
        raise RecordingError("neither a file nor a folder", where=path, valid=ACCEPTED)
    with path.open("rb") as stream:
        return stream.read(4096)
