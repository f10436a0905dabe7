"""CSV files with a header row, read with typed errors."""

from __future__ import annotations

import csv
import io
import lzma
import math
import re
from collections.abc import Iterator
from pathlib import Path

from uwb_mitigation.errors import RecordingError, did_you_mean


def read_rows(path: Path, columns: tuple[str, ...], max_bytes: int) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line number and {column: value} of each row; blank rows are skipped.

    Args:
        path: the file; `.xz` is decompressed.
        columns: required columns; other columns may be missing in a short row.
        max_bytes: maximum size after decompression.

    Raises:
        RecordingError: the file is absent, too large, not CSV, or a column or a value is missing; `where` gives the line.
    """
    valid = f"a CSV file of at most {max_bytes} bytes with {', '.join(columns)}"
    where = str(path)
    try:
        with lzma.open(path) if path.suffix == ".xz" else path.open("rb") as stream:
            data = stream.read(max_bytes + 1)
        if len(data) > max_bytes:
            raise RecordingError("too large", where=where, valid=valid)
        reader = csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        header = reader.fieldnames or ()
        if missing := [name for name in columns if name not in header]:
            what, suggestion = f"no column {missing[0]!r}", ""
            for name in sorted(set(header) - set(columns)):
                if suggestion := did_you_mean(name, missing[:1]):
                    what += f", but a column {name!r}"
                    break
            raise RecordingError(what, where=where, valid=valid, suggestion=suggestion)
        for row in reader:
            where = f"{path}: line {reader.line_num}"
            if any(row[name] is None for name in columns):
                raise RecordingError("a value is missing", where=where, valid=valid)
            yield reader.line_num, row
    except (OSError, EOFError, lzma.LZMAError, csv.Error, UnicodeDecodeError) as error:
        raise RecordingError(f"cannot be read: {error}", where=where, valid=valid) from error


def id_cell(row: dict[str, str], column: str, where: str) -> int:
    """Return the 64-bit number in a cell; raises RecordingError."""
    text = (row.get(column) or "").strip()
    if text.isascii() and text.isdigit() and len(text) <= 20 and int(text) < 1 << 64:
        return int(text)
    if re.fullmatch(r"0x[0-9a-fA-F]{1,16}", text):
        return int(text, 16)
    raise RecordingError(
        f"{column} = {text!r:.40}", where=where, valid="a whole number below 2^64, such as 3 or 0x1f"
    )


def number_cell(
    row: dict[str, str], column: str, where: str, low: float, high: float, empty: float = math.nan
) -> float:
    """Return the number in a cell, or `empty`; raises RecordingError."""
    text = (row.get(column) or "").strip()
    try:
        value = float(text) if text else empty
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise RecordingError(f"{column} = {text!r:.40}", where=where, valid=f"{low:g} to {high:g}")
    return value
