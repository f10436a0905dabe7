"""The position of one tag from its first range: initialisation and tracking.

While several positions explain the ranges of the last second, each is followed by a filter, and no position is published. It is
withheld also if the anchors do not exclude its image with another x and y (`ambiguity.py`).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import Dop, Height, dop
from uwb_mitigation.positioning.online.ambiguity import SAME_M, AmbiguityCheck
from uwb_mitigation.positioning.online.filter import CONTRADICTED_FACTOR, KinematicState, RangeFilter
from uwb_mitigation.positioning.online.initialization import (
    IMPLAUSIBLE,
    CandidatePosition,
    candidate_positions,
)
from uwb_mitigation.positioning.online.measurements import TagHeight, TagRange
from uwb_mitigation.positioning.online.robust_update import COVARIANCE_SCALE
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Estimate, Heights, Ranges, Track, rows_of

WINDOW_S = 1.0
"""A position is searched from the ranges of this time: every anchor had its turn, and a robot has moved by a metre."""

RANGE_TIMEOUT_S = 3.0
"""After a longer time without ranges the position is searched again: the predicted one may mislead."""

OUTLIER, LOST_SHARE = 3.0, 0.7
"""The tag was lost if this share of the latest ranges of at least half of the anchors had a larger normalised innovation."""

CONTRADICTED_S = 60.0
"""Two losses within this time happen in none of the 40 drives of `benchmarks positions` in layouts whose anchors are not on a line."""

TOO_SHORT = 10.0
"""Ranges contradict a position if the mean squares of the negative normalised innovations of two anchors are larger: obstacles do not
make ranges shorter, and one such anchor alone does not spoil the position. Largest values with right anchors: 6.0 (six Hanyang runs),
2.1 (30 simulated drives); with two of five swapped, 24 or more for seven of ten pairs."""

SHORT_MEAN, TYPICAL_MEAN = 0.5, 0.25
"""Obstacles only lengthen ranges. If the mean normalised innovation of an anchor is below minus the first value and the median magnitude of
those of all anchors is above the second one, anchors have larger constant errors than the model: the variance of raw ranges grows until
this ends. Otherwise the robust loss follows anchors that agree by chance. Chosen in 17 drives past random anchors, and in `box`."""

WIDENING, MAX_WIDENING = 0.1, 9.0
"""Change of the logarithm of this factor in 0.25 s, if the means are twice these values, and its limit: constant errors of 0.3 m."""

OBSTACLE_S = 1.5
"""If the ranges of exactly half of the anchors are too long, obstacles are the reason unless it lasts longer. Chosen in drives behind
concrete as in `docs/experiments/when_worth_it.py`, with other seeds."""

DISAGREES = 1.5
"""An anchor contradicts the others if the mean of its normalised innovations is larger: persisting errors average out."""

SURPRISE = 1.0
"""Normalised innovation of the first height from which the position is searched again."""

HEIGHT_AGE_NS = 200_000_000

MAX_AMBIGUOUS_S = 2.0
"""For this time the velocity determines on which side of a mirror a tag continues; after it, the position is searched again."""

_UNDETERMINED_M = 5.0
"""A position with a larger horizontal standard deviation is not determined by the ranges."""

_WITHOUT_HEIGHT = np.outer([1, 1, 0, 1, 1, 1], [1.0, 1, 0, 1, 1, 1])

_RETAINED_RANGES = 400
_MAX_CANDIDATES = 12
_RETRY_S = 0.25


@dataclass(slots=True)
class _AnchorState:
    """Statistics of the latest ranges of one anchor.

    Attributes:
        received_s: time of the latest; -inf: none.
        outliers: share of the latest ranges (about twenty) that contradicted the filter; short: share of those that were too short.
        mean_z: running mean of the normalised innovation over about fifty ranges, each limited to 5. short_square: the same of
            the square of negative ones, each limited to 10.
    """

    received_s: float = -math.inf
    outliers: float = 0.0
    short: float = 0.0
    mean_z: float = 0.0
    short_square: float = 0.0


@dataclass(slots=True)
class _PositionHypothesis:
    filter: RangeFilter
    loss: float


class TagEstimator:
    """Locates one tag.

    Attributes:
        config, anchors: as given, and those of the config.
        counts: numbers of ranges out of order (`backwards`), and of times the tag was `found`, `lost`, lost twice
            within `CONTRADICTED_S` (`contradicted`), and without ranges (`silent`); of ranges that contradicted it as
            `TOO_SHORT` says (`too short`).
        innovation_mean, innovation_square: running means over about a hundred ranges: of the normalised innovation, and of
            its square (1 is ideal).
        raw_factor: of the variance of raw ranges, see `SHORT_MEAN`.
        filter: the filter that follows the tag; None: its position is searched.
        images: other positions that explain the ranges; checked four times per second.
        undetermined: the ranges do not determine the horizontal position at all.
    """

    filter: RangeFilter | None
    _hypotheses: list[_PositionHypothesis]
    _origin_ns: int | None
    _time_s: float

    def __init__(self, config: EstimatorConfig) -> None:
        self.anchors = config.anchors
        self.counts: Counter[str] = Counter()
        self.innovation_mean, self.innovation_square, self.raw_factor = 0.0, 1.0, 1.0
        self.config, self._model = config, config.model
        self.images = AmbiguityCheck(config)
        self._height, self._area = config.height, config.area
        self._states = [_AnchorState() for _ in range(len(self.anchors))]
        self._heights: deque[tuple[float, float, float]] = deque(maxlen=_RETAINED_RANGES)
        self._recent: deque[tuple[float, int, float, float]] = deque(maxlen=_RETAINED_RANGES)
        self._losses_s: deque[float] = deque(maxlen=2)
        self.restart()

    @property
    def is_contradicted(self) -> bool:
        """Whether ranges of two anchors are too short, or those of half of the anchors contradicted it twice within `CONTRADICTED_S`."""
        is_often_lost = len(self._losses_s) == 2 and self._time_s < self._losses_s[0] + CONTRADICTED_S
        return self._is_short or is_often_lost

    @property
    def is_ambiguous(self) -> bool:
        """Whether positions with another x and y explain the ranges: the position is not published."""
        return self.images.is_ambiguous

    @property
    def candidates(self) -> int:
        """The number of plausible positions; 1: the tag is followed, 0: there are too few ranges."""
        return (1 if self.filter is not None else len(self._hypotheses)) + self.is_ambiguous

    @property
    def likely_position(self) -> NDArray[np.float64] | None:
        """The position that explains the ranges best, float64 (3,), even if it is not published; None: no position does."""
        if self.filter is None:
            return self._hypotheses[0].filter.position if self._hypotheses else None
        return self.filter.position

    def add(self, measurement: TagRange | TagHeight) -> Estimate | None:
        """Update with a measurement; an invalid one is skipped.

        A range that is up to `WINDOW_S` older than the latest one is used at that time.

        Returns:
            The estimate after a range; None: the position is not known.
        """
        if not measurement.is_valid:
            return None
        if isinstance(measurement, TagHeight):
            self._add_height(measurement)
            return None
        published = self.update(measurement)
        return None if published is None else Estimate(measurement.stamp_ns, *self.solution(published))

    def update(self, measurement: TagRange) -> RangeFilter | None:
        """Update with a valid range; return the filter whose `solution` can be published."""
        stamp_ns, anchor, range_m, variance_m2, _ = measurement
        time_s = self.seconds(stamp_ns)
        if time_s < self._time_s:
            if time_s < self._time_s - WINDOW_S:
                # A replay starts again.
                self.restart(stamp_ns)
                time_s = 0.0
            else:
                self.counts["backwards"] += 1
                time_s = self._time_s
        gap_s = time_s - self._time_s
        if self.filter is not None and gap_s > RANGE_TIMEOUT_S:
            self.counts["silent"] += 1
            self._restart_search(time_s)
        elif self.filter is not None and gap_s > WINDOW_S:
            # Not every anchor had its turn since the gap: check the geometry later.
            self._next_check_s = time_s + WINDOW_S
        self._time_s = time_s
        self._recent.append((time_s, anchor, range_m, variance_m2))
        self._states[anchor].received_s = time_s
        if self.filter is None:
            self._search(measurement)
        else:
            self._follow(self.filter, measurement)
        return None if self.images.is_ambiguous else self.filter

    def run(self, ranges: Ranges) -> Track:
        """Process recorded ranges, and the measured heights of the config; return an estimate for each range with one."""
        return run_estimator(self.add, self.config.heights, ranges)

    def predict_at(self, stamp_ns: int) -> Estimate | None:
        """Predict the position at a time after the latest range; None: not known."""
        predicted = self.predicted(stamp_ns)
        return None if predicted is None else Estimate(stamp_ns, *self.solution(predicted))

    def predicted(self, stamp_ns: int) -> RangeFilter | None:
        """Return the filter at a time after the latest range, see `update`."""
        if self.filter is None or self.is_ambiguous:
            return None
        predicted = self.filter.copy()
        predicted.predict(self.seconds(stamp_ns))
        self._confine(predicted)
        return predicted

    def restart(self, stamp_ns: int | None = None) -> None:
        """Reset the position, but not the statistics."""
        self._origin_ns = stamp_ns
        self._time_s = -math.inf
        self._heights.clear()
        self._recent.clear()
        self._losses_s.clear()
        self._is_short = False
        for state in self._states:
            state.received_s, state.short_square = -math.inf, 0.0
        self._restart_search(-math.inf)

    def received_anchors(self, within_s: float = WINDOW_S) -> list[int]:
        """Return the rows of the anchors that were received within that time before the latest range."""
        since_s = self._time_s - within_s
        return [i for i, s in enumerate(self._states) if s.received_s >= since_s]

    def disagreeing(self) -> list[int]:
        """Return the rows of anchors whose ranges contradict those of most others, or now those of the other half."""
        received = self.received_anchors(5.0)
        if self._blocked_since_s < math.inf:
            return [row for row in received if self._states[row].outliers > LOST_SHARE]
        contradicting = [i for i in received if abs(self._states[i].mean_z) > DISAGREES]
        return contradicting if 2 * len(contradicting) < len(received) else []

    def dop(self) -> Dop | None:
        """Return the geometry of the anchors that are received; None: the position is not known."""
        if self.filter is None:
            return None
        rows = self.received_anchors()
        return dop(self.anchors.position[rows], self.filter.position, level=self.dims == 2)

    def seconds(self, stamp_ns: int) -> float:
        """Return the time since the first range, s."""
        if self._origin_ns is None:
            self._origin_ns = stamp_ns
        return (stamp_ns - self._origin_ns) / NS_PER_S

    def _add_height(self, measurement: TagHeight) -> None:
        is_first = self._recent_height() is None
        self._heights.append((self._time_s, *measurement))
        for hypothesis in self._hypotheses:
            z, sd = hypothesis.filter.update_height(*measurement)
            hypothesis.loss += self._model.student_loss(z) + math.log(sd)
            self._confine(hypothesis.filter)
        if self.filter is not None:
            z, _ = self.filter.update_height(*measurement)
            self._confine(self.filter)
            if is_first and abs(z) > SURPRISE:
                # The linear update moves the position too far: search again with the known height.
                self._restart_search(self._time_s - WINDOW_S)

    def _follow(self, filter_: RangeFilter, measurement: TagRange) -> None:
        filter_.predict(self._time_s)
        # The first position contains the errors of the ranges of its window.
        filter_.state.estimates_errors = self._time_s >= self._found_s + WINDOW_S
        if self.images.mirror and self.images.compare(filter_, measurement, len(self.received_anchors())):
            self._next_check_s = -math.inf
        z, _ = filter_.update(*measurement[1:])
        self._confine(filter_)
        limited = z if -10.0 < z < 10.0 else math.copysign(10.0, z)
        self.innovation_mean += 0.01 * (limited - self.innovation_mean)
        self.innovation_square += 0.01 * (limited * limited - self.innovation_square)
        self.counts["too short"] += self._is_short
        # Wrong anchor positions also widen the variance, but must be reported.
        unwidened = z if measurement.is_corrected else z * math.sqrt(filter_.state.raw_factor)
        state, short = self._states[measurement.anchor], 0.0
        if unwidened < 0.0:
            short = unwidened if unwidened > -10.0 else -10.0
        state.short_square += 0.02 * (short * short - state.short_square)
        state.outliers += 0.1 * ((abs(unwidened) > OUTLIER) - state.outliers)
        state.short += 0.1 * ((unwidened < -OUTLIER) - state.short)
        limited = z if -5.0 < z < 5.0 else math.copysign(5.0, z)
        state.mean_z += 0.02 * (limited - state.mean_z)
        if self._time_s >= self._next_check_s:
            self._next_check_s = self._time_s + _RETRY_S
            received, was_ambiguous = self.received_anchors(), self.is_ambiguous
            self._is_short = sum(self._states[row].short_square > TOO_SHORT for row in received) > 1
            filter_.factor = CONTRADICTED_FACTOR if self.is_contradicted else 1.0
            if not self.config.widens:
                # The smoother compares filters in both directions.
                filter_.factor *= filter_.state.covariance_scale() / COVARIANCE_SCALE
            self._adapt_variance([self._states[row].mean_z for row in received])
            filter_.state.raw_factor = self.raw_factor
            if self._detect_loss(received):
                self.counts["lost"] += 1
                self._losses_s.append(self._time_s)
                self.counts["contradicted"] += self.is_contradicted
                self._restart_search(self._time_s - WINDOW_S)
                return
            self.images.update(filter_, received, self.dims, self._time_s)
            if self.is_ambiguous and not was_ambiguous:
                self._ambiguous_s = self._time_s
            if was_ambiguous and not self.is_ambiguous and self._time_s > self._ambiguous_s + MAX_AMBIGUOUS_S:
                self._restart_search(self._time_s - WINDOW_S)

    def _adapt_variance(self, means: list[float]) -> None:
        """Adapt the variance of raw ranges to the mean normalised innovations of the anchors."""
        excess = -1.0
        if len(means) > 3:
            excess += min(-min(means) / SHORT_MEAN, sorted(map(abs, means))[len(means) // 2] / TYPICAL_MEAN)
        factor = self.raw_factor * math.exp(WIDENING * min(excess, 1.0))
        self.raw_factor = min(max(factor, 1.0), MAX_WIDENING)

    def _detect_loss(self, received: list[int]) -> bool:
        """Return whether ranges of at least half of the received anchors contradict the filter, and obstacles are not the reason."""
        states = [self._states[row] for row in received]
        contradicting = [state for state in states if state.outliers > LOST_SHARE]
        if 2 * len(contradicting) < len(received):
            self._blocked_since_s = math.inf
            return False
        self._blocked_since_s = min(self._blocked_since_s, self._time_s)
        is_most = 2 * len(contradicting) > len(received)
        is_short = any(2.0 * state.short > state.outliers for state in contradicting)
        return is_most or is_short or self._time_s > self._blocked_since_s + OBSTACLE_S

    def solution(self, filter_: RangeFilter) -> KinematicState:
        """Return position, velocity and covariance of an estimate, with the known height and a covariance that contains images."""
        position, velocity, covariance = filter_.solution()
        if self.images.mirror is not None:
            position += self.images.shift
        if self._height is not None:
            # Constant errors of ranges would move it in the filter.
            position[2] = self._height.value
            covariance *= _WITHOUT_HEIGHT
            covariance[2, 2] = self._height.sd**2
        return position, velocity, covariance

    def _confine(self, filter_: RangeFilter) -> None:
        """Keep a filter inside the area."""
        if self._area is not None:
            filter_.confine(self._area.low, self._area.high)

    def _recent_height(self) -> Height | None:
        """The constant height, or that of the last second's measurements; None: unknown."""
        while self._heights and self._heights[0][0] < self._time_s - WINDOW_S:
            self._heights.popleft()
        if self._height is not None or not self._heights:
            return self._height
        _, heights, variances = zip(*self._heights, strict=True)
        return Height(float(np.median(heights)), max(math.sqrt(float(np.median(variances))), 0.02))

    @property
    def dims(self) -> int:
        """The number of unknown coordinates: 2 if the height is known or measured."""
        return 2 if self._recent_height() is not None else 3

    def _restart_search(self, time_s: float) -> None:
        self.filter, self._hypotheses = None, []
        for state in self._states:
            state.outliers = state.short = 0.0
        self.images.reset()
        self.undetermined = False
        self._search_began_s, self._next_check_s = time_s, -math.inf
        self._found_s = self._blocked_since_s = math.inf

    def _search(self, measurement: TagRange) -> None:
        time_s = self._time_s
        if self._search_began_s == -math.inf:
            self._search_began_s = time_s
        if self._hypotheses:
            for hypothesis in self._hypotheses:
                hypothesis.filter.predict(time_s)
                z, sd = hypothesis.filter.update(*measurement[1:])
                self._confine(hypothesis.filter)
                hypothesis.loss += self._model.student_loss(z) + math.log(sd)
            self._settle()
            return
        # Wait until every anchor had its turn, or enough were received.
        is_early = time_s - self._search_began_s < WINDOW_S / 2
        if time_s < self._next_check_s or (is_early and len(self.received_anchors()) < self.dims + 2):
            return
        self._next_check_s = time_s + _RETRY_S
        rows, range_m, sd_m = self._window()
        anchors = self.anchors.position[rows]
        height = self._recent_height()
        if len(range_m) < (2 if height is not None else 3):
            return
        candidates = candidate_positions(anchors, range_m, sd_m, self._model, height=height, area=self._area)
        if candidates and len(candidates) <= _MAX_CANDIDATES:
            self._start(candidates, 1.0 + self._model.offset_sd**2 / float(np.median(sd_m)) ** 2)

    def _window(self) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """Return rows (k,), median ranges (k,) and their standard deviations (k,) of the last second's anchors."""
        recent = [row for row in self._recent if row[0] >= self._time_s - WINDOW_S]
        rows = list(dict.fromkeys(row[1] for row in recent))
        ranges, sds = [], []
        for anchor in rows:
            times, _, values, variances = zip(*(row for row in recent if row[1] == anchor), strict=True)
            ranges.append(float(np.median(values)))
            variance = float(np.median(self._model.variances(np.array(variances))))
            age = self._time_s - float(np.mean(times))
            sds.append(
                math.sqrt(variance + self.anchors.sd[anchor] ** 2 + (self._model.speed * age) ** 2 / 3.0)
            )
        return np.array(rows, np.intp), np.array(ranges), np.array(sds)

    def _start(self, candidates: list[CandidatePosition], inflation: float) -> None:
        """Start a filter at each position; the covariances are inflated for the common offset."""
        model, height = self._model, self._height
        for candidate in candidates:
            position, covariance = candidate.position.copy(), candidate.covariance * inflation
            # The tag has moved since the middle of the window.
            covariance[[0, 1, 2], [0, 1, 2]] += (model.speed * WINDOW_S / 2.0) ** 2
            if height is not None:
                position[2] = height.value
                covariance[2] = covariance[:, 2] = 0.0
                covariance[2, 2] = height.sd**2
            level = height is not None
            started = RangeFilter(self.anchors, model, self._time_s, position, covariance, level=level)
            self._hypotheses.append(_PositionHypothesis(started, candidate.loss))
        self._settle()

    def _settle(self) -> None:
        """Remove candidates that are implausible or equal; follow the last one."""
        best = min(hypothesis.loss for hypothesis in self._hypotheses)
        plausible: list[_PositionHypothesis] = []
        for hypothesis in sorted(self._hypotheses, key=lambda hypothesis: hypothesis.loss):
            position = hypothesis.filter.position
            if hypothesis.loss <= best + IMPLAUSIBLE and all(
                np.linalg.norm(position - better.filter.position) > SAME_M for better in plausible
            ):
                plausible.append(hypothesis)
        self._hypotheses = plausible
        leader = plausible[0].filter
        self.undetermined = bool(leader.P[:2, :2].diagonal().max() > _UNDETERMINED_M**2)
        differences = [hypothesis.filter.position - leader.position for hypothesis in plausible[1:]]
        if not self.undetermined and all(math.hypot(x, y) < SAME_M for x, y, _ in differences):
            self.images.reset()
            self.images.check(leader, self.received_anchors(), self.dims)
            if not self.is_ambiguous:
                self.filter, self._hypotheses, self._found_s = leader, [], self._time_s
                self.counts["found"] += 1
                return
        if self._time_s - self._search_began_s > 10.0 * WINDOW_S:
            # The candidates from one second of ranges may all be wrong: search again.
            self._search_began_s, self._hypotheses = self._time_s, []


def run_estimator(
    add: Callable[[TagRange | TagHeight], Estimate | None], heights: Heights | None, ranges: Ranges
) -> Track:
    """Process recorded ranges and heights with the method `add` of an estimator."""
    estimates: list[Estimate] = []
    waiting = deque[tuple[int, float, float]]()
    if heights is not None:
        waiting.extend(rows_of(heights.stamp_ns, heights.height_m, heights.variance_m2))
    latest_ns = None
    is_corrected = np.broadcast_to(ranges.is_corrected, len(ranges))
    for row in rows_of(ranges.stamp_ns, ranges.anchor, ranges.range_m, ranges.variance_m2, is_corrected):
        while waiting and waiting[0][0] <= row[0]:
            height_ns, *height = waiting.popleft()
            # A height is valid at the time of the latest range: skip those in a gap of the ranges.
            if latest_ns is not None and height_ns - latest_ns <= HEIGHT_AGE_NS:
                add(TagHeight(*height))
        latest_ns = row[0]
        estimate = add(TagRange(*row))
        if estimate is not None:
            estimates.append(estimate)
    return Track.from_estimates(estimates)
