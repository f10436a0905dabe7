"""The position of one tag from its first range: initialisation, tracking, detection of a lost track, and relocalisation.

While several positions explain the ranges, each is followed by a filter of its own, and no position is published.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import Area, Dop, Height, dop
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.filter import FIRST_ERROR, OFFSET, RangeFilter
from uwb_mitigation.positioning.online.initialization import (
    IMPLAUSIBLE,
    CandidatePosition,
    candidate_positions,
)
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Estimate, Heights, Imu, Odometry, Ranges, Track, rows_of

WINDOW_S = 1.0
"""A position is searched from the ranges of this time: every anchor had its turn, and a robot has moved by a metre."""

RANGE_TIMEOUT_S = 3.0
"""After a longer time without ranges the position is searched again: the predicted one may mislead."""

OUTLIER = 3.0
"""A range with a larger normalised innovation contradicts the filter."""

DISAGREES = 1.5
"""An anchor contradicts the others if the mean of its normalised innovations is larger: persisting errors average out."""

HEIGHT_AGE_NS = 200_000_000

MAX_VALUE = 1e5
"""Ranges and heights (m) and their variances (m^2) beyond this are invalid."""

_BENDS_M = 0.5
"""A height that moves an estimate by more in plan is not a linear measurement: the position is searched again."""

_SEPARABLE = 9.0
"""Squared distance of two positions in their ranges, in standard deviations, from which the ranges separate them."""

_UNDETERMINED_M = 5.0
"""A position with a larger horizontal standard deviation is not determined by the ranges."""

_KEPT_RANGES = 400
_MAX_CANDIDATES = 12
_RETRY_S = 0.25
_SPARE_ANCHORS = 2


@dataclass(frozen=True, slots=True, eq=False)
class RobotData:
    """Recorded motion of a robot, and its antenna.

    Attributes:
        odometry, imu: recorded; None: none, or live.
        lever_arm: the antenna in the frame of the base, m.
    """

    odometry: Odometry | None = None
    imu: Imu | None = None
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorConfig:
    """Prior knowledge: anchors, error model, and of the tags a constant height, an area or measured heights, if any.

    Attributes:
        robot: motion of the robot that carries the tag, if it has odometry.
    """

    anchors: AnchorMap
    model: NoiseModel = field(default_factory=NoiseModel)
    height: Height | None = None
    area: Area | None = None
    heights: Heights | None = None
    robot: RobotData | None = None

    @property
    def dims(self) -> int:
        """The number of unknown coordinates of a position."""
        return 2 if self.height is not None else 3


@dataclass(slots=True)
class _AnchorState:
    """Statistics of the latest ranges of one anchor.

    Attributes:
        received_s: time of the latest; -inf: none.
        outliers: share of the latest ranges (about twenty) that contradicted the filter.
        mean_z: running mean of the normalised innovation over about fifty ranges, each limited to 5.
    """

    received_s: float = -math.inf
    outliers: float = 0.0
    mean_z: float = 0.0


@dataclass(slots=True)
class _PositionHypothesis:
    filter: RangeFilter
    loss: float


class TagEstimator:
    """Locates one tag.

    Attributes:
        anchors: those of the config.
        counts: numbers of ranges out of order (`backwards`), and of times the tag was `found`, `lost`, and without ranges
            (`silent`).
        innovation_mean, innovation_square: running means over about a hundred ranges: of the normalised innovation, and of
            its square (1 is ideal).
        filter: the filter that follows the tag; None: its position is searched.
        undetermined: the ranges do not determine the horizontal position at all.
    """

    filter: RangeFilter | None
    _last_known: RangeFilter | None
    _hypotheses: list[_PositionHypothesis]
    _ambiguous_with: list[NDArray[np.float64]]
    _origin_ns: int | None
    _time_s: float

    def __init__(self, config: EstimatorConfig) -> None:
        self.anchors = config.anchors
        self.counts: Counter[str] = Counter()
        self.innovation_mean, self.innovation_square = 0.0, 1.0
        self.undetermined = False
        self._config, self._model = config, config.model
        self._height, self._area = config.height, config.area
        self._states = [_AnchorState() for _ in range(len(self.anchors))]
        self._heights: deque[tuple[float, float, float]] = deque(maxlen=_KEPT_RANGES)
        self._recent: deque[tuple[float, int, float, float]] = deque(maxlen=_KEPT_RANGES)
        self._at_boundary = False
        self._latest_loss = math.nan
        self.restart()

    @property
    def is_known(self) -> bool:
        """Whether the position is known."""
        return self.filter is not None

    @property
    def candidates(self) -> int:
        """The number of plausible positions; 1: the tag is followed, 0: there are too few ranges."""
        return 1 if self.filter is not None else len(self._hypotheses) + len(self._ambiguous_with)

    def add(
        self, stamp_ns: int, anchor: int, range_m: float, variance_m2: float = math.nan
    ) -> Estimate | None:
        """Update with a range.

        Args:
            stamp_ns: of the range; if it is up to `WINDOW_S` older than the latest one, that time is used.
            anchor: a row of the anchors.
            range_m: m; a range that is not finite or negative is skipped.
            variance_m2: m^2; NaN: unknown. A range with an infinite one is skipped.

        Returns:
            The estimate; None: the position is not known.
        """
        if not is_valid(range_m, variance_m2):
            return None
        self._latest_loss = math.nan
        time_s = self._seconds(stamp_ns)
        if time_s < self._time_s:
            if time_s < self._time_s - WINDOW_S:
                # A replay starts again.
                self.restart(stamp_ns)
                time_s = 0.0
            else:
                self.counts["backwards"] += 1
                time_s = self._time_s
        if self.filter is not None and time_s - self._time_s > RANGE_TIMEOUT_S:
            self.counts["silent"] += 1
            self._restart_search(time_s)
        self._time_s = time_s
        self._recent.append((time_s, anchor, range_m, variance_m2))
        self._states[anchor].received_s = time_s
        if self.filter is None:
            self._search(anchor, range_m, variance_m2)
        else:
            self._follow(self.filter, anchor, range_m, variance_m2)
        return None if self.filter is None else self.filter.estimate(stamp_ns)

    def run(self, ranges: Ranges) -> Track:
        """Process recorded ranges, and the measured heights of the config; return an estimate for each range with one."""
        estimates: list[Estimate] = []
        heights = deque[tuple[int, float, float]]()
        if (known := self._config.heights) is not None:
            heights.extend(rows_of(known.stamp_ns, known.height_m, known.variance_m2))
        latest_ns = None
        rows = rows_of(ranges.stamp_ns, ranges.anchor, ranges.range_m, ranges.variance_m2)
        for stamp_ns, anchor, range_m, variance_m2 in rows:
            while heights and heights[0][0] <= stamp_ns:
                height_ns, *height = heights.popleft()
                # A height is valid at the time of the latest range: skip those in a gap of the ranges.
                if latest_ns is not None and height_ns - latest_ns <= HEIGHT_AGE_NS:
                    self.add_height(*height)
            latest_ns = stamp_ns
            estimate = self.add(stamp_ns, anchor, range_m, variance_m2)
            if estimate is not None:
                estimates.append(estimate)
        return Track.of(estimates)

    def add_height(self, height_m: float, variance_m2: float) -> None:
        """Update with the tag's height (finite) and its variance (positive), at the time of the latest range."""
        self._heights.append((self._time_s, height_m, variance_m2))
        if self._height is None and any(_is_nonlinear(one, height_m, variance_m2) for one in self._filters()):
            found = self._candidate_positions()
            if found and len(found) <= _MAX_CANDIDATES:
                self._last_known = self.filter or self._last_known
                self._start(found)
                return
        for one in self._filters():
            z = one.update_height(height_m, variance_m2)
            self._confine(one)
            for candidate in self._hypotheses:
                if candidate.filter is one:
                    candidate.loss += float(self._model.loss(np.float64(z)))

    def at(self, stamp_ns: int) -> Estimate | None:
        """Predict the position at a time after the latest range; None: not known."""
        if self.filter is None:
            return None
        ahead = self.filter.copy()
        ahead.predict(self._seconds(stamp_ns))
        self._confine(ahead)
        return ahead.estimate(stamp_ns)

    def restart(self, stamp_ns: int | None = None) -> None:
        """Reset the position, but not the statistics."""
        self._origin_ns = stamp_ns
        self.filter = self._last_known = None
        self._hypotheses, self._ambiguous_with = [], []
        self._recent.clear()
        self._heights.clear()
        self._time_s = self._next_try_s = self._checked_s = self._search_began_s = -math.inf
        for state in self._states:
            state.received_s, state.outliers = -math.inf, 0.0

    def received_anchors(self, within_s: float = WINDOW_S) -> list[int]:
        """Return the rows of the anchors that were received within that time before the latest range."""
        return [i for i, s in enumerate(self._states) if s.received_s >= self._time_s - within_s]

    def disagreeing(self) -> list[int]:
        """Return the rows of anchors whose ranges contradict those of most others."""
        received = self.received_anchors(5.0)
        contradicting = [i for i in received if abs(self._states[i].mean_z) > DISAGREES]
        return contradicting if 2 * len(contradicting) < len(received) else []

    def dop(self) -> Dop | None:
        """Return the geometry of the anchors that are received; None: the position is not known."""
        if self.filter is None:
            return None
        rows = self.received_anchors()
        return dop(self.anchors.position[rows], self.filter.position, level=self._dims == 2)

    def _seconds(self, stamp_ns: int) -> float:
        if self._origin_ns is None:
            self._origin_ns = stamp_ns
        return (stamp_ns - self._origin_ns) / NS_PER_S

    def _filters(self) -> list[RangeFilter]:
        return [self.filter] if self.filter is not None else [c.filter for c in self._hypotheses]

    def _follow(self, known: RangeFilter, anchor: int, range_m: float, variance_m2: float) -> None:
        known.predict(self._time_s)
        z, sd = known.update(anchor, range_m, variance_m2)
        self._latest_loss = self._model.loss_of(z, sd)
        if self._area is not None and self._confine(known):
            self._at_boundary = True
        limited = max(-10.0, min(10.0, z))
        self.innovation_mean += 0.01 * (limited - self.innovation_mean)
        self.innovation_square += 0.01 * (limited * limited - self.innovation_square)
        state = self._states[anchor]
        state.outliers += 0.1 * ((abs(z) > OUTLIER) - state.outliers)
        state.mean_z += 0.02 * (max(-5.0, min(5.0, z)) - state.mean_z)
        if self._time_s - self._checked_s >= _RETRY_S:
            self._checked_s = self._time_s
            received = self.received_anchors()
            known.updates_consider_states = len(received) >= self._dims + _SPARE_ANCHORS
            num_contradicting = sum(self._states[i].outliers > 0.5 for i in received)
            # At the edge of the area the filter may follow a solution that is outside of it.
            if self._at_boundary or (2 * num_contradicting >= len(received) > 0 and num_contradicting):
                self._at_boundary = False
                self._check_lost(known)

    def _confine(self, one: RangeFilter) -> bool:
        """Keep a filter inside the area; return whether it was outside."""
        return self._area is not None and one.confine(self._area.low, self._area.high)

    def _known_height(self) -> Height | None:
        """The constant height, or that of the last second's measurements; None: unknown."""
        while self._heights and self._heights[0][0] < self._time_s - WINDOW_S:
            self._heights.popleft()
        if self._height is not None or not self._heights:
            return self._height
        _, heights, variances = zip(*self._heights, strict=True)
        return Height(float(np.median(heights)), max(math.sqrt(float(np.median(variances))), 0.02))

    @property
    def _dims(self) -> int:
        return 2 if self._known_height() is not None else 3

    def _check_lost(self, known: RangeFilter) -> None:
        """Search for a position that explains the ranges much better, after most anchors contradicted the filter."""
        found = self._candidate_positions()
        if not found:
            return
        anchors, range_m, sd_m = self._window()
        here = np.linalg.norm(anchors - known.position, axis=1)
        loss = float(self._model.loss((range_m - here) / sd_m).sum())
        best = found[0]
        apart = best.position[:2] - known.position[:2]
        if loss > best.loss + IMPLAUSIBLE and apart @ apart > 9.0 * known.horizontal_sd**2:
            self.counts["lost"] += 1
            self._last_known = None
            self._start(found)

    def _restart_search(self, time_s: float) -> None:
        """Search the position again, with the present one as prior."""
        self._last_known = self.filter
        self.filter = None
        self._hypotheses = []
        self._recent.clear()
        self._search_began_s = time_s
        self._next_try_s = -math.inf

    def _search(self, anchor: int, range_m: float, variance_m2: float) -> None:
        time_s = self._time_s
        if self._search_began_s == -math.inf:
            self._search_began_s = time_s
        if self._hypotheses:
            for candidate in self._hypotheses:
                candidate.filter.predict(time_s)
                z, sd = candidate.filter.update(anchor, range_m, variance_m2)
                self._confine(candidate.filter)
                candidate.loss += self._model.loss_of(z, sd)
            self._settle()
            return
        if time_s < self._next_try_s:
            return
        self._next_try_s = time_s + _RETRY_S
        # Wait until every anchor had its turn, or enough were received.
        if (
            time_s - self._search_began_s < WINDOW_S / 2
            and len(self.received_anchors()) < self._dims + _SPARE_ANCHORS
        ):
            return
        found = self._candidate_positions()
        if found and len(found) <= _MAX_CANDIDATES:
            self._start(found)

    def _settle(self) -> None:
        """Remove candidates that are implausible or equal; follow the last one."""
        best = min(candidate.loss for candidate in self._hypotheses)
        kept: list[_PositionHypothesis] = []
        for candidate in sorted(self._hypotheses, key=lambda c: c.loss):
            if candidate.loss > best + IMPLAUSIBLE:
                continue
            if all(np.linalg.norm(candidate.filter.position - other.filter.position) > 0.3 for other in kept):
                kept.append(candidate)
        self._hypotheses = kept
        if len(kept) == 1 and self._is_unique(kept[0].filter):
            self.filter = kept[0].filter
            self._last_known = None
            self._hypotheses = []
            self.counts["found"] += 1
            self._checked_s = self._time_s + WINDOW_S
            for state in self._states:
                state.outliers = 0.0
        elif self._time_s - self._search_began_s > 10.0 * WINDOW_S:
            # The candidates from one second of ranges may all be wrong: search again.
            self._search_began_s = self._time_s
            self._hypotheses = []

    def _is_unique(self, one: RangeFilter) -> bool:
        """Whether the latest ranges distinguish the filter's position from every other possible one.

        The likelihood of recorded ranges can prefer one of two mirror images by chance, because errors persist. So exact
        ranges from the filter's position are compared with those from the other solutions.
        """
        if self._time_s < self._next_try_s:
            return not (self._ambiguous_with or self.undetermined)
        self._next_try_s = self._time_s + _RETRY_S
        rows = self.received_anchors()
        anchors, model = self.anchors.position[rows], self._model
        range_m = np.linalg.norm(anchors - one.position, axis=1)
        sd_m = np.sqrt(model.range_sd**2 + model.offset_sd**2 + self.anchors.sd[rows] ** 2)
        height = self._known_height()
        found = candidate_positions(anchors, range_m, sd_m, model, height=height, area=self._area)
        self._ambiguous_with, self.undetermined = [], False
        if not found:
            return True
        nearest = min(found, key=lambda candidate: float(np.linalg.norm(candidate.position - one.position)))
        here = self._prior_loss(nearest)
        for candidate in found:
            z = (np.linalg.norm(anchors - candidate.position, axis=1) - range_m) / sd_m
            apart = 2.0 * (self._prior_loss(candidate) - here) + float(z @ z)
            if candidate is nearest:
                largest = float(np.linalg.eigvalsh(candidate.covariance[:2, :2])[-1])
                self.undetermined = self._last_known is None and largest > _UNDETERMINED_M**2
            elif apart < _SEPARABLE and np.linalg.norm((candidate.position - one.position)[:2]) > 0.5:
                self._ambiguous_with.append(candidate.position)
        return not (self._ambiguous_with or self.undetermined)

    def _window(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return positions (k, 3), median ranges (k,) and their standard deviations (k,) of the last second's anchors."""
        recent = [one for one in self._recent if one[0] >= self._time_s - WINDOW_S]
        self._rows = list(dict.fromkeys(one[1] for one in recent))
        ranges, sds = [], []
        for row in self._rows:
            times, _, values, variances = zip(*(one for one in recent if one[1] == row), strict=True)
            ranges.append(float(np.median(values)))
            variance = float(np.median(self._model.variances(np.array(variances))))
            age = self._time_s - float(np.mean(times))
            sds.append(math.sqrt(variance + self.anchors.sd[row] ** 2 + (self._model.speed * age) ** 2 / 3.0))
        return self.anchors.position[self._rows], np.array(ranges), np.array(sds)

    def _candidate_positions(self) -> list[CandidatePosition]:
        anchors, range_m, sd_m = self._window()
        if len(range_m) < self._dims:
            return []
        return candidate_positions(
            anchors, range_m, sd_m, self._model, height=self._known_height(), area=self._area
        )

    def _start(self, found: list[CandidatePosition]) -> None:
        """Start a filter at each position, with the correlation between the position and the errors of the ranges."""
        self.filter, self._hypotheses, self._ambiguous_with = None, [], []
        # The next check whether the position is unique must not wait.
        self._next_try_s = -math.inf
        model, height = self._model, self._height
        for candidate in found:
            position, covariance = candidate.position.copy(), candidate.covariance.copy()
            offset = candidate.gain.sum(axis=1)
            covariance += np.multiply.outer(offset, offset) * model.offset_sd**2
            # The tag has moved since the middle of the window.
            covariance[[0, 1, 2], [0, 1, 2]] += (model.speed * WINDOW_S / 2.0) ** 2
            if height is not None:
                position[2] = height.value
                covariance[2] = covariance[:, 2] = 0.0
                covariance[2, 2] = height.sd**2
            level = height is not None
            one = RangeFilter(self.anchors, model, self._time_s, position, covariance, level=level)
            errors = FIRST_ERROR + np.array(self._rows)
            one.P[:3, errors] = candidate.gain * one.P[errors, errors]
            one.P[:3, OFFSET] = offset * model.offset_sd**2
            if height is not None:
                one.P[2, OFFSET:] = 0.0
            one.P[OFFSET:, :3] = one.P[:3, OFFSET:].T
            self._hypotheses.append(_PositionHypothesis(one, candidate.loss + self._prior_loss(candidate)))
        self._settle()

    def _prior_loss(self, candidate: CandidatePosition) -> float:
        """Return minus the log likelihood of a position after the last known one."""
        if self._last_known is None:
            return 0.0
        before = self._last_known.copy()
        before.predict(self._time_s)
        apart = candidate.position[:2] - before.position[:2]
        spread = before.P[:2, :2] + candidate.covariance[:2, :2]
        # Limited, so that a kidnapped tag is also found.
        return min(IMPLAUSIBLE, 0.5 * float(apart @ np.linalg.solve(spread, apart)))


def is_valid(range_m: float, variance_m2: float) -> bool:
    """Return whether a range can be used; a variance of NaN is valid."""
    return 0.0 <= range_m <= MAX_VALUE and not variance_m2 > MAX_VALUE


def _is_nonlinear(one: RangeFilter, height_m: float, variance_m2: float) -> bool:
    """Return whether a height would move an estimate so far in plan that the filter's linear model is not valid."""
    share = math.hypot(one.P[0, 2], one.P[1, 2]) / (one.P[2, 2] + variance_m2)
    return bool(share * abs(height_m - float(one.x[2])) > _BENDS_M)
