"""Test of a robot's heading: does its odometry explain the displacements that the ranges alone show?

Over the last metres, the path of the odometry is fitted to the positions from ranges only by a rotation, once as it is and once for each
fault in `_FAULTS`. The log likelihood ratios of the fits, for errors of unknown variance, are summed (Wald, Sequential Analysis, 1947).
A heading is confirmed when the faults are excluded. Late stamps are excluded by changes of the yaw rate only: until then, the variance
of the heading contains a turn that the odometry does not show yet.
"""

from __future__ import annotations

import cmath
import math
from collections import deque
from typing import NamedTuple

import numpy as np

from uwb_mitigation.positioning.online.dead_reckoning import PathPoint


class _Fault(NamedTuple):
    """What may be wrong with odometry.

    Attributes:
        gain: true displacements are turned, relative to those of the odometry, by its yaw multiplied by this.
        sign: of the yaw of the odometry in the true heading.
        delay_s: of its stamps.
    """

    gain: float = 0.0
    sign: float = 1.0
    delay_s: float = 0.0


_FAULTS = _Fault(), _Fault(gain=-1.0), _Fault(gain=-2.0, sign=-1.0), _Fault(delay_s=1.0), _Fault(delay_s=0.3)
"""None; velocities in the axes of the world, whose relation to the heading is unknown; yaw rates with the wrong sign; late stamps;
stamps that are slightly late: these only widen the variance."""

_MAX_DELAY_S = max(fault.delay_s for fault in _FAULTS)

IDENTIFIED, EXCLUDED, MOST_EVIDENCE = -2.0, 2.5, 15.0
"""The odometry has a fault if the sum of its log likelihood ratios is smaller; the sum from which it is excluded; limit of the sum."""

MOST_OF_FIT = 2.0
"""Limit of the contribution of one fit: errors of ranges persist."""

WINDOW_SD, WINDOW_M = 40.0, (6.0, 40.0)
"""Length of the path that is fitted: this many standard deviations of the positions, within limits in m."""

STEP_M, EVERY_M, SHORTEST_M, FEWEST = 0.2, 1.5, 3.0, 8
"""Distances between positions and between fits; shortest path and fewest positions that are fitted."""

ERROR_M, UNSEEN_M = 0.12, 0.05
"""Standard deviations of positions that are added to the residuals of fits: to compare them, and for the variance of the heading."""

SCALE_LIMITS = 0.9, 1.1
"""Of distances in the odometry."""

CONTRADICTION = 3.0
"""Difference of heading and fit in standard deviations from which the heading is not confirmed."""

FIT_SD = 1.5
"""The fit is within this many standard deviations of the published heading."""

MAX_FIT_SD = math.radians(8.0)
"""A fit with a larger standard deviation confirms no heading."""

KNOWN_YAW_SD = math.radians(15.0)
"""A heading is searched, or not confirmed, while its standard deviation is larger, without late stamps and separated positions."""

LATE_SD, STEADY_LATE_SD, STEADY = math.radians(45.0), math.radians(5.5), 2.5
"""Least standard deviation of a heading until late stamps are excluded: in the time of the delay a robot can turn by 140 degrees, which
neither the odometry nor the ranges show at once. The second is for one that turns steadily: its yaw rates differ by a smaller factor.
No heading with a larger standard deviation than the first is published."""

STAMP_SD = 0.15, 0.05
"""Standard deviation of the time between stamps of odometry and ranges, s: until slightly late stamps are excluded, and then."""

RATE_S = 0.5
"""Averaging time of yaw rates."""

LATE_EVIDENCE = 5.0
"""As `EXCLUDED`, of the other faults, until late stamps are excluded: a heading that is first confirmed in a sharp turn is soon wrong."""


class HeadingTest:
    """Compares the path of odometry with positions from ranges only.

    Args:
        lever_arm: the antenna in the frame of the base, m; only x and y are used.
        is_verified: all faults were excluded before, except for slightly late stamps.

    Attributes:
        contradicts: the latest heading contradicted the ranges, or the odometry has a fault.
        may_be_late: late stamps are not excluded yet.
    """

    def __init__(self, lever_arm: tuple[float, float, float], *, is_verified: bool = False) -> None:
        self._arm = complex(*lever_arm[:2])
        self._evidence = [is_verified * sum_ for sum_ in (LATE_EVIDENCE, LATE_EVIDENCE, EXCLUDED, 0.0)]
        self._slowest, self._fastest = math.inf, -math.inf
        self._turned, self.contradicts = (0.0, PathPoint(0)), False
        # Time, distance driven, variance, drift and turn of the odometry, position, and position relative to the start of the path for each fault.
        self._samples: deque[tuple[complex, ...]] = deque(maxlen=400)
        self._last: PathPoint | None = None
        self._path = [0j] * len(_FAULTS)
        self._fitted_m, self._variance, self._drift = 0.0, math.inf, 0.0
        self._rotation: float | None = None
        self._judge()

    def forget_positions(self) -> None:
        """Start again with other positions, but keep the evidence and the latest fit: faults of odometry stay."""
        self._samples.clear()
        self._last = None

    def is_due(self, time_s: float, point: PathPoint) -> bool:
        """Follow the odometry; return whether `add` needs a position, at times in ascending order."""
        last = self._last
        if last is not None and last.segment != point.segment:
            # Both paths have no known relative rotation.
            self.forget_positions()
            self._rotation = last = None
        begin_s, begin = self._turned
        if time_s - begin_s >= RATE_S or last is None:
            self._turned = time_s, point
            if last is not None and point.distance_m > begin.distance_m:
                rate = (point.yaw - begin.yaw) / (time_s - begin_s)
                self._slowest, self._fastest = min(self._slowest, rate), max(self._fastest, rate)
        return last is None or point.distance_m - last.distance_m >= STEP_M

    def add(self, time_s: float, position: complex, variance: float, point: PathPoint) -> None:
        """Add a position from ranges only.

        Args:
            time_s: not before the latest one.
            position: x + iy of the antenna, m.
            variance: mean of both axes, m^2.
            point: of the odometry at this time.
        """
        last = self._last
        if last is None:
            self._fitted_m = point.distance_m
        else:
            step, middle = complex(point.x - last.x, point.y - last.y), 0.5 * (point.yaw + last.yaw)
            self._path = [
                place + step * cmath.rect(1.0, fault.gain * middle)
                for place, fault in zip(self._path, _FAULTS, strict=True)
            ]
        self._last = point
        antenna = [
            place + self._arm * cmath.rect(1.0, fault.sign * point.yaw)
            for place, fault in zip(self._path, _FAULTS, strict=True)
        ]
        self._samples.append(
            (time_s, point.distance_m, variance, point.drift, point.turn, position, *antenna)
        )
        if point.distance_m - self._fitted_m >= EVERY_M:
            self._fit()

    def variance(
        self, yaw: float, variance: float, point: PathPoint, yaw_rate: float = 0.0, factor: float = 1.0
    ) -> float:
        """Return the variance of a heading, rad^2; inf: it is not confirmed.

        Args:
            yaw: heading of the base, rad, from odometry and ranges.
            variance: of it, if the odometry has no fault, rad^2.
            point: of the odometry at this time.
            yaw_rate: in which errors of stamps turn the heading, rad/s.
            factor: of the variance, if a wrong heading separated the positions of odometry and ranges.
        """
        self.contradicts = False
        if self._rotation is None:
            return math.inf
        difference = math.remainder(self._rotation + point.yaw - yaw, math.tau)
        limit = CONTRADICTION**2 * (variance + self._variance + self._drift)
        self.contradicts = self._is_faulty or difference * difference > limit
        # The sum: errors of ranges that turn the path are in neither completely, and those of wheels that slip not at all.
        variance = max(variance + self._variance, (difference / FIT_SD) ** 2)
        if self.contradicts or not self._is_confirmed or variance >= KNOWN_YAW_SD**2:
            return math.inf
        variance = factor * variance + (self._stamp_sd * yaw_rate) ** 2
        if self.may_be_late:
            # With both signs the right side is negative.
            is_steady = max(self._fastest, -self._slowest) < STEADY * max(self._slowest, -self._fastest)
            variance = max(variance, (STEADY_LATE_SD if is_steady else LATE_SD) ** 2)
        return variance if variance <= LATE_SD**2 else math.inf

    def _judge(self) -> None:
        """Update what follows from evidence and fit: `variance` runs after each range."""
        *others, late, slightly_late = self._evidence
        self._stamp_sd = STAMP_SD[slightly_late >= EXCLUDED]
        self._is_faulty, self.may_be_late = min(*others, late) < IDENTIFIED, late < EXCLUDED
        required = LATE_EVIDENCE if self.may_be_late else EXCLUDED
        self._is_confirmed = min(others) >= required and self._variance <= MAX_FIT_SD**2

    def _fit(self) -> None:
        """Fit the latest path for each fault, and add the log likelihood ratios."""
        samples = np.array(self._samples, np.complex128)
        time_s, distance_m, variance, *drifts = samples[:, :5].real.T
        # Later positions have no partner on a path with late stamps.
        end = int(np.searchsorted(time_s, time_s[-1] - _MAX_DELAY_S, side="right"))
        if end < FEWEST:
            return
        length_m = WINDOW_SD * math.sqrt(float(np.mean(variance[:end])))
        length_m = min(max(length_m, WINDOW_M[0]), WINDOW_M[1])
        fitted = slice(int(np.searchsorted(distance_m, distance_m[end - 1] - length_m)), end)
        if end - fitted.start < FEWEST or distance_m[end - 1] - distance_m[fitted.start] < SHORTEST_M:
            return
        position = samples[fitted, 5]
        position = position - position.mean()
        paths = np.array(
            [
                np.interp(time_s[fitted] + fault.delay_s, time_s, path)
                for fault, path in zip(_FAULTS, samples[:, 6:].T, strict=True)
            ]
        )
        paths -= paths.mean(axis=1, keepdims=True)
        product = paths.conj() @ position
        scale = np.abs(product) / np.maximum(np.sum(np.abs(paths) ** 2, axis=1), 1e-9)
        rotation = product / np.maximum(np.abs(product), 1e-12)
        fit = (np.clip(scale, *SCALE_LIMITS) * rotation)[:, None] * paths
        square = np.mean(np.abs(position - fit) ** 2, axis=1)
        # How far the other paths are from that without a fault: one that hardly turns is no evidence.
        norm = np.sum(np.abs(paths) ** 2, axis=1)
        distance = (norm - np.abs(paths @ paths[0].conj()) ** 2 / max(float(norm[0]), 1e-9)) / len(position)
        # One independent position for each metre of the path.
        driven_m = min(float(distance_m[-1]) - self._fitted_m, length_m)
        gain = driven_m * np.log((square + ERROR_M**2) / (square[0] + ERROR_M**2))
        expected = driven_m * np.log1p(distance / (np.minimum(square, square[0]) + ERROR_M**2))
        most = np.minimum(expected, MOST_OF_FIT)
        evidence = self._evidence + np.clip(gain, -most, most)[1:]
        self._evidence = np.minimum(evidence, MOST_EVIDENCE).tolist()
        self._fitted_m, self._rotation = float(distance_m[-1]), float(np.angle(rotation[0]))
        # Errors of ranges persist: averaging does not reduce the variance of the rotation.
        self._variance = float(square[0] + UNSEEN_M**2) / (2.0 * float(np.mean(np.abs(position) ** 2)))
        # From the beginning of the fitted path until now.
        self._drift = sum(float(drift[-1] - drift[fitted.start]) ** 2 for drift in drifts)
        self._judge()
