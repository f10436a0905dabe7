"""Odometry and IMU of a simulated robot that drives along a closed route.

The robot follows `along_route` with the tag's antenna at its origin, and turns while it passes a corner. It has an
omnidirectional base, so it can also reverse in place of a turn. The sizes of all errors are assumptions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.simulation.scene import Point, along_route
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Imu, Odometry

RATE_HZ = 50.0
"""Rate of odometry, IMU and transforms."""

SCALE_ERROR = 0.02
"""Relative error of distances and of turns; each has a random sign."""

DRIFT_RAD_PER_M = 0.01
"""Standard deviation of the constant yaw drift per distance, as of wheels with different diameters."""

SPEED_SD, TURN_SD = 0.01, 0.01
"""White noise of each velocity (m/s) and yaw rate (rad/s)."""

SLIP_EVERY_S, SLIP_S = 30.0, 0.5
SLIP_SHARE, SLIP_TURN_SD = 0.5, 0.1
"""Wheels slip on average this often and for this time. They then measure a speed that is larger by the share, and a yaw rate
with a constant error of this standard deviation, rad/s."""

GYRO_BIAS_SD, GYRO_SD = math.radians(0.3), math.radians(0.2)
"""Constant bias and white noise of the IMU's yaw rate, rad/s."""

TWIST_SD = (0.02, 0.02, 0.02)
"""Reported standard deviations of velocities (m/s) and yaw rate (rad/s); slip is not included."""

POSE_SHARE = 0.05
"""Reported standard deviation of the position as a share of the distance."""

_CORNER_M = 0.5
"""Length of the route over which `along_route` rounds a corner."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedMotion:
    """True and measured motion at the stamps of the odometry.

    Attributes:
        position: float64 (n, 2), true position, m. yaw: float64 (n,), true heading, rad, continuous.
        odometry: starts at zero in its frame.
        imu: has the same stamps.
    """

    position: NDArray[np.float64]
    yaw: NDArray[np.float64]
    odometry: Odometry
    imu: Imu


def simulate_motion(route: tuple[Point, ...], speed: float, seconds: float, seed: int) -> SimulatedMotion:
    """Return the motion of a robot that starts at the first point of the route.

    Args:
        route: Closed route, m.
        speed: Speed along the route, m/s.
        seconds: Duration.
        seed: Seed of all measurement errors.
    """
    travelled_m = speed * stamps_s(seconds)
    return motion_along(along_route(route, travelled_m), yaw_along_route(route, travelled_m), seed)


def stamps_s(seconds: float) -> NDArray[np.float64]:
    """Return the times of the odometry, float64 (n,), s."""
    return np.arange(math.ceil(seconds * RATE_HZ) + 1, dtype=np.float64) / RATE_HZ


def motion_along(position: NDArray[np.float64], yaw: NDArray[np.float64], seed: int) -> SimulatedMotion:
    """Return the motion of a robot with these true positions (n, 2) and continuous headings (n,) at `stamps_s`."""
    rng = np.random.default_rng([seed, 0x0D0])
    n, step_s = len(yaw), 1.0 / RATE_HZ

    # The true twist is the mean over the interval that ends at a stamp.
    middle = (yaw[1:] + yaw[:-1]) / 2.0
    twist = np.zeros((n, 3))
    twist[1:, :2] = _turned(np.diff(position, axis=0), -middle) / step_s
    twist[1:, 2] = np.diff(yaw) / step_s
    driven = np.cumsum(np.hypot(twist[:, 0], twist[:, 1])) * step_s

    imu_rate = twist[:, 2] + rng.normal(0.0, GYRO_BIAS_SD) + rng.normal(0.0, GYRO_SD, n)
    stamp_ns = np.rint(np.arange(n) * step_s * NS_PER_S).astype(np.int64)
    imu = Imu(stamp_ns, imu_rate, np.full(n, GYRO_SD**2 + GYRO_BIAS_SD**2), np.full(n, np.nan), np.zeros(n))

    distance_scale, turn_scale = 1.0 + SCALE_ERROR * rng.choice([-1.0, 1.0], 2)
    slips, slip_turn = _slips(n, rng)
    measured = twist * (distance_scale, distance_scale, turn_scale)
    measured[:, 2] += rng.normal(0.0, DRIFT_RAD_PER_M) * np.hypot(twist[:, 0], twist[:, 1]) + slip_turn
    measured[:, :2] *= 1.0 + SLIP_SHARE * slips[:, None]
    measured += rng.normal(0.0, 1.0, (n, 3)) * (SPEED_SD, SPEED_SD, TURN_SD)
    measured[0] = 0.0

    heading = np.cumsum(measured[:, 2]) * step_s
    before = np.concatenate([[0.0], heading[:-1]])
    steps = _turned(measured[:, :2], (before + heading) / 2.0) * step_s
    pose = np.column_stack([np.cumsum(steps, axis=0), heading])
    pose_sd = np.column_stack([POSE_SHARE * driven, POSE_SHARE * driven, 2.0 * DRIFT_RAD_PER_M * driven])
    odometry = Odometry(
        stamp_ns,
        pose,
        (pose_sd**2 + 1e-6)[:, :, None] * np.eye(3),
        measured,
        np.broadcast_to(np.diag(np.square(TWIST_SD)), (n, 3, 3)),
    )
    return SimulatedMotion(position, yaw, odometry, imu)


def yaw_along_route(route: tuple[Point, ...], travelled_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return headings float64 (n,) in rad after `travelled_m` on a closed route, continuous over all laps.

    Each heading is the mean direction of the route over half a metre around it, as the position of `along_route` is.
    """
    legs = np.diff(np.asarray([*route, route[0]], np.float64), axis=0)
    legs = legs[np.hypot(*legs.T) > 0.0]
    reached = np.concatenate([[0.0], np.cumsum(np.hypot(*legs.T))])
    direction = np.arctan2(legs[:, 1], legs[:, 0])
    direction = np.unwrap(np.append(direction, direction[0]))
    lap_turn = direction[-1] - direction[0]
    integral = np.concatenate([[0.0], np.cumsum(direction[:-1] * np.diff(reached))])

    def integrated(distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the integral of the direction from 0."""
        lap, distance_in_lap = np.divmod(distance_m, reached[-1])
        laps = lap * integral[-1] + lap_turn * reached[-1] * lap * (lap - 1.0) / 2.0
        return np.asarray(
            laps + np.interp(distance_in_lap, reached, integral) + lap * lap_turn * distance_in_lap
        )

    half = _CORNER_M / 2.0
    return (integrated(travelled_m + half) - integrated(travelled_m - half)) / _CORNER_M


def _slips(n: int, rng: np.random.Generator) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return whether the wheels slip at each stamp, and the error of the yaw rate, rad/s."""
    slips, turn = np.zeros(n, bool), np.zeros(n)
    time_s = rng.exponential(SLIP_EVERY_S)
    while (first := round(time_s * RATE_HZ)) < n:
        slipping = slice(first, first + round(SLIP_S * RATE_HZ))
        slips[slipping], turn[slipping] = True, rng.normal(0.0, SLIP_TURN_SD)
        time_s += SLIP_S + rng.exponential(SLIP_EVERY_S)
    return slips, turn


def _turned(vectors: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = vectors.T
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y])
