"""Live, smoothed and snapshot tracks of a recording, with their errors if the ground truth is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.hypotheses import LIMITS, AnchorHypotheses
from uwb_mitigation.errors import DatasetError, format_id
from uwb_mitigation.positioning.batch.smoother import Smoother, smooth
from uwb_mitigation.positioning.determination import Determination, current_determination, drive_determination
from uwb_mitigation.positioning.geometry import dop
from uwb_mitigation.positioning.online.initialization import snapshot
from uwb_mitigation.positioning.online.robot_estimator import RobotEstimator, live_track
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig, TagEstimator
from uwb_mitigation.positioning.track_errors import NO_ERRORS, TrackErrors, track_errors
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.recorded_ranges import TagRecording
from uwb_mitigation.types.ros.poses import (
    BodyTwist,
    encode_odometry,
    encode_pose,
    encode_true_position,
    tag_frame,
    tag_topic,
)
from uwb_mitigation.types.ros.topics import ODOMETRY, ODOMETRY_TRUTH, ODOMETRY_TYPE, POSE_SMOOTHED, POSE_TYPE
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Estimate, Ranges, Track, TruePath

KINDS = ("snapshot", "raw_live", "live", "smoothed")
MAX_WITHOUT_POSITION = 0.1
MIN_OTHERS = 3
"""Other anchors that a track without an anchor needs."""

WORSE = 1.1
MIN_COVERAGE = 0.85
MIN_HEIGHT_RMSE_M = 0.1
"""If the truth is known, a warning is given if the RMSE of the smoothed track, horizontal or of the height, exceeds `WORSE`
times the live one (heights: and this minimum); another one if its 95 % ellipses contain a smaller share of the true positions
than `MIN_COVERAGE`."""


@dataclass(frozen=True, slots=True, eq=False)
class TagTracks:
    """The tracks of one tag and their errors; `NO_ERRORS` if the truth is unknown.

    Attributes:
        recording: the input.
        live: an estimate for each range, from this and earlier ranges. raw_live: the same filter on raw ranges.
        smoothed: ten per second, from all ranges. snapshot: least squares on raw ranges.
        errors: errors of each of the `KINDS`.
        hdop: median horizontal dilution of precision along the track.
        determination: how well the position is determined, most of the time.
        warnings: reasons why the tracks may be unreliable; empty = none.
    """

    recording: TagRecording
    live: Track
    raw_live: Track
    smoothed: Track
    snapshot: Track
    errors: dict[str, TrackErrors]
    hdop: float
    determination: Determination
    warnings: list[str]

    def as_json(self) -> dict[str, object]:
        """Return the entry of a tag in `track --json`; it contains errors only if the truth is known."""
        errors = {kind: self.errors[kind].as_json() for kind in KINDS}
        return {
            "tag_id": self.recording.tag_id,
            "ranges": len(self.recording.ranges),
            **errors["smoothed"],
            "epochs": self.errors["smoothed"].epochs or len(self.smoothed),
            "determination": asdict(self.determination),
            "warnings": self.warnings,
            **(errors if self.errors["live"].epochs else {}),
        }


def track_tag(recording: TagRecording, config: EstimatorConfig) -> TagTracks:
    """Return the tracks of one tag.

    Raises:
        DatasetError: no position of the tag can be determined; the message contains the reason, if the anchors show it.
    """
    ranges, anchors = recording.ranges, config.anchors
    robot = None if config.robot is None else RobotEstimator(config)
    locator = TagEstimator(config) if robot is None else robot.tag
    live = (robot or locator).run(ranges)
    if len(live) < 2:
        raise DatasetError(
            f"tag {format_id(recording.tag_id)}: no position can be determined from {len(ranges)} ranges: "
            f"{current_determination(locator)}"
        )
    tracks = {
        "snapshot": snapshot(anchors, recording.raw, config.height),
        "raw_live": live_track(config, recording.raw) if recording.corrected else live,
        "live": live,
        "smoothed": smooth(config, ranges, live),
    }
    errors = {kind: track_errors(track, recording.truth) for kind, track in tracks.items()}
    sample = tracks["smoothed"].position[:: max(len(tracks["smoothed"]) // 200, 1)]
    used = anchors.position[np.unique(ranges.anchor)]
    level = config.height is not None or config.heights is not None
    hdop = float(np.median([dop(used, position, level=level).hdop for position in sample]))
    determined = drive_determination(locator, ranges, tracks["smoothed"])
    warnings = [] if determined.is_unique else [str(determined)]
    without_position = 1.0 - len(live) / len(ranges)
    if without_position > MAX_WITHOUT_POSITION:
        warnings.append(
            f"no position for {without_position:.0%} of the ranges, because several positions explain them or too few anchors "
            "were received"
        )
    if robot is not None and (times := robot.tag.counts["odometry wrong"]):
        warnings.append(
            f"odometry contradicted the ranges {times} times and was not used then: wheels that slip, a robot moved by hand, "
            "wrong axes, scale or signs"
        )
    warnings += _smoothing_warnings(errors["live"], errors["smoothed"])
    return TagTracks(
        recording, **tracks, errors=errors, hdop=hdop, determination=determined, warnings=warnings
    )


def _smoothing_warnings(live: TrackErrors, smoothed: TrackErrors) -> list[str]:
    warnings = []
    if smoothed.rmse > WORSE * live.rmse:
        warnings.append(
            f"smoothing increases the RMSE from {live.rmse:.3f} m to {smoothed.rmse:.3f} m. Use the live track"
        )
    if smoothed.height_rmse > WORSE * max(live.height_rmse, MIN_HEIGHT_RMSE_M):
        warnings.append(
            f"smoothing increases the RMSE of the height from {live.height_rmse:.3f} m to {smoothed.height_rmse:.3f} m. Use "
            "the live track"
        )
    if smoothed.coverage95 < MIN_COVERAGE:
        warnings.append(
            f"the covariances of the smoothed track are too small: its 95 % ellipses contain {smoothed.coverage95:.0%} of the "
            "true positions"
        )
    return warnings


@dataclass(frozen=True, slots=True)
class HoldoutErrors:
    """Medians of absolute held-out residuals, m; NaN: unknown.

    Attributes:
        anchor_id: None = all anchors.
        ranges: the number of residuals.
        raw_m, corrected_m: of measured and of corrected ranges; corrected NaN if the bag has none.
        is_displaced: whether another position of the anchor explains the ranges much better.
    """

    anchor_id: int | None
    ranges: int
    raw_m: float
    corrected_m: float
    is_displaced: bool = False


def held_out(tracks: Sequence[TagTracks], config: EstimatorConfig) -> list[HoldoutErrors]:
    """Return the held-out residuals of each anchor, and of all anchors last.

    The ranges of each anchor are compared with a track that was estimated without this anchor. This needs no ground truth,
    and a wrong offset of an anchor cannot hide, because its own ranges do not move the track.
    """
    raw = [(tag.live, tag.recording.raw) for tag in tracks]
    corrected = [(tag.live, tag.recording.ranges) for tag in tracks if tag.recording.corrected]
    rows, of_all = [], (np.zeros(0), np.zeros(0))
    for row, anchor in enumerate(config.anchors.anchors):
        before, displaced = _residuals(raw, row, config)
        after, displaced_after = _residuals(corrected, row, config)
        rows.append(
            HoldoutErrors(
                anchor.id,
                len(before),
                _median(before),
                _median(after),
                displaced_after if corrected else displaced,
            )
        )
        of_all = np.append(of_all[0], before), np.append(of_all[1], after)
    return [*rows, HoldoutErrors(None, len(of_all[0]), _median(of_all[0]), _median(of_all[1]))]


def _residuals(
    recorded: list[tuple[Track, Ranges]], row: int, config: EstimatorConfig
) -> tuple[NDArray[np.float64], bool]:
    """Return range minus distance of an anchor's ranges, where the track of the others is known.

    Also return whether another position of the anchor explains the ranges of a tag much better.
    """
    residuals, displaced = [np.zeros(0)], False
    for initial, ranges in recorded:
        mask = ranges.anchor == row
        reference = np.unique(ranges.anchor[~mask])
        if len(reference) < MIN_OTHERS or not mask.any():
            continue
        track = _track_without([row], initial, ranges, config)
        position = TruePath(track.stamp_ns, track.position).position_at(ranges.stamp_ns[mask])
        residual = ranges.range_m[mask] - np.linalg.norm(position - config.anchors.position[row], axis=1)
        residuals.append(residual[np.isfinite(residual)])
        # A displaced anchor also bends the tracks with which the others are judged: an accusation holds without each of them.
        displaced |= _gain(row, ranges, track, config) > LIMITS.gain and (
            len(reference) == MIN_OTHERS
            or all(
                _gain(row, ranges, _track_without([row, excluded], initial, ranges, config), config)
                > LIMITS.gain / 2.0
                for excluded in reference.tolist()
            )
        )
    return np.concatenate(residuals), displaced


def _gain(row: int, ranges: Ranges, track: Track, config: EstimatorConfig) -> float:
    """Return the gain in log likelihood of another position of an anchor, for a track that was estimated without it."""
    antenna = TruePath(track.stamp_ns, track.position).position_at(ranges.stamp_ns)
    return AnchorHypotheses(config.anchors, ranges, antenna).gain(row, is_independent=True)


def _track_without(rows: list[int], initial: Track, ranges: Ranges, config: EstimatorConfig) -> Track:
    return Smoother(config, ranges.take(~np.isin(ranges.anchor, rows))).fit(initial).track


def _median(residual: NDArray[np.float64]) -> float:
    return float(np.median(np.abs(residual))) if len(residual) else float("nan")


def pooled(errors: list[TrackErrors]) -> TrackErrors:
    """Return the errors of all tags, weighted by epochs; medians and percentiles are means."""
    with_truth = [error for error in errors if error.epochs]
    if not with_truth:
        return NO_ERRORS
    epochs, *columns = np.array([astuple(error) for error in with_truth]).T
    columns[0] = columns[0] ** 2
    rmse, *means = (float(epochs @ column / epochs.sum()) for column in columns)
    return TrackErrors(int(epochs.sum()), float(np.sqrt(rmse)), *means)


def write_tracks(bag: BagWriter, tracks: list[TagTracks]) -> None:
    """Write live estimates to `/uwb/odometry`, smoothed ones to `/uwb/pose_smoothed`, the truth to `/uwb/odometry_truth`.

    With several tags, each tag has separate topics, like those of the node.

    Raises:
        RecordingError: the bag cannot be written.
    """
    messages = sorted(
        (message for track in tracks for message in _messages(track, several=len(tracks) > 1)),
        key=lambda message: message[0],
    )
    for stamp, topic, kind, data in messages:
        bag.write_message(topic, kind, data, stamp)


def _messages(tracks: TagTracks, several: bool) -> Iterator[tuple[int, str, str, bytes]]:
    tag = tracks.recording.tag_id
    name, frame = (tag if several else None), tag_frame(tag)
    for estimate in tracks.live:
        data = encode_odometry(estimate, child_frame_id=frame, twist=_body_twist(estimate))
        yield estimate.stamp_ns, tag_topic(ODOMETRY, name), ODOMETRY_TYPE, data
    for estimate in tracks.smoothed:
        yield estimate.stamp_ns, tag_topic(POSE_SMOOTHED, name), POSE_TYPE, encode_pose(estimate)
    truth = tracks.recording.truth
    yaws = truth.yaw_at(truth.stamp_ns).tolist()
    for stamp, position, yaw in zip(truth.stamp_ns.tolist(), truth.position.tolist(), yaws, strict=True):
        data = encode_true_position(position, tag, stamp, yaw if np.isfinite(yaw) else None)
        yield stamp, ODOMETRY_TRUTH, ODOMETRY_TYPE, data


def _body_twist(estimate: Estimate) -> BodyTwist | None:
    """Return the velocity in the axes of the robot; None: its heading is unknown."""
    if estimate.heading is None:
        return None
    cosine, sine = np.cos(estimate.heading.yaw), np.sin(estimate.heading.yaw)
    vx, vy, _ = estimate.velocity.tolist()
    variance = float(estimate.covariance[[3, 4], [3, 4]].max())
    return BodyTwist(cosine * vx + sine * vy, cosine * vy - sine * vx, speed_variance=variance)


def tum(track: Track) -> str:
    """Return a track in TUM's format: stamp in s, position, and orientation, which is the identity if it is unknown."""
    columns = track.stamp_ns.tolist(), track.position.tolist(), track.orientations_quat_wxyz.tolist()
    return "".join(
        f"{stamp // NS_PER_S}.{stamp % NS_PER_S:09d} {x:.6f} {y:.6f} {z:.6f} {qx:g} {qy:g} {qz:.6f} {qw:.6f}\n"
        for stamp, (x, y, z), (qw, qx, qy, qz) in zip(*columns, strict=True)
    )


def tum_file(path: Path, tag_id: int, several: bool) -> Path:
    """Return the path of a tag's TUM file: `path`, with the tag's number in the name if there are several tags."""
    return path.with_name(f"{path.stem}.{tag_frame(tag_id)}{path.suffix}") if several else path
