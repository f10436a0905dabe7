"""Prior knowledge with which positions are estimated."""

from __future__ import annotations

from dataclasses import dataclass, field

from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Heights, Imu, Odometry


@dataclass(frozen=True, slots=True, eq=False)
class RobotData:
    """Recorded motion of a robot, and its antenna.

    Attributes:
        odometry, imu: recorded; None: none, or live.
        lever_arm: the antenna in the frame of the base, m.
        is_verified: the heading was confirmed before, so that the odometry has no fault.
    """

    odometry: Odometry | None = None
    imu: Imu | None = None
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_verified: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorConfig:
    """Prior knowledge: anchors, error model, and of the tags a constant height, an area or measured heights, if any.

    Attributes:
        robot: motion of the robot that carries the tag, if it has odometry.
        widens: published covariances contain constant errors of ranges, and other positions that explain the ranges.
    """

    anchors: AnchorMap
    model: NoiseModel = field(default_factory=NoiseModel)
    height: Height | None = None
    area: Area | None = None
    heights: Heights | None = None
    robot: RobotData | None = None
    widens: bool = True

    @property
    def dims(self) -> int:
        """The number of unknown coordinates of a position."""
        return 2 if self.height is not None else 3
