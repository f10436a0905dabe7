"""Index of a recording: the status and error of every range, and the complete tracks of the tags."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, RecordingError
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.positioning.batch.smoother import smooth
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.online.initialization import snapshot
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig, TagEstimator
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import CorrectedRange, RangeMeasurement, Status
from uwb_mitigation.types.palette import TrackKind
from uwb_mitigation.types.ros.codec import MeasurementKey, measurement_key
from uwb_mitigation.types.ros.poses import tag_frame
from uwb_mitigation.types.ros.topics import (
    ODOMETRY_TRUTH,
    POSE_SMOOTHED,
    RANGE_CORRECTED,
    RANGE_RAW,
    RANGE_TRUTH,
)
from uwb_mitigation.types.stamps import to_ns
from uwb_mitigation.types.tracks import Estimate, Ranges
from uwb_mitigation.viewer.recording import POSITIONS, Recording
from uwb_mitigation.viewer.scene import MAX_CELLS, MAX_RANGE_M, MAX_TAGS, BoundedDict, Pair, add_heat

MAX_RANGES = 500_000
"""Maximum number of indexed ranges; the rest of the recording has no marks."""
BINS = 300
"""Maximum number of points of the error over time."""
BATCH = 256
"""Number of raw ranges that are corrected at once."""
_KINDS = {ODOMETRY_TRUTH: TrackKind.TRUE, POSE_SMOOTHED: TrackKind.SMOOTHED}


@dataclass(slots=True)
class Timeline:
    """Everything about a recording that does not depend on the position of the player.

    Attributes:
        time_s: time of each range from the beginning, float64 (n,), increasing.
        pairs: pair of each range. bad: bool (n,), whether the status is not OK.
        raw_m, corrected_m, true_m: float64 (n,); NaN: unknown.
        tracks: {(tag, kind): (time_s (k,), positions (k, 3))}.
        estimates: {tag: estimates of the filter}, if the recording contains no positions.
        heat: see `Scene`.
    """

    time_s: NDArray[np.float64]
    pairs: list[Pair]
    bad: NDArray[np.bool_]
    raw_m: NDArray[np.float64]
    corrected_m: NDArray[np.float64]
    true_m: NDArray[np.float64]
    tracks: dict[tuple[str, TrackKind], tuple[NDArray[np.float64], NDArray[np.float64]]] = field(
        default_factory=dict
    )
    estimates: dict[str, list[Estimate]] = field(default_factory=dict)
    heat: BoundedDict[tuple[int, int], list[float]] = field(default_factory=lambda: BoundedDict(MAX_CELLS))

    @property
    def deviation_m(self) -> NDArray[np.float64]:
        """Absolute error of each corrected range; without any truth, the absolute correction. NaN: unknown."""
        known = np.isfinite(self.true_m).any()
        deviation: NDArray[np.float64] = np.abs(self.corrected_m - (self.true_m if known else self.raw_m))
        deviation[~(deviation < MAX_RANGE_M)] = np.nan
        return deviation

    def next_bad(self, position_s: float) -> int | None:
        """Return the row of the first range after a position whose status is not OK."""
        rows = np.flatnonzero(self.bad & (self.time_s > position_s + 1e-6))
        return int(rows[0]) if len(rows) else None

    def largest_error(self) -> int | None:
        """Return the row of the range with the largest `deviation_m`."""
        deviation = self.deviation_m
        return int(np.nanargmax(deviation)) if np.isfinite(deviation).any() else None

    def mean_errors(self, seconds: float) -> dict[str, NDArray[np.float32]]:
        """Return the mean absolute errors over time: `time`, `raw` and `corrected`, float32 (k,)."""
        errors = np.abs(np.stack([self.raw_m - self.true_m, self.corrected_m - self.true_m]))
        known = (errors < MAX_RANGE_M).all(axis=0)
        if not known.any():
            # Without truth, only the size of the corrections is known.
            errors = np.stack([np.full(len(self.time_s), np.nan), self.deviation_m])
            known = np.isfinite(errors[1])
        width_s = max(seconds / BINS, 1.0)
        row = (self.time_s[known] // width_s).astype(np.intp)
        count = np.bincount(row)
        filled = count > 0
        raw, corrected = (np.bincount(row, values)[filled] / count[filled] for values in errors[:, known])
        columns = {"time": (np.flatnonzero(filled) + 0.5) * width_s, "raw": raw, "corrected": corrected}
        return {name: column.astype(np.float32) for name, column in columns.items()}


def index_recording(
    recording: Recording, anchors: AnchorMap | None, height: Height | None, backend: Corrector | None
) -> Timeline:
    """Read a recording.

    Args:
        recording: the bag.
        anchors: for tracks; None: unknown.
        height: of the tags; None: the median of the true heights, or unknown.
        backend: corrects raw ranges; None: the recording contains corrected ranges.
    """
    ranges: list[tuple[MeasurementKey, CorrectedRange]] = []
    batch: list[RangeMeasurement] = []
    truths: dict[MeasurementKey, float] = {}
    points: dict[tuple[str, TrackKind], list[tuple[float, float, float, float]]] = {}

    def seconds(stamp_ns: Any) -> Any:
        return (stamp_ns - recording.start_ns) / 1e9

    def flush() -> None:
        if backend is not None and batch:
            ranges.extend(zip(map(measurement_key, batch), backend.correct(batch), strict=True))
            batch.clear()

    wanted = {RANGE_CORRECTED if backend is None else RANGE_RAW, RANGE_TRUTH, ODOMETRY_TRUTH, *POSITIONS}
    # The player reports the damage of a bag when it reaches it.
    with contextlib.suppress(RecordingError):
        for _, topic, message, tag in recording.events(wanted):
            if len(ranges) >= MAX_RANGES:
                break
            if message is None:
                continue
            if topic == RANGE_CORRECTED:
                ranges.append(message)
            elif topic == RANGE_RAW:
                batch.append(message)
                if len(batch) == BATCH:
                    flush()
            elif topic == RANGE_TRUTH:
                truths[message[0]] = message[1].range_m
            else:
                kind = _KINDS.get(topic, TrackKind.CORRECTED)
                name = str(message.child_frame_id) if kind is TrackKind.TRUE else tag
                at, stamp = message.pose.pose.position, message.header.stamp
                if np.isfinite([at.x, at.y]).all() and (len(points) < 4 * MAX_TAGS or (name, kind) in points):
                    time_s = seconds(to_ns(stamp))
                    points.setdefault((name, kind), []).append((time_s, at.x, at.y, at.z))
    flush()
    ranges.sort(key=lambda row: row[0].stamp_ns)
    keys = [key for key, _ in ranges]
    timeline = Timeline(
        seconds(np.array([key.stamp_ns for key in keys], np.int64)),
        [(key.anchor_id, key.tag_id) for key in keys],
        np.array([corrected.status is not Status.OK for _, corrected in ranges], bool),
        np.array([corrected.range_raw_m for _, corrected in ranges], np.float64),
        np.array([corrected.range_m for _, corrected in ranges], np.float64),
        np.array([truths.get(key, np.nan) for key in keys], np.float64),
    )
    for one, rows in points.items():
        columns = np.array(sorted(rows))
        timeline.tracks[one] = columns[:, 0], columns[:, 1:]
    if anchors is None or not ranges:
        return timeline
    true_z = [
        z for (_, kind), (_, xyz) in timeline.tracks.items() if kind is TrackKind.TRUE for z in xyz[:, 2]
    ]
    if height is None and np.isfinite(true_z).any():
        height = Height(float(np.nanmedian(true_z)))
    config = EstimatorConfig(anchors, height=height)
    for tag_id in sorted({key.tag_id for key in keys})[:MAX_TAGS]:
        own = [row for row in ranges if row[0].tag_id == tag_id and row[0].anchor_id in anchors.index]
        raw = _ranges([(key, found.range_raw_m, np.nan) for key, found in own], anchors)
        corrected = _ranges([(key, found.range_m, found.variance_m2) for key, found in own], anchors)
        name, tracks = tag_frame(tag_id), {}
        # There may be too few ranges for a track of this tag.
        with contextlib.suppress(DatasetError, IndexError, ValueError):
            tracks[TrackKind.RAW] = snapshot(anchors, raw, height)
            if not recording.contents & POSITIONS:
                tracks[TrackKind.CORRECTED] = live = TagEstimator(config).run(corrected)
                timeline.estimates[name] = list(live)
                tracks[TrackKind.SMOOTHED] = smooth(config, corrected, live)
        for kind, track in tracks.items():
            timeline.tracks[name, kind] = seconds(track.stamp_ns), track.position
    _add_heat(timeline)
    return timeline


def _add_heat(timeline: Timeline) -> None:
    """Add the mean correction along the tracks."""
    tracks = {name: track for (name, kind), track in timeline.tracks.items() if kind is TrackKind.CORRECTED}
    only = next(iter(tracks.values())) if len(tracks) == 1 else None
    for tag_id in {tag_id for _, tag_id in timeline.pairs}:
        track = tracks.get(tag_frame(tag_id)) or only
        if track is None or not len(track[0]):
            continue
        rows = [row for row, pair in enumerate(timeline.pairs) if pair[1] == tag_id]
        x, y = (np.interp(timeline.time_s[rows], track[0], axis) for axis in track[1][:, :2].T)
        correction = timeline.raw_m[rows] - timeline.corrected_m[rows]
        for row in np.flatnonzero(np.abs(correction) < MAX_RANGE_M):
            add_heat(timeline.heat, float(x[row]), float(y[row]), float(correction[row]))


def _ranges(rows: list[tuple[MeasurementKey, float, float]], anchors: AnchorMap) -> Ranges:
    kept = [row for row in rows if 0.0 <= row[1] < MAX_RANGE_M and row[2] != np.inf]
    return Ranges(
        np.array([key.stamp_ns for key, _, _ in kept], np.int64),
        np.array([anchors.index[key.anchor_id] for key, _, _ in kept], np.intp),
        np.array([range_m for _, range_m, _ in kept], np.float64),
        np.array([variance for _, _, variance in kept], np.float64),
        np.full(len(kept), np.nan),
    )
