"""Text files in any encoding, packed or damaged, in blocks of complete lines; and the CSV tables in them."""

from __future__ import annotations

import codecs
import gzip
import io
import lzma
import re
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import dropwhile
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
        self._path, self._quote, self._keep_rest, self.unread = path, quote, keep_rest, ""
        self.damage: Exception | None = None

    def __iter__(self) -> Iterator[str]:
        limit, total, yielded = max(MAX_EXPANSION * self._path.stat().st_size, MIN_BOMB_CHARS), 0, False
        with _OPENERS.get(self._path.suffix, open)(self._path, "rb") as packed:
            source = _UpToDamage(packed)
            buffered = io.BufferedReader(source)
            text = io.TextIOWrapper(buffered, _encoding(buffered.peek(4096)), errors="replace")
            while len(self.unread) < MAX_ROW_CHARS and (data := text.read(BLOCK_CHARS)):
                total, self.unread = total + len(data), self.unread + data
                if total > limit:
                    what = f"the file expands to more than {MAX_EXPANSION} times its size"
                    raise RecordingError(what, where=str(self._path), valid="no decompression bomb")
                end = self.unread.rfind("\n") + 1
                if self._quote and self.unread.count(self._quote, 0, end) % 2:
                    end = self.unread.rfind("\n", 0, self.unread.rfind(self._quote, 0, end)) + 1
                if end:
                    yield self.unread[:end]
                    self.unread, yielded = self.unread[end:], True
            self.damage = source.damage
        if len(self.unread) >= MAX_ROW_CHARS or ("\n" in self.unread and not self.damage):
            what = f"a closing quote or a line break is missing after {self.unread[:60]!r}"
            raise RecordingError(what, where=str(self._path))
        if self.unread and not self.damage and (self._keep_rest or not yielded):
            yield self.unread
            self.unread = ""


def _encoding(head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


class CsvRows:
    """The rows of a CSV file.

    Args:
        table: format of the file.
        path: the file.
        choose: selects the columns.
        ids: columns that are read as integers or texts.
        dropped: counts rows that are not yielded, by reason.
        on_warning: called if the last row is cut, and not yielded; None: it is yielded.

    Raises:
        RecordingError: from the iteration: there is no header, a name is not unique, or a quote is not closed.
        DamagedRecordingError: from the iteration: the file is truncated, after yielding the rows before.
    """

    def __init__(
        self, table: TableFormat, path: Path, choose: ChooseColumns, ids: Collection[str],
        dropped: Counter[str], on_warning: OnWarning | None,
    ) -> None:  # fmt: skip
        self._table, self._path, self._choose, self._ids = table, path, choose, set(ids)
        self._dropped, self._on_warning = dropped, on_warning
        # The fields are separated by one mark, by white space, or by an expression that is replaced by tabs.
        self._regex = table.separator if len(table.separator) > 1 and table.separator != r"\s+" else ""
        self._mark = "\t" if self._regex else " " if table.separator == r"\s+" else table.separator
        self._chosen, self._header, self._width = dict[str, str](), "", 0
        self._options: dict[str, Any] = {
            "sep": r"\s+" if self._mark == " " else self._mark, "decimal": table.decimal, "index_col": False,
            "comment": table.comment or None, "skipinitialspace": True,
        }  # fmt: skip

    def __iter__(self) -> Rows:
        blocks, first = TextBlocks(self._path, '"', keep_rest=self._on_warning is None), 0
        previous: Any = None
        for block in blocks:
            lines = block.split("\n")
            if self._regex:
                lines = [re.sub(self._regex, self._mark, line.strip()) for line in lines]
            if not self._chosen:
                lines = self._after_header(lines[self._table.skip :])
            if previous:
                yield previous
            columns, numbers = self._parsed(lines)
            previous, first = (columns, first + numbers), first + int(numbers.max(initial=-1)) + 1
        if not self._chosen and not blocks.damage:
            raise RecordingError("the file is empty", where=str(self._path))
        if previous and self._on_warning and not blocks.damage:
            fault = "the file does not end with a line break" if blocks.unread else ""
            widths = [self._count(line) for line in lines if line.strip()][-2:]
            if not fault and widths[-1:] < [self._width] and widths[-1:] < widths[:1]:
                fault = "the last row is short"
                previous = {name: values[:-1] for name, values in columns.items()}, previous[1][:-1]
            if fault:
                self._on_warning(f"{self._path.name}: {fault}; the last row is not used")
        if previous:
            yield previous
        if blocks.damage:
            what, where = f"truncated or corrupt: {blocks.damage}", f"{self._path}: after row {first}"
            raise DamagedRecordingError(what, where=where)

    def _count(self, line: str) -> int:
        return len(line.split()) if self._mark == " " else line.count(self._mark) + 1

    def _after_header(self, lines: list[str]) -> list[str]:
        """Choose the columns, and return the lines after the header."""
        import pandas as pd

        names, comment = [*self._table.columns], self._table.comment or "\n"
        if not names:
            lines = list(dropwhile(lambda line: not line.strip() or line.startswith(comment), lines))
            self._header, lines = lines[0] if lines else "", lines[1:]
            header = pd.read_csv(io.StringIO(self._header), nrows=0, **self._options)
            names = [str(name) for name in header.columns]
            self._width = len(names)
        self._chosen = self._choose(names)
        originals = [name.strip('" ') for name in self._header.split(self._mark)]
        if equal := [name for name in self._chosen.values() if originals.count(name) > 1]:
            what, valid = f"several columns have the name {equal[0]}", f"columns: [{', '.join(names[:40])}]"
            raise RecordingError(what, where=str(self._path), valid=f"{valid} and skip: 1")
        if self._table.columns:
            # Pandas refuses columns that no row of a block has.
            self._header = self._mark.join("x" * len(names))
            self._options |= {"names": names, "header": 0}
        self._options["usecols"] = [*self._chosen.values()]
        return lines

    def _parsed(self, lines: list[str]) -> tuple[dict[str, Any], NDArray[np.int64]]:
        """Return the columns, and the numbers of their rows in the block."""
        import pandas as pd

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
            self._dropped[reason] += len(lines) - len(numbers)
            lines = [lines[number] for number in numbers.tolist()]
        data = "\n".join([self._header, *lines]).encode()
        frame = pd.read_csv(io.BytesIO(data), **self._options)
        # `1e2` may be a hexadecimal id, and float64 merges large ids.
        ids = {column for name, column in self._chosen.items() if name in self._ids}
        if texts := {column: str for column in ids if frame[column].dtype.kind == "f"}:
            frame = pd.read_csv(io.BytesIO(data), **self._options, dtype=texts)
            frame[[*texts]] = frame[[*texts]].replace(r"\.0+$", "", regex=True)
        arrays = {name: frame[column].to_numpy() for name, column in self._chosen.items()}
        return arrays, np.arange(len(frame)) if numbers is None else numbers
