"""The rows of CSV files."""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.mapping.mapping import TableFormat
from uwb_mitigation.recordings.text_blocks import OnWarning

Rows = Iterator[tuple[dict[str, Any], NDArray[np.int64]]]
"""Columns, and the numbers of their rows in the file from 0."""

ChooseColumns = Callable[[Sequence[str]], dict[str, str]]
"""Returns {column: column of the file}, from all columns of the file."""


class CsvRows:
    """The rows of a CSV file.

    Args:
        table: format of the file.
        path: the file, for errors.
        blocks: its text, in blocks of complete rows.
        choose: selects the columns.
        ids: columns that are read as integers or texts.
        dropped: counts rows that are not yielded, by reason.
        on_warning: called if the last row is short, and not yielded; None: it is yielded.

    Raises:
        RecordingError: from the iteration: there is no header, or a name is not unique.
    """

    def __init__(
        self, table: TableFormat, path: Path, blocks: Iterable[str], choose: ChooseColumns,
        ids: Collection[str], dropped: Counter[str], on_warning: OnWarning | None,
    ) -> None:  # fmt: skip
        self._table, self._path, self._blocks, self._choose = table, path, blocks, choose
        self._ids, self._dropped, self._on_warning = set(ids), dropped, on_warning
        # The fields are separated by one mark, by white space, or by an expression that is replaced by tabs.
        self._regex = table.separator if len(table.separator) > 1 and table.separator != r"\s+" else ""
        self._mark = "\t" if self._regex else " " if table.separator == r"\s+" else table.separator
        self._chosen, self._header, self._width = dict[str, str](), "", 0
        self._options: dict[str, Any] = {
            "sep": r"\s+" if self._mark == " " else self._mark, "decimal": table.decimal, "index_col": False,
            "comment": table.comment or None, "skipinitialspace": True,
        }  # fmt: skip

    def __iter__(self) -> Rows:
        first, previous = 0, None
        for block in self._blocks:
            lines = block.split("\n")
            if self._regex:
                lines = [re.sub(self._regex, self._mark, line.strip()) for line in lines]
            if not self._chosen:
                lines = self._after_header(lines[self._table.skip :])
            if previous:
                yield previous
            columns, numbers = self._parsed(lines)
            previous, first = (columns, first + numbers), first + int(numbers.max(initial=-1)) + 1
        if previous and self._on_warning:
            widths = [self._count(line) for line in lines if line.strip()][-2:]
            if widths[-1:] < [self._width] and widths[-1:] < widths[:1]:
                self._on_warning(f"{self._path.name}: the last row is short; the last row is not used")
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
