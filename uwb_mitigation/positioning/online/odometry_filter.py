"""The filter of a robot with odometry: position and heading of its base, one range at a time.

State: position of the base (0-2), yaw (3), relative error of distances (4), drift of the yaw (5), relative error of rotations (6),
and the errors of the ranges as in `robust_update`. Odometry is the motion model, and ranges are predicted for the antenna, which
has a lever arm. The persisting errors decay with the distance driven: they change as the tag moves, so that a stationary
robot does not take repeated errors for new information.
"""

from __future__ import annotations

import copy
import math
from operator import le, sub

import numpy as np

from uwb_mitigation.positioning.geometry import Area
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning, PathPoint
from uwb_mitigation.positioning.online.filter import RangeFilter
from uwb_mitigation.positioning.online.robust_update import COVARIANCE_SCALE, SHORTEST_M
from uwb_mitigation.types.anchors import AnchorMap

YAW, SCALE, DRIFT, TURN, MOTION = 3, 4, 5, 6, 7

SCALE_SD = 0.05
"""Standard deviation of the constant relative error of distances: wheel diameters."""

STATIONARY_S = 30.0
"""Range errors of a stationary robot change in about this time: people and doors move."""

WALKING_SPEED = 1.0
"""The time constant of range errors is for this speed, m/s."""


class OdometryFilter:
    """Extended Kalman filter of the position and yaw of a robot's base.

    Args:
        anchors, model: as in `RangeFilter`.
        start: filter of the antenna's position at the time of `point`.
        point: of the integrated odometry.
        lever_arm: the antenna in the frame of the base, m.
        yaw: prior of the yaw and its standard deviation, rad.

    Attributes:
        time_s: of the state, s.
        point: at the time of the state.
        state: mean, covariance and updates.
    """

    __slots__ = ("_F", "_anchors", "_lever_arm", "_model", "point", "state", "time_s")

    def __init__(
        self,
        anchors: AnchorMap,
        model: NoiseModel,
        start: RangeFilter,
        point: PathPoint,
        lever_arm: tuple[float, float, float],
        yaw: tuple[float, float],
    ) -> None:
        self._anchors: list[list[float]] = anchors.position.tolist()
        self._model, self._F = model, np.eye(MOTION)
        self.time_s, self.point, self._lever_arm = start.time_s, point, lever_arm
        motion = np.zeros(MOTION)
        motion[:3], motion[YAW] = start.position, yaw[0]
        self.state = start.state.replace_motion(motion)
        self.state.estimates_errors = True
        x, P = self.state.x, self.state.P
        P[range(YAW, MOTION), range(YAW, MOTION)] = yaw[1] ** 2, SCALE_SD**2, 1.0, 1.0
        # The range filter knows the antenna, and the base is at antenna - arm(yaw).
        arm_x, arm_y = self._arm(yaw[0])
        x[:3] -= arm_x, arm_y, lever_arm[2]
        P[:2] += np.multiply.outer((arm_y, -arm_x), P[YAW])
        P[:, :2] += np.multiply.outer(P[:, YAW], (arm_y, -arm_x))

    def copy(self) -> OdometryFilter:
        """Return an independent copy."""
        twin = copy.copy(self)
        twin.state = self.state.copy()
        return twin

    def advance(self, time_s: float, point: PathPoint) -> None:
        """Predict the state at a later time, with the motion of the odometry; an earlier time has no effect."""
        dt, before = time_s - self.time_s, self.point
        if dt <= 0.0:
            return
        self.time_s, self.point = time_s, point
        state, F = self.state, self._F
        x, P = state.x_items, state.P_items
        _, dx, dy, turned, distance, drift, turn, of_position, of_yaw, source = map(sub, point, before)
        if source:
            # The errors of wheels say nothing about those of an IMU.
            for index in (DRIFT, TURN):
                x[index] = state.P[index] = state.P[:, index] = 0.0
                P[index, index] = 1.0
        east, north, _, yaw, scale, yaw_drift, yaw_turn = x[:MOTION]
        dx, dy = _rotated(dx, dy, yaw - before.yaw)
        scale += 1.0
        if distance or drift or turn:
            # The position depends on the yaw before.
            F[0, YAW], F[0, SCALE] = -scale * dy, dx
            F[1, YAW], F[1, SCALE] = scale * dx, dy
            F[YAW, DRIFT], F[YAW, TURN] = drift, turn
            state.predict_motion(F)
        x[0], x[1] = east + scale * dx, north + scale * dy
        x[YAW] = yaw + turned + drift * yaw_drift + turn * yaw_turn
        # Sums are smaller than before if they were extrapolated.
        if of_position > 0.0:
            P[0, 0] += of_position
            P[1, 1] += of_position
        if of_yaw > 0.0:
            P[YAW, YAW] += of_yaw
        elapsed = dt / STATIONARY_S
        if distance > 0.0:
            elapsed += distance / (self._model.persistence_s * WALKING_SPEED)
        state.predict_errors(elapsed)

    def update(
        self, anchor: int, range_m: float, variance_m2: float, is_corrected: bool
    ) -> tuple[float, float]:
        """Update with a finite range at the time of the state; see `RobustUpdate.update_range`."""
        # Python numbers are faster here than NumPy.
        state, (u, v, w) = self.state, self._anchors[anchor]
        x, y, z, yaw = state.x_items[:SCALE]
        arm_x, arm_y = self._arm(yaw)
        x, y, z = x + arm_x - u, y + arm_y - v, z + self._lever_arm[2] - w
        distance = math.sqrt(x * x + y * y + z * z)
        divisor, H = distance if distance > SHORTEST_M else SHORTEST_M, state.H_items
        H[0], H[1], H[2] = x / divisor, y / divisor, z / divisor
        H[YAW] = (y * arm_x - x * arm_y) / divisor
        return state.update_range(anchor, range_m, distance, variance_m2, is_corrected)

    def set_height(self, height_m: float, variance_m2: float) -> None:
        """Set the height of the antenna: the odometry is horizontal, so that ranges only determine it."""
        P = self.state.P
        P[2] = P[:, 2] = 0.0
        self.state.x[2], P[2, 2] = height_m - self._lever_arm[2], variance_m2

    def confine(self, area: Area) -> None:
        """Move the antenna into a box."""
        antenna = self.antenna
        if all(map(le, area.low, antenna)) and all(map(le, antenna, area.high)):
            return
        nearest, arm = area.clip(np.array(antenna)), np.subtract(antenna, self.state.x[:3])
        for axis in np.flatnonzero(nearest != antenna).tolist():
            self.state.project(axis, float(nearest[axis] - arm[axis]))
        # The projection has turned the lever arm.
        self.state.x[:3] += area.clip(np.array(self.antenna)) - self.antenna

    def velocity(self, odometry: DeadReckoning, yaw_variance: float) -> tuple[float, float, float]:
        """Return the velocity of the antenna (m/s) and its variance in each axis (m^2/s^2), with the latest twist of the odometry.

        The variance of the published heading is given in rad^2.
        """
        (x, y, yaw_rate), yaw = odometry.twist or (0.0, 0.0, 0.0), self.state.x.item(YAW)
        (vx, vy), (arm_x, arm_y) = _rotated(x, y, yaw), self._arm(yaw)
        variance = odometry.twist_variance[0] + yaw_variance * (x * x + y * y)
        return vx - yaw_rate * arm_y, vy + yaw_rate * arm_x, variance

    def published(self) -> tuple[float, ...]:
        """Return x and y of the antenna and the yaw, and their covariance: xx, xy, yy, x yaw, y yaw, yaw yaw (m, rad)."""
        (x, y, _, yaw), P = self.state.x_items[:SCALE], self.state.P_items
        xx, xy, yy, x_yaw, y_yaw, yaw_yaw = P[0, 0], P[0, 1], P[1, 1], P[0, YAW], P[1, YAW], P[YAW, YAW]
        arm_x, arm_y = self._arm(yaw)
        # Only the position: the heading depends on the odometry more than on errors of ranges.
        scale = COVARIANCE_SCALE
        root = math.sqrt(scale)
        return (
            x + arm_x,
            y + arm_y,
            yaw,
            scale * (xx - 2.0 * arm_y * x_yaw + arm_y * arm_y * yaw_yaw),
            scale * (xy + arm_x * x_yaw - arm_y * y_yaw - arm_x * arm_y * yaw_yaw),
            scale * (yy + 2.0 * arm_x * y_yaw + arm_x * arm_x * yaw_yaw),
            root * (x_yaw - arm_y * yaw_yaw),
            root * (y_yaw + arm_x * yaw_yaw),
            yaw_yaw,
        )

    @property
    def antenna(self) -> tuple[float, float, float]:
        """Position of the antenna, m."""
        x, y, z, yaw = self.state.x_items[:SCALE]
        arm_x, arm_y = self._arm(yaw)
        return x + arm_x, y + arm_y, z + self._lever_arm[2]

    @property
    def yaw(self) -> float:
        """Yaw of the base, rad."""
        return self.state.x_items[YAW]

    @property
    def yaw_variance(self) -> float:
        """Variance of the yaw, rad^2."""
        return self.state.P_items[YAW, YAW]

    def _arm(self, yaw: float) -> tuple[float, float]:
        """Return the horizontal lever arm in the axes of the map."""
        x, y, _ = self._lever_arm
        return (0.0, 0.0) if x == y == 0.0 else _rotated(x, y, yaw)


def _rotated(x: float, y: float, angle: float) -> tuple[float, float]:
    cosine, sine = math.cos(angle), math.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y
