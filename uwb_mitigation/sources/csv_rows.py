"""CSV files with a header row that people make by hand or publish, read with typed errors."""

from __future__ import annotations

import csv
import io
import lzma
from collections.abc import Iterator
from pathlib import Path

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.files import read_bounded


def read_rows(path: Path, columns: tuple[str, ...], most_bytes: int) -> Iterator[tuple[int, dict[str, str]]]:
    """Line number and values by column of each row; blank rows are passed over.

    Args:
        path: of the file; `.xz` is unpacked.
        columns: that must be there; the values of others are given, too, and may be absent from a short row.
        most_bytes: that are read, and unpacked.

    Raises:
        RecordingError: the file is absent, too large, no CSV file, or lacks a column or a value; names the line.
    """
    valid = f"a CSV file with {', '.join(columns)}"
    data = read_bounded(path, most_bytes, RecordingError, valid)
    if path.suffix == ".xz":
        try:
            with lzma.open(io.BytesIO(data)) as stream:
                data = stream.read(most_bytes + 1)
        except (EOFError, lzma.LZMAError) as error:
            raise RecordingError(f"not whole: {error}", where=str(path), valid=valid) from error
        if len(data) > most_bytes:
            raise RecordingError(f"more than {most_bytes} bytes", where=str(path), valid=valid)
    try:
        reader = csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        absent = [name for name in columns if name not in (reader.fieldnames or ())]
        if absent:
            raise RecordingError(f"the column {absent[0]} is absent", where=str(path), valid=valid)
        for row in reader:
            if any(row[name] is None for name in columns):
                raise RecordingError(
                    "the row is too short", where=f"{path}: line {reader.line_num}", valid=valid
                )
            yield reader.line_num, row
    except (csv.Error, UnicodeDecodeError) as error:
        raise RecordingError(f"not a CSV file: {error}", where=str(path), valid=valid) from error
