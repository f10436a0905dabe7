"""Position and heading of a robot with odometry, from its first range.

The estimator of the tag's position, which uses ranges only, always runs. From its position, filters with odometry start with
several yaws, and run until one of them explains the ranges. If the odometry is missing, or explains the ranges worse than the
ranges-only filter (wheels that slip, a robot that was moved), the estimates are those of ranges only until a heading is found
again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning, PathPoint
from uwb_mitigation.positioning.online.initialization import IMPLAUSIBLE
from uwb_mitigation.positioning.online.odometry_filter import OdometryFilter
from uwb_mitigation.positioning.online.tag_estimator import (
    OUTLIER,
    EstimatorConfig,
    RobotData,
    TagEstimator,
    is_valid,
)
from uwb_mitigation.types.tracks import Estimate, Ranges, Track, rows_of

NUM_YAWS = 8
"""Number of initial yaws."""

KNOWN_YAW_SD = math.radians(15.0)
"""The heading is known if one hypothesis is left and its standard deviation is smaller."""

START_M = 0.1
"""The yaw is unobservable for a stationary robot: hypotheses start after it has driven this distance."""

SAME_YAW = math.radians(20.0)
"""Hypotheses with a smaller difference are equal."""

YAW_CONCENTRATION = 2.0
"""Concentration of the von Mises prior of the yaw after the odometry was missing or wrong."""


def make_estimator(config: EstimatorConfig) -> TagEstimator:
    """Return the estimator for a configuration: with odometry if it contains the motion of a robot."""
    return TagEstimator(config) if config.robot is None else RobotEstimator(config)


def live_track(config: EstimatorConfig, ranges: Ranges) -> Track:
    """Run the estimator over recorded ranges; return an estimate for each range with a position."""
    return make_estimator(config).run(ranges)


@dataclass(slots=True)
class _HeadingHypothesis:
    filter: OdometryFilter
    loss: float


class RobotEstimator(TagEstimator):
    """Locates one tag on a robot. `counts` also has `heading found`, `odometry missing` and `odometry wrong`.

    Args:
        config: with the recorded motion of the robot, if any.
        odometry: shared with the caller; None: of its own.

    Attributes:
        odometry: add live messages to it in the order of time.
        rejects_odometry: the odometry contradicted the ranges, and no heading was found since.
    """

    def __init__(self, config: EstimatorConfig, odometry: DeadReckoning | None = None) -> None:
        self.odometry = odometry or DeadReckoning()
        self._robot = config.robot or RobotData()
        self._known: OdometryFilter | None = None
        self._yaws: list[_HeadingHypothesis] = []
        self._begin: PathPoint | None = None
        self._last_yaw: float | None = None
        self.rejects_odometry = False
        self._evidence = self._outlier_share = 0.0
        recorded: list[tuple[int, Callable[..., None], Any]] = []
        if (imu := self._robot.imu) is not None:
            rows = rows_of(imu.stamp_ns, imu.yaw_rate, imu.yaw_rate_variance)
            recorded += [(stamp_ns, self.odometry.add_imu, values) for stamp_ns, *values in rows]
        if (motion := self._robot.odometry) is not None:
            variance = np.diagonal(motion.twist_covariance, axis1=1, axis2=2)
            rows = rows_of(motion.stamp_ns, motion.pose, motion.twist, variance)
            recorded += [(stamp_ns, self.odometry.add, values) for stamp_ns, *values in rows]
        self._recorded = deque(sorted(recorded, key=lambda one: one[0]))
        super().__init__(config)

    @property
    def lever_arm(self) -> tuple[float, float, float]:
        """The antenna in the frame of the base, m; a change restarts the search for the heading."""
        return self._robot.lever_arm

    @lever_arm.setter
    def lever_arm(self, lever_arm: tuple[float, float, float]) -> None:
        if lever_arm != self._robot.lever_arm:
            self._robot = replace(self._robot, lever_arm=lever_arm)
            self._forget(None)

    @property
    def is_known(self) -> bool:
        """Whether the position is known, with or without a heading."""
        return self._known is not None or super().is_known

    @property
    def heading(self) -> str:
        """The state of the heading as text: known, unknown, or the number of hypotheses."""
        if self._known is not None:
            return "known"
        return f"{len(self._yaws)} hypotheses" if self._yaws else "unknown"

    def add(
        self, stamp_ns: int, anchor: int, range_m: float, variance_m2: float = math.nan
    ) -> Estimate | None:
        """Update with a range; see `TagEstimator.add`. The estimate has a heading if it is known."""
        if not is_valid(range_m, variance_m2):
            return None
        while self._recorded and self._recorded[0][0] <= stamp_ns:
            recorded_ns, add, values = self._recorded.popleft()
            add(recorded_ns, *values)
        estimate = super().add(stamp_ns, anchor, range_m, variance_m2)
        self._update_robot(anchor, range_m, variance_m2)
        return estimate if self._known is None else self._estimate(self._known, stamp_ns)

    def add_height(self, height_m: float, variance_m2: float) -> None:
        """Update with the antenna's height; see `TagEstimator.add_height`."""
        super().add_height(height_m, variance_m2)
        for one in self._yaws:
            one.filter.update_height(height_m, variance_m2)

    def at(self, stamp_ns: int) -> Estimate | None:
        """Predict position and heading at a time after the latest range; None: not known."""
        point = self.odometry.at(stamp_ns)
        if self._known is None or point is None or point.part != self._known.point.part:
            return super().at(stamp_ns)
        ahead = self._known.copy()
        ahead.advance(self._seconds(stamp_ns), point)
        self._confine(ahead)
        return self._estimate(ahead, stamp_ns)

    def restart(self, stamp_ns: int | None = None) -> None:
        """Reset position and heading, but not the statistics."""
        super().restart(stamp_ns)
        self._forget(None)

    def _estimate(self, known: OdometryFilter, stamp_ns: int) -> Estimate:
        estimate = known.estimate_robot(stamp_ns, self.odometry)
        if self._area is None:
            return estimate
        return replace(estimate, position=self._area.clip(estimate.position))

    def _update_robot(self, anchor: int, range_m: float, variance_m2: float) -> None:
        time_s = self._time_s
        point = self.odometry.at((self._origin_ns or 0) + round(time_s * 1e9))
        if point is None or (self._yaws and point.part != self._yaws[0].filter.point.part):
            if self._yaws:
                self._forget("odometry missing")
            return
        if not self._yaws:
            self._start_yaws(point)
            return
        model, best = self._model, self._yaws[0]
        for one in self._yaws:
            one.filter.advance(time_s, point)
            z, sd = one.filter.update(anchor, range_m, variance_m2)
            self._confine(one.filter)
            loss = model.loss_of(z, sd)
            one.loss += loss
            if one is best:
                best_z, best_loss = z, loss
        self._prune()
        self._outlier_share += 0.1 * ((abs(best_z) > OUTLIER) - self._outlier_share)
        # Page's cumulative sum of the log likelihood ratio of the two models.
        if math.isfinite(self._latest_loss):
            self._evidence = max(0.0, self._evidence + best_loss - self._latest_loss)
        if self._evidence > IMPLAUSIBLE or self._outlier_share > 0.5:
            self._forget("odometry wrong")
            self.rejects_odometry = True

    def _start_yaws(self, point: PathPoint) -> None:
        """Start filters at the position of the ranges-only filter when the robot drives."""
        if self.filter is None:
            return
        if self._begin is None or self._begin.part != point.part:
            self._begin = point
        if point.distance_m - self._begin.distance_m < START_M:
            return
        step = math.tau / NUM_YAWS
        center = self._last_yaw or 0.0
        concentration = 0.0 if self._last_yaw is None else YAW_CONCENTRATION
        for number in range(NUM_YAWS):
            yaw = number * step
            one = OdometryFilter(self.filter, point, self._robot.lever_arm, center + yaw, step / 2.0)
            self._yaws.append(_HeadingHypothesis(one, concentration * (1.0 - math.cos(yaw))))

    def _prune(self) -> None:
        """Remove implausible and equal hypotheses; the best one is the first."""
        if len(self._yaws) > 1:
            self._yaws.sort(key=lambda one: one.loss)
            least, kept = self._yaws[0].loss, list[_HeadingHypothesis]()
            for one in self._yaws:
                one.loss -= least
                apart = [abs(math.remainder(one.filter.yaw - other.filter.yaw, math.tau)) for other in kept]
                if one.loss <= IMPLAUSIBLE and all(angle > SAME_YAW for angle in apart):
                    kept.append(one)
            self._yaws = kept
        best = self._yaws[0].filter
        if self._known is None and len(self._yaws) == 1 and best.yaw_variance < KNOWN_YAW_SD**2:
            self._known, self.rejects_odometry = best, False
            self._outlier_share = 0.0
            self.counts["heading found"] += 1

    def _forget(self, reason: str | None) -> None:
        """Continue with ranges only, for a reason to count."""
        self._last_yaw = None if self._known is None or reason is None else self._known.yaw
        self._known, self._begin, self._evidence, self._outlier_share = None, None, 0.0, 0.0
        self._yaws = []
        if reason is not None:
            self.counts[reason] += 1
