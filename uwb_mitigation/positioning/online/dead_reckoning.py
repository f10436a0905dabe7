"""Motion of a robot's base in the plane, integrated from odometry and optionally from the yaw rates of an IMU."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from uwb_mitigation.types.stamps import NS_PER_S

ODOMETRY_TIMEOUT_S = 0.5
"""Motion is extrapolated by at most this time; a longer gap is missing odometry."""

IMU_TIMEOUT_S = 0.1
"""After a longer gap of the IMU, the yaw of the odometry is used."""

SPEED_SD, YAW_RATE_SD = 0.05, 0.05
"""White noise of velocities (m/s) and yaw rates (rad/s) of messages without a covariance."""

MOTION_SHARE, CORRELATION_S = 0.05, 1.0
"""Wheels slip and floors are uneven: velocities have random errors of this share, for about this time."""

WHEEL_DRIFT, GYRO_DRIFT = 0.02, 0.01
"""Standard deviation of the constant yaw drift of wheels (rad/m) and of an IMU (rad/s, 0.6 degrees per second)."""

WHEEL_TURN, GYRO_TURN = 0.05, 0.01
"""Standard deviation of the constant relative error of rotations."""

TURN_SHARE = 0.02
"""The same for the yaw rates of wheels, in addition to the constant error of rotations."""

MAX_SPEED, MAX_YAW_RATE = 50.0, 50.0
"""m/s, rad/s: faster odometry is invalid."""

JUMP_SPEED, JUMP_YAW_RATE = 3.0, 10.0
"""If the pose of the odometry moves by this much faster than its twist, it was reset: the twist is used (m/s, rad/s)."""

_SLIP, _TURN_NOISE = 2.0 * CORRELATION_S * MOTION_SHARE**2, 2.0 * CORRELATION_S * TURN_SHARE**2
"""Variance per second of random errors: of the position for the squared velocity, of the yaw for the squared yaw rate."""

_TIMEOUT_NS = ODOMETRY_TIMEOUT_S * NS_PER_S
_MAX_VARIANCE = 1e3
_NUM_SAMPLES = 512


class PathPoint(NamedTuple):
    """A point of the integrated path, with sums since its beginning.

    Attributes:
        segment: points of different segments have no known relative motion.
        x, y, yaw: pose in the frame of the path, m and rad.
        distance_m: distance driven.
        drift: standard deviation of the yaw error by a constant drift, rad.
        turn: standard deviation of the yaw error by a constant relative error of rotations, rad, with the sign of the rotation.
        position_variance, yaw_variance: variances of the random errors, m^2 and rad^2.
        source: number of changes of the source of the yaw: wheels if even, IMU if odd.
    """

    segment: int
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    distance_m: float = 0.0
    drift: float = 0.0
    turn: float = 0.0
    position_variance: float = 0.0
    yaw_variance: float = 0.0
    source: int = 0


_Sample = tuple[int, PathPoint, tuple[float, ...], Sequence[float] | None]
"""Stamp of a message in ns, point, change of each value of the point per second before it, and pose; None: unknown."""


class DeadReckoning:
    """The path of a robot's base.

    The increments of the poses of the odometry are used, or its twists if the poses jump or have no orientation. If there is an
    IMU, its yaw rates replace those of the odometry.

    Attributes:
        rejected: number of messages that were invalid or out of order.
        twist: velocity in the axes of the base (m/s) and yaw rate (rad/s) of the latest interval; None before its end.
        twist_variance: of x and y, and of the yaw rate.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self.twist: tuple[float, float, float] | None = None
        self.twist_variance = (SPEED_SD**2, YAW_RATE_SD**2)
        self._samples: deque[_Sample] = deque(maxlen=_NUM_SAMPLES)
        self._segment = 0
        # Stamp, yaw rate and its variance, integrated yaw, and yaw of the latest message.
        self._imu: tuple[int, float, float, float, float] | None = None
        self._imu_yaw: float | None = None

    def add(
        self,
        stamp_ns: int,
        pose: Sequence[float] | None,
        twist: Sequence[float],
        twist_variance: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Add a message of odometry.

        Args:
            stamp_ns: later than the latest one, otherwise it is rejected.
            pose: x and y in m and yaw in rad, in a frame that drifts; None or NaN: unknown.
            twist: velocities x and y in m/s and yaw rate in rad/s, in the axes of the base.
            twist_variance: of each; 0: unknown.
        """
        vx, vy, yaw_rate = twist
        speed = math.hypot(vx, vy)
        # Also false for NaN.
        if not (speed <= MAX_SPEED and abs(yaw_rate) <= MAX_YAW_RATE):
            self.rejected += 1
            return
        # A sum is finite if its terms are.
        if pose is not None and not math.isfinite(pose[0] + pose[1] + pose[2]):
            pose = None
        samples = self._samples
        last_ns, before, _, last_pose = samples[-1] if samples else (0, None, (), None)
        gap_ns = stamp_ns - last_ns
        if before is not None and -NS_PER_S <= gap_ns <= 0:
            self.rejected += 1
            return
        imu_yaw = None if self._imu is None else _yaw_of_imu(stamp_ns, self._imu)
        if before is None or not 0 < gap_ns <= _TIMEOUT_NS:
            self._segment += 1
            samples.clear()
            samples.append((stamp_ns, PathPoint(self._segment), (0.0,) * 8, pose))
            self._imu_yaw, self.twist = imu_yaw, None
            return
        dt = gap_ns / NS_PER_S
        if pose is not None and last_pose is not None:
            vx, vy, yaw_rate = _twist_of_poses(last_pose, pose, dt, twist)
            speed = math.hypot(vx, vy)
        of_x, of_y, of_yaw_rate = twist_variance
        of_speed = of_x if of_x > of_y else of_y
        of_speed = of_speed if 0.0 < of_speed < _MAX_VARIANCE else SPEED_SD**2
        of_yaw_rate = of_yaw_rate if 0.0 < of_yaw_rate < _MAX_VARIANCE else YAW_RATE_SD**2
        drift, turn_sd = WHEEL_DRIFT * speed, WHEEL_TURN
        yaw_density = of_yaw_rate * dt + _TURN_NOISE * yaw_rate * yaw_rate
        source = before.source + before.source % 2
        if imu_yaw is not None and self._imu_yaw is not None and self._imu is not None:
            yaw_rate, of_yaw_rate = (imu_yaw - self._imu_yaw) / dt, self._imu[2]
            drift, turn_sd, yaw_density = GYRO_DRIFT, GYRO_TURN, of_yaw_rate * dt
            source = before.source | 1
        self._imu_yaw = imu_yaw
        self.twist, self.twist_variance = (vx, vy, yaw_rate), (of_speed, of_yaw_rate)
        middle = before.yaw + 0.5 * yaw_rate * dt
        cosine, sine = math.cos(middle), math.sin(middle)
        east, north = cosine * vx - sine * vy, sine * vx + cosine * vy
        position_density = of_speed * dt + _SLIP * speed * speed
        rates = (east, north, yaw_rate, speed, drift, turn_sd * yaw_rate, position_density, yaw_density)
        samples.append((stamp_ns, _moved(before, rates, dt, source), rates, pose))

    def add_imu(self, stamp_ns: int, yaw_rate: float, variance: float = 0.0, yaw: float = math.nan) -> None:
        """Add a message of an IMU; an invalid one is rejected.

        Args:
            stamp_ns: later than the latest one, otherwise it is rejected.
            yaw_rate: rad/s.
            variance: of the yaw rate; 0: unknown.
            yaw: in a frame of its own, rad; its differences replace the yaw rates. NaN: unknown.
        """
        turned, latest = 0.0, self._imu
        gap_ns = 1 if latest is None else stamp_ns - latest[0]
        if not abs(yaw_rate) <= MAX_YAW_RATE or -NS_PER_S < gap_ns <= 0:
            self.rejected += 1
            return
        if latest is not None:
            turned = 0.5 * (latest[1] + yaw_rate) * gap_ns / NS_PER_S
            if math.isfinite(difference := yaw - latest[4]):
                turned = math.remainder(difference, math.tau)
            turned += latest[3]
            if not 0 < gap_ns <= ODOMETRY_TIMEOUT_S * NS_PER_S:
                # The rotation in a gap is unknown, also after a wrong stamp.
                self._imu_yaw = None
        variance = variance if 0.0 < variance < _MAX_VARIANCE else YAW_RATE_SD**2
        self._imu = stamp_ns, yaw_rate, variance, turned, yaw

    def point_at(self, stamp_ns: int) -> PathPoint | None:
        """Return the path at a time, by interpolation, or by extrapolation of the latest motion; None: unknown."""
        latest = self._before(stamp_ns)
        if latest is None:
            return None
        (_, point, _, _), rates, dt = latest
        return _moved(point, rates, dt, point.source)

    def pose_at(self, stamp_ns: int) -> tuple[float, float, float] | None:
        """Return x, y and yaw in the frame of the odometry at a time; None: unknown, or messages without a pose."""
        latest = self._before(stamp_ns)
        if latest is None:
            return None
        (_, point, _, pose), rates, dt = latest
        if pose is None:
            return None
        x, y, yaw = pose
        # The frame of the path is another one.
        turn = yaw - point.yaw
        cosine, sine = math.cos(turn), math.sin(turn)
        dx, dy = rates[0] * dt, rates[1] * dt
        return x + cosine * dx - sine * dy, y + sine * dx + cosine * dy, yaw + rates[2] * dt

    def _before(self, stamp_ns: int) -> tuple[_Sample, tuple[float, ...], float] | None:
        """Return the latest sample before a time, the rates after it, and the time since, s."""
        samples = self._samples
        if not samples or stamp_ns > samples[-1][0] + _TIMEOUT_NS:
            return None
        rates = samples[-1][2]
        for sample in reversed(samples):
            if sample[0] <= stamp_ns:
                return sample, rates, (stamp_ns - sample[0]) / NS_PER_S
            rates = sample[2]
        return None


def _yaw_of_imu(stamp_ns: int, imu: tuple[int, float, float, float, float]) -> float | None:
    at_ns, rate, _, yaw, _ = imu
    dt = (stamp_ns - at_ns) / NS_PER_S
    return yaw + rate * dt if abs(dt) <= IMU_TIMEOUT_S else None


def _twist_of_poses(
    before: Sequence[float], after: Sequence[float], dt: float, twist: Sequence[float]
) -> tuple[float, float, float]:
    """Return the mean twist between two poses, or `twist` of the message if the poses jump."""
    (x, y, yaw), (end_x, end_y, end_yaw), (vx, vy, yaw_rate) = before, after, twist
    turned = math.remainder(end_yaw - yaw, math.tau)
    # In the axes halfway between both.
    middle, east, north = yaw + 0.5 * turned, end_x - x, end_y - y
    cosine, sine = math.cos(middle), math.sin(middle)
    speed_limit, yaw_rate_limit = 2.0 * math.hypot(vx, vy) + JUMP_SPEED, 2.0 * abs(yaw_rate) + JUMP_YAW_RATE
    # False for NaN.
    if math.hypot(east, north) <= speed_limit * dt and abs(turned) <= yaw_rate_limit * dt:
        return (cosine * east + sine * north) / dt, (cosine * north - sine * east) / dt, turned / dt
    return vx, vy, yaw_rate


def _moved(point: PathPoint, rates: tuple[float, ...], dt: float, source: int) -> PathPoint:
    """Return the point after a time with constant rates of its values."""
    # Names instead of loops: this runs for each message and each range.
    segment, x, y, yaw, distance_m, drift, turn, of_position, of_yaw, _ = point
    vx, vy, yaw_rate, speed, drift_rate, turn_rate, position_density, yaw_density = rates
    x, y, yaw = x + dt * vx, y + dt * vy, yaw + dt * yaw_rate
    distance_m, drift, turn = distance_m + dt * speed, drift + dt * drift_rate, turn + dt * turn_rate
    of_position, of_yaw = of_position + dt * position_density, of_yaw + dt * yaw_density
    return PathPoint(segment, x, y, yaw, distance_m, drift, turn, of_position, of_yaw, source)
