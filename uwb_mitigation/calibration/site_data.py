"""Recorded ranges of a site in columns, and their conversion to a `Dataset` when the true ranges are known."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.motion_segments import GAP_S
from uwb_mitigation.errors import DatasetError, format_id
from uwb_mitigation.mitigation.correction import MAX_RANGE_M
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.choice import CirKind, is_trained_for
from uwb_mitigation.mitigation.model.floating import float_network, predict_m
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.training.data.dataset import CirSources, Dataset
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


@dataclass(frozen=True, slots=True, eq=False)
class SiteData:
    """Ranges of all tags of all recordings, one tag after the other.

    Attributes:
        anchors: anchors of the site.
        tags: data of each tag, in the order of time.
        preprocessing: preprocessing of the universal model.
        rx_power_dbm, first_path_power_dbm: float32 (r,), NaN = unknown.
        has_cirs: whether CIRs are used.
        is_usable: bool (r,), ranges to which a model can be fitted; the others only affect track and offsets.
        universal_m: float64 (r,), predictions of the universal network, m; 0: none.
        recording: int (r,), number of the recording of each range.
        height_m: float64 (r,), measured heights of the tags; None: not measured.
        frame_ids: {tag id: the frame ids of its ranges}.
        skipped: {reason: number of excluded ranges}.
        shift_ns: time added to the stamps of each recording, so that recordings do not overlap.
        sources: radios and segments of the CIRs.
    """

    anchors: AnchorMap
    tags: tuple[Ranges, ...]
    preprocessing: Preprocessing
    rx_power_dbm: NDArray[np.float32]
    first_path_power_dbm: NDArray[np.float32]
    has_cirs: bool
    is_usable: NDArray[np.bool_]
    universal_m: NDArray[np.float64]
    recording: NDArray[np.intp]
    height_m: NDArray[np.float64] | None
    frame_ids: dict[int, tuple[str, ...]]
    skipped: Counter[str]
    shift_ns: tuple[int, ...]
    sources: CirSources

    @property
    def first_rows(self) -> NDArray[np.intp]:
        """Index of the first range of each tag."""
        return np.cumsum([0, *map(len, self.tags)])[:-1].astype(np.intp)

    @property
    def ranges(self) -> Ranges:
        """Ranges of all tags."""
        return Ranges.joined(self.tags)

    @property
    def tag(self) -> NDArray[np.intp]:
        """Index of the tag of each range, shape (r,)."""
        return np.repeat(np.arange(len(self.tags)), list(map(len, self.tags)))

    def select(self, is_selected: NDArray[np.bool_]) -> SiteData:
        """Return only these ranges, bool (r,), and the tags that have any."""
        columns = ("rx_power_dbm", "first_path_power_dbm", "is_usable", "universal_m", "recording")
        tags = [tag.take(is_selected[self.tag == number]) for number, tag in enumerate(self.tags)]
        return replace(
            self,
            tags=tuple(tag for tag in tags if len(tag)),
            height_m=None if self.height_m is None else self.height_m[is_selected],
            **{name: getattr(self, name)[is_selected] for name in columns},
        )

    def halves(self) -> tuple[NDArray[np.bool_], bool]:
        """Return which ranges belong to the first half, bool (r,), and whether the halves are separate recordings.

        The halves are separated between recordings if these allow it, or else by time, if possible in a pause.
        """
        counts = np.cumsum(np.bincount(self.recording))
        number = int(np.argmin(np.abs(counts - counts[-1] / 2.0)))
        if MIN_HALF <= counts[number] / counts[-1] <= 1.0 - MIN_HALF:
            return self.recording <= number, True
        stamps = np.sort(self.ranges.stamp_ns)
        first, last = (round(fraction * (len(stamps) - 1)) for fraction in (MIN_HALF, 1.0 - MIN_HALF))
        pauses = first + np.flatnonzero(np.diff(stamps[first : last + 1]) > GAP_S * NS_PER_S)
        middle = len(stamps) // 2
        cut = int(pauses[np.argmin(np.abs(pauses - middle))]) if len(pauses) else middle
        return self.ranges.stamp_ns <= stamps[cut], False

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
            self.rx_power_dbm[rows],
            self.first_path_power_dbm[rows],
            ranges.range_m - offset_m,
            ranges.range_m - true_m - offset_m,
            np.array(names),
            np.full(len(rows), ""),
            **self.sources.as_fields(),
        )


def read_site(
    recordings: Iterable[Iterable[Record]],
    anchors: AnchorMap,
    universal: Bundle,
    on_record: Callable[[], None] = lambda: None,
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
        on_record: called for each record that was read.
        stamp_offset_s: time offset added to the stamps of ranges: -0.2 if they are 0.2 s late.
        heights: heights of the tags for each recording. Ranges without a height are excluded.

    Raises:
        DatasetError: no range belongs to an anchor in the map.
    """
    table = _RangeTable(anchors, universal)
    shifts: list[int] = []
    for number, recording in enumerate(recordings):
        shift_ns: int | None = None
        end_of_previous = table.last_stamp_ns
        heights_of_recording = None if heights is None else heights[number]
        for record in recording:
            on_record()
            stamp_ns = record.measurement.stamp_ns + round(stamp_offset_s * NS_PER_S)
            if shift_ns is None:
                shift_ns = 0
                if end_of_previous is not None and stamp_ns <= end_of_previous:
                    shift_ns = end_of_previous - stamp_ns + RECORDING_GAP_NS
            height_m = None
            if heights_of_recording is not None:
                height_m = float(heights_of_recording.height_at(np.array([stamp_ns]))[0][0])
            table.add(record.measurement, stamp_ns + shift_ns, height_m, number)
        shifts.append(shift_ns or 0)
    return table.to_site(tuple(shifts))


_COLUMNS = np.dtype(
    [
        ("tag", np.uint64),
        ("stamp_ns", np.int64),
        ("anchor", np.intp),
        ("range_m", np.float64),
        ("rx_power_dbm", np.float64),
        ("first_path_power_dbm", np.float64),
        ("height_m", np.float64),
        ("is_usable", np.bool_),
        ("recording", np.intp),
    ]
)


class _RangeTable:
    """Collects ranges row by row.

    Attributes:
        last_stamp_ns: latest stamp; None: no range yet.
    """

    def __init__(self, anchors: AnchorMap, universal: Bundle) -> None:
        self.last_stamp_ns: int | None = None
        self._anchors, self._universal = anchors, universal
        self._skipped, self._unknown_anchors = Counter[str](), Counter[int]()
        self._rows: list[tuple[object, ...]] = []
        self._windows: list[NDArray[np.float32]] = []
        self._sources = CirSources()
        self._frame_ids: dict[int, dict[str, None]] = {}

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
            card = self._universal.card
            (fault,), (window,) = card.preprocessing.windows_of([measured])
            self.last_stamp_ns = max(stamp_ns, self.last_stamp_ns or stamp_ns)
            cir = measured.cir
            powers = (
                dbm if math.isfinite(dbm) else math.nan
                for dbm in (cir.rx_power_dbm, cir.first_path_power_dbm)
            )
            is_usable = fault == 0 and is_trained_for(card, CirKind.of(cir))
            self._rows.append(
                (measured.tag_id, stamp_ns, row, measured.range_m, *powers, height_m, is_usable, recording)
            )
            self._windows.append(window)
            self._sources.add(cir)

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
        table = np.array(self._rows, _COLUMNS)
        order = np.lexsort((table["stamp_ns"], table["tag"]))
        column = {name: np.ascontiguousarray(table[name][order]) for name in _COLUMNS.names or ()}
        unknown = np.full(len(table), np.nan)
        ranges = Ranges(
            column["stamp_ns"], column["anchor"], column["range_m"], unknown, column["rx_power_dbm"]
        )
        tags = tuple(
            replace(ranges.take(rows), tag_id=int(column["tag"][rows[0]]))
            for rows in np.split(np.arange(len(table)), np.flatnonzero(np.diff(column["tag"])) + 1)
        )
        is_usable = column["is_usable"]
        has_cirs = bool(is_usable.mean() >= MIN_CIR_SHARE)
        universal_m = np.zeros(len(table))
        if has_cirs:
            inputs = np.stack([self._windows[index] for index in order[is_usable]])
            universal_m[is_usable] = predict_m(float_network(self._universal), inputs)
        return SiteData(
            anchors=self._anchors,
            tags=tags,
            preprocessing=self._universal.preprocessing,
            rx_power_dbm=column["rx_power_dbm"].astype(np.float32),
            first_path_power_dbm=column["first_path_power_dbm"].astype(np.float32),
            has_cirs=has_cirs,
            is_usable=is_usable if has_cirs else np.ones(len(table), np.bool_),
            universal_m=np.nan_to_num(universal_m, nan=0.0, posinf=0.0, neginf=0.0),
            recording=column["recording"],
            height_m=None if np.isnan(column["height_m"]).all() else column["height_m"],
            frame_ids={tag_id: tuple(names) for tag_id, names in self._frame_ids.items()},
            skipped=self._skipped,
            shift_ns=shift_ns,
            sources=self._sources,
        )
