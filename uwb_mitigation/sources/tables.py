"""Rows of CSV, Parquet, NumPy, MATLAB, HDF5 and YAML files and of ROS bags, in chunks of bounded size."""

from __future__ import annotations

import contextlib
import io
import lzma
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from uwb_mitigation.errors import (
    DamagedRecordingError,
    RecordingError,
    did_you_mean,
    not_installed,
)
from uwb_mitigation.files import read_bounded
from uwb_mitigation.sources.mapping import LIST_INDEX, Table
from uwb_mitigation.sources.messages import MessageRows

CHUNK_ROWS, CHUNK_VALUES = 100_000, 4_000_000
"""Largest number of rows, and of values in columns, of a chunk."""

MAX_FILE_BYTES, MAX_ARRAY_BYTES = 64 << 30, 4 << 30
"""Largest size of a file that is read in chunks, and of one that is loaded."""

MAX_YAML_BYTES = 1 << 20
LOG_TIME = "@stamp"
"""Column with the time at which a message was recorded, ns."""

TOPIC = "@topic"
"""Column with the topic of a message."""

_SUFFIXES = {
    ".csv": "csv", ".txt": "csv", ".tsv": "csv", ".parquet": "parquet", ".npy": "numpy", ".npz": "numpy",
    ".mat": "matlab", ".h5": "hdf5", ".hdf5": "hdf5", ".bag": "messages", ".db3": "messages", ".mcap": "messages",
    ".yaml": "yaml", ".yml": "yaml",
}  # fmt: skip
_SERIES = re.compile(r"(.*)\{(\d+)\.\.(\d+)\}")


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


def _chunk(columns: Mapping[str, Any], count: int, path: Path, first: int) -> Chunk:
    return Chunk(columns, count, path, np.arange(first, first + count))


def series(column: str) -> list[str]:
    """Return the columns of `CIR{0..1015}`; another name is returned alone."""
    match = _SERIES.fullmatch(column)
    return [f"{match[1]}{n}" for n in range(int(match[2]), int(match[3]) + 1)] if match else [column]


def find_files(table: Table, root: Path, ranges: Path | None = None) -> list[Path]:
    """Return the files of a table below a folder, or the file `root` itself, in the order of their names.

    Args:
        table: description of the files.
        root: the folder, or the only file.
        ranges: the file of the ranges, if the table contains other values; a pattern in `files` is searched in its path.

    Raises:
        RecordingError: no file matches.
    """
    if root.is_file() or (root / "metadata.yaml").is_file():
        return [root]
    pattern = table.files
    if isinstance(pattern, dict):
        absolute = (ranges or root).resolve().as_posix()
        pattern = next((glob for rule, glob in pattern.items() if re.search(rule, absolute)), "")
    try:
        found = sorted(path for path in root.glob(pattern) if path.is_file()) if pattern else []
    except (ValueError, NotImplementedError, OSError) as error:
        raise RecordingError(
            f"files = {pattern!r}: {error}", where=str(root), valid="a relative glob"
        ) from error
    if not found:
        what = "no such file or folder" if not root.exists() else f"no file {pattern!r}"
        raise RecordingError(what, where=str(root), valid="the folder that contains the files of the mapping")
    return found


def read_chunks(
    table: Table, path: Path, columns: Sequence[str], optional: Sequence[str] = ()
) -> Iterator[Chunk]:
    """Yield the rows of a file, only the given columns.

    Args:
        table: format of the file.
        path: the file.
        columns: names of the columns; all must exist, except those in `optional`.
        optional: columns that are left out if they are missing.

    Raises:
        RecordingError: the file cannot be read, or a column is missing; the message names similar columns.
        DamagedRecordingError: the file is truncated, after yielding the rows before.
    """
    kind = table.format or _SUFFIXES.get(
        Path(path.name.removesuffix(".xz").removesuffix(".gz")).suffix.lower(), ""
    )
    if path.is_dir():
        kind = "messages"
    readers = {
        "csv": _csv, "parquet": _parquet, "numpy": _loaded, "matlab": _loaded, "hdf5": _hdf5, "messages": _messages,
        "yaml": _loaded,
    }  # fmt: skip
    if kind not in readers:
        raise RecordingError("unknown format", where=str(path), valid=f"format: {', '.join(readers)}")
    if path.is_file() and path.stat().st_size > MAX_FILE_BYTES:
        raise RecordingError(f"more than {MAX_FILE_BYTES >> 30} GiB", where=str(path))
    try:
        yield from readers[kind](table, path, columns, optional)
    except UNREADABLE as error:
        raise RecordingError(f"cannot be read: {error!s:.200}", where=str(path)) from error


UNREADABLE = (OSError, ValueError, TypeError, KeyError, EOFError, OverflowError, NotImplementedError)


def _chosen(known: Sequence[str], columns: Sequence[str], optional: Sequence[str], path: Path) -> list[str]:
    """Return the columns that exist; raise RecordingError if a required one is missing."""
    for name in columns:
        if name not in known and name not in optional:
            valid = f"columns: {', '.join(known[:40])}"
            if len(known) == 1 and (other := next((mark for mark in ";\t|," if mark in known[0]), "")):
                valid = f"there is one column {known[0]!r:.60}; set separator: {other!r}"
            suggestion = did_you_mean(name, known)
            raise RecordingError(f"no column {name}", where=str(path), valid=valid, suggestion=suggestion)
    return [name for name in columns if name in known]


def _csv(table: Table, path: Path, columns: Sequence[str], optional: Sequence[str]) -> Iterator[Chunk]:
    import pandas as pd

    options: dict[str, Any] = {
        "sep": table.separator, "decimal": table.decimal, "encoding": "utf-8-sig", "skipinitialspace": True,
        "engine": "c" if len(table.separator) == 1 or table.separator == r"\s+" else "python",
    }  # fmt: skip
    if table.columns:
        options |= {"names": table.columns, "header": None, "index_col": False}
    first = 0
    try:
        with _text(path) as stream:
            known = table.columns or [str(name) for name in pd.read_csv(stream, nrows=0, **options).columns]
        chosen = _chosen(known, columns, optional, path)
        rows = max(1, min(CHUNK_ROWS, CHUNK_VALUES // max(len(chosen), 1)))
        with _text(path) as stream:
            # Unused columns cost most of the time of a file with CIRs.
            for frame in pd.read_csv(stream, usecols=chosen, chunksize=rows, **options):
                yield _chunk({name: frame[name].to_numpy() for name in chosen}, len(frame), path, first)
                first += len(frame)
    except pd.errors.EmptyDataError as error:
        raise RecordingError("the file is empty", where=str(path)) from error
    except (EOFError, lzma.LZMAError) as error:
        raise DamagedRecordingError(
            f"truncated or corrupt: {error}", where=f"{path}: after row {first}"
        ) from error


@contextlib.contextmanager
def _text(path: Path) -> Iterator[Any]:
    import gzip

    openers: dict[str, Any] = {".xz": lzma.open, ".gz": gzip.open}
    with openers.get(path.suffix, open)(path, "rb") as stream:
        yield _Limited(stream, path)


class _Limited(io.RawIOBase):
    """Reads at most `MAX_FILE_BYTES` after decompression."""

    def __init__(self, stream: Any, path: Path) -> None:
        self._stream, self._path, self._left = stream, path, MAX_FILE_BYTES

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        data: bytes = self._stream.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise RecordingError(f"more than {MAX_FILE_BYTES >> 30} GiB", where=str(self._path))
        return data

    def readinto(self, buffer: Any) -> int:
        data = self.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)


def _parquet(table: Table, path: Path, columns: Sequence[str], optional: Sequence[str]) -> Iterator[Chunk]:
    try:
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise not_installed("pyarrow") from error
    file, first = parquet.ParquetFile(path), 0
    chosen = _chosen(file.schema_arrow.names, columns, optional, path)
    for batch in file.iter_batches(batch_size=CHUNK_ROWS // 10, columns=chosen):
        values = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in chosen}
        yield _chunk(values, batch.num_rows, path, first)
        first += batch.num_rows


def _loaded(table: Table, path: Path, columns: Sequence[str], optional: Sequence[str]) -> Iterator[Chunk]:
    """Read a NumPy, MATLAB or YAML file."""
    if path.stat().st_size > MAX_ARRAY_BYTES:
        raise RecordingError(
            f"more than {MAX_ARRAY_BYTES >> 30} GiB", where=str(path), valid="Parquet or HDF5"
        )
    arrays: Any
    if path.suffix in (".yaml", ".yml"):
        arrays = _yaml(table, path)
    elif path.suffix in (".npy", ".npz"):
        loaded = np.load(path, allow_pickle=False, mmap_mode="r" if path.suffix == ".npy" else None)
        arrays = loaded if isinstance(loaded, np.ndarray) else {name: loaded[name] for name in loaded.files}
    else:
        from scipy.io import loadmat

        try:
            arrays = loadmat(path, simplify_cells=True)
        except NotImplementedError:
            # Version 7.3 is HDF5.
            yield from _hdf5(table, path, columns, optional)
            return
    if isinstance(arrays, dict) and table.group and path.suffix not in (".yaml", ".yml"):
        if table.group not in arrays:
            raise RecordingError(
                f"no variable {table.group}", where=str(path), valid=", ".join(map(str, arrays))
            )
        arrays = arrays[table.group]
    yield from _slices(_as_columns(arrays, table, path), columns, optional, path)


def _hdf5(table: Table, path: Path, columns: Sequence[str], optional: Sequence[str]) -> Iterator[Chunk]:
    try:
        import h5py
    except ImportError as error:
        raise not_installed("h5py") from error
    with h5py.File(path, "r") as file:
        found = file[table.group] if table.group else file
        if isinstance(found, h5py.Group):
            arrays: Any = {name: item for name, item in found.items() if isinstance(item, h5py.Dataset)}
            if path.suffix == ".mat":
                # MATLAB writes the transposed array.
                arrays = {name: np.squeeze(item[()].T) for name, item in arrays.items()}
        else:
            arrays = found
        yield from _slices(_as_columns(arrays, table, path), columns, optional, path)


def _as_columns(arrays: Any, table: Table, path: Path) -> dict[str, Any]:
    """Return {name: array with one entry a row}: the fields of a structure, or the columns of a matrix."""
    if isinstance(arrays, Mapping):
        return {str(name): value for name, value in arrays.items() if not str(name).startswith("__")}
    if isinstance(arrays, list) and arrays and isinstance(arrays[0], dict):
        return {name: np.array([row[name] for row in arrays]) for name in arrays[0]}
    names = getattr(arrays.dtype, "names", None) if hasattr(arrays, "dtype") else None
    if names:
        return {name: arrays[name] for name in names}
    if table.columns and len(arrays.shape) == 2 and arrays.shape[1] == len(table.columns):
        return {name: arrays[:, column] for column, name in enumerate(table.columns)}
    if not table.columns and len(arrays.shape) > 1:
        return {"": arrays}
    raise RecordingError(
        f"an array of shape {arrays.shape}", where=str(path), valid="`columns` names its columns"
    )


def _slices(
    arrays: dict[str, Any], columns: Sequence[str], optional: Sequence[str], path: Path
) -> Iterator[Chunk]:
    chosen = _chosen(list(arrays), columns, optional, path)
    whole = {
        name: np.atleast_1d(arrays[name]) if np.ndim(arrays[name]) == 0 else arrays[name] for name in chosen
    }
    lengths = {name: len(value) for name, value in whole.items()}
    count = max(lengths.values(), default=0)
    if len(set(lengths.values())) > 1:
        raise RecordingError("columns of different length", where=str(path), valid=str(lengths))
    width = max([int(np.prod(value.shape[1:])) for value in whole.values()], default=1)
    rows = max(1, min(CHUNK_ROWS, CHUNK_VALUES // width))
    for first in range(0, count, rows):
        part = {name: np.asarray(value[first : first + rows]) for name, value in whole.items()}
        yield _chunk(part, min(rows, count - first), path, first)


def _yaml(table: Table, path: Path) -> dict[str, NDArray[Any]]:
    """Return the entries of a YAML mapping or list as rows: `key`, and nested names joined with dots."""
    document = yaml.safe_load(read_bounded(path, MAX_YAML_BYTES, RecordingError))
    if table.group:
        document = document[table.group]
    entries = document.items() if isinstance(document, dict) else enumerate(document)
    rows = [{"key": str(key), **dict(_flat(value, ""))} for key, value in entries]
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


def _messages(table: Table, path: Path, columns: Sequence[str], optional: Sequence[str]) -> Iterator[Chunk]:
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    reader = MessageRows(table, [name for name in columns if not name.startswith("@")], optional)
    store = get_typestore(Stores.ROS2_JAZZY)
    try:
        for name, text in table.definitions.items():
            store.register(get_types_from_msg(text, name))
        with AnyReader([path], default_typestore=store) as bag:
            topics = {connection.topic: connection.msgtype for connection in bag.connections}
            if missing := [topic for topic in table.topics if topic not in topics]:
                known = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())[:40])
                raise RecordingError(f"no topic {missing[0]}", where=str(path), valid=f"the bag has: {known}")
            chosen = [each for each in bag.connections if each.topic in table.topics]
            rows: dict[str, list[Any]] = {}
            first = 0
            for number, (connection, stamp_ns, data) in enumerate(bag.messages(chosen)):
                try:
                    found = reader.rows(bag.deserialize(data, connection.msgtype))
                except RecordingError as error:
                    raise RecordingError(
                        error.what, where=f"{path}: {connection.topic}", valid=error.valid
                    ) from error
                count = len(found[LIST_INDEX])
                found |= {LOG_TIME: [stamp_ns] * count, TOPIC: [connection.topic] * count}
                for name, values in found.items():
                    rows.setdefault(name, []).extend(values)
                if number % 1000 == 999:
                    yield _message_chunk(rows, path, first)
                    first, rows = first + len(rows[LIST_INDEX]), {}
            if rows:
                yield _message_chunk(rows, path, first)
    except (AnyReaderError, SerdeError, TypesysError) as error:
        raise RecordingError(f"cannot be read: {error!s:.200}", where=str(path)) from error


def _message_chunk(rows: dict[str, list[Any]], path: Path, first: int) -> Chunk:
    return _chunk(rows, len(rows[LIST_INDEX]), path, first)
