"""The ranges of a bag by tag, in columns for positioning, and the true positions of the tags."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag.pose_paths import read_truth
from uwb_mitigation.recordings.bag.reader import BagReader, check_channel
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.ros.codec import MeasurementKey, decode_corrected, decode_range, measurement_key
from uwb_mitigation.types.ros.topics import RANGE_CIR_TYPE, RANGE_CORRECTED, RANGE_CORRECTED_TYPE, RANGE_RAW
from uwb_mitigation.types.tracks import Ranges, TruePath


@dataclass(frozen=True, slots=True, eq=False)
class TagRecording:
    """The ranges of one tag in a bag.

    Attributes:
        raw: ranges as measured, with unknown variances.
        ranges: corrected ranges with their variances, if the bag contains any; otherwise the raw ranges.
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


def read_ranges(path: Path, anchors: AnchorMap, stamp_offset_s: float = 0.0) -> RecordedRanges:
    """Read all ranges of a bag.

    Args:
        path: the bag.
        anchors: the map; ranges of other anchors are skipped.
        stamp_offset_s: added to the stamps of the ranges (not of the truth): -0.2 if they are late by 0.2 s.

    Raises:
        RecordingError: the bag cannot be read, or has no range of an anchor in the map.
    """
    bag, offset_ns = BagReader(path), round(stamp_offset_s * 1e9)
    raw, corrected = defaultdict[int, list[_Row]](list), defaultdict[int, list[_Row]](list)
    unknown_anchors, skipped, checked = Counter[int](), Counter[str](), set[int]()
    powers: dict[MeasurementKey, float] = {}

    def add(
        table: dict[int, list[_Row]], key: MeasurementKey, value: float, variance: float, power: float
    ) -> bool:
        row = anchors.index.get(key.anchor_id)
        if row is None or not (math.isfinite(value) and value >= 0.0) or variance == math.inf:
            return False
        table[key.tag_id].append((key.stamp_ns + offset_ns, row, value, variance, power))
        return True

    for message in bag.messages((RANGE_RAW, RANGE_CORRECTED)):
        is_raw = message.channel.topic == RANGE_RAW
        if id(message.channel) not in checked:
            check_channel(message.channel, RANGE_CIR_TYPE if is_raw else RANGE_CORRECTED_TYPE, path)
            checked.add(id(message.channel))
        try:
            if is_raw:
                measured = decode_range(message.data)
                key = measurement_key(measured)
                powers[key] = measured.cir.rx_power_dbm
                row = (measured.range_m, math.nan, powers[key])
            else:
                key, corrected_range = decode_corrected(message.data)
                row = (corrected_range.range_m, corrected_range.variance_m2, powers.get(key, math.nan))
                if key not in powers:
                    # A bag without raw ranges: corrected ranges contain the measured ones.
                    add(raw, key, corrected_range.range_raw_m, math.nan, math.nan)
        except RecordingError as error:
            skipped[error.what] += 1
            continue
        if not add(raw if is_raw else corrected, key, *row):
            is_new = is_raw or not raw
            if key.anchor_id not in anchors.index:
                unknown_anchors[key.anchor_id] += is_new
            else:
                skipped["invalid range"] += is_new
    if not raw and not corrected:
        map_ids = ", ".join(map(str, sorted(anchors.index)))
        recorded_ids = ", ".join(map(str, sorted(unknown_anchors))) or "none"
        raise RecordingError(
            f"no range of the anchors {map_ids}",
            where=str(path),
            valid=f"the bag's ranges come from anchors: {recorded_ids}",
        )
    truths = read_truth(path)
    no_truth = TruePath(np.zeros(0, np.int64), np.zeros((0, 3)))
    tags = []
    for tag in sorted(raw.keys() | corrected.keys()):
        measured_ranges = _columns(tag, raw.get(tag, []))
        usable = _columns(tag, corrected[tag]) if tag in corrected else measured_ranges
        tags.append(TagRecording(tag, measured_ranges, usable, tag in corrected, truths.get(tag, no_truth)))
    return RecordedRanges(tags, unknown_anchors, skipped + bag.warnings)


def _columns(tag_id: int, rows: list[_Row]) -> Ranges:
    columns = np.array(sorted(rows, key=lambda row: row[0]), _DTYPE)
    stamp, anchor, range_m, variance, power = (columns[name].copy() for name in "sarvp")
    return Ranges(stamp, anchor, range_m, variance, power, tag_id)
