"""True ranges of pairs over time in a CSV file, for recordings without ground truth.

Columns `tag_id`, `anchor_id` (decimal) and `range_m`; optionally `start_s` and `stop_s`, seconds from the
recording's first measurement (empty = from its start, to its end), `configuration` and `label`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.csv_tables import read_csv
from uwb_mitigation.types.measurement import Record, Truth

MAX_RANGE_M = 1e6


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
        RecordingError: the file is missing, too large or malformed; the message names the row.
    """
    numbers = {"range_m": (0.0, MAX_RANGE_M), "start_s": (0.0, MAX_RANGE_M), "stop_s": (0.0, math.inf)}
    optional = ("start_s", "stop_s", "label", "configuration")
    columns = read_csv(path, ("tag_id", "anchor_id"), numbers, optional)
    starts = np.nan_to_num(columns["start_s"])
    stops = np.where(np.isnan(columns["stop_s"]), math.inf, columns["stop_s"])
    if bad := np.flatnonzero(starts >= stops).tolist():
        what = f"start_s = {starts[bad[0]]} is not before stop_s = {stops[bad[0]]}"
        raise RecordingError(what, where=f"{path}: row {bad[0] + 1}")
    segments = []
    for row, range_m in enumerate(columns["range_m"].tolist()):
        name = columns["configuration"][row] or f"{path.name} row {row + 1}"
        truth = Truth(range_m, columns["label"][row], name)
        ids = int(columns["tag_id"][row]), int(columns["anchor_id"][row])
        segments.append(TruthSegment(*ids, float(starts[row]), float(stops[row]), truth))
    return segments


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
