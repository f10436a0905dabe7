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
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.measurement import format_id
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import Shape, geometry, shape
from uwb_mitigation.positioning.locator import TagLocator, run_live
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.smoother import Smoother
from uwb_mitigation.positioning.snapshot import snapshot
from uwb_mitigation.positioning.start import Area, Height
from uwb_mitigation.positioning.track_errors import NO_ERRORS, TrackErrors, track_errors
from uwb_mitigation.positioning.tracks import Estimate, Track
from uwb_mitigation.sources.recorded_ranges import TagRecording


@dataclass(frozen=True, slots=True, eq=False)
class TagTracks:
    """The tracks of one tag, and their errors; `NO_ERRORS` where the truth is not known.

    Attributes:
        recording: what they were made of.
        live: an estimate for each range, without looking ahead. smoothed: ten a second, looking ahead.
        snapshot: least squares on raw ranges.
        live_errors, smoothed_errors, snapshot_errors: beside the truth.
        hdop: median horizontal dilution of precision along the track.
        disagreeing: rows of anchors that disagree with most others.
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


def track_tag(
    recording: TagRecording,
    anchors: AnchorMap,
    model: Model,
    height: Height | None = None,
    area: Area | None = None,
) -> TagTracks:
    """The tracks of one tag.

    Raises:
        DatasetError: no place of the tag can be told: says why, as far as the anchors show it.
    """
    ranges = recording.ranges
    locator = TagLocator(anchors, model, height=height, area=area)
    live = run_live(ranges, locator).track
    if len(live) < 2:
        raise DatasetError(*_nowhere(recording, anchors, locator, height))
    # What came before the first place was found is smoothed too, from there.
    smoothed = Smoother(anchors, model, ranges, height=height).fit(live).track
    snapshots = snapshot(anchors, recording.raw, height)
    truth = recording.truth
    of_live, of_smoothed, of_snapshots = (
        track_errors(track, truth) if len(truth) else NO_ERRORS for track in (live, smoothed, snapshots)
    )
    sample = smoothed.position[:: max(len(smoothed) // 200, 1)]
    used = anchors.position[np.unique(ranges.anchor)]
    hdop = float(np.median([geometry(used, place, level=height is not None).hdop for place in sample]))
    return TagTracks(
        recording, live, smoothed, snapshots, of_live, of_smoothed, of_snapshots, hdop, locator.disagreeing()
    )


def _nowhere(
    recording: TagRecording, anchors: AnchorMap, locator: TagLocator, height: Height | None
) -> tuple[str]:
    used = anchors.position[np.unique(recording.ranges.anchor)]
    what = f"tag {format_id(recording.tag_id)}: no place can be told from {len(recording.ranges)} ranges"
    if locator.candidates > 1:
        what += f": {locator.candidates} places are as good"
    needed = 3 if height is not None else 4
    kind = shape(used)
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
        *(mean(name) for name in ("median", "p95", "coverage95", "nees_per_dof", "exceeded")),
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
