"""The position of one tag from its first range: initialisation, tracking, and ambiguity of its position.

While several positions explain the ranges, each is followed by a filter, and no position is published, unless they differ in
height only. If the anchors of the last second do not exclude a mirror image of the position, an area or the time before can do so.
Otherwise the position is withheld if the image has another x and y, and else published with a variance that contains the image.
"""

from __future__ import annotations

import enum
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import (
    Area,
    Dop,
    Height,
    Symmetry,
    constant_error_gain,
    dop,
    separation,
)
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.filter import OFFSET, RangeFilter
from uwb_mitigation.positioning.online.initialization import (
    IMPLAUSIBLE,
    CandidatePosition,
    candidate_positions,
)
from uwb_mitigation.positioning.online.measurements import TagHeight, TagRange
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Estimate, Heights, Imu, Odometry, Ranges, Track, rows_of

WINDOW_S = 1.0
"""A position is searched from the ranges of this time: every anchor had its turn, and a robot has moved by a metre."""

RANGE_TIMEOUT_S = 3.0
"""After a longer time without ranges the position is searched again: the predicted one may mislead."""

OUTLIER, LOST_SHARE = 3.0, 0.7
"""The tag was lost if this share of the latest ranges of at least half of the anchors had a larger normalised innovation."""

DISAGREES = 1.5
"""An anchor contradicts the others if the mean of its normalised innovations is larger: persisting errors average out."""

SURPRISE = 1.0
"""Normalised innovation of the first height from which the position is searched again."""

HEIGHT_AGE_NS = 200_000_000

MIRROR_SD, EXCLUDED_SD = 2.0, 3.0
"""Within `MIRROR_SD` standard deviations of the mirror the side of a tag is unknown; an image that is outside the area by more
than `EXCLUDED_SD`, or whose ranges differ by more than that, is excluded."""

EVIDENCE_RATE, EVIDENCE = 0.01, 1.0
"""The loss of each anchor's ranges is averaged over about a hundred ranges, in which persisting errors change a few times. The
image is used if the sum over the anchors is smaller by `EVIDENCE`."""

MAX_AMBIGUOUS_S = 2.0
"""For this time the velocity determines on which side of a mirror a tag continues; after it, the position is searched again."""

RANGE_ERROR_M = 0.17
"""Ranges of positions are compared with this standard deviation at least: also errors persist, and obstacles."""

FEW_ANCHORS = 3.0
"""Factor of a variance that is estimated from few anchors: that of Student's t-distribution with three degrees of freedom."""

_UNDETERMINED_M = 5.0
"""A position with a larger horizontal standard deviation is not determined by the ranges."""

LEVEL = 0.9
"""A mirror with a larger vertical component of its normal reflects heights."""

_HALF_WAY = np.array([[1.0], [0.5]])
_SAME_M = 0.3
_MAX_ARC_M = 0.5
_RETAINED_RANGES = 400
_MAX_CANDIDATES = 12
_RETRY_S = 0.25


class Ambiguity(enum.Enum):
    """Which other positions explain the ranges of a tag; `WEAK`: nearby ones in one direction."""

    NONE = "unique"
    WEAK = "weak direction"
    HEIGHT = "mirrored height"
    ARC = "arc"
    MIRROR = "mirrored position"
    CIRCLE = "circle"


_GEOMETRY_S = {Ambiguity.NONE: 1.0, Ambiguity.WEAK: 0.5, Ambiguity.HEIGHT: 0.5}


@dataclass(frozen=True, slots=True, eq=False)
class RobotData:
    """Recorded motion of a robot, and its antenna.

    Attributes:
        odometry, imu: recorded; None: none, or live.
        lever_arm: the antenna in the frame of the base, m.
        is_verified: the heading was confirmed before, so that the odometry has no fault.
    """

    odometry: Odometry | None = None
    imu: Imu | None = None
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_verified: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorConfig:
    """Prior knowledge: anchors, error model, and of the tags a constant height, an area or measured heights, if any.

    Attributes:
        robot: motion of the robot that carries the tag, if it has odometry.
        widens: published covariances contain constant errors of ranges, and other positions that explain the ranges.
    """

    anchors: AnchorMap
    model: NoiseModel = field(default_factory=NoiseModel)
    height: Height | None = None
    area: Area | None = None
    heights: Heights | None = None
    robot: RobotData | None = None
    widens: bool = True

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
        config, anchors: as given, and those of the config.
        counts: numbers of ranges out of order (`backwards`), and of times the tag was `found`, `lost`, and without ranges
            (`silent`).
        innovation_mean, innovation_square: running means over about a hundred ranges: of the normalised innovation, and of
            its square (1 is ideal).
        filter: the filter that follows the tag; None: its position is searched.
        ambiguity: which other positions explain the ranges. ambiguities: how often it was found, four times per second.
        error_sd_m: standard deviation with which the ranges of positions were compared.
        undetermined: the ranges do not determine the horizontal position at all.
    """

    filter: RangeFilter | None
    _hypotheses: list[_PositionHypothesis]
    _origin_ns: int | None
    ambiguity: Ambiguity
    _symmetry: Symmetry | None
    _shift: NDArray[np.float64]
    _is_side_known: bool
    _evidence: float
    _checked: list[int]
    _checked_s: float
    _time_s: float
    _search_began_s: float
    _next_check_s: float
    _found_s: float
    _ambiguous_s: float
    undetermined: bool

    def __init__(self, config: EstimatorConfig) -> None:
        self.anchors = config.anchors
        self.counts: Counter[str] = Counter()
        self.innovation_mean, self.innovation_square = 0.0, 1.0
        self.config, self._model = config, config.model
        self.ambiguities, self.error_sd_m = Counter[Ambiguity](), RANGE_ERROR_M
        self._height, self._area = config.height, config.area
        self._states = [_AnchorState() for _ in range(len(self.anchors))]
        self._heights: deque[tuple[float, float, float]] = deque(maxlen=_RETAINED_RANGES)
        self._symmetries: dict[tuple[int, ...], tuple[Symmetry, bool]] = {}
        self._recent: deque[tuple[float, int, float, float]] = deque(maxlen=_RETAINED_RANGES)
        self.restart()

    @property
    def is_ambiguous(self) -> bool:
        """Whether positions with another x and y explain the ranges: the position is not published."""
        return self.ambiguity in (Ambiguity.MIRROR, Ambiguity.CIRCLE)

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
        stamp_ns, anchor, _, _ = measurement
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
        self._recent.append((time_s, *measurement[1:]))
        self._states[anchor].received_s = time_s
        if self.filter is None:
            self._search(measurement)
        else:
            self._follow(self.filter, measurement)
        if self.filter is None or self.is_ambiguous:
            return None
        return self._estimate(self.filter, stamp_ns)

    def run(self, ranges: Ranges) -> Track:
        """Process recorded ranges, and the measured heights of the config; return an estimate for each range with one."""
        return run_estimator(self.add, self.config.heights, ranges)

    def predict_at(self, stamp_ns: int) -> Estimate | None:
        """Predict the position at a time after the latest range; None: not known."""
        if self.filter is None or self.is_ambiguous:
            return None
        predicted = self.filter.copy()
        predicted.predict(self.seconds(stamp_ns))
        self._confine(predicted)
        return self._estimate(predicted, stamp_ns)

    def restart(self, stamp_ns: int | None = None) -> None:
        """Reset the position, but not the statistics."""
        self._origin_ns = stamp_ns
        self._time_s = -math.inf
        self._heights.clear()
        self._recent.clear()
        for state in self._states:
            state.received_s = -math.inf
        self._restart_search(-math.inf)

    def received_anchors(self, within_s: float = WINDOW_S) -> list[int]:
        """Return the rows of the anchors that were received within that time before the latest range."""
        since_s = self._time_s - within_s
        return [i for i, s in enumerate(self._states) if s.received_s >= since_s]

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
        if self._symmetry is not None:
            self._compare_image(filter_, self._symmetry, measurement)
        z, _ = filter_.update(*measurement[1:])
        self._confine(filter_)
        limited = max(-10.0, min(10.0, z))
        self.innovation_mean += 0.01 * (limited - self.innovation_mean)
        self.innovation_square += 0.01 * (limited * limited - self.innovation_square)
        state = self._states[measurement.anchor]
        state.outliers += 0.1 * ((abs(z) > OUTLIER) - state.outliers)
        state.mean_z += 0.02 * (max(-5.0, min(5.0, z)) - state.mean_z)
        if self._time_s >= self._next_check_s:
            self._next_check_s = self._time_s + _RETRY_S
            received, was_ambiguous = self.received_anchors(), self.is_ambiguous
            num_contradicting = sum(self._states[row].outliers > LOST_SHARE for row in received)
            if 2 * num_contradicting >= len(received):
                self.counts["lost"] += 1
                self._restart_search(self._time_s - WINDOW_S)
                return
            valid_s = _GEOMETRY_S.get(self.ambiguity, 0.0) if received == self._checked else 0.0
            if self._time_s >= self._checked_s + valid_s:
                self._checked, self._checked_s = received, self._time_s
                self._check_ambiguity(filter_)
            self.ambiguities[self.ambiguity] += 1
            if self.is_ambiguous and not was_ambiguous:
                self._ambiguous_s = self._time_s
            if was_ambiguous and not self.is_ambiguous and self._time_s > self._ambiguous_s + MAX_AMBIGUOUS_S:
                self._restart_search(self._time_s - WINDOW_S)

    def _compare_image(self, filter_: RangeFilter, mirror: Symmetry, measurement: TagRange) -> None:
        """Average how much better the position explains the ranges than its image, and swap both if the image is better."""
        # Python numbers are faster here than NumPy.
        x, y, z, _, _, _, offset = filter_.state.x[: OFFSET + 1].tolist()
        (a, b, c), (u, v, w) = mirror.axis.tolist(), mirror.center.tolist()
        twice = 2.0 * (a * (x - u) + b * (y - v) + c * (z - w))
        u, v, w = self.anchors.position[measurement.anchor].tolist()
        x, y, z = x - u, y - v, z - w
        expected, model = measurement.range_m - offset, self._model
        sd = math.sqrt(model.variance(measurement.variance_m2))
        of_position = model.student_loss((expected - math.hypot(x, y, z)) / sd)
        image_m = math.hypot(x - twice * a, y - twice * b, z - twice * c)
        of_image = model.student_loss((expected - image_m) / sd)
        difference = len(self.received_anchors()) * (of_image - of_position)
        self._evidence += EVIDENCE_RATE * (difference - self._evidence)
        if self._evidence < -EVIDENCE:
            filter_.reflect(mirror)
            self._evidence, self._next_check_s = -self._evidence, -math.inf

    def _check_ambiguity(self, filter_: RangeFilter) -> None:
        """Find other positions that explain the ranges."""
        position, dims, rows = filter_.position, self.dims, self.received_anchors()
        if not rows:
            return
        anchors, state = self.anchors.position[rows], filter_.state
        gain, redundancy = constant_error_gain(anchors, position, dims, self._model.offset_sd)
        variance = state.persisting_variance(redundancy)
        excess = FEW_ANCHORS * max(variance - state.modelled_variance, 0.0)
        filter_.unseen = self.config.widens * (excess * gain + state.hidden_offset_covariance())
        sd_m, scale = math.sqrt(max(FEW_ANCHORS * variance, RANGE_ERROR_M**2)), state.covariance_scale()
        self.error_sd_m = sd_m
        offset_sd_m = math.sqrt(float(state.P[OFFSET, OFFSET]))
        covariance = scale * state.P[:3, :3] + excess * gain
        key = dims, *rows
        if key not in self._symmetries:
            symmetry = Symmetry.of(anchors, dims, RANGE_ERROR_M)
            self._symmetries[key] = symmetry, self._is_one_sided(symmetry)
        symmetry, is_one_sided = self._symmetries[key]
        self.ambiguity, self._symmetry, self._shift = Ambiguity.NONE, None, np.zeros(3)
        if symmetry.is_rotation:
            self._check_circle(filter_, symmetry, covariance)
            return
        if is_one_sided:
            self._is_side_known = True
            return
        # The image, and the position half-way.
        images = (symmetry.images(position) - position) * _HALF_WAY
        places = position + images
        separations = separation(anchors, position, places, sd_m, offset_sd_m, dims)
        is_possible = (separations < EXCLUDED_SD) & self._area_contains(places, covariance)
        same_m = max(_SAME_M, EXCLUDED_SD * math.sqrt(max(covariance[0, 0], covariance[1, 1])))
        if dims == 3 and abs(symmetry.axis[2]) > LEVEL and math.hypot(*images[0, :2]) < same_m:
            self._is_side_known = not is_possible[0]
            images, weight = images[is_possible], np.exp(-0.5 * separations[is_possible] ** 2)
            filter_.unseen += self.config.widens * (images.T @ images) / (len(images) + 1)
            self._shift[:2] = (weight @ images)[:2] / (1.0 + weight.sum())
            if len(images):
                is_apart = is_possible[0] and separations[0] < separations[1]
                self.ambiguity = Ambiguity.HEIGHT if is_apart else Ambiguity.WEAK
                self._symmetry = symmetry
        elif not is_possible[0]:
            self._is_side_known = True
        elif separations[0] < separations[1] and not self._knows_side(images[:1], covariance):
            # If the position half-way is better, all three are one solution with a large covariance.
            self.ambiguity, self._symmetry = Ambiguity.MIRROR, symmetry

    def _check_circle(self, filter_: RangeFilter, circle: Symmetry, covariance: NDArray[np.float64]) -> None:
        position = filter_.position
        images = circle.images(position) - position
        is_possible = self._area_contains(position + images, np.eye(3) * (_SAME_M / EXCLUDED_SD) ** 2)
        images = images[is_possible]
        if not len(images):
            self._is_side_known = True
        elif not self._knows_side(images, covariance):
            # From the position on, around the circle.
            is_inside = np.append(True, is_possible)
            is_arc = np.count_nonzero(is_inside != np.roll(is_inside, 1)) == 2
            spread = images.T @ images / (len(images) + 1)
            filter_.unseen += self.config.widens * spread
            is_short = np.trace(spread[:2, :2]) < _MAX_ARC_M**2
            self.ambiguity = Ambiguity.ARC if is_arc and is_short else Ambiguity.CIRCLE

    def _knows_side(self, images: NDArray[np.float64], covariance: NDArray[np.float64]) -> bool:
        """Return whether the position was known before its `images` (n, 3) relative to it appeared, and is far from them."""
        squared = np.einsum("ni,ni->n", images, images)
        variance = np.einsum("ni,ij,nj->n", images, covariance, images)
        self._is_side_known &= bool((squared**2 > (2.0 * MIRROR_SD) ** 2 * variance).all())
        return self._is_side_known

    def _is_one_sided(self, mirror: Symmetry) -> bool:
        """Whether the area is on one side of a mirror."""
        if self._area is None:
            return False
        corners = np.stack(np.meshgrid(*zip(self._area.low, self._area.high, strict=True)), axis=-1)
        sides = (corners - mirror.center) @ mirror.axis
        return bool(sides.min() >= 0.0 or sides.max() <= 0.0)

    def _area_contains(
        self, images: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return which images (n, 3) the area does not exclude in any axis, with the variance of this axis."""
        if self._area is None:
            return np.ones(len(images), np.bool_)
        excess = np.abs(images - self._area.clip(images))
        contains: NDArray[np.bool_] = np.all(excess <= EXCLUDED_SD * np.sqrt(np.diag(covariance)), axis=1)
        return contains

    def _estimate(self, filter_: RangeFilter, stamp_ns: int) -> Estimate:
        """Return the estimate of a filter for publication, with the known height and a covariance that contains images."""
        estimate = filter_.estimate(stamp_ns)
        covariance, position = estimate.covariance, estimate.position
        if self._symmetry is not None:
            position += self._shift
        if self._height is not None:
            # Constant errors of ranges would move it in the filter.
            position[2] = self._height.value
            covariance[2] = covariance[:, 2] = 0.0
            covariance[2, 2] = self._height.sd**2
        return estimate

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
            state.outliers = 0.0
        self.ambiguity, self._symmetry = Ambiguity.NONE, None
        self._shift = np.zeros(3)
        self._is_side_known, self._evidence, self.undetermined = False, 0.0, False
        self._checked, self._checked_s = [], -math.inf
        self._search_began_s, self._next_check_s, self._found_s = time_s, -math.inf, math.inf

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
                np.linalg.norm(position - better.filter.position) > _SAME_M for better in plausible
            ):
                plausible.append(hypothesis)
        self._hypotheses = plausible
        leader = plausible[0].filter
        self.undetermined = leader.horizontal_sd > _UNDETERMINED_M
        differences = [hypothesis.filter.position - leader.position for hypothesis in plausible[1:]]
        if not self.undetermined and all(math.hypot(x, y) < _SAME_M for x, y, _ in differences):
            self._is_side_known = False
            self._check_ambiguity(leader)
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
    for row in rows_of(ranges.stamp_ns, ranges.anchor, ranges.range_m, ranges.variance_m2):
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
