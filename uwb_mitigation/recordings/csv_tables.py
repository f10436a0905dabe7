"""Small CSV files of known columns, such as surveys and true ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.mapping.conversion import UNKNOWN_ID, ColumnDict, Converter
from uwb_mitigation.recordings.mapping.mapping import FieldRule, TableFormat
from uwb_mitigation.recordings.mapping.tables import TableFile

MAX_ROWS = 100_000


def read_csv(
    path: Path, ids: Sequence[str], numbers: Mapping[str, tuple[float, float]], optional: Sequence[str] = ()
) -> ColumnDict:
    """Read a CSV file of at most `MAX_ROWS` rows; `.xz` is decompressed.

    Args:
        path: the file.
        ids: columns with ids.
        numbers: columns with numbers, and their limits.
        optional: names of numbers or texts that may be missing.

    Raises:
        RecordingError: a column or a value is missing or invalid; `where` gives the row.
    """
    values = {name: FieldRule(column=name, optional=name in optional) for name in (*ids, *numbers, *optional)}
    converter = Converter(values, ids=ids)
    file = TableFile(TableFormat(format="csv"), path, converter.columns, ids)
    chunks = list(islice(file.chunks(), 2))
    if len(chunks) != 1 or not 0 < chunks[0].count <= MAX_ROWS:
        raise RecordingError("no rows, or too many", where=str(path), valid=f"1 to {MAX_ROWS} rows")
    columns = converter.convert(chunks[0])
    for name, (low, high) in [*((name, (0, UNKNOWN_ID - 1)) for name in ids), *numbers.items()]:
        bad = ~((columns[name] >= low) & (columns[name] <= high))
        for row in np.flatnonzero(bad & ~(np.isnan(columns[name]) & (name in optional)))[:1].tolist():
            what, where = f"{name} = {columns[name][row]}", chunks[0].where(row)
            raise RecordingError(what, where=where, valid=f"{low:g} to {high:g}")
    return columns
