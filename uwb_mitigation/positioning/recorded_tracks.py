"""The only place that estimates tracks of recordings: live, smoothed and snapshot, with their errors if the truth is known.

The same `TrackSettings` give the same tracks in every command, on the page of the viewer and in Python.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path

import numpy as np

from uwb_mitigation.errors import DatasetError, ParameterError, format_id
from uwb_mitigation.positioning.batch.smoother import smooth
from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.determination import (
    UNKNOWN_POSITION,
    Determination,
    current_determination,
    drive_determination,
)
from uwb_mitigation.positioning.geometry import Area, Height, dop
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.initialization import snapshot
from uwb_mitigation.positioning.online.robot_estimator import RobotEstimator, live_track
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.positioning.track_errors import NO_ERRORS, TrackErrors, track_errors
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets
from uwb_mitigation.types.tracks import Heights, TagRecording, Track

KINDS = ("snapshot", "raw_live", "live", "smoothed")
MAX_WITHOUT_POSITION = 0.1
WORSE = 1.1
MIN_COVERAGE = 0.85
MIN_HEIGHT_RMSE_M = 0.1
"""If the truth is known, a warning is given if the RMSE of the smoothed track, horizontal or of the height, exceeds `WORSE`
times the live one (heights: and this minimum); another one if its 95 % ellipses contain a smaller share of the true positions
than `MIN_COVERAGE`."""


MAX_STAMP_OFFSET_S = 3600.0


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """All options that decide the tracks of a recording.

    Attributes:
        height_m: constant height of the tags in the anchors' frame, m; None: unknown.
        height_sd_m: its standard deviation, and that of measured heights without a variance, m.
        height_topic: topic of measured heights; None: none.
        area: box that contains the tags; None: unknown.
        odometry, imu: topics of the motion of the robot that carries the tag; None: none.
        lever_arm_m: antenna in the frame of the robot, m; None: from the transforms of the recording.
        stamp_offset_s: added to the stamps of the ranges.
        acceleration: of the motion model, see `NoiseModel`.
        model, offsets: correct raw ranges: file or name of a model (None: the shipped ones), and offsets of the radios.

    Raises:
        ParameterError: a value is out of its range, or two options exclude each other.
    """

    height_m: float | None = None
    height_sd_m: float = 0.1
    height_topic: str | None = None
    area: Area | None = None
    odometry: str | None = None
    imu: str | None = None
    lever_arm_m: tuple[float, float, float] | None = None
    stamp_offset_s: float = 0.0
    acceleration: float = NoiseModel().acceleration
    model: Path | None = None
    offsets: Offsets | float | str | Path = NO_OFFSETS

    def __post_init__(self) -> None:
        if not abs(self.stamp_offset_s) <= MAX_STAMP_OFFSET_S:
            raise ParameterError(f"stamp offset {self.stamp_offset_s}", valid="-3600 to 3600 s")
        if self.height_m is not None and self.height_topic is not None:
            raise ParameterError("--height and --height-topic", valid="either of them")
        if self.odometry is None and (self.imu is not None or self.lever_arm_m is not None):
            raise ParameterError("--imu or --lever-arm without --odometry", valid="with --odometry TOPIC")
        # This also checks the standard deviation of measured heights, and the acceleration.
        Height(self.height_m or 0.0, self.height_sd_m)
        NoiseModel(self.acceleration)

    @property
    def height(self) -> Height | None:
        """The constant height with its standard deviation."""
        return None if self.height_m is None else Height(self.height_m, self.height_sd_m)

    def config(
        self, anchors: AnchorMap, heights: Heights | None = None, robot: RobotData | None = None
    ) -> EstimatorConfig:
        """Return the configuration of the estimators, with what a recording contains of measured heights and motion."""
        return EstimatorConfig(anchors, NoiseModel(self.acceleration), self.height, self.area, heights, robot)


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


def check_one_tag(config: EstimatorConfig, recordings: Sequence[TagRecording]) -> None:
    """Raise a ParameterError if motion or heights of one tag are given for several."""
    option = "--odometry" if config.robot else "--height-topic" if config.heights is not None else ""
    if option and len(recordings) > 1:
        tags = ", ".join(format_id(recording.tag_id) for recording in recordings)
        raise ParameterError(f"{option} with the tags {tags}", valid="a bag with one tag")


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
            f"tag {format_id(recording.tag_id)}: {UNKNOWN_POSITION} from {len(ranges)} ranges: {current_determination(locator)}"
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


def pooled(errors: list[TrackErrors]) -> TrackErrors:
    """Return the errors of all tags, weighted by epochs; medians and percentiles are means."""
    with_truth = [error for error in errors if error.epochs]
    if not with_truth:
        return NO_ERRORS
    epochs, *columns = np.array([astuple(error) for error in with_truth]).T
    columns[0] = columns[0] ** 2
    rmse, *means = (float(epochs @ column / epochs.sum()) for column in columns)
    return TrackErrors(int(epochs.sum()), float(np.sqrt(rmse)), *means)
