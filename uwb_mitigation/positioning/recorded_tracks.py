"""The only place that estimates tracks of recordings: live, smoothed and snapshot, with their errors if the truth is known.

The same `TrackSettings` give the same tracks in every command, on the page of the viewer and in Python.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass

import numpy as np

from uwb_mitigation.errors import DatasetError, ParameterError, format_id
from uwb_mitigation.positioning.batch.smoother import smooth
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.determination import (
    UNKNOWN_POSITION,
    Determination,
    current_determination,
    drive_determination,
)
from uwb_mitigation.positioning.geometry import dop
from uwb_mitigation.positioning.online.initialization import snapshot
from uwb_mitigation.positioning.online.robot_estimator import RobotEstimator, live_track
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.positioning.track_errors import NO_ERRORS, TrackErrors, track_errors
from uwb_mitigation.types.tracks import TagRecording, Track

KINDS = ("snapshot", "raw_live", "live", "smoothed")
MAX_WITHOUT_POSITION = 0.1
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


def check_one_tag(config: EstimatorConfig, recordings: Sequence[TagRecording]) -> None:
    """Raise a ParameterError if motion or heights of one tag are given for several."""
    option = "--odometry" if config.robot else "--height-topic" if config.heights is not None else ""
    if option and len(recordings) > 1:
        tags = ", ".join(format_id(recording.tag_id) for recording in recordings)
        raise ParameterError(f"{option} with the tags {tags}", valid="a bag with one tag")


def track_tags(
    recordings: Sequence[TagRecording],
    config: EstimatorConfig,
    on_tag: Callable[[], None] = lambda: None,
) -> tuple[list[TagTracks], list[DatasetError]]:
    """Return the tracks of the tags, and the errors of those without a position; `on_tag` is called after each tag.

    Raises:
        DatasetError: no position of any tag can be determined.
    """
    tracks, failures = list[TagTracks](), list[DatasetError]()
    for recording in recordings:
        try:
            tracks.append(track_tag(recording, config))
        except DatasetError as error:
            failures.append(error)
        on_tag()
    if not tracks:
        raise failures[0]
    return tracks, failures


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
            "wrong axes, scale, signs or lever arm"
        )
    warnings += _smoothing_warnings(errors["live"], errors["smoothed"], is_unique=determined.is_unique)
    return TagTracks(
        recording, **tracks, errors=errors, hdop=hdop, determination=determined, warnings=warnings
    )


def _smoothing_warnings(live: TrackErrors, smoothed: TrackErrors, *, is_unique: bool) -> list[str]:
    warnings = []
    if smoothed.rmse > WORSE * live.rmse:
        warnings.append(
            f"smoothing increases the RMSE from {live.rmse:.3f} m to {smoothed.rmse:.3f} m. Use the live track"
        )
    # Of two mirrored heights, each track has either.
    if is_unique and smoothed.height_rmse > WORSE * max(live.height_rmse, MIN_HEIGHT_RMSE_M):
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
