"""The filter of a robot with odometry: position and heading of its base, one range at a time.

State: position of the base (0-2), yaw (3), relative error of distances (4), drift of the yaw (5), and the same consider states
as in `filter`: the common offset (6) and the persisting error of each anchor (7...). Odometry is the motion model, and ranges
are predicted for the antenna, which has a lever arm. The persisting errors decay with the distance driven: they change as the
tag moves, so that a stationary robot does not take repeated errors for new information.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning, PathPoint
from uwb_mitigation.positioning.online.filter import SHORTEST_M, RangeFilter
from uwb_mitigation.types.tracks import Estimate, Heading

YAW, SCALE, DRIFT = 3, 4, 5

SCALE_SD = 0.05
"""Standard deviation of the constant relative error of distances: wheel diameters."""

SLOPE = 0.1
"""Without a known height, it changes by this share of the distance."""

STATIONARY_S = 30.0
"""Range errors of a stationary robot change in about this time: people and doors move."""

WALKING_SPEED = 1.0
"""The time constant of range errors is for this speed, m/s."""


class OdometryFilter(RangeFilter):
    """Extended Kalman filter of the position and yaw of a robot's base.

    Args:
        start: filter of the antenna's position at the time of `point`.
        point: of the integrated odometry.
        lever_arm: the antenna in the frame of the base, m.
        yaw, yaw_sd: prior of the yaw, rad.

    Attributes:
        point: at the time of the state.
    """

    __slots__ = ("_lever_arm", "point")

    def __init__(
        self,
        start: RangeFilter,
        point: PathPoint,
        lever_arm: tuple[float, float, float],
        yaw: float,
        yaw_sd: float,
    ) -> None:
        start = start.copy()
        for name in RangeFilter.__slots__:
            setattr(self, name, getattr(start, name))
        self.point, self._lever_arm = point, lever_arm
        self.updates_consider_states = True
        self._H[:] = 0.0
        x, P = self.x, self.P
        x[3:6] = yaw, 0.0, 0.0
        P[3:6] = P[:, 3:6] = 0.0
        P[range(3, 6), range(3, 6)] = yaw_sd**2, SCALE_SD**2, 1.0
        # The range filter knows the antenna, and the base is at antenna - arm(yaw).
        arm_x, arm_y = self._arm()
        x[:3] -= arm_x, arm_y, lever_arm[2]
        P[:2] += np.multiply.outer((arm_y, -arm_x), P[YAW])
        P[:, :2] += np.multiply.outer(P[:, YAW], (arm_y, -arm_x))

    def advance(self, time_s: float, point: PathPoint) -> None:
        """Predict the state at a later time, with the motion of the odometry; an earlier time has no effect."""
        dt, before = time_s - self.time_s, self.point
        if dt <= 0.0:
            return
        self.time_s, self.point = time_s, point
        x, P = self.x, self.P
        if point.source != before.source:
            # The drift of wheels says nothing about that of an IMU.
            x[DRIFT] = P[DRIFT] = P[:, DRIFT] = 0.0
            P[DRIFT, DRIFT] = 1.0
        relative = float(x[YAW]) - before.yaw
        cosine, sine = math.cos(relative), math.sin(relative)
        east, north = point.x - before.x, point.y - before.y
        dx, dy = cosine * east - sine * north, sine * east + cosine * north
        distance, drift = max(point.distance_m - before.distance_m, 0.0), point.drift - before.drift
        scale = 1.0 + float(x[SCALE])
        x[0] += scale * dx
        x[1] += scale * dy
        x[YAW] += point.yaw - before.yaw + drift * float(x[DRIFT])
        if distance or drift:
            # The transition matrix is the identity with these elements.
            F = np.array([[-scale * dy, dx], [scale * dx, dy]])
            P[:2] += F @ P[YAW:DRIFT]
            P[YAW] += drift * P[DRIFT]
            P[:, :2] += P[:, YAW:DRIFT] @ F.T
            P[:, YAW] += drift * P[:, DRIFT]
        q = max(point.position_variance - before.position_variance, 0.0)
        P[0, 0] += q
        P[1, 1] += q
        P[YAW, YAW] += max(point.yaw_variance - before.yaw_variance, 0.0)
        if not self._level:
            P[2, 2] += SLOPE**2 * distance
        self._predict_errors(distance / (self._model.persistence_s * WALKING_SPEED) + dt / STATIONARY_S)

    def update_height(self, height_m: float, variance_m2: float) -> float:
        """Update with the height of the antenna; return the normalised innovation."""
        return super().update_height(height_m - self._lever_arm[2], variance_m2)

    def confine(self, low: Sequence[float], high: Sequence[float]) -> bool:
        """Project the antenna onto a box; return whether it was outside."""
        arm = (*self._arm(), self._lever_arm[2])
        low, high = (tuple(a - b for a, b in zip(corner, arm, strict=True)) for corner in (low, high))
        return super().confine(low, high)

    def estimate_robot(self, stamp_ns: int, odometry: DeadReckoning) -> Estimate:
        """Return position and velocity of the antenna and the heading, with the latest twist of the odometry."""
        x, P = self.x, self.P
        arm_x, arm_y = self._arm()
        to_antenna = np.eye(4)
        to_antenna[:2, YAW] = -arm_y, arm_x
        pose = to_antenna @ P[:4, :4] @ to_antenna.T
        yaw = math.remainder(float(x[YAW]), math.tau)
        vx, vy, yaw_rate = odometry.twist or (0.0, 0.0, 0.0)
        cosine, sine = math.cos(yaw), math.sin(yaw)
        velocity = np.array(
            [cosine * vx - sine * vy - yaw_rate * arm_y, sine * vx + cosine * vy + yaw_rate * arm_x, 0.0]
        )
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = pose[:3, :3]
        speed_variance = odometry.twist_variance[0] + float(P[YAW, YAW]) * (vx * vx + vy * vy)
        covariance[[3, 4], [3, 4]] = speed_variance
        covariance[5, 5] = SLOPE**2 * speed_variance
        position = x[:3] + np.array([arm_x, arm_y, self._lever_arm[2]])
        return Estimate(stamp_ns, position, velocity, covariance, Heading(yaw, pose[YAW]))

    @property
    def yaw(self) -> float:
        """Yaw of the base, rad."""
        return float(self.x[YAW])

    @property
    def yaw_variance(self) -> float:
        """Variance of the yaw, rad^2."""
        return float(self.P[YAW, YAW])

    def _arm(self) -> tuple[float, float]:
        """Return the horizontal lever arm in the axes of the map."""
        x, y, _ = self._lever_arm
        if x == y == 0.0:
            return 0.0, 0.0
        yaw = float(self.x[YAW])
        cosine, sine = math.cos(yaw), math.sin(yaw)
        return cosine * x - sine * y, sine * x + cosine * y

    def _linearize(self, anchor: NDArray[np.float64]) -> float:
        arm_x, arm_y = self._arm()
        away = self.x[:3] - anchor
        away += (arm_x, arm_y, self._lever_arm[2])
        distance = math.sqrt(away @ away)
        H = self._H
        H[:3] = away / max(distance, SHORTEST_M)
        H[YAW] = H[1] * arm_x - H[0] * arm_y
        return distance
