"""The ranges of a bag by tag, in columns for positioning, and the true positions of the tags."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag.pose_paths import read_truth
from uwb_mitigation.recordings.bag.reader import BagReader, check_channel
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import CorrectedRange, Record
from uwb_mitigation.types.ros.codec import MeasurementKey, decode_corrected, decode_range, measurement_key
from uwb_mitigation.types.ros.topics import RANGE_CIR_TYPE, RANGE_CORRECTED, RANGE_CORRECTED_TYPE, RANGE_RAW
from uwb_mitigation.types.tracks import Ranges, TruePath


@dataclass(frozen=True, slots=True, eq=False)
class TagRecording:
    """The ranges of one tag in a bag.

    Attributes:
        raw: ranges as measured, with unknown variances.
        ranges: corrected ranges with their variances, if there are any; otherwise the raw ranges.
        corrected: whether `ranges` are corrected.
        truth: true positions; empty: unknown.
    """

    tag_id: int
    raw: Ranges
    ranges: Ranges
    corrected: bool
    truth: TruePath


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


_Row = tuple[int, int, float, float, float]
_DTYPE = np.dtype([("s", "i8"), ("a", "i8"), ("r", "f8"), ("v", "f8"), ("p", "f8")])


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
        corrected: corrected ranges of a bag that contains none; of a tag whose ranges they do not change, the raw ranges
            are used. Not read if the bag contains corrected ranges.

    Raises:
        RecordingError: the bag cannot be read, or has no range of an anchor in the map.
    """
    bag = BagReader(path)
    table = _RangeTable(anchors, round(stamp_offset_s * 1e9))
    checked = set[int]()
    for message in bag.messages((RANGE_RAW, RANGE_CORRECTED)):
        is_raw = message.channel.topic == RANGE_RAW
        if id(message.channel) not in checked:
            check_channel(message.channel, RANGE_CIR_TYPE if is_raw else RANGE_CORRECTED_TYPE, path)
            checked.add(id(message.channel))
        try:
            if is_raw:
                table.add_raw(message.data)
            else:
                table.add_corrected(*decode_corrected(message.data))
        except RecordingError as error:
            table.skipped[error.what] += 1
    if not (has_corrected := RANGE_CORRECTED in bag.topics):
        for record, result in corrected:
            table.add_corrected(measurement_key(record.measurement), result)
    if not table.raw and not table.corrected:
        map_ids = ", ".join(map(str, sorted(anchors.index)))
        recorded_ids = ", ".join(map(str, sorted(table.unknown_anchors))) or "none"
        raise RecordingError(
            f"no range of the anchors {map_ids}",
            where=str(path),
            valid=f"the bag's ranges come from anchors: {recorded_ids}",
        )
    truths = read_truth(path)
    no_truth = TruePath(np.zeros(0, np.int64), np.zeros((0, 3)))
    tags = []
    for tag in sorted(table.raw.keys() | table.corrected.keys()):
        raw = _columns(tag, table.raw.get(tag, []))
        ranges = _columns(tag, table.corrected[tag]) if tag in table.corrected else raw
        if not has_corrected and np.array_equal(ranges.range_m, raw.range_m):
            ranges = raw
        tags.append(TagRecording(tag, raw, ranges, ranges is not raw, truths.get(tag, no_truth)))
    return RecordedRanges(tags, table.unknown_anchors, table.skipped + bag.warnings)


class _RangeTable:
    """Rows of the raw and corrected ranges of a bag, by tag."""

    def __init__(self, anchors: AnchorMap, offset_ns: int) -> None:
        self._anchors, self._offset_ns = anchors, offset_ns
        self._powers: dict[MeasurementKey, float] = {}
        self.raw = defaultdict[int, list[_Row]](list)
        self.corrected = defaultdict[int, list[_Row]](list)
        self.unknown_anchors, self.skipped = Counter[int](), Counter[str]()

    def add_raw(self, data: bytes) -> None:
        measured = decode_range(data)
        key, power = measurement_key(measured), measured.cir.rx_power_dbm
        self._powers[key] = power
        if not self._add(self.raw, key, measured.range_m, math.nan, power):
            self._count(key)

    def add_corrected(self, key: MeasurementKey, corrected: CorrectedRange) -> None:
        power = self._powers.get(key, math.nan)
        if key not in self._powers:
            # A bag without raw ranges: corrected ranges contain the measured ones.
            self._add(self.raw, key, corrected.range_raw_m, math.nan, math.nan)
        is_valid = self._add(self.corrected, key, corrected.range_m, corrected.variance_m2, power)
        # Otherwise, the raw range was counted.
        if not is_valid and not self.raw:
            self._count(key)

    def _add(
        self, rows: dict[int, list[_Row]], key: MeasurementKey, range_m: float, variance: float, power: float
    ) -> bool:
        anchor = self._anchors.index.get(key.anchor_id)
        if anchor is None or not (math.isfinite(range_m) and range_m >= 0.0) or variance == math.inf:
            return False
        rows[key.tag_id].append((key.stamp_ns + self._offset_ns, anchor, range_m, variance, power))
        return True

    def _count(self, key: MeasurementKey) -> None:
        if key.anchor_id in self._anchors.index:
            self.skipped["invalid range"] += 1
        else:
            self.unknown_anchors[key.anchor_id] += 1


def _columns(tag_id: int, rows: list[_Row]) -> Ranges:
    columns = np.array(sorted(rows, key=lambda row: row[0]), _DTYPE)
    stamp, anchor, range_m, variance, power = (columns[name].copy() for name in "sarvp")
    return Ranges(stamp, anchor, range_m, variance, power, tag_id)
