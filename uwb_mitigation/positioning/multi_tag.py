"""All tags of a site: an estimator and a fixed-lag smoother for each, and their diagnostics."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np

from uwb_mitigation.errors import DatasetError, format_id
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.determination import current_determination
from uwb_mitigation.positioning.geometry import protection_levels
from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning
from uwb_mitigation.positioning.online.filter import RangeFilter
from uwb_mitigation.positioning.online.measurements import TagHeight, TagRange
from uwb_mitigation.positioning.online.robot_estimator import RobotEstimator
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Estimate, Heights, Ranges, Track

MAX_TAGS = 256
"""More tags are probably damaged numbers."""

MIN_RANGES, MAX_RATE_HZ = 100, 10_000.0
"""No radio ranges faster; stamps of more ranges at a higher rate are in another unit than nanoseconds (microseconds: from 10 Hz)."""

UNKNOWN_HEIGHT_SD_M = 0.1
"""Standard deviation of a measured height without a variance."""

LAG_S = 1.0
"""What a robot does next shows its present position for about this time."""

_BEFORE_S = 0.5
_EVERY_S = 0.1
_MAX_RANGES = 400
_ITERATIONS = 3


class FixedLagSmoother:
    """Keeps the latest states of the filter and ranges of a tag, and smooths over them on request."""

    def __init__(self, config: EstimatorConfig) -> None:
        # The filter has no offsets of single anchors, and 1.5 s do not determine them.
        self._config = replace(config, model=replace(config.model, pair_sd=0.0))
        self._states: deque[tuple[int, RangeFilter, Estimate]] = deque()
        self._ranges: deque[tuple[int, int, float, float]] = deque()
        self._heights: deque[tuple[int, float, float]] = deque(maxlen=_MAX_RANGES)

    def add_height(self, height_m: float, variance_m2: float) -> None:
        """Add the tag's height at the time of the latest range; the variance is positive."""
        if self._ranges:
            self._heights.append((self._ranges[-1][0], height_m, variance_m2))

    def add(
        self,
        range_filter: RangeFilter,
        stamp_ns: int,
        anchor: int,
        range_m: float,
        variance_m2: float,
        estimate: Estimate,
    ) -> None:
        """Add a range, and the filter and the estimate after it."""
        if self._ranges and stamp_ns < self._ranges[-1][0]:
            self.clear()
        self._ranges.append((stamp_ns, anchor, range_m, variance_m2))
        if not self._states or stamp_ns - self._states[-1][0] >= _EVERY_S * NS_PER_S:
            self._states.append((stamp_ns, range_filter.copy(), estimate))
        oldest = stamp_ns - round((LAG_S + _BEFORE_S + _EVERY_S) * NS_PER_S)
        for history in (self._states, self._ranges, self._heights):
            while history and history[0][0] < oldest:
                history.popleft()

    def clear(self) -> None:
        """Reset all states: the tag was lost."""
        self._states.clear()
        self._ranges.clear()
        self._heights.clear()

    def estimate(self) -> Estimate | None:
        """Return the position `LAG_S` before the latest range; None: it is not known for that long."""
        # SciPy is imported on demand: it would delay the first position by 0.2 s.
        from uwb_mitigation.positioning.batch.smoother import Smoother, fused_with_batch

        if not self._states or len(self._ranges) < 2:
            return None
        config, (start_ns, range_filter, _) = self._config, self._states[0]
        query_ns = self._ranges[-1][0] - round(LAG_S * NS_PER_S)
        after = [row for row in self._ranges if row[0] > start_ns]
        if start_ns > query_ns or len(after) < 2:
            return None
        # Errors persist for a second: at a high rate a part of the ranges contains the same information.
        after = after[:: math.ceil(len(after) / _MAX_RANGES)]
        stamp, anchor, range_m, variance = (np.array(column) for column in zip(*after, strict=True))
        ranges = Ranges(stamp, anchor, range_m, variance, np.full(len(after), np.nan))
        first = range_filter.copy()
        first.predict(first.time_s + (int(stamp[0]) - start_ns) / NS_PER_S)
        states = [(stamp_ns, state) for stamp_ns, state, _ in self._states if stamp_ns > start_ns] or [
            (int(stamp[0]), first)
        ]
        initial = Track.from_estimates([state.estimate(stamp_ns) for stamp_ns, state in states])
        if self._heights:
            columns = zip(*self._heights, strict=True)
            config = replace(config, heights=Heights(*(np.array(column) for column in columns)))
        try:
            track = Smoother(config, ranges, after=first).fit(initial, _ITERATIONS).track
        except DatasetError:
            return None
        nearest = int(np.abs(track.stamp_ns - query_ns).argmin())
        batch = track.take(slice(nearest, nearest + 1))
        batch.position[:] += (query_ns - int(track.stamp_ns[nearest])) / NS_PER_S * batch.velocity
        live_ns, live, estimate = [state for state in self._states if state[0] <= query_ns][-1]
        after_s = (query_ns - live_ns) / NS_PER_S
        moved, velocity = estimate.position + after_s * estimate.velocity, estimate.velocity
        covariance = estimate.covariance
        if estimate.heading is None:
            live = live.copy()
            live.predict(live.time_s + after_s)
            predicted = live.estimate(query_ns)
            moved, velocity, covariance = predicted.position, predicted.velocity, predicted.covariance
        batch.covariance[:] = live.factor * batch.covariance + live.unseen
        mean = np.concatenate([moved, velocity])
        state, covariance, spread = fused_with_batch(mean[None], covariance[None], batch)
        position = state[0, :3] if config.area is None else config.area.clip(state[0, :3])
        return Estimate(query_ns, position, state[0, 3:], (covariance + spread)[0], estimate.heading)


@dataclass(slots=True)
class TagState:
    """Estimators of one tag.

    Attributes:
        tag_id: its number.
        estimator: position from ranges only. robot: with odometry, if a robot carries this tag; it contains `estimator`.
        smoother: of this tag.
        latest_ns: stamp of its latest range. ranges: number of its ranges.
        first_ns: stamp of its first range.
        is_corrected: whether a range of this tag was corrected.
    """

    tag_id: int
    estimator: TagEstimator
    smoother: FixedLagSmoother
    robot: RobotEstimator | None = None
    latest_ns: int = 0
    ranges: int = 0
    first_ns: int = 0
    is_corrected: bool = False

    @property
    def best(self) -> TagEstimator | RobotEstimator:
        """The estimator with odometry, if there is one."""
        return self.robot or self.estimator

    def add_height(self, height_m: float, variance_m2: float) -> None:
        """Update with the tag's height at the time of its latest range; an implausible height is skipped."""
        # A variance of 0 means unknown in ROS.
        height = TagHeight(height_m, UNKNOWN_HEIGHT_SD_M**2 if variance_m2 <= 0.0 else variance_m2)
        if height.is_valid:
            self.best.add(height)
            self.smoother.add_height(height_m, height.variance_m2)


class MultiTagEstimator:
    """The tags of a site.

    Attributes:
        anchors: those of the config.
        tags: {tag id: tag}, in the order of their first ranges.
        unknown_anchors: number of ranges from anchors that are not on the map, {anchor id: count}.
        invalid: number of ranges that were skipped: not finite, negative, implausible, or of too many tags.
        odometry: motion of the robot of the config; add its messages.
        robot: estimator of the tag that this robot carries; None: it was not received yet.

    Args:
        config: `robot` set: one of the tags is on a robot with odometry.
        robot_tag: its id; 0: the first tag that is received.
        odometry: shared with the caller; None: of its own.
    """

    def __init__(
        self, config: EstimatorConfig, robot_tag: int = 0, odometry: DeadReckoning | None = None
    ) -> None:
        self.odometry = odometry or DeadReckoning()
        self.robot: RobotEstimator | None = None
        self._robot_tag = robot_tag
        self.anchors = config.anchors
        self.tags: dict[int, TagState] = {}
        self.unknown_anchors: Counter[int] = Counter()
        self.invalid = 0
        self._config = config

    def add(
        self,
        tag_id: int,
        anchor_id: int,
        stamp_ns: int,
        range_m: float,
        variance_m2: float,
        is_corrected: bool = True,
    ) -> tuple[TagState, Estimate | None] | None:
        """Update with a range.

        Until a range of the tag was corrected (a radio without CIRs), its ranges are those of an uncorrected radio: the variance
        is that of `NoiseModel`, whose robust weights and offset cover what a published variance adds.

        Returns:
            The tag and its estimate (None: unknown); None: the range was skipped.
        """
        row = self.anchors.index.get(anchor_id)
        if row is None:
            if anchor_id in self.unknown_anchors or len(self.unknown_anchors) < MAX_TAGS:
                self.unknown_anchors[anchor_id] += 1
            return None
        tag = self.tags.get(tag_id)
        if not is_corrected and (tag is None or not tag.is_corrected) and variance_m2 < math.inf:
            variance_m2 = math.nan
        measurement = TagRange(stamp_ns, row, range_m, variance_m2, is_corrected)
        if not measurement.is_valid or (tag is None and len(self.tags) >= MAX_TAGS):
            self.invalid += 1
            return None
        if tag is None:
            tag = self.tags[tag_id] = self._new_tag(tag_id)
        if not tag.ranges or stamp_ns < tag.latest_ns - NS_PER_S:
            # The first range, or a replay that starts again.
            tag.first_ns, tag.ranges = stamp_ns, 0
        tag.ranges += 1
        tag.is_corrected |= is_corrected
        estimate = tag.best.add(measurement)
        tag.latest_ns = stamp_ns
        range_filter = tag.estimator.filter
        if range_filter is None:
            tag.smoother.clear()
        elif estimate is not None:
            tag.smoother.add(range_filter, stamp_ns, row, range_m, variance_m2, estimate)
        return tag, estimate

    def _new_tag(self, tag_id: int) -> TagState:
        smoother = FixedLagSmoother(self._config)
        if self._config.robot is None or self.robot is not None or self._robot_tag not in (0, tag_id):
            return TagState(tag_id, TagEstimator(self._config), smoother)
        self.robot = RobotEstimator(self._config, self.odometry)
        return TagState(tag_id, self.robot.tag, smoother, self.robot)

    def warnings(self) -> list[str]:
        """Return warnings for the diagnostics; empty: none."""
        warnings = []
        if self.unknown_anchors:
            names = ", ".join(format_id(identity) for identity in sorted(self.unknown_anchors)[:5])
            warnings.append(f"ranges of anchors that are not in the anchors file: {names}")
        for tag in self.tags.values():
            estimator, name = tag.estimator, f"tag {format_id(tag.tag_id)}"
            span_s = (tag.latest_ns - tag.first_ns) / NS_PER_S
            if tag.ranges >= MIN_RANGES and tag.ranges > MAX_RATE_HZ * abs(span_s):
                warnings.append(
                    f"{name}: {tag.ranges} ranges in {span_s:.6f} s: positions are wrong, because stamps must be nanoseconds"
                )
            determination = current_determination(estimator)
            if not determination.is_unique:
                warnings.append(f"{name}: {determination}")
            if tag.robot is not None:
                if tag.robot.odometry.point_at(tag.latest_ns) is None:
                    warnings.append(
                        f"{name}: no odometry at the times of the ranges: estimated from ranges only"
                    )
                elif tag.robot.rejects_odometry:
                    warnings.append(
                        f"{name}: odometry contradicts the ranges (slip, moved by hand, or a wrong axis, sign, delay or lever "
                        "arm): not used"
                    )
            contradicting = [self.anchors.anchors[row] for row in estimator.disagreeing()]
            warnings += [
                f"{name}: ranges of anchor {anchor} do not fit: blocked, wrong in the anchors file, or a wrong height or "
                "lever arm of the tag"
                for anchor in contradicting
            ]
        return warnings

    def diagnostics(self) -> dict[str, object]:
        """Return the values for the diagnostics."""
        values: dict[str, object] = {
            "anchors": len(self.anchors),
            "tags": len(self.tags),
            "ranges not valid": self.invalid,
            "ranges of unknown anchors": self.unknown_anchors.total(),
        }
        for tag in self.tags.values():
            estimator, name = tag.estimator, f"tag {format_id(tag.tag_id)}"
            counts, range_filter = estimator.counts, estimator.filter
            values |= {
                f"{name} determination": str(current_determination(estimator)),
                f"{name} candidates": estimator.candidates,
                f"{name} anchors used": len(estimator.received_anchors()),
                f"{name} found, lost, silent": f"{counts['found']}, {counts['lost']}, {counts['silent']}",
                f"{name} out of order": counts["backwards"],
                f"{name} innovation mean": f"{estimator.innovation_mean:.2f}",
                f"{name} innovation square": f"{estimator.innovation_square:.2f}",
            }
            if range_filter is not None:
                values |= {
                    f"{name} overcorrection": f"{min(range_filter.state.overcorrection, 0.0):.2f}",
                    f"{name} persisting errors m": f"{math.sqrt(range_filter.state.persisting_variance(len(estimator.received_anchors()), estimator.dims)):.2f}",
                    f"{name} variance factor": f"{estimator.raw_factor:.1f}",
                }
            if tag.robot is not None:
                values |= {
                    f"{name} heading": tag.robot.heading,
                    f"{name} heading found, odometry missing, wrong": ", ".join(
                        str(counts[key]) for key in ("heading found", "odometry missing", "odometry wrong")
                    ),
                    "odometry rejected": tag.robot.odometry.rejected,
                }
            dop = estimator.dop()
            if dop is not None and range_filter is not None:
                levels = protection_levels(range_filter.estimate(0).covariance)
                values |= {
                    f"{name} HDOP": f"{dop.hdop:.2f}",
                    f"{name} VDOP": f"{dop.vdop:.2f}",
                    f"{name} protection level m": ", ".join(f"{level:.2f}" for level in levels),
                }
        return values
