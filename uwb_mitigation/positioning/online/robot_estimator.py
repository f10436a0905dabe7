"""Position and heading of a robot with odometry, from its first range.

The estimator of the tag's position, which uses ranges only, always runs. From its position, filters with odometry start with
several yaws, and run until one of them explains the ranges. Its position and that of the ranges-only filter are then mixed by
solution separation (Brown, "A baseline GPS RAIM scheme", 1992): the larger their difference, relative to the covariance of
the ranges-only filter, the smaller the weight of the odometry (wheels that slip, wrong axes, a robot that was moved).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import numpy as np

from uwb_mitigation.positioning.config import EstimatorConfig, RobotData
from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning, PathPoint
from uwb_mitigation.positioning.online.filter import RangeFilter
from uwb_mitigation.positioning.online.heading_test import KNOWN_YAW_SD, HeadingTest
from uwb_mitigation.positioning.online.initialization import IMPLAUSIBLE
from uwb_mitigation.positioning.online.measurements import TagHeight, TagRange
from uwb_mitigation.positioning.online.odometry_filter import OdometryFilter
from uwb_mitigation.positioning.online.robust_update import items_of
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator, run_estimator
from uwb_mitigation.types.tracks import Estimate, Heading, Ranges, Track, rows_of

NUM_YAWS = 8
"""Number of initial yaws."""

START_M = 0.1
"""The yaw is unobservable for a stationary robot: hypotheses start after it has driven this distance."""

SAME_YAW = math.radians(20.0)
"""Hypotheses with a smaller difference are equal."""

SEPARATION_S = 2.0
"""Averaging time of the separation of the two solutions."""

EQUAL_SEPARATION, REJECTED_SEPARATION = 2.0, 4.0
"""Mean squared separation, relative to the covariance, at which both solutions have equal weights, and from which the odometry is
rejected. Two is its mean if the odometry had no errors, and the ranges-only solution those of its covariance."""

APART = 10.0
"""Squared separation, without averaging, from which a heading is withheld while late stamps of the odometry are not excluded: so the ranges
show a sharp turn 0.7 s after its beginning. Correct odometry reaches 7.9 (simulated ellipse in a hall, two minutes at rest)."""

CONSTANT_SHARE = 0.4
"""Share of the covariance of ranges only that odometry does not reduce: errors of ranges that stay the same, or return with the place."""

VERIFIED_SEPARATION = 1.0
"""After a rejection the odometry is reported as wrong until the separation is smaller."""

FORGIVEN_S = 60.0
"""Time constant of the number of rejections, which reduces the weight of the odometry."""

_SEPARATE = np.kron(np.eye(2), np.ones((3, 3)))
"""Covariances of position and velocity that are not 0 in a mixture."""


def make_estimator(config: EstimatorConfig) -> TagEstimator | RobotEstimator:
    """Return the estimator for a configuration: with odometry if it contains the motion of a robot."""
    return TagEstimator(config) if config.robot is None else RobotEstimator(config)


def live_track(config: EstimatorConfig, ranges: Ranges) -> Track:
    """Run the estimator over recorded ranges; return an estimate for each range with a position."""
    return make_estimator(config).run(ranges)


@dataclass(slots=True)
class _HeadingHypothesis:
    filter: OdometryFilter
    loss: float


class RobotEstimator:
    """Locates one tag on a robot.

    Args:
        config: with the recorded motion of the robot, if any.
        odometry: shared with the caller; None: a separate one.

    Attributes:
        tag: estimator of the position from ranges only. Its `counts` also have `heading found`, `odometry missing` and
            `odometry wrong`.
        odometry: add live messages to it in the order of time.
    """

    def __init__(self, config: EstimatorConfig, odometry: DeadReckoning | None = None) -> None:
        self.tag, self.odometry = TagEstimator(config), odometry or DeadReckoning()
        self._config, self._area, self._robot = config, config.area, config.robot or RobotData()
        self._heading_filter: OdometryFilter | None = None
        self._yaws: list[_HeadingHypothesis] = []
        self._begin: PathPoint | None = None
        self._is_rejected, self._is_confirmed, self._is_apart = False, False, False
        self._rejections, self._separation, self._latest_separation = 0.0, 0.0, 0.0
        self._test = HeadingTest(self._robot.lever_arm, is_verified=self._robot.is_verified)
        self._recorded = deque(sorted(self._recorded_motion(), key=itemgetter(0)))

    @property
    def rejects_odometry(self) -> bool:
        """Whether the odometry contradicted the ranges, and was not verified since."""
        return self._is_rejected or self._test.contradicts

    @property
    def lever_arm(self) -> tuple[float, float, float]:
        """The antenna in the frame of the base, m; a change restarts the search for the heading."""
        return self._robot.lever_arm

    @lever_arm.setter
    def lever_arm(self, lever_arm: tuple[float, float, float]) -> None:
        if lever_arm != self._robot.lever_arm:
            self._robot = replace(self._robot, lever_arm=lever_arm)
            self._test = HeadingTest(lever_arm, is_verified=self._robot.is_verified)
            self._reset_heading(None)

    @property
    def heading(self) -> str:
        """The state of the heading as text: known, unconfirmed, unknown, or the number of hypotheses."""
        if self._heading_filter is not None:
            return "known" if self._is_confirmed else "unconfirmed"
        return f"{len(self._yaws)} hypotheses" if self._yaws else "unknown"

    def add(self, measurement: TagRange | TagHeight) -> Estimate | None:
        """Update with a measurement; see `TagEstimator.add`. The estimate has a heading if it is known."""
        if not measurement.is_valid:
            return None
        if isinstance(measurement, TagHeight):
            return self.tag.add(measurement)
        while self._recorded and self._recorded[0][0] <= measurement.stamp_ns:
            _, add, message = self._recorded.popleft()
            add(*message)
        published = self.tag.update(measurement)
        self._update_headings(measurement)
        return self._estimate(published, self._heading_filter, measurement.stamp_ns)

    def run(self, ranges: Ranges) -> Track:
        """Process recorded ranges, and heights and motion of the config; return an estimate for each range with one."""
        return run_estimator(self.add, self._config.heights, ranges)

    def predict_at(self, stamp_ns: int) -> Estimate | None:
        """Predict position and heading at a time after the latest range; None: not known."""
        point, latest, predicted = self.odometry.point_at(stamp_ns), self._heading_filter, None
        if latest is not None and point is not None and point.segment == latest.point.segment:
            predicted = latest.copy()
            predicted.advance(self.tag.seconds(stamp_ns), point)
            if self._area is not None:
                predicted.confine(self._area)
        return self._estimate(self.tag.predicted(stamp_ns), predicted, stamp_ns)

    def restart(self, stamp_ns: int | None = None) -> None:
        """Reset position and heading, but not the statistics."""
        self.tag.restart(stamp_ns)
        self._test = HeadingTest(self._robot.lever_arm)
        self._reset_heading(None)

    def _recorded_motion(self) -> list[tuple[int, Callable[..., None], Any]]:
        recorded: list[tuple[int, Callable[..., None], Any]] = []
        if (imu := self._robot.imu) is not None:
            rows = rows_of(imu.stamp_ns, imu.yaw_rate, imu.yaw_rate_variance)
            add_imu = self.odometry.add_imu
            recorded += [(row[0], add_imu, row) for row in rows]
        if (motion := self._robot.odometry) is not None:
            variance = np.diagonal(motion.twist_covariance, axis1=1, axis2=2)
            rows = rows_of(motion.stamp_ns, motion.pose, motion.twist, variance)
            add = self.odometry.add
            recorded += [(row[0], add, row) for row in rows]
        return recorded

    def _estimate(
        self, ranges_only: RangeFilter | None, heading_filter: OdometryFilter | None, stamp_ns: int
    ) -> Estimate | None:
        """Return the mean of both solutions; its covariance includes their difference. Without a heading, it is that of ranges only."""
        if ranges_only is None:
            return None
        position, velocity, covariance = self.tag.solution(ranges_only)
        if heading_filter is None:
            return Estimate(stamp_ns, position, velocity, covariance)
        excess = 2.0 * (self._separation - EQUAL_SEPARATION)
        weight = math.exp(-self._rejections) / (1.0 + math.exp(min(excess, 50.0)))
        # Python numbers are faster here than NumPy.
        P, unseen = items_of(covariance), items_of(ranges_only.unseen)
        x, y, yaw, xx, xy, yy, x_yaw, y_yaw, yaw_variance = heading_filter.published()
        x0, y0, _ = position.tolist()
        dx, dy = x0 - x, y0 - y
        of_mean = weight * (1.0 - CONSTANT_SHARE)
        rest, apart = 1.0 - of_mean, weight * (1.0 - weight)
        P[0, 0] = rest * P[0, 0] + of_mean * (xx + unseen[0, 0]) + apart * dx * dx
        P[0, 1] = P[1, 0] = rest * P[0, 1] + of_mean * (xy + unseen[0, 1]) + apart * dx * dy
        P[1, 1] = rest * P[1, 1] + of_mean * (yy + unseen[1, 1]) + apart * dy * dy
        P[0, 2] = P[2, 0] = (1.0 - weight) * P[0, 2]
        P[1, 2] = P[2, 1] = (1.0 - weight) * P[1, 2]
        covariance *= _SEPARATE
        position[0], position[1] = x0 - weight * dx, y0 - weight * dy
        if self._area is not None:
            position = self._area.clip(position)
        yaw = math.remainder(yaw, math.tau)
        # A wrong heading separates the solutions by more than their covariances.
        factor = max(self._separation, self._latest_separation, EQUAL_SEPARATION) / EQUAL_SEPARATION
        yaw_rate = self.odometry.twist[2] if self.odometry.twist else 0.0
        variance = self._test.variance(yaw, yaw_variance, heading_filter.point, yaw_rate, factor)
        # Ranges show a turn that late odometry hides first as a separation that averages do not contain yet.
        self._is_confirmed = variance < math.inf and not (self._is_apart and self._test.may_be_late)
        heading: Heading | None = None
        if self._is_confirmed:
            velocity[0], velocity[1], speed_variance = heading_filter.velocity(self.odometry, variance)
            covariance[3, 4] = covariance[4, 3] = 0.0
            covariance[3, 3] = covariance[4, 4] = speed_variance
            heading = Heading(yaw, np.array([weight * x_yaw, weight * y_yaw, 0.0, variance]))
        return Estimate(stamp_ns, position, velocity, covariance, heading)

    def _update_headings(self, measurement: TagRange) -> None:
        tag = self.tag
        time_s, point = tag.seconds(measurement.stamp_ns), self.odometry.point_at(measurement.stamp_ns)
        if point is None or (self._yaws and point.segment != self._yaws[0].filter.point.segment):
            if self._yaws:
                self._reset_heading("odometry missing")
            return
        if not self._yaws:
            self._start_yaws(point)
            return
        dt = time_s - self._yaws[0].filter.time_s
        # Its height is copied, unless it is constant.
        climbing = None if tag.filter is None or tag.filter.is_level else tag.filter.state
        for hypothesis in self._yaws:
            filter_ = hypothesis.filter
            filter_.advance(time_s, point)
            if climbing is not None:
                filter_.set_height(climbing.x_items[2], climbing.P_items[2, 2])
            filter_.state.raw_factor = tag.raw_factor
            z, sd = filter_.update(*measurement[1:])
            if self._area is not None:
                filter_.confine(self._area)
            if self._heading_filter is None:
                hypothesis.loss += self._config.model.student_loss(z) + math.log(sd)
        if self._heading_filter is None:
            self._prune()
        if tag.filter is None:
            self._test.forget_positions()
            return
        if self._test.is_due(time_s, point):
            state = tag.filter.state
            variance = 0.5 * (state.P_items[0, 0] + state.P_items[1, 1]) * state.covariance_scale()
            self._test.add(time_s, complex(*state.x_items[:2]), variance, point)
        if self._heading_filter is not None:
            self._update_separation(self._heading_filter, dt)

    def _update_separation(self, heading_filter: OdometryFilter, dt: float) -> None:
        assert self.tag.filter is not None
        state, (x, y, _) = self.tag.filter.state, heading_filter.antenna
        dx, dy, P = x - state.x_items[0], y - state.x_items[1], state.P_items
        a, b, c = P[0, 0], P[0, 1], P[1, 1]
        separation = (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / max(a * c - b * b, 1e-12)
        self._latest_separation = separation
        if dt > 0.0:
            self._separation += min(dt / SEPARATION_S, 1.0) * (separation - self._separation)
            self._rejections *= math.exp(-dt / FORGIVEN_S)
        # Large range errors move the ranges-only solution away from correct odometry, too.
        scale = max(state.covariance_scale(), 1.0)
        self._is_apart = separation > APART * scale
        if self._separation < VERIFIED_SEPARATION * scale:
            self._is_rejected = False
        elif self._separation > REJECTED_SEPARATION * scale:
            self._reset_heading("odometry wrong")
            self._rejections += 1.0
            self._is_rejected = True

    def _start_yaws(self, point: PathPoint) -> None:
        """Start filters at the position of the ranges-only filter when the robot drives."""
        start = self.tag.filter
        if start is None:
            return
        if self._begin is None or self._begin.segment != point.segment:
            self._begin = point
        if point.distance_m - self._begin.distance_m < START_M:
            return
        config, lever_arm, step = self._config, self._robot.lever_arm, math.tau / NUM_YAWS
        for number in range(NUM_YAWS):
            yaw = number * step, step / 2.0
            started = OdometryFilter(config.anchors, config.model, start, point, lever_arm, yaw)
            self._yaws.append(_HeadingHypothesis(started, 0.0))

    def _prune(self) -> None:
        """Remove implausible and equal hypotheses; the best one is the first."""
        if len(self._yaws) > 1:
            self._yaws.sort(key=lambda hypothesis: hypothesis.loss)
            least, plausible = self._yaws[0].loss, list[_HeadingHypothesis]()
            for hypothesis in self._yaws:
                hypothesis.loss -= least
                yaw = hypothesis.filter.yaw
                if hypothesis.loss <= IMPLAUSIBLE and all(
                    abs(math.remainder(yaw - better.filter.yaw, math.tau)) > SAME_YAW for better in plausible
                ):
                    plausible.append(hypothesis)
            self._yaws = plausible
        best = self._yaws[0].filter
        if self._heading_filter is None and len(self._yaws) == 1 and best.yaw_variance < KNOWN_YAW_SD**2:
            self._heading_filter = best
            # Not verified yet.
            self._separation = EQUAL_SEPARATION
            self.tag.counts["heading found"] += 1

    def _reset_heading(self, reason: str | None) -> None:
        """Continue with ranges only, for a reason to count."""
        self._heading_filter, self._begin, self._separation, self._yaws = None, None, 0.0, []
        if reason is not None:
            self.tag.counts[reason] += 1
