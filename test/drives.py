"""Simulated drives past anchors, with the range errors of the measurement model."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.tracks import Odometry, Ranges, Track, TruePath


def anchors_at(places: Iterable[Sequence[float]], sd: float = 0.01) -> AnchorMap:
    """Return anchors with the ids 1, 2, ... at places."""
    return AnchorMap([Anchor(number, tuple(place), sd) for number, place in enumerate(places, 1)])


HALL = anchors_at([(0.0, 0.0, 2.5), (12.0, 0.0, 0.5), (12.0, 9.0, 2.5), (0.0, 9.0, 0.5), (6.0, 0.0, 1.5)])
NANOSECONDS = 1_000_000_000
ODOMETRY_HZ = 50.0


def circuit(time_s: NDArray[np.float64], height_m: float = 1.0) -> NDArray[np.float64]:
    """Return positions (n, 3) on an ellipse through the hall, at about 0.8 m/s."""
    phase = 0.2 * time_s
    return np.stack([6 + 4 * np.cos(phase), 4.5 + 3 * np.sin(phase), np.full_like(phase, height_m)], axis=1)


def drive(
    anchors: AnchorMap = HALL,
    *,
    seconds: float = 60.0,
    rate_hz: float = 40.0,
    seed: int = 1,
    offset_m: float = 0.1,
    model: NoiseModel | None = None,
    path=circuit,
) -> tuple[Ranges, TruePath]:
    """Return corrected ranges to the anchors in turn, with white noise, correlated errors and a common offset."""
    model = model or NoiseModel()
    rng = np.random.default_rng(seed)
    n = round(seconds * rate_hz)
    time_s = np.arange(n) / rate_hz
    anchor = np.arange(n) % len(anchors)
    position = path(time_s)
    kept = np.exp(-len(anchors) / rate_hz / model.persistence_s)
    error = np.empty(n)
    persisting = rng.normal(0, 1, len(anchors))
    for i in range(n):
        row = anchor[i]
        persisting[row] = kept * persisting[row] + np.sqrt(1 - kept**2) * rng.normal()
        error[i] = persisting[row]
    error *= model.range_sd * np.sqrt(1 - model.white)
    error += rng.normal(0, model.range_sd * np.sqrt(model.white), n) + offset_m
    distance = np.linalg.norm(position - anchors.position[anchor], axis=1)
    stamp_ns = np.rint(time_s * NANOSECONDS).astype(np.int64)
    nothing = np.full(n, np.nan)
    ranges = Ranges(stamp_ns, anchor, distance + error, np.full(n, model.range_sd**2), nothing, 7, True)
    return ranges, TruePath(stamp_ns, position)


WALL = anchors_at([(1, -3, 0.2), (1, 3, 0.2), (1, -3, 2.5), (1, 3, 2.5), (1.1, 0, 1.3)], 0.03)
"""Anchors on one wall: beyond it is a mirror image of every position."""


def flight(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions (n, 3) of a drone that ascends from 0.08 m in front of `WALL` and lands."""
    height = 0.08 + 1.2 * np.sin(np.pi * np.clip(time_s / 60.0, 0.0, 1.0))
    return np.stack([-1.2 + 1.4 * np.sin(0.3 * time_s), 2.5 * np.sin(0.21 * time_s + 1.0), height], axis=1)


def block(ranges: Ranges, seed: int = 1, share: float = 0.25, mean_m: float = 0.5, anchors=None) -> Ranges:
    """Lengthen the ranges of each anchor (or of `anchors`) in a share of intervals of 2 s."""
    rng = np.random.default_rng(seed)
    interval = (ranges.stamp_ns - ranges.stamp_ns[0]) // (2 * NANOSECONDS)
    for row in np.unique(ranges.anchor) if anchors is None else anchors:
        size = int(interval.max()) + 1
        longer = (rng.random(size) < share) * rng.exponential(mean_m, size)
        own = ranges.anchor == row
        ranges.range_m[own] += longer[interval[own]]
    return ranges


def wrapped(angle):
    return np.angle(np.exp(1j * np.asarray(angle)))


class Robot:
    """A robot on an ellipse, whose wheels measure 2 % too much and drift by 0.01 rad/m.

    Args:
        facing: the angle between its x axis and its direction of travel.
        slip: seconds between which the wheels turn at an additional 1 m/s.
        stand: seconds between which it stands.
    """

    def __init__(self, *, facing=0.0, lever=(0.0, 0.0, 0.0), slip=(0.0, 0.0), stand=(0.0, 0.0), seconds=60.0):
        self.facing, self.lever, self.stand = facing, lever, stand
        time_s = np.arange(round(seconds * ODOMETRY_HZ) + 1) / ODOMETRY_HZ
        pose = np.column_stack([self.base(time_s)[:, :2], self.yaw(time_s)])
        step = np.diff(pose, axis=0)
        cosine, sine = np.cos(pose[:-1, 2]), np.sin(pose[:-1, 2])
        twist = np.zeros_like(pose)
        twist[1:, 0] = cosine * step[:, 0] + sine * step[:, 1]
        twist[1:, 1] = cosine * step[:, 1] - sine * step[:, 0]
        twist[1:, 2] = step[:, 2]
        twist *= ODOMETRY_HZ * 1.02
        twist[:, 2] += 0.01 * np.hypot(*twist[:, :2].T)
        twist[(time_s >= slip[0]) & (time_s < slip[1]), 0] += 1.0
        yaw = np.concatenate([[0.0], np.cumsum(twist[1:, 2] / ODOMETRY_HZ)])
        before = np.concatenate([[0.0], yaw[:-1]])
        cosine, sine = np.cos(before) / ODOMETRY_HZ, np.sin(before) / ODOMETRY_HZ
        x = np.cumsum(cosine * twist[:, 0] - sine * twist[:, 1])
        y = np.cumsum(sine * twist[:, 0] + cosine * twist[:, 1])
        n = len(time_s)
        covariance = np.broadcast_to(np.diag([0.02**2] * 3), (n, 3, 3))
        stamps = np.rint(time_s * NANOSECONDS).astype(np.int64)
        self.odometry = Odometry(stamps, np.column_stack([x, y, yaw]), np.zeros((n, 3, 3)), twist, covariance)
        self.config = EstimatorConfig(
            HALL, NoiseModel(), Height(1.0, 0.05), robot=RobotData(self.odometry, lever_arm=lever)
        )

    def _moving(self, time_s):
        begin, end = self.stand
        return np.where(time_s < begin, time_s, np.maximum(time_s - (end - begin), begin))

    def base(self, time_s):
        return circuit(self._moving(time_s))

    def yaw(self, time_s):
        phase = 0.2 * self._moving(time_s)
        return np.unwrap(np.arctan2(3 * np.cos(phase), -4 * np.sin(phase))) + self.facing

    def antenna(self, time_s):
        yaw = self.yaw(time_s)
        x, y, z = self.lever
        arm = np.column_stack(
            [np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, np.full_like(yaw, z)]
        )
        return self.base(time_s) + arm

    def ranges(self, seconds=60.0, seed=1) -> Ranges:
        return drive(seconds=seconds, seed=seed, path=self.antenna)[0]

    def errors(self, track: Track, after_s=0.0):
        """Return the errors of antenna and yaw after a time, and the standard deviations of the yaw."""
        late = track.take(track.stamp_ns >= after_s * NANOSECONDS)
        np.testing.assert_allclose(late.covariance, late.covariance.transpose(0, 2, 1), rtol=1e-6, atol=1e-12)
        time_s = late.stamp_ns / NANOSECONDS
        error = late.position[:, :2] - self.antenna(time_s)[:, :2]
        known = np.isfinite(late.yaw[:, 0])
        of_yaw = wrapped(late.yaw[known, 0] - self.yaw(time_s)[known])
        return np.hypot(*error.T), of_yaw, np.sqrt(late.yaw[known, 4])
