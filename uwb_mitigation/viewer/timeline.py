"""Index of a recording: the status and error of every range, and the complete tracks of the tags.

The time of a message is its stamp, or its log time if they differ by more than `MAX_STAMP_S`. The player and its marks use
the log time, because it is the time at which a subscriber received the message.
"""

from __future__ import annotations

import contextlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError, RecordingError, format_id
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.online.robot_estimator import live_track
from uwb_mitigation.positioning.recorded_tracks import TagTracks, check_one_tag, track_tag
from uwb_mitigation.recordings.bag.pose_paths import read_truth
from uwb_mitigation.recordings.recorded_ranges import KEY, RangeTable, Table, match
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import CORRECTED, FAULTS, RangeMeasurement
from uwb_mitigation.types.ros.codec import measurement_key
from uwb_mitigation.types.ros.poses import tag_frame
from uwb_mitigation.types.ros.topics import (
    ODOMETRY_TRUTH,
    POSE_SMOOTHED,
    RANGE_CORRECTED,
    RANGE_RAW,
    RANGE_TRUTH,
)
from uwb_mitigation.types.stamps import NS_PER_S, to_ns
from uwb_mitigation.types.tracks import Track, TruePath
from uwb_mitigation.viewer.histories import MAX_RANGE_M, NO_DATA_S, BoundedDict, Pair, RangeColumns
from uwb_mitigation.viewer.incidents import Incidents
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.recording import POSITIONS, Recording
from uwb_mitigation.viewer.scene import MAX_CELLS, MAX_TAGS, add_heat, tag_label, tag_name

MAX_STAMP_S = 1.0
"""If stamp and log time of a message differ by more, its time is the log time."""
BATCH = 256
"""Number of raw ranges that are corrected in one call."""
_KINDS = {ODOMETRY_TRUTH: TrackKind.TRUE, POSE_SMOOTHED: TrackKind.SMOOTHED}
_TRUTH = np.dtype([*KEY, ("true_m", "f8")])


@dataclass
class Timeline:
    """Everything about a recording that does not depend on the position of the player.

    Attributes:
        log_s: log time of each range from the beginning, float64 (n,), increasing.
        time_s: time of each range from the beginning, float64 (n,).
        stamp_s: stamps, s, float64 (n,).
        anchor, tag: ids of each range, uint64 (n,). status: uint8 (n,).
        raw_m, corrected_m, true_m, residual_m, gap_db: float64 (n,), see `Sample`; NaN: unknown.
        losses: {pair: (missing sequence numbers, ranges)}.
        notices: messages for the page.
        tracks: {(tag, kind): float64 (k, 5), time (s), x, y, z and horizontal standard deviation (m)}.
        estimates: {tag: its estimated tracks}, if the recording contains no positions.
        heat: see `Scene`.
        incidents: (log time, text).
        displaced: {anchor whose ranges fit another position: its median held-out residual, m}.
        is_complete: whether tracks, residuals, heat map and incidents have been added.
    """

    log_s: NDArray[np.float64]
    time_s: NDArray[np.float64]
    stamp_s: NDArray[np.float64]
    anchor: NDArray[np.uint64]
    tag: NDArray[np.uint64]
    status: NDArray[np.uint8]
    raw_m: NDArray[np.float64]
    corrected_m: NDArray[np.float64]
    true_m: NDArray[np.float64]
    gap_db: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    losses: dict[Pair, tuple[int, int]] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    tracks: dict[tuple[str, TrackKind], NDArray[np.float64]] = field(default_factory=dict)
    estimates: dict[str, TagTracks] = field(default_factory=dict)
    heat: BoundedDict[tuple[int, int], list[float]] = field(default_factory=lambda: BoundedDict(MAX_CELLS))
    incidents: list[tuple[float, str]] = field(default_factory=list)
    displaced: dict[int, float] = field(default_factory=dict)
    is_complete: bool = False

    @cached_property
    def bad(self) -> NDArray[np.bool_]:
        """Whether the status of each range needs attention."""
        return np.isin(self.status, FAULTS)

    @cached_property
    def is_corrected(self) -> NDArray[np.bool_]:
        """Whether a model corrected each range."""
        return np.isin(self.status, CORRECTED)

    @cached_property
    def _rows_of_pairs(self) -> dict[Pair, NDArray[np.intp]]:
        return dict(_rows_by_pair(self.anchor, self.tag))

    def ranges(self, pair: Pair, begin_s: float = -np.inf, end_s: float = np.inf) -> RangeColumns:
        """Return the ranges of a pair in an interval of the log time."""
        rows = self._rows_of_pairs.get(pair, np.zeros(0, np.intp))
        rows = rows[slice(*np.searchsorted(self.log_s[rows], (begin_s, end_s + 1e-6), side="right"))]
        columns = {name: getattr(self, name)[rows] for name in RangeColumns._fields if name != "interval_s"}
        return RangeColumns(interval_s=np.diff(columns["stamp_s"], prepend=np.nan), **columns)

    @cached_property
    def deviation_m(self) -> NDArray[np.float64]:
        """Absolute error of each corrected range; without any truth, the absolute correction. NaN: unknown."""
        reference_m = self.true_m if np.isfinite(self.true_m).any() else self.raw_m
        deviation: NDArray[np.float64] = np.abs(self.corrected_m - reference_m)
        deviation[~(deviation < MAX_RANGE_M)] = np.nan
        return deviation

    def pair(self, row: int) -> Pair:
        return int(self.anchor[row]), int(self.tag[row])

    def bad_row(self, position_s: float, is_next: bool) -> int | None:
        """Return the row of the next or previous range whose status needs attention; None: there is none."""
        is_there = self.log_s > position_s + 1e-6 if is_next else self.log_s < position_s - 2e-6
        rows = np.flatnonzero(self.bad & is_there)
        return int(rows[0 if is_next else -1]) if len(rows) else None

    def largest_error(self) -> int | None:
        """Return the row of the range with the largest `deviation_m`; None: nothing deviates."""
        deviation = np.nan_to_num(self.deviation_m)
        return int(deviation.argmax()) if deviation.any() else None

    def range_errors(self, begin_s: float, end_s: float) -> NDArray[np.float64]:
        """Return raw and corrected errors of the ranges with known truth in an interval, float64 (2, k)."""
        rows = slice(*np.searchsorted(self.log_s, (begin_s, end_s), side="right"))
        errors = np.stack([self.raw_m[rows], self.corrected_m[rows]]) - self.true_m[rows]
        return errors[:, (np.abs(errors) <= MAX_RANGE_M).all(axis=0)]


def index_recording(
    recording: Recording,
    config: EstimatorConfig | None,
    backend: Corrector | None,
    publish: Callable[[Timeline], None],
    stamp_offset_s: float = 0.0,
) -> Timeline:
    """Read a recording.

    Args:
        recording: the bag.
        config: of the estimators of tracks; None: the anchors are unknown.
        backend: corrects raw ranges; None: the recording contains corrected ranges.
        publish: called with the timeline as soon as the ranges have been read; the estimation of tracks takes longer.
        stamp_offset_s: added to the stamps of the ranges.
    """
    reader = _Reader(recording, backend)
    # The player reports the damage of a bag when it reaches it.
    with contextlib.suppress(RecordingError):
        reader.read()
    ranges = reader.table.corrected.array()
    timeline = reader.timeline(ranges)
    publish(timeline)
    if config is not None and len(ranges):
        truths: dict[int | None, TruePath] = {}
        with contextlib.suppress(RecordingError):
            truths = read_truth(recording.path, recording.prefix + ODOMETRY_TRUTH)
        recorded = reader.table.by_tag(config.anchors, stamp_offset_s, truths)
        has_positions = bool(recording.contents & POSITIONS)
        names = {name for name, kind in timeline.tracks if kind is TrackKind.CORRECTED}
        for tag in recorded.tags[:MAX_TAGS]:
            name = tag_name(tag.tag_id, names, timeline.losses) or tag_frame(tag.tag_id)
            tracks: dict[TrackKind, Track] = {}
            if has_positions:
                tracks[TrackKind.RAW] = live_track(config, tag.raw)
            else:
                try:
                    check_one_tag(config, recorded.tags)
                    estimated = timeline.estimates[name] = track_tag(tag, config)
                except (DatasetError, ParameterError) as error:
                    timeline.notices.append(str(error))
                    continue
                tracks[TrackKind.RAW], tracks[TrackKind.CORRECTED] = estimated.raw_live, estimated.live
                tracks[TrackKind.SMOOTHED] = estimated.smoothed
                label, state = f"tag {format_id(tag.tag_id)}", str(estimated.determination)
                timeline.notices += [
                    f"{label}{' determination' * (text == state)}: {text}" for text in estimated.warnings
                ]
            rows = np.flatnonzero(ranges["tag"] == tag.tag_id)
            rows = rows[np.argsort(ranges["stamp_ns"][rows], kind="stable")]
            stamp_ns = ranges["stamp_ns"][rows] + round(stamp_offset_s * NS_PER_S)
            for kind, track in tracks.items():
                # Relative stamps: a float64 resolves nanoseconds since 1970 only to a fraction of a microsecond.
                since_ns = track.stamp_ns - stamp_ns[0]
                track_s = np.interp(since_ns, stamp_ns - stamp_ns[0], timeline.time_s[rows])
                sd_m = np.sqrt(track.covariance[:, 0, 0] + track.covariance[:, 1, 1])
                timeline.tracks[name, kind] = np.column_stack([track_s, track.position, sd_m])
        _add_positions(timeline, config.anchors)
    timeline.incidents = _incidents(timeline, recording.seconds)
    timeline.is_complete = True
    return timeline


class _Reader:
    """Reads ranges, truths and positions of a recording."""

    def __init__(self, recording: Recording, backend: Corrector | None) -> None:
        self._recording, self._backend = recording, backend
        self._batch: list[tuple[int, RangeMeasurement]] = []
        self._truths = Table(_TRUTH)
        self._points = defaultdict[tuple[str, TrackKind], list[tuple[float, ...]]](list)
        self._late = Counter[str]()
        self._delays_s: dict[str, float] = {}
        self.table = RangeTable()

    def read(self) -> None:
        topics = {RANGE_RAW, RANGE_CORRECTED, RANGE_TRUTH, ODOMETRY_TRUTH, *POSITIONS}
        try:
            for log_ns, topic, message, tag in self._recording.events(topics):
                if message is None:
                    continue
                if topic == RANGE_CORRECTED:
                    key, result = message
                    self.table.add_corrected(key, result, log_ns)
                elif topic == RANGE_RAW:
                    self.table.add_raw(message)
                    if self._backend is not None:
                        self._batch.append((log_ns, message))
                    if len(self._batch) == BATCH:
                        self._correct()
                elif topic == RANGE_TRUTH:
                    self._truths.add(*message[0], message[1].range_m)
                else:
                    self._add_position(log_ns, topic, message, tag)
        finally:
            self._correct()

    def _correct(self) -> None:
        if self._backend is not None and self._batch:
            corrected = self._backend.correct([measurement for _, measurement in self._batch])
            for (log_ns, measurement), result in zip(self._batch, corrected, strict=True):
                self.table.add_corrected(measurement_key(measurement), result, log_ns)
            self._batch.clear()

    def _add_position(self, log_ns: int, topic: str, message: Any, tag: str) -> None:
        kind = _KINDS.get(topic, TrackKind.CORRECTED)
        name = str(message.child_frame_id) if kind is TrackKind.TRUE else tag
        point, covariance = message.pose.pose.position, message.pose.covariance
        is_new = (name, kind) not in self._points
        if not np.isfinite([point.x, point.y]).all() or (is_new and len(self._points) >= 4 * MAX_TAGS):
            return
        time_s, log_s = (to_ns(message.header.stamp) - self._recording.start_ns) / NS_PER_S, log_ns / NS_PER_S
        if abs(time_s - log_s) > MAX_STAMP_S:
            self._note_delay(f"the positions of {name}", time_s - log_s)
            time_s = log_s
        variance = covariance[0] + covariance[7]
        sd_m = np.sqrt(variance) if variance > 0.0 else np.nan
        self._points[name, kind].append((time_s, point.x, point.y, point.z, sd_m))

    def _note_delay(self, name: str, delay_s: float) -> None:
        self._late[name] += 1
        self._delays_s.setdefault(name, delay_s)

    def timeline(self, ranges: NDArray[Any]) -> Timeline:
        """Return the timeline without estimated tracks."""
        stamp_s = (ranges["stamp_ns"] - self._recording.start_ns) / NS_PER_S
        log_s = ranges["log_ns"] / NS_PER_S
        delay_s = stamp_s - log_s
        is_late = np.abs(delay_s) > MAX_STAMP_S
        for tag in np.unique(ranges["tag"][is_late]):
            rows = is_late & (ranges["tag"] == tag)
            name = f"the ranges of tag {format_id(int(tag))}"
            self._late[name], self._delays_s[name] = int(rows.sum()), float(np.median(delay_s[rows]))
        names = ", ".join(f"{name} by {self._delays_s[name]:+.1f} s" for name in self._late)
        notice = f"Stamps differ from the log time, and the log time is used: {names[:300]}." if names else ""
        truths, measured = self._truths.array(), self.table.raw.array()
        timeline = Timeline(
            log_s=log_s,
            time_s=np.where(is_late, log_s, stamp_s),
            stamp_s=ranges["stamp_ns"] / NS_PER_S,
            true_m=np.append(truths["true_m"], np.nan)[match(ranges, truths)],
            gap_db=np.append(measured["gap_db"], np.nan)[match(ranges, measured)],
            residual_m=np.full(len(ranges), np.nan),
            losses={
                pair: (_lost(ranges["sequence"][rows]), len(rows))
                for pair, rows in _rows_by_pair(ranges["anchor"], ranges["tag"])
            },
            notices=[notice] if notice else [],
            status=ranges["status"].copy(),
            corrected_m=ranges["range_m"].copy(),
            **{name: ranges[name].copy() for name in ("anchor", "tag", "raw_m")},
        )
        for key, points in self._points.items():
            columns = np.array(points)
            timeline.tracks[key] = columns[np.argsort(columns[:, 0], kind="stable")]
        return timeline


def _rows_by_pair(
    anchor: NDArray[np.uint64], tag: NDArray[np.uint64]
) -> Iterator[tuple[Pair, NDArray[np.intp]]]:
    order = np.lexsort((tag, anchor))
    is_new = (np.diff(anchor[order]) != 0) | (np.diff(tag[order]) != 0)
    for rows in np.split(order, np.flatnonzero(is_new) + 1) if len(order) else ():
        yield (int(anchor[rows[0]]), int(tag[rows[0]])), rows


def _lost(sequence: NDArray[np.uint32]) -> int:
    """Return the number of missing sequence numbers of a pair, relative to its median step; see `History.count_lost`."""
    step = np.diff(sequence)
    step = step[(step > 0) & (step < 1000)]
    return int(np.maximum(np.rint(step / np.median(step)) - 1.0, 0.0).sum()) if len(step) else 0


def _add_positions(timeline: Timeline, anchors: AnchorMap) -> None:
    """Add what ranges and tracks yield together: residuals, and the mean correction along the tracks."""
    ids = np.array(sorted(anchors.index), np.uint64)
    place = anchors.position[[anchors.index[int(anchor_id)] for anchor_id in ids]]
    tracks = {name: track for (name, kind), track in timeline.tracks.items() if kind is TrackKind.CORRECTED}
    for tag_id in np.unique(timeline.tag):
        track = tracks.get(tag_name(int(tag_id), tracks, timeline.losses))
        if track is None or not len(track):
            continue
        rows = np.flatnonzero(timeline.tag == tag_id)
        x, y, z = (np.interp(timeline.time_s[rows], track[:, 0], axis) for axis in track[:, 1:4].T)
        index = np.minimum(np.searchsorted(ids, timeline.anchor[rows]), len(ids) - 1)
        distance_m = np.linalg.norm(np.column_stack([x, y, np.nan_to_num(z)]) - place[index], axis=1)
        age_s = timeline.time_s[rows] - track[_latest(track, timeline.time_s[rows]), 0]
        is_known = (ids[index] == timeline.anchor[rows]) & (np.abs(age_s) < NO_DATA_S)
        timeline.residual_m[rows] = np.where(is_known, timeline.corrected_m[rows] - distance_m, np.nan)
        correction = timeline.raw_m[rows] - timeline.corrected_m[rows]
        for row in np.flatnonzero(np.abs(correction) < MAX_RANGE_M):
            add_heat(timeline.heat, float(x[row]), float(y[row]), float(correction[row]))


def _latest(track: NDArray[np.float64], time_s: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the row of the latest position at each time, or the first row."""
    rows: NDArray[np.intp] = np.maximum(np.searchsorted(track[:, 0], time_s, side="right") - 1, 0)
    return rows


def _incidents(timeline: Timeline, seconds: float) -> list[tuple[float, str]]:
    """Return the incidents of ranges and positions until the end, in the order of their times."""
    ranges = Incidents()
    columns = (timeline.anchor, timeline.tag, timeline.log_s, timeline.stamp_s)
    for anchor_id, tag_id, log_s, stamp_s in zip(*(column.tolist() for column in columns), strict=True):
        ranges.add_range((anchor_id, tag_id), log_s, stamp_s)
    streams = [ranges]
    for (name, kind), track in timeline.tracks.items():
        if kind is TrackKind.CORRECTED:
            streams.append(Incidents())
            for time_s, x, y in track[:, :3].tolist():
                streams[-1].add_position(tag_label(name, None), time_s, x, y)
    for stream in streams:
        stream.check(seconds)
    return sorted(incident for stream in streams for incident in stream.found)
