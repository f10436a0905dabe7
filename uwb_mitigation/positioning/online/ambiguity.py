"""Other positions that explain the ranges of a tag: images in a mirror or on a circle.

An area, or the time before they appeared, can exclude them. One with another x and y makes the position ambiguous; the published
covariance contains the others.
"""

from __future__ import annotations

import enum
import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import Symmetry, constant_error_gain, separation
from uwb_mitigation.positioning.online.filter import OFFSET, RangeFilter
from uwb_mitigation.positioning.online.measurements import TagRange
from uwb_mitigation.positioning.online.robust_update import COVARIANCE_SCALE

SAME_M = 0.3
"""Positions with a smaller distance are one."""

MIRROR_SD, EXCLUDED_SD = 2.0, 3.0
"""Within `MIRROR_SD` standard deviations of the mirror the side of a tag is unknown; an image that is outside the area by more
than `EXCLUDED_SD`, or whose ranges differ by more than that, is excluded."""

EVIDENCE_RATE, EVIDENCE = 0.01, 1.0
"""The loss of each anchor's ranges is averaged over about a hundred ranges, in which persisting errors change a few times. The
image is used if the sum over the anchors is smaller by `EVIDENCE`."""

RANGE_ERROR_M = 0.17
"""Ranges of positions are compared with this standard deviation at least: also errors persist, and obstacles."""

CAUTION = 1.5
"""Factor of the variance of persisting errors in published covariances. This, `COVARIANCE_SCALE` and the constants of `residual_square`
were chosen on 139 development runs (drives past random anchors with constant errors of up to 0.3 m, layouts of real deployments, simulated
sites with raw and corrected ranges, Hanyang): 95 % ellipses contain less than 85 % of the positions in three of them."""

LEVEL = 0.9
"""A mirror with a larger vertical component of its normal reflects heights."""

_MAX_ARC_M = 0.5
_HALF_WAY = np.array([[1.0], [0.5]])


class Ambiguity(enum.Enum):
    """Which other positions explain the ranges of a tag; `WEAK`: nearby ones in one direction."""

    NONE = "unique"
    WEAK = "weak direction"
    HEIGHT = "mirrored height"
    ARC = "arc"
    MIRROR = "mirrored position"
    CIRCLE = "circle"


_VALID_S = {Ambiguity.NONE: 1.0, Ambiguity.WEAK: 0.5, Ambiguity.HEIGHT: 0.5}


class AmbiguityCheck:
    """Finds other positions that explain the ranges of a tag.

    Attributes:
        ambiguity: which there are; at first none.
        counts: how often each was found.
        mirror: symmetry of the anchors, if the image in it is possible.
        shift: from the position of the filter to the one to publish, float64 (3,), m.
        error_sd_m: standard deviation with which the ranges of positions were compared.
    """

    ambiguity: Ambiguity
    mirror: Symmetry | None
    _checked: list[int]

    def __init__(self, config: EstimatorConfig) -> None:
        self.counts, self.error_sd_m = Counter[Ambiguity](), RANGE_ERROR_M
        self._position, self._model = config.anchors.position, config.model
        self._area, self._widens = config.area, config.widens
        self._symmetries: dict[tuple[int, ...], tuple[Symmetry, bool]] = {}
        self.reset()

    def reset(self) -> None:
        """Start with a position from which nothing is known."""
        self.ambiguity, self.mirror, self.shift = Ambiguity.NONE, None, np.zeros(3)
        self._is_side_known, self._evidence = False, 0.0
        self._checked, self._next_s = [], -math.inf

    @property
    def is_ambiguous(self) -> bool:
        """Whether positions with another x and y explain the ranges."""
        return self.ambiguity is Ambiguity.MIRROR or self.ambiguity is Ambiguity.CIRCLE

    def compare(self, filter_: RangeFilter, measurement: TagRange, num_anchors: int) -> bool:
        """Average how much better the position explains the ranges than its image; return whether both were swapped.

        Args:
            filter_: predicted to the time of the range.
            measurement: the range.
            num_anchors: the number of anchors that are received.
        """
        mirror = self.mirror
        if mirror is None:
            return False
        # Python numbers are faster here than NumPy.
        x, y, z, _, _, _, offset = filter_.state.x[: OFFSET + 1].tolist()
        (a, b, c), (u, v, w) = mirror.axis.tolist(), mirror.center.tolist()
        twice = 2.0 * (a * (x - u) + b * (y - v) + c * (z - w))
        u, v, w = self._position[measurement.anchor].tolist()
        x, y, z = x - u, y - v, z - w
        expected, model = measurement.range_m - offset, self._model
        sd = math.sqrt(model.variance(measurement.variance_m2))
        of_position = model.student_loss((expected - math.hypot(x, y, z)) / sd)
        image_m = math.hypot(x - twice * a, y - twice * b, z - twice * c)
        of_image = model.student_loss((expected - image_m) / sd)
        difference = num_anchors * (of_image - of_position)
        self._evidence += EVIDENCE_RATE * (difference - self._evidence)
        if self._evidence >= -EVIDENCE:
            return False
        filter_.reflect(mirror)
        self._evidence = -self._evidence
        return True

    def update(self, filter_: RangeFilter, rows: list[int], dims: int, time_s: float) -> None:
        """Check again if other anchors are received, or the latest result is too old."""
        if rows != self._checked or time_s >= self._next_s:
            self.check(filter_, rows, dims)
            self._checked, self._next_s = rows, time_s + _VALID_S.get(self.ambiguity, 0.0)
        self.counts[self.ambiguity] += 1

    def check(self, filter_: RangeFilter, rows: list[int], dims: int) -> None:
        """Find other positions that explain the ranges, and set the `unseen` covariance of the filter.

        Args:
            filter_: with the position.
            rows: anchors that are received.
            dims: the number of unknown coordinates.
        """
        if not rows:
            return
        position, anchors, state = filter_.position, self._position[rows], filter_.state
        gain = constant_error_gain(anchors, position, dims, self._model.offset_sd)
        variance = state.persisting_variance(len(rows), dims)
        filter_.unseen = np.zeros((6, 6))
        unseen = filter_.unseen[:3, :3]
        # P contains the modelled errors.
        constant = max(CAUTION * variance - state.modelled_variance, state.constant_variance(rows))
        unseen[:] = self._widens * constant * gain
        sd_m = math.sqrt(max(variance, RANGE_ERROR_M**2))
        self.error_sd_m = sd_m
        offset_sd_m = math.sqrt(float(state.P[OFFSET, OFFSET]))
        excess = max(state.residual_square - RANGE_ERROR_M**2, 0.0)
        covariance = COVARIANCE_SCALE * state.P[:3, :3] + excess * gain
        key = dims, *rows
        if key not in self._symmetries:
            symmetry = Symmetry.of(anchors, dims, RANGE_ERROR_M)
            self._symmetries[key] = symmetry, self._is_one_sided(symmetry)
        symmetry, is_one_sided = self._symmetries[key]
        self.ambiguity, self.mirror, self.shift = Ambiguity.NONE, None, np.zeros(3)
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
        same_m = max(SAME_M, EXCLUDED_SD * math.sqrt(max(covariance[0, 0], covariance[1, 1])))
        if dims == 3 and abs(symmetry.axis[2]) > LEVEL and math.hypot(*images[0, :2]) < same_m:
            self._is_side_known = not is_possible[0]
            images, weight = images[is_possible], np.exp(-0.5 * separations[is_possible] ** 2)
            unseen += self._widens * (images.T @ images) / (len(images) + 1)
            self.shift[:2] = (weight @ images)[:2] / (1.0 + weight.sum())
            if len(images):
                is_apart = is_possible[0] and separations[0] < separations[1]
                self.ambiguity = Ambiguity.HEIGHT if is_apart else Ambiguity.WEAK
                self.mirror = symmetry
        elif not is_possible[0]:
            self._is_side_known = True
        elif separations[0] < separations[1] and not self._knows_side(images[:1], covariance):
            # If the position half-way is better, all three are one solution with a large covariance.
            self.ambiguity, self.mirror = Ambiguity.MIRROR, symmetry

    def _check_circle(self, filter_: RangeFilter, circle: Symmetry, covariance: NDArray[np.float64]) -> None:
        position = filter_.position
        images = circle.images(position) - position
        is_possible = self._area_contains(position + images, np.eye(3) * (SAME_M / EXCLUDED_SD) ** 2)
        images = images[is_possible]
        if not len(images):
            self._is_side_known = True
        elif not self._knows_side(images, covariance):
            # From the position on, around the circle.
            is_inside = np.append(True, is_possible)
            is_arc = np.count_nonzero(is_inside != np.roll(is_inside, 1)) == 2
            spread = images.T @ images / (len(images) + 1)
            filter_.unseen[:3, :3] += self._widens * spread
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
