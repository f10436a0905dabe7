"""The ranges of a bag by tag, in columns for positioning, and the true positions of the tags."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError, format_id
from uwb_mitigation.recordings.bag.pose_paths import read_truth
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import CORRECTED, CorrectedRange, RangeMeasurement, Record
from uwb_mitigation.types.ros.codec import MeasurementKey, decode_corrected, decode_range, measurement_key
from uwb_mitigation.types.ros.topics import RANGE_CIR_TYPE, RANGE_CORRECTED, RANGE_CORRECTED_TYPE, RANGE_RAW
from uwb_mitigation.types.tracks import Ranges, TagRecording, TruePath

CHUNK = 50_000
"""Number of rows that are collected before they are stored compactly."""

KEY = [("stamp_ns", "i8"), ("tag", "u8"), ("anchor", "u8"), ("sequence", "u4")]
_RAW = np.dtype([*KEY, ("range_m", "f8"), ("gap_db", "f8"), ("rx_dbm", "f8")])
_CORRECTED = np.dtype([*KEY, ("status", "u1"), ("raw_m", "f8"), ("range_m", "f8"), ("variance_m2", "f8")])


class Table:
    """Rows of a structured array that grows."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype, self._rows = dtype, list[tuple[Any, ...]]()
        self._chunks: list[NDArray[Any]] = []

    def add(self, *row: Any) -> None:
        """Append a row."""
        self._rows.append(row)
        if len(self._rows) == CHUNK:
            self._chunks.append(np.array(self._rows, self._dtype))
            self._rows.clear()

    def array(self) -> NDArray[Any]:
        """Return all rows."""
        return np.concatenate([*self._chunks, np.array(self._rows, self._dtype)])


def match(rows: NDArray[Any], others: NDArray[Any]) -> NDArray[np.intp]:
    """Return for each of n rows the index of the row of `others` with the same `KEY`, the last one, int (n,); -1: none."""
    # Its import takes 0.4 s.
    import pandas as pd

    left, right = (pd.DataFrame({name: table[name] for name, _ in KEY}) for table in (rows, others))
    right = right.assign(row=np.arange(len(others))).drop_duplicates(list(left), keep="last")
    return np.asarray(left.merge(right, "left")["row"].fillna(-1), np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRanges:
    """Ranges of a recording, by tag.

    Attributes:
        tags: by their numbers.
        unknown_anchors: number of ranges from anchors that are not in the map, {anchor id: count}.
        skipped: other skipped ranges, {reason: count}.
    """

    tags: list[TagRecording]
    unknown_anchors: Counter[int]
    skipped: Counter[str]

    @property
    def warnings(self) -> list[str]:
        """What was left out, for the user."""
        reason = "it is not in the anchors file"
        unknown = self.unknown_anchors.items()
        lines = [
            f"{count} ranges of anchor {format_id(anchor)} left out: {reason}" for anchor, count in unknown
        ]
        return [*lines, *(f"left out: {count} x {reason}" for reason, count in self.skipped.items())]

    def check(self, anchors: AnchorMap, where: str = "") -> None:
        """Raise RecordingError if no range is of an anchor in the map."""
        if not self.tags:
            map_ids = ", ".join(map(str, sorted(anchors.index)))
            recorded_ids = ", ".join(map(str, sorted(self.unknown_anchors))) or "none"
            valid = f"the ranges come from anchors: {recorded_ids}"
            raise RecordingError(f"no range of the anchors {map_ids}", where=where, valid=valid)


@dataclass(slots=True)
class RangeTable:
    """Raw and corrected ranges of a recording.

    Attributes:
        raw, corrected: their rows.
        skipped: number of messages that cannot be decoded, {reason: count}.
    """

    raw: Table = field(default_factory=lambda: Table(_RAW))
    corrected: Table = field(default_factory=lambda: Table(_CORRECTED))
    skipped: Counter[str] = field(default_factory=Counter)

    def add_raw(self, measured: RangeMeasurement) -> None:
        """Append a measured range."""
        levels = measured.cir.power_gap_db, measured.cir.rx_power_dbm
        self.raw.add(*measurement_key(measured), measured.range_m, *levels)

    def add_corrected(self, key: MeasurementKey, corrected: CorrectedRange) -> None:
        """Append the corrected range of a measurement."""
        columns = corrected.status, corrected.range_raw_m, corrected.range_m, corrected.variance_m2
        self.corrected.add(*key, *columns)

    def by_tag(
        self, anchors: AnchorMap, stamp_offset_s: float, truths: Mapping[int | None, TruePath]
    ) -> RecordedRanges:
        """Return the usable ranges of each tag; see `read_ranges`."""
        measured, corrected = self.raw.array(), self.corrected.array()
        row_of_raw = match(corrected, measured)
        # A bag without raw ranges: corrected ranges contain the measured ones.
        raw = np.concatenate([measured, np.zeros(int((row_of_raw < 0).sum()), _RAW)])
        for name, _ in KEY:
            raw[name][len(measured) :] = corrected[name][row_of_raw < 0]
        raw["range_m"][len(measured) :] = corrected["raw_m"][row_of_raw < 0]
        unknown_m2 = np.full(len(raw), np.nan)
        raw_rows = _usable(raw, anchors, unknown_m2)
        corrected_rows = _usable(corrected, anchors, corrected["variance_m2"])
        counted, rows = (measured, raw_rows) if len(measured) else (corrected, corrected_rows)
        rejected = counted["anchor"][rows[: len(counted)] < 0].tolist()
        unknown = Counter(anchor for anchor in rejected if anchor not in anchors.index)
        skipped = self.skipped + Counter({"invalid range": len(rejected) - unknown.total()})
        offset_ns = round(stamp_offset_s * 1e9)
        no_truth, tags = TruePath(np.zeros(0, np.int64), np.zeros((0, 3))), []
        for tag in np.unique(
            np.concatenate([raw["tag"][raw_rows >= 0], corrected["tag"][corrected_rows >= 0]])
        ):
            raw_ranges = _ranges(raw, raw_rows, unknown_m2, tag, offset_ns)
            ranges = _ranges(corrected, corrected_rows, corrected["variance_m2"], tag, offset_ns)
            is_same = not np.any(ranges.is_corrected) and np.array_equal(ranges.range_m, raw_ranges.range_m)
            if not len(ranges) or is_same:
                ranges = raw_ranges
            tags.append(
                TagRecording(
                    int(tag), raw_ranges, ranges, ranges is not raw_ranges, truths.get(int(tag), no_truth)
                )
            )
        return RecordedRanges(tags, unknown, skipped)


def _usable(rows: NDArray[Any], anchors: AnchorMap, variance_m2: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the row of the anchor of each range, int (n,); -1: the range cannot be used."""
    ids, inverse = np.unique(rows["anchor"], return_inverse=True)
    anchor = np.array([anchors.index.get(int(one), -1) for one in ids], np.intp)[inverse]
    usable = np.isfinite(rows["range_m"]) & (rows["range_m"] >= 0.0) & (variance_m2 != math.inf)
    return np.where(usable, anchor, -1)


def _ranges(
    rows: NDArray[Any],
    anchor: NDArray[np.intp],
    variance_m2: NDArray[np.float64],
    tag: np.uint64,
    offset_ns: int,
) -> Ranges:
    """Return the usable ranges of a tag in the order of their stamps; their received powers are not read."""
    index = np.flatnonzero((rows["tag"] == tag) & (anchor >= 0))
    index = index[np.argsort(rows["stamp_ns"][index], kind="stable")]
    measured, is_corrected = rows[index], np.zeros(len(index), np.bool_)
    if rows.dtype == _CORRECTED:
        is_corrected |= np.isin(measured["status"], CORRECTED)
    # As in `MultiTagEstimator`.
    variance_m2 = np.where(np.logical_or.accumulate(is_corrected), variance_m2[index], np.nan)
    columns = measured["range_m"], variance_m2, np.full(len(index), np.nan)
    return Ranges(measured["stamp_ns"] + offset_ns, anchor[index], *columns, int(tag), is_corrected)


def read_ranges(
    path: Path,
    anchors: AnchorMap,
    stamp_offset_s: float = 0.0,
    corrected: Iterable[tuple[Record, CorrectedRange]] = (),
) -> RecordedRanges:
    """Read all ranges of a bag.

    Args:
        path: the bag.
        anchors: the map; ranges of other anchors are skipped.
        stamp_offset_s: added to the stamps of the ranges (not of the truth): -0.2 if they are late by 0.2 s.
        corrected: corrected ranges of a bag that contains none. Not read if the bag contains corrected ranges. Of a tag whose
            ranges the correction does not change, the raw ranges are used.

    Raises:
        RecordingError: the bag cannot be read, or has no range of an anchor in the map.
    """
    bag, table = BagReader(path), RangeTable()
    types = {RANGE_RAW: RANGE_CIR_TYPE, RANGE_CORRECTED: RANGE_CORRECTED_TYPE}
    for message in bag.checked_messages(types):
        try:
            if message.channel.topic == RANGE_RAW:
                table.add_raw(decode_range(message.data))
            else:
                table.add_corrected(*decode_corrected(message.data))
        except RecordingError as error:  # noqa: PERF203
            table.skipped[error.what] += 1
    if RANGE_CORRECTED not in bag.topics:
        for record, result in corrected:
            table.add_corrected(measurement_key(record.measurement), result)
    recorded = table.by_tag(anchors, stamp_offset_s, read_truth(path))
    recorded.check(anchors, str(path))
    recorded.skipped.update(bag.warnings)
    return recorded
