"""Recorded ranges of a site in columns, and their conversion to a `Dataset` when the true ranges are known."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.motion_segments import GAP_S
from uwb_mitigation.errors import DatasetError, format_id
from uwb_mitigation.mitigation.correction import MAX_RANGE_M
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.choice import CirKind, is_trained_for
from uwb_mitigation.mitigation.model.floating import float_network, predict_m
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.training.data.dataset import CirSource, Dataset, source_fields, source_of
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import RangeMeasurement, Record
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Heights, Ranges

MIN_CIR_SHARE = 0.5
"""If the share of ranges with a usable CIR is smaller, no CIR is used."""

CONFIGURATION_S = 2.0
"""Duration of a configuration in motion: the errors of a pair are correlated for about this time."""

RECORDING_GAP_NS = 3_600_000_000_000

MIN_HALF = 0.3
"""Minimum share of the ranges in each part of a recording that is divided for a test."""

_RANGE = [("tag", "u8"), ("stamp_ns", "i8"), ("anchor", "i8"), ("range_m", "f8"), ("height_m", "f8")]
_CIR = [("rx_power_dbm", "f4"), ("first_path_power_dbm", "f4"), ("is_usable", "?"), ("universal_m", "f8")]
COLUMNS = np.dtype([*_RANGE, *_CIR, ("recording", "i8")])
"""A range: row of its anchor in the map; NaN: unknown. `is_usable`: a model can be fitted to it, the others only affect track and
offsets. `universal_m`: prediction of the universal network, 0: none. `recording`: its number."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteData:
    """Ranges of all tags of all recordings, one tag after the other.

    Attributes:
        anchors: anchors of the site.
        table: `COLUMNS` (r,), by tag and time.
        preprocessing: preprocessing of the universal model.
        has_cirs: whether CIRs are used.
        frame_ids: {tag id: the frame ids of its ranges}.
        skipped: {reason: number of excluded ranges}.
        shift_ns: time added to the stamps of each recording, so that recordings do not overlap.
        sources: radio, segment and channel of the CIRs.
    """

    anchors: AnchorMap
    table: NDArray[Any]
    preprocessing: Preprocessing
    has_cirs: bool
    frame_ids: dict[int, tuple[str, ...]]
    skipped: Counter[str]
    shift_ns: tuple[int, ...]
    sources: set[CirSource]

    @property
    def first_rows(self) -> NDArray[np.intp]:
        """Index of the first range of each tag."""
        return np.flatnonzero(np.diff(self.tag, prepend=-1))

    @property
    def ranges(self) -> Ranges:
        """Ranges of all tags."""
        names = ("stamp_ns", "anchor", "range_m", "rx_power_dbm")
        stamp_ns, anchor, range_m, power_dbm = (np.ascontiguousarray(self.table[name]) for name in names)
        return Ranges(stamp_ns, anchor, range_m, np.full(len(stamp_ns), np.nan), power_dbm.astype(np.float64))

    @property
    def tags(self) -> tuple[Ranges, ...]:
        """Ranges of each tag, in the order of time."""
        ranges, tag = self.ranges, self.tag
        ids = self.table["tag"][self.first_rows].tolist()
        return tuple(replace(ranges.take(tag == number), tag_id=tag_id) for number, tag_id in enumerate(ids))

    @property
    def tag(self) -> NDArray[np.intp]:
        """Index of the tag of each range, shape (r,)."""
        return np.unique(self.table["tag"], return_inverse=True)[1]

    @property
    def height_m(self) -> NDArray[np.float64] | None:
        """Measured heights of the tags, float64 (r,), m; None: not measured."""
        height_m: NDArray[np.float64] = self.table["height_m"]
        return None if np.isnan(height_m).all() else height_m

    def select(self, is_selected: NDArray[np.bool_]) -> SiteData:
        """Return only these ranges, bool (r,), and the tags that have any."""
        return replace(self, table=self.table[is_selected])

    def halves(self) -> tuple[NDArray[np.bool_], bool]:
        """Return which ranges belong to the first half, bool (r,), and whether the halves are separate recordings.

        The halves are separated between recordings if these allow it, or else by time, if possible in a pause.
        """
        recording, stamp_ns = self.table["recording"], self.table["stamp_ns"]
        counts = np.cumsum(np.bincount(recording))
        number = int(np.argmin(np.abs(counts - counts[-1] / 2.0)))
        if MIN_HALF <= counts[number] / counts[-1] <= 1.0 - MIN_HALF:
            return recording <= number, True
        stamps = np.sort(stamp_ns)
        first, last = (round(fraction * (len(stamps) - 1)) for fraction in (MIN_HALF, 1.0 - MIN_HALF))
        pauses = first + np.flatnonzero(np.diff(stamps[first : last + 1]) > GAP_S * NS_PER_S)
        middle = len(stamps) // 2
        cut = int(pauses[np.argmin(np.abs(pauses - middle))]) if len(pauses) else middle
        return stamp_ns <= stamps[cut], False

    def to_dataset(
        self, rows: NDArray[np.intp], true_m: NDArray[np.float64], offset_m: NDArray[np.float64]
    ) -> Dataset:
        """Return a dataset of selected ranges, without CIRs. A configuration is a pair for `CONFIGURATION_S`.

        Args:
            rows: indices, (k,), into the ranges of all tags, in ascending order.
            true_m: (k,), their true ranges.
            offset_m: (k,), subtracted from the ranges.
        """
        ranges, tag = self.ranges.take(rows), self.tag[rows]
        _, first, slot = np.unique(tag, return_index=True, return_inverse=True)
        elapsed_s = (ranges.stamp_ns - ranges.stamp_ns[first][slot]) / NS_PER_S
        interval = (elapsed_s // CONFIGURATION_S).astype(int)
        names = [f"tag {t}/{c}/anchor {a}" for t, c, a in zip(tag, interval, ranges.anchor, strict=True)]
        return Dataset(
            self.preprocessing,
            np.zeros((len(rows), self.preprocessing.samples), np.float32),
            self.table["rx_power_dbm"][rows],
            self.table["first_path_power_dbm"][rows],
            ranges.range_m - offset_m,
            ranges.range_m - true_m - offset_m,
            np.array(names),
            np.full(len(rows), ""),
            **source_fields(self.sources),
        )


def read_site(
    recordings: Iterable[Iterable[Record]],
    anchors: AnchorMap,
    universal: Bundle,
    *,
    stamp_offset_s: float = 0.0,
    heights: Sequence[Heights] | None = None,
) -> SiteData:
    """Read recordings, without their ground truth.

    Args:
        recordings: records of each recording, in the order of time.
        anchors: anchors of the site; other anchors are skipped.
        universal: bundle that the models of the site start from. CIRs that it was not trained for are not used, but their levels
            are.
        stamp_offset_s: time offset added to the stamps of ranges: -0.2 if they are 0.2 s late.
        heights: heights of the tags for each recording. Ranges without a height are excluded.

    Raises:
        DatasetError: no range belongs to an anchor in the map.
    """
    table = _RangeTable(anchors, universal)
    shifts: list[int] = []
    for number, recording in enumerate(recordings):
        shift_ns: int | None = None
        end_ns = table.last_stamp_ns
        for record in recording:
            stamp_ns = record.measurement.stamp_ns + round(stamp_offset_s * NS_PER_S)
            if shift_ns is None:
                shift_ns = end_ns - stamp_ns + RECORDING_GAP_NS if stamp_ns <= end_ns else 0
            height_m = None
            if heights is not None:
                height_m = float(heights[number].height_at(np.array([stamp_ns]))[0][0])
            table.add(record.measurement, stamp_ns + shift_ns, height_m, number)
        shifts.append(shift_ns or 0)
    return table.to_site(tuple(shifts))


class _RangeTable:
    """Collects ranges row by row.

    Attributes:
        last_stamp_ns: latest stamp so far.
    """

    def __init__(self, anchors: AnchorMap, universal: Bundle) -> None:
        self.last_stamp_ns = -(1 << 63)
        self._anchors, self._universal = anchors, universal
        self._skipped, self._unknown_anchors = Counter[str](), Counter[int]()
        self._rows, self._windows = list[tuple[object, ...]](), list[NDArray[np.float32]]()
        self._sources, self._frame_ids = set[CirSource](), dict[int, dict[str, None]]()

    def add(self, measured: RangeMeasurement, stamp_ns: int, height_m: float | None, recording: int) -> None:
        """Add a range, or count why it is skipped."""
        row = self._anchors.index.get(measured.anchor_id)
        if row is None:
            self._unknown_anchors[measured.anchor_id] += 1
        elif not (math.isfinite(measured.range_m) and 0 <= measured.range_m <= MAX_RANGE_M):
            self._skipped["no valid range"] += 1
        elif height_m is not None and math.isnan(height_m):
            self._skipped["no height at that time"] += 1
        else:
            self._frame_ids.setdefault(measured.tag_id, {}).setdefault(measured.frame_id)
            card, cir = self._universal.card, measured.cir
            (fault,), (window,) = card.preprocessing.windows_of([measured])
            self.last_stamp_ns = max(stamp_ns, self.last_stamp_ns)
            powers = cir.rx_power_dbm, cir.first_path_power_dbm
            is_usable = fault == 0 and is_trained_for(card, CirKind.of(cir))
            columns = measured.tag_id, stamp_ns, row, measured.range_m, height_m, *powers, is_usable, 0.0
            self._rows.append((*columns, recording))
            self._windows.append(window)
            self._sources.add(source_of(cir))

    def to_site(self, shift_ns: tuple[int, ...]) -> SiteData:
        """Return the ranges by tag and time.

        Raises:
            DatasetError: no range can be used, or most are from anchors that are not in the map.
        """
        if not self._rows and not self._unknown_anchors:
            reasons = ", ".join(f"{count} x {reason}" for reason, count in self._skipped.items())
            raise DatasetError(f"no range can be used: {reasons or 'there are none'}")
        for anchor_id, count in self._unknown_anchors.items():
            self._skipped[f"anchor {format_id(anchor_id)} is not in the anchors file"] += count
        if (num_unknown := self._unknown_anchors.total()) > len(self._rows) or not self._rows:
            unknown_ids = ", ".join(map(format_id, sorted(self._unknown_anchors))) or "none"
            raise DatasetError(
                f"{num_unknown} of {num_unknown + len(self._rows)} ranges are from anchors that are not in the anchors file: "
                f"{unknown_ids}",
                valid=f"anchors of the file: {', '.join(map(format_id, sorted(self._anchors.index)))}",
            )
        table = np.array(self._rows, COLUMNS)
        order = np.lexsort((table["stamp_ns"], table["tag"]))
        table = table[order]
        for name in ("rx_power_dbm", "first_path_power_dbm"):
            table[name][~np.isfinite(table[name])] = np.nan
        is_usable = table["is_usable"]
        has_cirs = bool(is_usable.mean() >= MIN_CIR_SHARE)
        if has_cirs:
            inputs = np.stack([self._windows[index] for index in order[is_usable]])
            predicted_m = predict_m(float_network(self._universal), inputs)
            table["universal_m"][is_usable] = np.nan_to_num(predicted_m, nan=0.0, posinf=0.0, neginf=0.0)
        else:
            is_usable[:] = True
        return SiteData(
            anchors=self._anchors,
            table=table,
            preprocessing=self._universal.card.preprocessing,
            has_cirs=has_cirs,
            frame_ids={tag_id: tuple(names) for tag_id, names in self._frame_ids.items()},
            skipped=self._skipped,
            shift_ns=shift_ns,
            sources=self._sources,
        )
