"""True ranges of pairs over time in a CSV file, for recordings without ground truth.

Columns `tag_id`, `anchor_id` (decimal) and `range_m`; optionally `start_s` and `stop_s`, seconds from the
recording's first measurement (empty = from its start, to its end), `configuration` and `label`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.measurement import Record, Truth
from uwb_mitigation.sources.csv_rows import id_cell, number_cell, read_rows

MAX_CSV_BYTES = 1 << 20
MAX_RANGE_M = 1e6

_REQUIRED = ("tag_id", "anchor_id", "range_m")


@dataclass(frozen=True, slots=True)
class TruthSegment:
    """The true range of one pair from `start_s` (inclusive) to `stop_s` (exclusive)."""

    tag_id: int
    anchor_id: int
    start_s: float
    stop_s: float
    truth: Truth


def load_truth(path: Path) -> list[TruthSegment]:
    """Read the rows of a truth table; each row without a configuration name is a separate configuration.

    Raises:
        RecordingError: the file is missing, too large or malformed; the message names the line.
    """
    found = [_segment(row, path, line) for line, row in read_rows(path, _REQUIRED, MAX_CSV_BYTES)]
    if not found:
        raise RecordingError(
            "the truth table has no rows", where=str(path), valid="one row for each configuration"
        )
    return found


def with_truth(records: Iterable[Record], segments: Sequence[TruthSegment]) -> Iterator[Record]:
    """Yield the records with the truth of the first row for their pair and time, if any."""
    by_pair: dict[tuple[int, int], list[TruthSegment]] = {}
    for segment in segments:
        by_pair.setdefault((segment.tag_id, segment.anchor_id), []).append(segment)
    first_ns: int | None = None
    for record in records:
        measurement = record.measurement
        first_ns = measurement.stamp_ns if first_ns is None else first_ns
        elapsed_s = (measurement.stamp_ns - first_ns) / 1e9
        candidates = by_pair.get((measurement.tag_id, measurement.anchor_id), ())
        yield replace(
            record,
            truth=next((item.truth for item in candidates if item.start_s <= elapsed_s < item.stop_s), None),
        )


def _segment(row: dict[str, str], path: Path, line: int) -> TruthSegment:
    where = f"{path}: line {line}"
    start_s = number_cell(row, "start_s", where, 0.0, MAX_RANGE_M, 0.0)
    stop_s = number_cell(row, "stop_s", where, 0.0, math.inf, math.inf)
    if start_s >= stop_s:
        raise RecordingError(f"start_s = {start_s} is not before stop_s = {stop_s}", where=where)
    truth = Truth(
        number_cell(row, "range_m", where, 0.0, MAX_RANGE_M),
        (row.get("label") or "").strip(),
        (row.get("configuration") or "").strip() or f"{path.name} line {line}",
    )
    tag_id, anchor_id = (id_cell(row, name, where) for name in ("tag_id", "anchor_id"))
    return TruthSegment(tag_id, anchor_id, start_s, stop_s, truth)
