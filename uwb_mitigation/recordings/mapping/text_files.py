"""Text files in any encoding, packed or damaged, in blocks of complete lines; and the CSV tables in them."""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import lzma
import re
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.recordings.mapping.mapping import TableFormat

BLOCK_CHARS, MAX_ROW_CHARS = 1 << 22, 1 << 26
"""Size of a block, and largest size of a row."""

MAX_EXPANSION, MIN_BOMB_CHARS = 500, 1 << 28
"""A packed file that expands to a larger multiple and to more characters is not read."""

_DAMAGES = (EOFError, lzma.LZMAError, zlib.error, gzip.BadGzipFile)
_OPENERS: dict[str, Any] = {".xz": lzma.open, ".gz": gzip.open}
# CIRs in one field are longer than the default.
csv.field_size_limit(MAX_ROW_CHARS)

OnWarning = Callable[[str], None]
Rows = Iterator[tuple[dict[str, Any], NDArray[np.int64]]]
"""Columns, and the numbers of their rows in the file from 0."""

ChooseColumns = Callable[[Sequence[str]], dict[str, str]]
"""Returns {column: column of the file}, from all columns of the file."""


class _UpToDamage(io.RawIOBase):
    """A stream that ends where its packed file is damaged; `damage` is then the reason."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.damage: Exception | None = None

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        try:
            # `read` loses what precedes the damage.
            data = self._stream.read1(len(buffer))  # type: ignore[attr-defined]
        except _DAMAGES as error:
            self.damage, data = error, b""
        buffer[: len(data)] = data
        return len(data)


class TextBlocks:
    """The lines of a text file, in blocks that end with a line break, and not within quotes.

    Args:
        path: the file.
        quote: the mark of quotes; empty: none.
        keep_rest: the last line is yielded even if it has no line break. Otherwise only if it is the only one.

    Attributes:
        rest: after the iteration, the text that was not yielded.
        damage: after the iteration, why the file ends early; None: it is complete.

    Raises:
        RecordingError: from the iteration: a quote is not closed, or the file is a decompression bomb.
    """

    def __init__(self, path: Path, quote: str = "", *, keep_rest: bool = False) -> None:
        self._path, self._quote, self._keep_rest, self.rest = path, quote, keep_rest, ""
        self.damage: Exception | None = None

    def __iter__(self) -> Iterator[str]:
        limit, total, yielded = max(MAX_EXPANSION * self._path.stat().st_size, MIN_BOMB_CHARS), 0, False
        with _OPENERS.get(self._path.suffix, open)(self._path, "rb") as packed:
            source = _UpToDamage(packed)
            buffered = io.BufferedReader(source)
            text = io.TextIOWrapper(buffered, _encoding(buffered.peek(4096)), errors="replace")
            while len(self.rest) < MAX_ROW_CHARS and (data := text.read(BLOCK_CHARS)):
                total, self.rest = total + len(data), self.rest + data
                if total > limit:
                    what = f"the file expands to more than {MAX_EXPANSION} times its size"
                    raise RecordingError(what, where=str(self._path), valid="no decompression bomb")
                end = self.rest.rfind("\n") + 1
                if self._quote and self.rest.count(self._quote, 0, end) % 2:
                    end = self.rest.rfind("\n", 0, self.rest.rfind(self._quote, 0, end)) + 1
                if end:
                    yield self.rest[:end]
                    self.rest, yielded = self.rest[end:], True
            self.damage = source.damage
        if len(self.rest) >= MAX_ROW_CHARS or ("\n" in self.rest and not self.damage):
            what = f"a closing quote or a line break is missing after {self.rest[:60]!r}"
            raise RecordingError(what, where=str(self._path))
        if self.rest and not self.damage and (self._keep_rest or not yielded):
            yield self.rest
            self.rest = ""


def _encoding(head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def read_csv_rows(
    table: TableFormat,
    path: Path,
    choose: ChooseColumns,
    ids: Collection[str],
    dropped: Counter[str],
    on_warning: OnWarning | None,
) -> Rows:
    """Yield the rows of a CSV file.

    Args:
        table: format of the file.
        path: the file.
        choose: selects the columns.
        ids: columns that are read as integers or texts.
        dropped: counts rows that are not yielded, by reason.
        on_warning: called if the last row is cut, and not yielded; None: it is yielded.

    Raises:
        RecordingError: the header does not describe the rows, or a quote is not closed.
        DamagedRecordingError: the file is truncated, after yielding the rows before.
    """
    blocks, first = TextBlocks(path, '"', keep_rest=on_warning is None), 0
    reader: _CsvReader | None = None
    previous: Any = None
    for block in blocks:
        if reader is None:
            reader, block = _csv_reader(table, path, block, choose)
        if previous:
            yield previous
        columns, numbers = reader.read(block, ids, dropped)
        previous = columns, first + numbers
        first += int(numbers[-1]) + 1 if len(numbers) else 0
    if reader is None and not blocks.damage:
        raise RecordingError("the file is empty", where=str(path))
    if previous and reader and on_warning and not blocks.damage:
        if blocks.rest:
            fault = "the file does not end with a line break"
        elif fault := "the last row is short" if reader.is_short(block) else "":
            previous = {name: values[:-1] for name, values in previous[0].items()}, previous[1][:-1]
        if fault:
            on_warning(f"{path.name}: {fault}; the last row is not used")
    if previous:
        yield previous
    if blocks.damage:
        where = f"{path}: after row {first}"
        raise DamagedRecordingError(f"truncated or corrupt: {blocks.damage}", where=where)


@dataclass(frozen=True, slots=True)
class _CsvReader:
    """Reads blocks of a CSV file.

    Attributes:
        chosen: {column: column of the file}.
        header: the line with the names; empty: none.
        width: number of columns; 0: the rows may have several widths.
        first: a line with the width of the table, because pandas refuses columns that no row of a block has.
        options: of `pandas.read_csv`.
    """

    chosen: dict[str, str]
    header: str
    first: str
    width: int
    options: dict[str, Any]

    def read(
        self, block: str, ids: Collection[str], dropped: Counter[str]
    ) -> tuple[dict[str, Any], NDArray[np.int64]]:
        """Return the columns, and the numbers of their rows in the block."""
        import pandas as pd

        lines, numbers, separator = block.split("\n"), None, self.options["sep"]
        # A quoted text may contain line breaks.
        if self.width and '"' not in block:
            bad = {line for line in lines if line.count(separator) >= self.width and self._is_long(line)}
            if bad or self.header in block:
                comment = self.options["comment"]
                lines = [
                    line for line in lines if line.strip() and not (comment and line.startswith(comment))
                ]
                good = np.array([line not in bad and line != self.header for line in lines], bool)
                dropped["repeated header, or more fields than the header"] += int(np.count_nonzero(~good))
                numbers = np.flatnonzero(good)
                block = "\n".join(lines[number] for number in numbers.tolist())
        data = (self.first + block).encode()
        frame = pd.read_csv(io.BytesIO(data), **self.options)
        # `1e2` may be a hexadecimal id, and float64 merges large ids.
        columns = {self.chosen[name] for name in ids if name in self.chosen}
        if texts := {column: str for column in columns if frame[column].dtype.kind == "f"}:
            frame = pd.read_csv(io.BytesIO(data), **self.options, dtype=texts)
            frame[[*texts]] = frame[[*texts]].replace(r"\.0+$", "", regex=True)
        arrays = {name: frame[column].to_numpy() for name, column in self.chosen.items()}
        return arrays, np.arange(len(frame)) if numbers is None else numbers

    def _is_long(self, line: str) -> bool:
        separator = self.options["sep"]
        return len(_fields(line.rstrip(f"{separator} "), separator)) > self.width

    def is_short(self, block: str) -> bool:
        """Return whether the last line of a block has less fields than the header and the line before."""
        separator = self.options["sep"]
        widths = [len(_fields(line, separator)) for line in block.rstrip().rsplit("\n", 2)[-2:]]
        return bool(self.width) and widths[-1:] < [self.width] and widths[-1:] < widths[:1]


def _csv_reader(table: TableFormat, path: Path, block: str, choose: ChooseColumns) -> tuple[_CsvReader, str]:
    """Read the header; return the reader and the text after the header."""
    separator, lines = table.separator, block.split("\n")[table.skip :]
    header, width, line = table.columns, 0, ""
    if not header:
        marks = (table.comment or "\n",)
        first = next((n for n, line in enumerate(lines) if line.strip() and not line.startswith(marks)), None)
        if first is None:
            raise RecordingError("no header", where=str(path))
        line, lines = lines[first], lines[first + 1 :]
        header = [name or f"Unnamed: {n}" for n, name in enumerate(_fields(line, separator))]
        # A separator may follow the last field. Lists of any length may follow the header.
        rows = [row.rstrip(f"{separator} ") for row in lines[:20] if row.strip()]
        shortest = min([len(_fields(row, separator)) for row in rows], default=0)
        if shortest == len(header) + 1:
            what, valid = (
                f"the rows have {shortest} columns, the header {len(header)}",
                "columns: all names, and skip: 1",
            )
            raise RecordingError(what, where=str(path), valid=valid)
        width = len(header) if shortest <= len(header) else 0
    # Equal names become `r` and `r.1`.
    names = [f"{name}.{header[:n].count(name)}".removesuffix(".0") for n, name in enumerate(header)]
    chosen = choose(names)
    if equal := [name for name in chosen.values() if header.count(name) > 1]:
        what = f"{header.count(equal[0])} columns have the name {equal[0]}"
        raise RecordingError(what, where=str(path), valid=f"columns: [{', '.join(names[:40])}] and skip: 1")
    mark = separator if len(separator) == 1 else " " if separator == r"\s+" else ""
    options = {
        "header": 0 if mark else None, "index_col": False, "skipinitialspace": True, "names": names, "sep": separator,
        "usecols": [*chosen.values()], "decimal": table.decimal, "comment": table.comment or None,
        "engine": "c" if mark else "python",
    }  # fmt: skip
    widest = mark.join("x" * len(names)) + "\n" if mark else ""
    return _CsvReader(chosen, line, widest, width, options), "\n".join(lines)


def _fields(line: str, separator: str) -> list[str]:
    if len(separator) > 1:
        return re.split(separator, line.strip())
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
