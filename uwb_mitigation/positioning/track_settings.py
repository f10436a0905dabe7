"""The options that decide the tracks of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.tracks import Heights

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
        model, offsets: correct raw ranges: file or name of a model (None: the shipped ones), and offsets of the radios (None: 0).

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
    offsets: Offsets | float | str | Path | None = None

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
