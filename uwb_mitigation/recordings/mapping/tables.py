"""Rows of files of all formats and of ROS bags, in chunks of bounded size."""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import dropwhile, islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray

from uwb_mitigation.errors import DamagedRecordingError, MissingDependencyError, RecordingError, did_you_mean
from uwb_mitigation.files import read_bounded
from uwb_mitigation.recordings.mapping.conversion import LOG_TIME, Chunk
from uwb_mitigation.recordings.mapping.mapping import FILE, LIST_INDEX, TOPIC, VARIABLE, TableFormat
from uwb_mitigation.recordings.mapping.messages import MAX_ROWS, MessageRows
from uwb_mitigation.recordings.text_blocks import OnWarning, text_blocks

CHUNK_ROWS, CHUNK_VALUES = 100_000, 4_000_000
"""Largest number of rows, and of values in columns, of a chunk."""

MAX_ARRAY_BYTES = 4 << 30
"""Largest size of a file that is loaded."""

MAX_DOCUMENT_ROWS, MAX_YAML_BYTES = 20_000_000, 1 << 20
"""Largest number of rows of a JSON or YAML document, and largest size of a YAML file."""

Rows = Iterator[tuple[dict[str, Any], NDArray[np.int64]]]
"""Columns, and the numbers of their rows in the file from 0."""

_SUFFIXES = {
    ".csv": "csv", ".txt": "csv", ".tsv": "csv", ".log": "lines", ".jsonl": "lines", ".json": "json", ".mat": "matlab",
    ".h5": "hdf5", ".hdf5": "hdf5", ".bag": "messages", ".db3": "messages", ".mcap": "messages", ".yaml": "yaml",
    ".yml": "yaml",
}  # fmt: skip


def _kind_of(path: Path) -> str:
    name = path.name.lower().removesuffix(".xz").removesuffix(".gz")
    return "messages" if path.is_dir() else _SUFFIXES.get(Path(name).suffix, "")


def find_files(table: TableFormat, root: Path, ranges: Path | None = None) -> list[Path]:
    """Return the files of a table below a folder, or the file `root` itself, in the order of their names.

    Args:
        table: description of the files; without `files`, all tables and bags.
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
        paths = sorted(path for path in root.glob(pattern) if path.is_file()) if pattern else []
    except (ValueError, NotImplementedError, OSError, re.error) as error:
        raise RecordingError(f"files = {pattern!r}: {error}", where=root, valid="a glob") from error
    if pattern == "*":
        # The folder may contain the mapping, logs and descriptions.
        kinds = {"csv", "matlab", "hdf5", "messages", table.format} - {"", "yaml"}
        kinds |= {"lines"} if table.pattern or table.text else set()
        paths = [path for path in paths if (_kind_of(path) or table.format) in kinds]
    if not paths:
        what = "no such file or folder" if not root.exists() else f"no file {pattern!r}"
        valid = "the folder that contains the files of the mapping"
        if ranges:
            valid = f"relative to the folder of the ranges, {root}"
        raise RecordingError(what, where=root, valid=valid)
    return paths


@dataclass(slots=True)
class TableFile:
    """A file of a table.

    Attributes:
        table: format of the file.
        path: the file.
        columns: {name of a needed column: whether it is left out if it is missing}.
        ids: columns that contain ids.
        file: its path in the recording.
        dropped: counts damaged rows, by reason.
        on_warning: called if the last row of a text file is cut, and not yielded; None: it is yielded.
    """

    table: TableFormat
    path: Path
    columns: Mapping[str, bool | None]
    ids: Collection[str] = ()
    file: str = ""
    dropped: Counter[str] = field(default_factory=Counter)
    on_warning: OnWarning | None = None
    _damage: DamagedRecordingError | None = field(default=None, init=False)

    def chunks(self, before: int = 0) -> Iterator[Chunk]:
        """Yield the rows, only the needed columns and those of the rules to drop rows.

        Args:
            before: number of rows in the files before.

        Raises:
            RecordingError: the file cannot be read, or a column is missing; the message names similar columns.
            DamagedRecordingError: the file is truncated, after yielding the rows before.
        """
        table, path = self.table, self.path
        kind = ("" if path.is_dir() else table.format) or _kind_of(path)
        is_log = kind != "messages" and (table.pattern or table.text)
        kind = "lines" if is_log else kind.replace("lines", "")
        if (groups := re.search(table.file_name, self.file)) is None:
            raise RecordingError(f"{self.file!r} does not match {table.file_name!r}", where=path)
        constants = {FILE: self.file, **groups.groupdict()}
        needed = {**self.columns, **{rule.column: False for rule in table.drop}}
        self.columns = {name: optional for name, optional in needed.items() if name not in constants}
        try:
            if kind in ("messages", "lines", "json", "yaml"):
                rows = self._messages(kind)
            elif kind == "csv":
                rows = iter(_CsvRows(self))
            elif kind:
                rows = self._arrays(is_matlab=kind == "matlab")
            else:
                valid = "csv, hdf5, json, matlab, messages, yaml; lines with `pattern` or `text`; save others as CSV"
                raise RecordingError(f"unknown format {path.suffix}", where=path, valid=valid)
            last = 0
            for values, numbers in rows:
                last = int(numbers.max(initial=last - 1)) + 1
                values |= {name: np.full(len(numbers), text, object) for name, text in constants.items()}
                if table.unpivot:
                    values, repeats = _unpivot(table, values, len(numbers))
                    numbers = np.repeat(numbers, repeats)
                yield Chunk(values, len(numbers), path, numbers, before)
            if self._damage:
                raise DamagedRecordingError(self._damage.what, where=f"{path}: after row {last}")
        except (RecordingError, MissingDependencyError):
            raise
        except Exception as error:
            # For damaged files the libraries raise many other types, such as BadZipFile or ZeroDivisionError.
            raise RecordingError(f"cannot be read: {error!s:.200}", where=path) from error

    def _up_to_damage(self, items: Iterable[Any]) -> Iterator[Any]:
        """Yield items; `chunks` raises the error after the rows before."""
        try:
            yield from items
        except DamagedRecordingError as error:
            self._damage = error

    def text(self, quote: str = "") -> Iterator[str]:
        """Yield the text in blocks of complete lines, up to a damage."""
        return self._up_to_damage(text_blocks(self.path, self.on_warning, quote))

    def choose(self, names: Sequence[str]) -> dict[str, str]:
        """Return {column: column of the file, also with other case}; raise RecordingError if a required one is missing."""
        table, where = self.table, str(self.path)
        folded = {name.strip().lower(): name for name in names}
        chosen = {name: name if name in names else folded.get(name.lower(), "") for name in self.columns}
        groups = [name for rule in table.unpivot.values() for name in re.compile(rule).groupindex]
        for name in (*table.unpivot, *groups, *([VARIABLE] if table.unpivot else ())):
            chosen.pop(name, None)
        for rule in table.unpivot.values():
            if not (matches := [name for name in names if re.fullmatch(rule, name)]):
                what, valid = f"no column matches unpivot {rule!r}", ", ".join(names[:40])
                raise RecordingError(what, where=where, valid=valid)
            chosen |= dict(zip(matches, matches, strict=True))
        for name, column in chosen.items():
            if not column and name not in names and not self.columns[name]:
                valid, suggestion = f"columns: {', '.join(names[:40])}", did_you_mean(name, names)
                if names and names[0][:1] in tuple("#%;"):
                    valid = f"the first line is {names[0]!r:.60}; set comment: {names[0][0]!r}, or skip: 1"
                elif len(names) == 1 and (mark := next((mark for mark in ";\t|," if mark in names[0]), "")):
                    valid = f"there is one column {names[0]!r:.60}; set separator: {mark!r}"
                raise RecordingError(f"no column {name}", where=where, valid=valid, suggestion=suggestion)
        return {name: column for name, column in chosen.items() if column in names}

    def _arrays(self, *, is_matlab: bool) -> Rows:
        """Read a MATLAB or HDF5 file in slices."""
        with contextlib.ExitStack() as stack:
            arrays = self._load(stack, is_matlab=is_matlab)
            chosen = self.choose([str(name) for name in arrays if not str(name).startswith("__")])
            # Slices of large files are read later, other values are arrays of one row at least.
            columns = {name: arrays[column] for name, column in chosen.items()}
            columns = {n: a if getattr(a, "ndim", 0) else np.atleast_1d(a) for n, a in columns.items()}
            lengths = {name: len(array) for name, array in columns.items()}
            if len(set(lengths.values())) > 1:
                raise RecordingError("columns of different length", where=self.path, valid=str(lengths))
            width = max([int(np.prod(array.shape[1:])) for array in columns.values()], default=1)
            rows = max(1, min(CHUNK_ROWS, CHUNK_VALUES // max(width, 1)))
            for first in range(0, count := max(lengths.values(), default=0), rows):
                values = {name: np.asarray(array[first : first + rows]) for name, array in columns.items()}
                yield values, np.arange(first, min(first + rows, count))

    def _load(self, stack: contextlib.ExitStack, *, is_matlab: bool) -> Mapping[str, Any]:
        """Return {name: array with one entry a row}: the variables of a file, or the fields of its variable `group`."""
        table, where, content = self.table, str(self.path), None
        if is_matlab:
            from scipy.io import loadmat

            if self.path.stat().st_size > MAX_ARRAY_BYTES:
                raise RecordingError(f"more than {MAX_ARRAY_BYTES >> 30} GiB", where=where, valid="CSV, HDF5")
            # Version 7.3 is HDF5.
            with contextlib.suppress(NotImplementedError):
                content = loadmat(self.path, simplify_cells=True)
        if is_hdf5 := content is None:
            try:
                import h5py
            except ImportError as error:
                raise MissingDependencyError("h5py is not installed", valid="pip install h5py") from error
            content = stack.enter_context(h5py.File(self.path, "r"))
        content = self._group(content)
        # MATLAB writes the transposed array.
        if is_hdf5 and is_matlab and hasattr(content, "dtype"):
            content = content[()].T
        elif is_hdf5 and is_matlab:
            content = {n: np.squeeze(item[()].T) for n, item in content.items() if hasattr(item, "dtype")}
        if isinstance(content, Mapping):
            return content
        if np.ndim(content) > 1 and not table.columns:
            return {"": content}
        # The fields of a structure, or the columns of a matrix.
        content = content if isinstance(content, list) else np.asarray(content)
        frame = pd.DataFrame(content, columns=table.columns or None)
        return {str(name): column.to_numpy() for name, column in frame.items()}

    def _group(self, content: Any) -> Any:
        if (group := self.table.group) and group not in content:
            valid = ", ".join(map(str, content))
            raise RecordingError(f"no variable {group}", where=self.path, valid=valid)
        return content[group] if group else content

    def _messages(self, kind: str) -> Rows:
        """Read the messages of a bag, the lines of a log, or the objects of a document."""
        table, path, limit = self.table, self.path, MAX_DOCUMENT_ROWS
        messages: Iterator[tuple[dict[str, Any], Any]]
        if kind == "messages":
            from uwb_mitigation.recordings.bag.foreign_messages import read_messages

            limit, bag = MAX_ROWS, self._up_to_damage(read_messages(path, table.topics))
            messages = (({TOPIC: topic, LOG_TIME: stamp_ns}, message) for topic, stamp_ns, message in bag)
        elif kind == "lines":
            messages = (({}, line) for block in self.text() for line in block.removesuffix("\n").split("\n"))
        elif kind == "json":
            messages = iter([({}, json.loads(read_bounded(path, MAX_ARRAY_BYTES, RecordingError)))])
        else:
            document = yaml.safe_load(read_bounded(path, MAX_YAML_BYTES, RecordingError))
            messages = iter([({}, _entries(self._group(document)))])
            table = table.model_copy(update={"group": "[]"})
        reader, first, reason = MessageRows(table, self.columns), 0, ""
        while batch := list(islice(messages, 1000)):
            rows = defaultdict[str, list[Any]](list)
            for constants, message in batch:
                values, problem = dict[str, list[Any]](), ""
                try:
                    values = reader.rows(message, limit)
                except RecordingError as error:
                    where, problem = ": ".join([str(path), *constants.values()][:2]), f" ({error.what})"
                    if kind != "lines":
                        raise RecordingError(error.what, where=where, valid=error.valid) from error
                repeats = len(values.get(LIST_INDEX, ()))
                if kind == "lines" and not repeats and message.strip():
                    reason = reason or f"lines without a range, such as {message.strip()!r:.60}{problem}"
                    self.dropped[reason] += 1
                values |= {name: [cell] * repeats for name, cell in constants.items()}
                for name, cells in values.items():
                    rows[name] += cells
            yield rows, np.arange(first, first := first + len(rows[LIST_INDEX]))


class _CsvRows:
    """The rows of a CSV file, read in blocks of complete lines."""

    def __init__(self, file: TableFile) -> None:
        self._file, self._table = file, file.table
        separator = file.table.separator
        # The fields are separated by one mark, by white space, or by an expression that is replaced by tabs.
        self._regex = separator if len(separator) > 1 and separator != r"\s+" else ""
        self._mark = "\t" if self._regex else " " if separator == r"\s+" else separator
        self._chosen, self._header, self._width = dict[str, str](), "", 0
        self._options: dict[str, Any] = {
            "sep": r"\s+" if self._mark == " " else self._mark, "decimal": self._table.decimal, "index_col": False,
            "comment": self._table.comment or None, "skipinitialspace": True,
        }  # fmt: skip

    def __iter__(self) -> Rows:
        first, previous = 0, None
        for block in self._file.text('"'):
            lines = block.split("\n")
            if self._regex:
                lines = [re.sub(self._regex, self._mark, line.strip()) for line in lines]
            if not self._chosen:
                lines = self._after_header(lines[self._table.skip :])
            if previous:
                yield previous
            columns, numbers = self._parsed(lines)
            previous, first = (columns, first + numbers), first + int(numbers.max(initial=-1)) + 1
        if previous and self._file.on_warning:
            widths = [self._count(line) for line in lines if line.strip()][-2:]
            if widths[-1:] < [self._width] and widths[-1:] < widths[:1]:
                self._file.on_warning(
                    f"{self._file.path.name}: the last row is short; the last row is not used"
                )
                previous = {name: values[:-1] for name, values in columns.items()}, previous[1][:-1]
        if previous:
            yield previous

    def _count(self, line: str) -> int:
        return len(line.split()) if self._mark == " " else line.count(self._mark) + 1

    def _after_header(self, lines: list[str]) -> list[str]:
        """Choose the columns, and return the lines after the header."""
        names, comment = [*self._table.columns], self._table.comment or "\n"
        if not names:
            lines = list(dropwhile(lambda line: not line.strip() or line.startswith(comment), lines))
            self._header, lines = lines[0] if lines else "", lines[1:]
            header = pd.read_csv(io.StringIO(self._header), nrows=0, **self._options)
            names = [str(name) for name in header.columns]
            self._width = len(names)
        self._chosen = self._file.choose(names)
        originals = [name.strip('" ') for name in self._header.split(self._mark)]
        if equal := [name for name in self._chosen.values() if originals.count(name) > 1]:
            what, valid = f"several columns have the name {equal[0]}", f"columns: [{', '.join(names[:40])}]"
            raise RecordingError(what, where=self._file.path, valid=f"{valid} and skip: 1")
        if self._table.columns:
            # Pandas refuses columns that no row of a block has.
            self._header = self._mark.join("x" * len(names))
            self._options |= {"names": names, "header": 0}
        self._options["usecols"] = [*self._chosen.values()]
        return lines

    def _parsed(self, lines: list[str]) -> tuple[dict[str, Any], NDArray[np.int64]]:
        """Return the columns, and the numbers of their rows in the block."""
        # A separator may follow the last field.
        long = {line for line in lines if self._width and line.count(self._mark) >= self._width}
        long = {line for line in long if self._count(line.rstrip(f"{self._mark} ")) > self._width}
        numbers = None
        # A quoted text may contain separators and line breaks.
        if (long or (self._width and self._header in lines)) and not any('"' in line for line in lines):
            comment = self._table.comment or "\n"
            lines = [line for line in lines if line.strip() and not line.startswith(comment)]
            numbers = np.flatnonzero([line not in long and line != self._header for line in lines])
            reason = "a repeated header, or more fields than the header (columns: all names; skip: 1)"
            self._file.dropped[reason] += len(lines) - len(numbers)
            lines = [lines[number] for number in numbers.tolist()]
        data = "\n".join([self._header, *lines]).encode()
        frame = pd.read_csv(io.BytesIO(data), **self._options)
        # `1e2` may be a hexadecimal id, and float64 merges large ids.
        ids = {column for name, column in self._chosen.items() if name in self._file.ids}
        if texts := {column: str for column in ids if frame[column].dtype.kind == "f"}:
            frame = pd.read_csv(io.BytesIO(data), **self._options, dtype=texts)
            frame[[*texts]] = frame[[*texts]].replace(r"\.0+$", "", regex=True)
        arrays = {name: frame[column].to_numpy() for name, column in self._chosen.items()}
        return arrays, np.arange(len(frame)) if numbers is None else numbers


def _entries(document: Any) -> list[dict[str, Any]]:
    """Return the entries of a YAML mapping or list as objects: `key`, and the fields or elements of its value."""
    entries = []
    for key, value in document.items() if isinstance(document, dict) else enumerate(document):
        # Such as a text `[1.0, 2.0]`, or a list `- position: ...` and `- orientation: ...`.
        value = yaml.safe_load(value) if isinstance(value, str) and value.startswith("[") else value
        entry = {"key": str(key)}
        for number, item in enumerate(value if isinstance(value, list) else [value]):
            entry |= item if isinstance(item, dict) else {str(number): item}
        entries.append(entry)
    return entries


def _unpivot(table: TableFormat, columns: Mapping[str, Any], count: int) -> tuple[dict[str, Any], int]:
    """Return one row for each column that matches, as `pandas.melt`, and the number of rows for each row.

    The columns of a matrix are numbered from 1.
    """
    melted: dict[str, dict[str, Any]] = {}
    rows = dict(columns)
    for target, rule in table.unpivot.items():
        for name in columns:
            if match := re.fullmatch(rule, name):
                groups, values = match.groupdict(), rows.pop(name)
                keys = ["_".join(groups.values()) if groups else match[1] if match.re.groups == 1 else name]
                if is_matrix := np.ndim(values) == 2:
                    keys = [str(number + 1) for number in range(values.shape[1])]
                for key, column in zip(keys, values.T if is_matrix else [values], strict=True):
                    cells = {group: np.full(count, text, object) for group, text in groups.items()}
                    melted.setdefault(key, cells)[target] = column
    rows = {name: np.repeat(values, len(melted), axis=0) for name, values in rows.items()}
    unknown = np.full(count, np.nan)
    for target in dict.fromkeys(name for cells in melted.values() for name in cells):
        rows[target] = np.stack([cells.get(target, unknown) for cells in melted.values()], axis=1).reshape(-1)
    return rows | {VARIABLE: np.tile(np.array(list(melted), object), count)}, len(melted)
