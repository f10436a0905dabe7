"""Rows of CSV, Parquet, NumPy, MATLAB, HDF5 and YAML files and of ROS bags, in chunks of bounded size."""

from __future__ import annotations

import contextlib
import lzma
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from uwb_mitigation.errors import (
    DamagedRecordingError,
    RecordingError,
    UwbMitigationError,
    did_you_mean,
    not_installed,
)
from uwb_mitigation.files import read_bounded
from uwb_mitigation.recordings.mapping.mapping import LIST_INDEX, TableFormat
from uwb_mitigation.recordings.mapping.messages import MessageRows

CHUNK_ROWS, CHUNK_VALUES = 100_000, 4_000_000
"""Largest number of rows, and of values in columns, of a chunk."""

MAX_ARRAY_BYTES = 4 << 30
"""Largest size of a file that is loaded."""

MAX_YAML_BYTES, MAX_YAML_VALUES = 1 << 20, 1000
"""Largest size of a YAML file, and largest number of values of an entry."""

LOG_TIME = "@stamp"
"""Column with the time at which a message was recorded, ns."""

TOPIC = "@topic"
"""Column with the topic of a message."""

_SUFFIXES = {
    ".csv": "csv", ".txt": "csv", ".tsv": "csv", ".parquet": "parquet", ".npy": "numpy", ".npz": "numpy",
    ".mat": "matlab", ".h5": "hdf5", ".hdf5": "hdf5", ".bag": "messages", ".db3": "messages", ".mcap": "messages",
    ".yaml": "yaml", ".yml": "yaml",
}  # fmt: skip
UNREADABLE = (OSError, ValueError, TypeError, KeyError, EOFError, OverflowError, NotImplementedError)
"""Errors of values that do not have the expected form."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Rows of one file.

    Attributes:
        columns: {name: array or list}.
        count: number of rows.
        path: the file, or the topic.
        rows: int64 (count,), numbers of the rows in the file, from 0.
        before: number of rows in the files before.
    """

    columns: Mapping[str, Any]
    count: int
    path: Path | str
    rows: NDArray[np.int64]
    before: int = 0

    def where(self, row: int) -> str:
        """Return the location of a row for errors."""
        return f"{self.path}: row {self.rows[row] + 1}"

    def take(self, kept: NDArray[np.bool_]) -> Chunk:
        """Return the chosen rows."""
        if kept.all():
            return self
        chosen = np.flatnonzero(kept).tolist()
        columns = {
            name: values[kept] if isinstance(values, np.ndarray) else [values[row] for row in chosen]
            for name, values in self.columns.items()
        }
        return Chunk(columns, len(chosen), self.path, self.rows[kept], self.before)


def _kind_of(path: Path) -> str:
    name = path.name.lower().removesuffix(".xz").removesuffix(".gz")
    return "messages" if path.is_dir() else _SUFFIXES.get(Path(name).suffix, "")


def find_files(table: TableFormat, root: Path, ranges: Path | None = None) -> list[Path]:
    """Return the files of a table below a folder, or the file `root` itself, in the order of their names.

    Args:
        table: description of the files; without `files`, all whose names show a format, except YAML.
        root: the folder, or the only file.
        ranges: the file of the ranges, if the table contains other values; a pattern in `files` is searched in its path.

    Raises:
        RecordingError: no file matches.
    """
    if root.is_file() or (ranges is None and (root / "metadata.yaml").is_file()):
        return [root]
    pattern = table.files
    try:
        if isinstance(pattern, dict):
            absolute = (ranges or root).resolve().as_posix()
            pattern = next((glob for rule, glob in pattern.items() if re.search(rule, absolute)), "")
        found = sorted(path for path in root.glob(pattern) if path.is_file()) if pattern else []
    except (ValueError, NotImplementedError, OSError, re.error) as error:
        raise RecordingError(f"files = {pattern!r}: {error}", where=str(root), valid="a glob") from error
    if pattern == "*":
        found = [path for path in found if (_kind_of(path) or table.format or "yaml") != "yaml"]
    if not found:
        what = "no such file or folder" if not root.exists() else f"no file {pattern!r}"
        raise RecordingError(what, where=str(root), valid="the folder that contains the files of the mapping")
    return found


_Rows = Iterator[tuple[dict[str, Any], int]]
_Choose = Callable[[Sequence[str]], dict[str, str]]
"""Returns {wanted column: column of the file}, from all columns of the file."""


def read_chunks(
    table: TableFormat, path: Path, columns: Mapping[str, bool], before: int = 0
) -> Iterator[Chunk]:
    """Yield the rows of a file, only the given columns and those of the rules to drop rows.

    Args:
        table: format of the file.
        path: the file.
        columns: {name: whether it is left out if it is missing}.
        before: number of rows in the files before.

    Raises:
        RecordingError: the file cannot be read, or a column is missing; the message names similar columns.
        DamagedRecordingError: the file is truncated, after yielding the rows before.
    """
    kind = ("" if path.is_dir() else table.format) or _kind_of(path)
    wanted = {**columns, **{rule.column: False for rule in table.drop}}
    first = 0
    try:
        if kind == "messages":
            rows = _messages(table, path, wanted)
        elif kind in _READERS:
            rows = _READERS[kind](table, path, partial(_choose, wanted, path))
        else:
            raise RecordingError("unknown format", where=str(path), valid=", ".join([*_READERS, "messages"]))
        for found, count in rows:
            yield Chunk(found, count, path, np.arange(first, first + count), before)
            first += count
    except (EOFError, lzma.LZMAError, zlib.error) as error:
        raise DamagedRecordingError(
            f"truncated or corrupt: {error}", where=f"{path}: after row {first}"
        ) from error
    except UwbMitigationError:
        raise
    except Exception as error:
        # For damaged files the libraries raise many other types, such as BadZipFile or ZeroDivisionError.
        raise RecordingError(f"cannot be read: {error!s:.200}", where=str(path)) from error


def _choose(columns: Mapping[str, bool], path: Path, known: Sequence[str]) -> dict[str, str]:
    """Return the columns that exist, also with other case; raise RecordingError if a required one is missing."""
    folded = {name.strip().lower(): name for name in known}
    chosen = {name: name if name in known else folded.get(name.lower(), "") for name in columns}
    for name, found in chosen.items():
        if not found and name not in known and not columns[name]:
            valid = f"columns: {', '.join(known[:40])}"
            if len(known) == 1 and (other := next((mark for mark in ";\t|," if mark in known[0]), "")):
                valid = f"there is one column {known[0]!r:.60}; set separator: {other!r}"
            suggestion = did_you_mean(name, known)
            raise RecordingError(f"no column {name}", where=str(path), valid=valid, suggestion=suggestion)
    return {name: found for name, found in chosen.items() if found in known}


def _csv(table: TableFormat, path: Path, choose: _Choose) -> _Rows:
    import pandas as pd

    options: dict[str, Any] = {
        "sep": table.separator, "decimal": table.decimal, "encoding": "utf-8-sig", "skipinitialspace": True,
        "engine": "c" if len(table.separator) == 1 or table.separator == r"\s+" else "python",
    }  # fmt: skip
    if table.columns:
        options |= {"names": table.columns, "header": None, "index_col": False}
    try:
        known = table.columns or [str(name) for name in pd.read_csv(path, nrows=0, **options).columns]
        chosen = choose(known)
        rows = max(1, min(CHUNK_ROWS, CHUNK_VALUES // max(len(chosen), 1)))
        # Unused columns cost most of the time of a file with CIRs.
        with pd.read_csv(path, usecols=list(chosen.values()), chunksize=rows, **options) as frames:
            for frame in frames:
                yield {name: frame[column].to_numpy() for name, column in chosen.items()}, len(frame)
    except pd.errors.EmptyDataError as error:
        raise RecordingError("the file is empty", where=str(path)) from error


def _parquet(table: TableFormat, path: Path, choose: _Choose) -> _Rows:
    file = _installed("pyarrow.parquet").ParquetFile(path)
    chosen = choose(file.schema_arrow.names)
    for batch in file.iter_batches(batch_size=CHUNK_ROWS // 10, columns=list(chosen.values())):
        found = {name: batch.column(column) for name, column in chosen.items()}
        yield {name: values.to_numpy(zero_copy_only=False) for name, values in found.items()}, batch.num_rows


def _arrays(table: TableFormat, path: Path, choose: _Choose) -> _Rows:
    """Read a NumPy, MATLAB, HDF5 or YAML file in slices."""
    with contextlib.ExitStack() as stack:
        arrays = _as_columns(_load(table, path, stack), table, path)
        chosen = choose([str(name) for name in arrays if not str(name).startswith("__")])
        found = {name: arrays[column] for name, column in chosen.items()}
        # Slices of large files are read later, other values are arrays of one row at least.
        found = {
            name: each if getattr(each, "ndim", 0) else np.atleast_1d(each) for name, each in found.items()
        }
        lengths = {name: len(each) for name, each in found.items()}
        if len(set(lengths.values())) > 1:
            raise RecordingError("columns of different length", where=str(path), valid=str(lengths))
        width = max([int(np.prod(each.shape[1:])) for each in found.values()], default=1)
        rows = max(1, min(CHUNK_ROWS, CHUNK_VALUES // max(width, 1)))
        count = max(lengths.values(), default=0)
        for first in range(0, count, rows):
            part = {name: np.asarray(each[first : first + rows]) for name, each in found.items()}
            yield part, min(rows, count - first)


def _load(table: TableFormat, path: Path, stack: contextlib.ExitStack) -> Any:
    """Return an array, or {name: array}: the variables of a file, or of its variable `group`."""
    kind = table.format or _kind_of(path)
    if kind != "hdf5" and path.stat().st_size > MAX_ARRAY_BYTES:
        raise RecordingError(f"more than {MAX_ARRAY_BYTES >> 30} GiB", where=str(path), valid="Parquet, HDF5")
    found: Any = None
    if kind == "yaml":
        found = yaml.safe_load(read_bounded(path, MAX_YAML_BYTES, RecordingError))
    elif kind == "numpy":
        found = np.load(path, allow_pickle=False, mmap_mode="r" if path.suffix == ".npy" else None)
    elif kind == "matlab":
        from scipy.io import loadmat

        # Version 7.3 is HDF5.
        with contextlib.suppress(NotImplementedError):
            found = loadmat(path, simplify_cells=True)
    if is_hdf5 := found is None:
        found = stack.enter_context(_installed("h5py").File(path, "r"))
    if table.group and not isinstance(found, np.ndarray):
        if table.group not in found:
            raise RecordingError(
                f"no variable {table.group}", where=str(path), valid=", ".join(map(str, found))
            )
        found = found[table.group]
    if kind == "yaml":
        return _yaml_rows(found)
    if is_hdf5 and kind == "matlab":
        # MATLAB writes the transposed array.
        if hasattr(found, "dtype"):
            return found[()].T
        return {name: np.squeeze(item[()].T) for name, item in found.items() if hasattr(item, "dtype")}
    return found


def _installed(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise not_installed(name.partition(".")[0]) from error


def _as_columns(arrays: Any, table: TableFormat, path: Path) -> Mapping[str, Any]:
    """Return {name: array with one entry a row}: the fields of a structure, or the columns of a matrix."""
    if isinstance(arrays, Mapping):
        return arrays
    if isinstance(arrays, list) and arrays and isinstance(arrays[0], dict):
        return {name: np.array([row[name] for row in arrays]) for name in arrays[0]}
    if names := getattr(getattr(arrays, "dtype", None), "names", None):
        return {name: arrays[name] for name in names}
    if table.columns and len(arrays.shape) == 2 and arrays.shape[1] == len(table.columns):
        return {name: arrays[:, column] for column, name in enumerate(table.columns)}
    if not table.columns and len(arrays.shape) > 1:
        return {"": arrays}
    raise RecordingError(
        f"an array of shape {arrays.shape}", where=str(path), valid="`columns` names its columns"
    )


def _yaml_rows(document: Any) -> dict[str, NDArray[Any]]:
    """Return the entries of a mapping or list as rows: `key`, and nested names joined with dots."""
    entries = document.items() if isinstance(document, dict) else enumerate(document)
    rows = [{"key": str(key), **dict(islice(_flat(value, ""), MAX_YAML_VALUES))} for key, value in entries]
    names = sorted(set.intersection(*map(set, rows))) if rows else []
    return {name: np.array([row[name] for row in rows], object) for name in names}


def _flat(value: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, str) and value.startswith("["):
        value = yaml.safe_load(value)
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _flat(item, f"{prefix}{name}.")
    elif isinstance(value, list):
        for number, item in enumerate(value):
            # A list of mappings is one mapping, such as `- position: ...` and `- orientation: ...`.
            yield from _flat(item, prefix if isinstance(item, dict) else f"{prefix}{number}.")
    else:
        yield prefix.rstrip("."), value


_READERS = {"csv": _csv, "parquet": _parquet} | dict.fromkeys(("numpy", "matlab", "hdf5", "yaml"), _arrays)


def _messages(table: TableFormat, path: Path, columns: Mapping[str, bool]) -> _Rows:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    reader = MessageRows(table, columns)
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in table.definitions.items():
        store.register(get_types_from_msg(text, name))
    with AnyReader([path], default_typestore=store) as bag:
        topics = {connection.topic: connection.msgtype for connection in bag.connections}
        # Without topics, the library would read all of them.
        if missing := [topic for topic in table.topics or [""] if topic not in topics]:
            known = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())[:40])
            what = f"no topic {missing[0]}" if missing[0] else "the mapping has no topics"
            raise RecordingError(what, where=str(path), valid=f"the bag has: {known}")
        messages = bag.messages([each for each in bag.connections if each.topic in table.topics])
        while batch := list(islice(messages, 1000)):
            rows: dict[str, list[Any]] = {}
            for connection, stamp_ns, data in batch:
                try:
                    found = reader.rows(bag.deserialize(data, connection.msgtype))
                except RecordingError as error:
                    where = f"{path}: {connection.topic}"
                    raise RecordingError(error.what, where=where, valid=error.valid) from error
                count = len(found[LIST_INDEX])
                found |= {LOG_TIME: [stamp_ns] * count, TOPIC: [connection.topic] * count}
                for name, values in found.items():
                    rows.setdefault(name, []).extend(values)
            yield rows, len(rows[LIST_INDEX])
