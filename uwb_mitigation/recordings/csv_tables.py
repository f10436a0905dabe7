"""Small CSV files of known columns, such as surveys, and true ranges for recordings without ground truth.

A table of true ranges has the columns `tag_id`, `anchor_id` (decimal) and `range_m`; optionally `start_s` and `stop_s`,
seconds from the recording's first measurement (empty = from its start, to its end), `configuration` and `label`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.mapping.conversion import UNKNOWN_ID, ColumnDict, Converter
from uwb_mitigation.recordings.mapping.mapping import FieldRule, TableFormat
from uwb_mitigation.recordings.mapping.tables import TableFile
from uwb_mitigation.types.measurement import Record, Truth

MAX_ROWS = 100_000
MAX_RANGE_M = 1e6


TruthTable = dict[tuple[int, int], list[tuple[float, float, Truth]]]
"""{(tag, anchor): [(start, stop, truth), ...]}, from `start` (inclusive) to `stop` (exclusive), s."""


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
        raise RecordingError("no rows, or too many", where=path, valid=f"1 to {MAX_ROWS} rows")
    columns = converter.convert(chunks[0])
    for name, (low, high) in [*((name, (0, UNKNOWN_ID - 1)) for name in ids), *numbers.items()]:
        bad = ~((columns[name] >= low) & (columns[name] <= high))
        for row in np.flatnonzero(bad & ~(np.isnan(columns[name]) & (name in optional)))[:1].tolist():
            what, where = f"{name} = {columns[name][row]}", chunks[0].where(row)
            raise RecordingError(what, where=where, valid=f"{low:g} to {high:g}")
    return columns


def load_truth(*paths: Path) -> TruthTable:
    """Read the rows of truth tables; each row without a configuration name is a separate configuration.

    Raises:
        RecordingError: a file is missing, too large or malformed; the message names the row.
    """
    numbers = {"range_m": (0.0, MAX_RANGE_M), "start_s": (0.0, MAX_RANGE_M), "stop_s": (0.0, math.inf)}
    optional = ("start_s", "stop_s", "label", "configuration")
    table = defaultdict[tuple[int, int], list[tuple[float, float, Truth]]](list)
    for path in paths:
        columns = read_csv(path, ("tag_id", "anchor_id"), numbers, optional)
        columns["start_s"] = np.nan_to_num(columns["start_s"])
        columns["stop_s"] = np.nan_to_num(columns["stop_s"], nan=math.inf)
        names = ("tag_id", "anchor_id", "start_s", "stop_s", "range_m", "label", "configuration")
        rows = zip(*(columns[name].tolist() for name in names), strict=True)
        for row, (tag, anchor, start_s, stop_s, range_m, label, configuration) in enumerate(rows, 1):
            if start_s >= stop_s:
                what = f"start_s = {start_s} is not before stop_s = {stop_s}"
                raise RecordingError(what, where=f"{path}: row {row}")
            truth = Truth(range_m, label, configuration or f"{path.name} row {row}")
            table[tag, anchor].append((start_s, stop_s, truth))
    return table


def with_truth(records: Iterable[Record], table: TruthTable) -> Iterator[Record]:
    """Yield the records with the truth of the first row for their pair and time, if any."""
    first_ns: int | None = None
    for record in records:
        measurement = record.measurement
        first_ns = measurement.stamp_ns if first_ns is None else first_ns
        elapsed_s = (measurement.stamp_ns - first_ns) / 1e9
        rows = table.get((measurement.tag_id, measurement.anchor_id), ())
        truths = (truth for start_s, stop_s, truth in rows if start_s <= elapsed_s < stop_s)
        yield replace(record, truth=next(truths, None))
