"""The tracks of a recording: as told live, smoothed afterwards, and by snapshots, each judged where truth is known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwb_mitigation.bag.poses import encode_odometry, encode_pose, tag_frame, tag_topic
from uwb_mitigation.bag.topics import (
    ODOMETRY,
    ODOMETRY_TRUTH,
    ODOMETRY_TYPE,
    POSE_SMOOTHED,
    POSE_TYPE,
)
from uwb_mitigation.bag.writer import BagWriter
from uwb_mitigation.errors import DatasetError, format_id
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import Area, Height, Shape, geometry, shape
from uwb_mitigation.positioning.locator import TagLocator, run_live
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.smoother import smooth
from uwb_mitigation.positioning.start import snapshot
from uwb_mitigation.positioning.tracks import (
    NO_ERRORS,
    Estimate,
    Heights,
    Ranges,
    Track,
    TrackErrors,
    track_errors,
)
from uwb_mitigation.sources.recorded_ranges import TagRecording

KINDS = ("live", "smoothed", "snapshot")
POOR_HDOP = 10.0
CONTRADICTION_M = 0.4
"""NLOS errors of the other anchors move their track by up to about this much."""

WORSE = 1.1
MIN_COVERAGE = 0.85
MIN_HEIGHT_RMSE_M = 0.1
"""If the truth is known, smoothing has failed if its horizontal RMSE or that of the height exceeds `WORSE` times the live one
(heights: and this minimum), or its 95 % ellipses contain a smaller share of the true positions than `MIN_COVERAGE`."""


@dataclass(frozen=True, slots=True, eq=False)
class TagTracks:
    """The tracks of one tag, and their errors; `NO_ERRORS` where the truth is not known.

    Attributes:
        recording: what they were made of.
        live: an estimate for each range, without looking ahead. smoothed: ten a second, looking ahead.
        snapshot: least squares on raw ranges.
        live_errors, smoothed_errors, snapshot_errors: beside the truth.
        hdop: median horizontal dilution of precision along the track.
        disagreeing: rows of anchors whose ranges contradict the track of the other anchors.
        warnings: What makes the tracks unreliable; empty = nothing found.
    """

    recording: TagRecording
    live: Track
    smoothed: Track
    snapshot: Track
    live_errors: TrackErrors
    smoothed_errors: TrackErrors
    snapshot_errors: TrackErrors
    hdop: float
    disagreeing: list[int]
    warnings: list[str]

    def as_json(self, anchors: AnchorMap) -> dict[str, object]:
        """A tag of `track --json`; the errors of each kind of track only if the truth is known."""
        errors = {kind: getattr(self, f"{kind}_errors").as_json() for kind in KINDS}
        return {
            "tag_id": self.recording.tag_id,
            "ranges": len(self.recording.ranges),
            **self.smoothed_errors.as_json(),
            "epochs": self.smoothed_errors.epochs or len(self.smoothed),
            "warnings": self.warnings,
            "disagreeing": [anchors.anchors[row].id for row in self.disagreeing],
            **(errors if self.live_errors.epochs else {}),
        }


def track_tag(
    recording: TagRecording,
    anchors: AnchorMap,
    model: Model,
    height: Height | None = None,
    area: Area | None = None,
    heights: Heights | None = None,
) -> TagTracks:
    """The tracks of one tag.

    Raises:
        DatasetError: no place of the tag can be told: says why, as far as the anchors show it.
    """
    ranges = recording.ranges
    locator = TagLocator(anchors, model, height=height, area=area)
    live = run_live(ranges, locator, heights).track
    if len(live) < 2:
        raise DatasetError(*_nowhere(recording, anchors, locator, height or heights))
    smoothed = smooth(anchors, model, ranges, live, height=height, area=area, heights=heights)
    snapshots = snapshot(anchors, recording.raw, height)
    truth = recording.truth
    of_live, of_smoothed, of_snapshots = (
        track_errors(track, truth) if len(truth) else NO_ERRORS for track in (live, smoothed, snapshots)
    )
    sample = smoothed.position[:: max(len(smoothed) // 200, 1)]
    used = anchors.position[np.unique(ranges.anchor)]
    level = height is not None or heights is not None
    hdop = float(np.median([geometry(used, place, level=level).hdop for place in sample]))
    warnings = []
    if not hdop <= POOR_HDOP:
        warnings.append(
            f"poor geometry: median HDOP {hdop:.0f}. The anchors are {shape(used).value}. "
            "Place anchors on more sides of the tag"
        )
    share = len(live) / len(ranges)
    if share < 0.9:
        warnings.append(
            f"no position for {1.0 - share:.0%} of the ranges, because several positions explain them or too few anchors "
            "were received. Give a height or an area"
        )
    if (
        of_smoothed.rmse > WORSE * of_live.rmse
        or of_smoothed.height_rmse > WORSE * max(of_live.height_rmse, MIN_HEIGHT_RMSE_M)
        or of_smoothed.coverage95 < MIN_COVERAGE
    ):
        warnings.append(
            f"smoothing failed: RMSE {of_smoothed.rmse:.3f} m (live {of_live.rmse:.3f} m), height "
            f"{of_smoothed.height_rmse:.3f} m (live {of_live.height_rmse:.3f} m), {of_smoothed.coverage95:.0%} of the true "
            "positions in the 95 % ellipses. Use the live track"
        )

    def live_without(row: int) -> Track:
        others = ranges.take(ranges.anchor != row)
        return run_live(others, TagLocator(anchors, model, height=height, area=area), heights).track

    # A locator accuses by its last ranges only: evidence comes from the whole recording.
    odd = [row for row in locator.disagreeing() if contradicts(anchors, ranges, row, live_without(row))]
    return TagTracks(
        recording, live, smoothed, snapshots, of_live, of_smoothed, of_snapshots, hdop, odd, warnings
    )


def contradicts(anchors: AnchorMap, ranges: Ranges, row: int, others: Track) -> bool:
    """Whether an anchor's ranges contradict the track that was estimated without them.

    A blocked line of sight makes some ranges too long, which is a long tail: the shortest residuals still fit. A wrong
    anchor position or offset shifts all residuals, or makes many ranges too short, which no obstacle does.
    """
    own = ranges.anchor == row
    if len(others) < 2 or not own.any() or own.all():
        return False
    position = np.stack(
        [np.interp(ranges.stamp_ns, others.stamp_ns, axis) for axis in others.position.T], axis=1
    )
    residual = ranges.range_m - np.linalg.norm(position - anchors.position[ranges.anchor], axis=1)
    low = float(np.percentile(residual[own], 20.0) - np.median(residual[~own]))
    return abs(low) > CONTRADICTION_M


def _nowhere(
    recording: TagRecording, anchors: AnchorMap, locator: TagLocator, height: Height | Heights | None
) -> tuple[str]:
    used = anchors.position[np.unique(recording.ranges.anchor)]
    what = f"tag {format_id(recording.tag_id)}: no place can be told from {len(recording.ranges)} ranges"
    if locator.candidates > 1:
        what += f": {locator.candidates} places are as good"
    needed = 3 if height is not None else 4
    kind = shape(used)
    if locator.undetermined:
        what += ": the ranges do not determine it"
    if len(used) < needed:
        what += f"; {len(used)} anchors were heard, {needed} are needed"
    if kind in (Shape.LINE, Shape.POINT) or (kind is Shape.PLANE and height is None):
        what += f"; the anchors are {kind.value}: give a height or an area that leaves one place"
    return (what,)


def pooled(errors: list[TrackErrors]) -> TrackErrors:
    """Errors of several tags as if of one: weighted by epochs; medians and percentiles are means of theirs."""
    known = [one for one in errors if one.epochs]
    if not known:
        return NO_ERRORS
    weight = np.array([one.epochs for one in known], float)
    weight /= weight.sum()

    def mean(name: str) -> float:
        return float(weight @ np.array([getattr(one, name) for one in known]))

    rmse = float(np.sqrt(weight @ np.array([one.rmse**2 for one in known])))
    return TrackErrors(
        sum(one.epochs for one in known),
        rmse,
        *(mean(name) for name in ("median", "p95", "coverage95", "nees_per_dof", "exceeded", "height_rmse")),
    )


def write_tracks(bag: BagWriter, tracks: list[TagTracks]) -> None:
    """Live estimates to `/uwb/odometry`, smoothed ones to `/uwb/pose_smoothed`, the truth to `/uwb/odometry_truth`.

    Of several tags, each has topics of its own, as from the node.

    Raises:
        RecordingError: the bag cannot be written.
    """
    messages = sorted(
        (message for one in tracks for message in _messages(one, several=len(tracks) > 1)),
        key=lambda message: message[0],
    )
    for stamp, topic, kind, data in messages:
        bag.write_message(topic, kind, data, stamp)


def _messages(one: TagTracks, several: bool) -> Iterator[tuple[int, str, str, bytes]]:
    tag = one.recording.tag_id
    name, frame = (tag if several else None), tag_frame(tag)
    for estimate in _estimates(one.live):
        data = encode_odometry(estimate, child_frame_id=frame)
        yield estimate.stamp_ns, tag_topic(ODOMETRY, name), ODOMETRY_TYPE, data
    for estimate in _estimates(one.smoothed):
        yield estimate.stamp_ns, tag_topic(POSE_SMOOTHED, name), POSE_TYPE, encode_pose(estimate)
    truth = one.recording.truth
    for stamp, place in zip(truth.stamp_ns.tolist(), truth.position, strict=True):
        exact = Estimate(stamp, place, np.zeros(3), np.zeros((6, 6)))
        yield stamp, ODOMETRY_TRUTH, ODOMETRY_TYPE, encode_odometry(exact, child_frame_id=frame)


def _estimates(track: Track) -> list[Estimate]:
    columns = zip(track.stamp_ns.tolist(), track.position, track.velocity, track.covariance, strict=True)
    return [Estimate(*row) for row in columns]


def tum(track: Track) -> str:
    """A track in TUM's format: stamp in s, position, orientation as a quaternion (none: ranges do not tell it)."""
    lines = (
        f"{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d} {x:.6f} {y:.6f} {z:.6f} 0 0 0 1\n"
        for stamp, (x, y, z) in zip(track.stamp_ns.tolist(), track.position.tolist(), strict=True)
    )
    return "".join(lines)


def tum_file(path: Path, tag_id: int, several: bool) -> Path:
    """Where the TUM file of a tag goes: `path`, or with the tag's number in its name where there are several."""
    return path.with_name(f"{path.stem}.{tag_frame(tag_id)}{path.suffix}") if several else path
