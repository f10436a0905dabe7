"""Input and output of the tracks of a recording: settings and ranges from bags, residuals of held-out anchors, files."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.hypotheses import LIMITS, AnchorHypotheses
from uwb_mitigation.errors import RecordingError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.shipped import load_model
from uwb_mitigation.positioning.batch.smoother import Smoother
from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.recorded_tracks import TagTracks
from uwb_mitigation.positioning.track_settings import TrackSettings
from uwb_mitigation.recordings.bag.odometry import BASE_LINK, read_imu, read_odometry
from uwb_mitigation.recordings.bag.pose_paths import read_heights, read_lever_arm, read_range_frame
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.offsets import NO_OFFSETS
from uwb_mitigation.types.ros import poses
from uwb_mitigation.types.ros.topics import ODOMETRY, ODOMETRY_TRUTH, ODOMETRY_TYPE, POSE_SMOOTHED, POSE_TYPE
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Estimate, Ranges, Track, TruePath

MIN_OTHERS = 3
"""Other anchors that a track without an anchor needs."""


def mitigation(settings: TrackSettings) -> Mitigation:
    """Return what corrects the raw ranges of a recording.

    Raises:
        ModelError: the model cannot be loaded.
    """
    return Mitigation(load_model(settings.model), settings.offsets or NO_OFFSETS, median_at_rest=True)


def read_config(
    bag: Path, anchors: AnchorMap, settings: TrackSettings, warn: Callable[[str], object] = warnings.warn
) -> EstimatorConfig:
    """Return the configuration of the estimators, with measured heights and the motion of the robot from the bag.

    Args:
        bag: the recording.
        anchors: its anchors.
        settings: the options.
        warn: called with a warning if the lever arm is unknown.

    Raises:
        RecordingError: the bag cannot be read, or a topic is missing.
    """
    if not bag.exists():
        raise RecordingError("no such bag", where=bag, valid="an MCAP bag")
    topic = settings.height_topic
    heights = None if topic is None else read_heights(bag, topic, settings.height_sd_m)
    return settings.config(anchors, heights, _read_robot(bag, settings, warn))


def _read_robot(bag: Path, settings: TrackSettings, warn: Callable[[str], object]) -> RobotData | None:
    if settings.odometry is None:
        return None
    arm = settings.lever_arm_m
    if arm is None:
        frame = read_range_frame(bag)
        arm = read_lever_arm(bag, BASE_LINK, frame)
        if arm is None and frame.lstrip("/") != BASE_LINK:
            antenna = frame or "the antenna (ranges without frame_id)"
            warn(
                f"lever arm of the antenna unknown, 0,0,0 is used: no transform from {BASE_LINK} to {antenna} in the bag. Set "
                "--lever-arm X,Y,Z"
            )
    motion, imu = read_odometry(bag, settings.odometry), settings.imu
    return RobotData(motion, None if imu is None else read_imu(bag, imu), arm or (0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class HoldoutErrors:
    """Medians of absolute held-out residuals, m; NaN: unknown.

    Attributes:
        anchor_id: None = all anchors.
        ranges: the number of residuals.
        raw_m, corrected_m: of measured and of corrected ranges; corrected NaN if the bag has none.
        fitted: the anchor at another position that explains the ranges much better; None: there is none.
    """

    anchor_id: int | None
    ranges: int
    raw_m: float
    corrected_m: float
    fitted: Anchor | None = None


def held_out(tracks: Sequence[TagTracks], config: EstimatorConfig) -> list[HoldoutErrors]:
    """Return the held-out residuals of each anchor, and of all anchors last.

    The ranges of each anchor are compared with a track that was estimated without this anchor. This needs no ground truth,
    and a wrong offset of an anchor cannot hide, because its own ranges do not move the track.
    """
    raw = [(tag.live, tag.recording.raw) for tag in tracks]
    corrected = [(tag.live, tag.recording.ranges) for tag in tracks if tag.recording.corrected]
    rows, of_all = [], (np.zeros(0), np.zeros(0))
    for row, anchor in enumerate(config.anchors.anchors):
        before, fitted = _residuals(raw, row, config)
        after, fitted_after = _residuals(corrected, row, config)
        medians_m = _median(before), _median(after)
        rows.append(HoldoutErrors(anchor.id, len(before), *medians_m, fitted_after if corrected else fitted))
        of_all = np.append(of_all[0], before), np.append(of_all[1], after)
    return [*rows, HoldoutErrors(None, len(of_all[0]), _median(of_all[0]), _median(of_all[1]))]


def displaced_anchor(tracks: Sequence[TagTracks], config: EstimatorConfig) -> dict[int, tuple[float, Anchor]]:
    """Return `worst_displaced` of the held-out residuals of tracks."""
    return worst_displaced(held_out(tracks, config))


def worst_displaced(residuals: Sequence[HoldoutErrors]) -> dict[int, tuple[float, Anchor]]:
    """Return {anchor id: (median held-out residual, m, the anchor at the position that its ranges fit)}; empty: none.

    Of several, it is the one with the largest residual: a displaced anchor also bends the tracks without the others. Of four
    anchors, several accusations contradict each other: blocked ranges of one bend the three tracks without the others.
    """
    displaced = [(row.raw_m, row.fitted) for row in residuals if row.fitted is not None]
    num_anchors = sum(row.anchor_id is not None and row.ranges > 0 for row in residuals)
    if not displaced or (len(displaced) > 1 and num_anchors <= MIN_OTHERS + 1):
        return {}
    worst = max(displaced, key=lambda row: row[0])
    return {worst[1].id: worst}


def _residuals(
    recorded: list[tuple[Track, Ranges]], row: int, config: EstimatorConfig
) -> tuple[NDArray[np.float64], Anchor | None]:
    """Return range minus distance of an anchor's ranges, where the track of the others is known.

    Also return the anchor at another position that explains the ranges of a tag much better, or None.
    """
    residuals, fitted = [np.zeros(0)], list[tuple[float, Anchor]]()
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
        gain, anchor = _fit(row, ranges, track, config)
        if gain > LIMITS.gain and (
            len(reference) == MIN_OTHERS
            or all(
                _fit(row, ranges, _track_without([row, excluded], initial, ranges, config), config)[0]
                > LIMITS.gain / 2.0
                for excluded in reference.tolist()
            )
        ):
            fitted.append((gain, anchor))
    return np.concatenate(residuals), max(fitted, key=lambda fit: fit[0], default=(0.0, None))[1]


def _fit(row: int, ranges: Ranges, track: Track, config: EstimatorConfig) -> tuple[float, Anchor]:
    """Return `gain` and `fitted` of an anchor, for a track that was estimated without it."""
    antenna = TruePath(track.stamp_ns, track.position).position_at(ranges.stamp_ns)
    hypotheses = AnchorHypotheses(config.anchors, ranges, antenna)
    gain = hypotheses.gain(row, is_independent=True)
    return gain, hypotheses.fitted(row) if gain else config.anchors.anchors[row]


def _track_without(rows: list[int], initial: Track, ranges: Ranges, config: EstimatorConfig) -> Track:
    return Smoother(config, ranges.take(~np.isin(ranges.anchor, rows))).fit(initial).track


def _median(residual: NDArray[np.float64]) -> float:
    return float(np.median(np.abs(residual))) if len(residual) else float("nan")


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
    name, frame = (tag if several else None), poses.tag_frame(tag)
    for estimate in tracks.live:
        data = poses.encode_odometry(estimate, child_frame_id=frame, twist=_body_twist(estimate))
        yield estimate.stamp_ns, poses.tag_topic(ODOMETRY, name), ODOMETRY_TYPE, data
    for estimate in tracks.smoothed:
        yield estimate.stamp_ns, poses.tag_topic(POSE_SMOOTHED, name), POSE_TYPE, poses.encode_pose(estimate)
    truth = tracks.recording.truth
    yaws = truth.yaw_at(truth.stamp_ns).tolist()
    for stamp, position, yaw in zip(truth.stamp_ns.tolist(), truth.position.tolist(), yaws, strict=True):
        data = poses.encode_true_position(position, tag, stamp, yaw if np.isfinite(yaw) else None)
        yield stamp, ODOMETRY_TRUTH, ODOMETRY_TYPE, data


def _body_twist(estimate: Estimate) -> poses.BodyTwist | None:
    """Return the velocity in the axes of the robot; None: its heading is unknown."""
    if estimate.heading is None:
        return None
    cosine, sine = np.cos(estimate.heading.yaw), np.sin(estimate.heading.yaw)
    vx, vy, _ = estimate.velocity.tolist()
    variance = float(estimate.covariance[[3, 4], [3, 4]].max())
    return poses.BodyTwist(cosine * vx + sine * vy, cosine * vy - sine * vx, speed_variance=variance)


def tum(track: Track) -> str:
    """Return a track in TUM's format: stamp in s, position, and orientation, which is the identity if it is unknown."""
    columns = track.stamp_ns.tolist(), track.position.tolist(), track.orientations_quat_wxyz.tolist()
    return "".join(
        f"{stamp // NS_PER_S}.{stamp % NS_PER_S:09d} {x:.6f} {y:.6f} {z:.6f} {qx:g} {qy:g} {qz:.6f} {qw:.6f}\n"
        for stamp, (x, y, z), (qw, qx, qy, qz) in zip(*columns, strict=True)
    )


def tum_file(path: Path, tag_id: int, several: bool) -> Path:
    """Return the path of a tag's TUM file: `path`, with the tag's number in the name if there are several tags."""
    return path.with_name(f"{path.stem}.{poses.tag_frame(tag_id)}{path.suffix}") if several else path
