"""Geometry: where a tag can be, the arrangement of anchors, dilution of precision, and protection levels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError

FLAT = 0.05
"""Anchors whose spread in a direction is a smaller part of their largest one have no extent in it."""

CIRCLE_POINTS = 36
"""Points on a circle of positions: 10 degrees apart."""

IMAGE_SHIFT_M = 0.5
"""An image that is shifted by this (standard deviation) to fit the ranges is the same solution."""

CONSTANT_ERROR_M, POSITION_SD_M = 0.1, (5.0, 5.0, 1.0)
"""Constant errors of ranges, and what else is known of a position: without it, weak directions would have infinite variances."""


@dataclass(frozen=True, slots=True)
class Dop:
    """Dilution of precision, horizontal and vertical; inf: the ranges do not determine the position."""

    hdop: float
    vdop: float


@dataclass(frozen=True, slots=True)
class Height:
    """The tag's height and its standard deviation, m."""

    value: float
    sd: float = 0.1

    def __post_init__(self) -> None:
        if not (abs(self.value) <= 1e5 and 0.0 < self.sd <= 1e3):
            raise ParameterError(
                f"height {self.value} with standard deviation {self.sd}",
                valid="in metres; the latter above 0",
            )


@dataclass(frozen=True, slots=True)
class Area:
    """The box in which tags can be: two opposite corners, m."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ParameterError(
                f"area from {self.low} to {self.high}", valid="three smaller, then three larger"
            )

    @classmethod
    def parse(cls, text: str | None) -> Area | None:
        """Parse `X,Y,Z,X,Y,Z`, m; an empty text or None gives None.

        Raises:
            ParameterError: the text is no box.
        """
        if not text:
            return None
        try:
            x, y, z, x1, y1, z1 = (float(word) for word in text.split(","))
        except ValueError as error:
            raise ParameterError(f"area {text!r}", valid="six numbers: X,Y,Z,X,Y,Z") from error
        return cls((x, y, z), (x1, y1, z1))

    def holds(self, position: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which positions float64 (n, 3) are inside."""
        inside: NDArray[np.bool_] = np.all((position >= self.low) & (position <= self.high), axis=-1)
        return inside

    def clip(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the nearest point of the box to each position float64 (..., 3), faster than `np.clip`."""
        return np.minimum(np.maximum(position, self.low), self.high)


def parse_lever_arm(text: str | None) -> tuple[float, float, float] | None:
    """Parse `X,Y,Z`, m; an empty text or None gives None.

    Raises:
        ParameterError: the text is not a vector, or longer than 100 m in an axis.
    """
    if not text:
        return None
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError as error:
        raise ParameterError(f"lever arm {text!r}", valid="three numbers: X,Y,Z") from error
    # False for NaN.
    if not (abs(x) <= 100.0 and abs(y) <= 100.0 and abs(z) <= 100.0):
        raise ParameterError(f"lever arm {text!r}", valid="-100 to 100 m each")
    return x, y, z


def unit_vectors(
    tag: NDArray[np.float64], anchor: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors (..., 3) from anchors to tags, and distances (...), 0.05 m at least."""
    away = tag - anchor
    distance = np.maximum(np.sqrt(np.einsum("...i,...i->...", away, away)), 0.05)
    return away / distance[..., None], distance


def extents(position: NDArray[np.float64]) -> int:
    """Return in how many directions anchors at float64 (m, 3) are spread: 0 in one place, 1 on a line, 2 in a plane, 3."""
    if len(position) < 2:
        return 0
    spread = np.linalg.svd(position - position.mean(axis=0), compute_uv=False)
    return int((spread > max(FLAT * spread[0], 1e-6)).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Symmetry:
    """What maps a position to others with the same ranges: a mirror, or the rotations about a line.

    Attributes:
        center: a point of the mirror or the line, float64 (3,), m.
        axis: normal of the mirror or direction of the line, float64 (3,).
        is_rotation: anchors on a line (at known heights: in one place) leave a circle.
    """

    center: NDArray[np.float64]
    axis: NDArray[np.float64]
    is_rotation: bool

    @classmethod
    def of(cls, anchors: NDArray[np.float64], dims: int, sd_m: float) -> Symmetry:
        """Return the symmetry that anchors float64 (m, 3) have approximately; whether ranges show the difference: `separation`.

        Args:
            anchors: at least one.
            dims: number of unknown coordinates: 2 if the height is known.
            sd_m: errors of ranges. Anchors whose distances from a line are smaller are on it.
        """
        center, count = anchors.mean(axis=0), len(anchors)
        offsets = np.pad((anchors - center)[:, :dims], ((0, max(0, dims - count)), (0, 0)))
        _, spread, axes = np.linalg.svd(offsets)
        is_rotation = bool(spread[dims - 2] < sd_m * math.sqrt(count))
        axis = np.zeros(3)
        if is_rotation and dims == 2:
            axis[2] = 1.0
        else:
            axis[:dims] = axes[0 if is_rotation else dims - 1]
        return cls(center, axis, is_rotation)

    def images(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the other positions float64 (n, 3), around the line in the order of their angles."""
        offset = position - self.center
        along = float(offset @ self.axis) * self.axis
        if not self.is_rotation:
            return (position - 2.0 * along)[None]
        angle = np.arange(1, CIRCLE_POINTS)[:, None] * (math.tau / CIRCLE_POINTS)
        across, turned = offset - along, np.cross(self.axis, offset)
        return np.asarray(self.center + along + np.cos(angle) * across + np.sin(angle) * turned, np.float64)


def separation(
    anchors: NDArray[np.float64],
    position: NDArray[np.float64],
    images: NDArray[np.float64],
    sd_m: float,
    offset_sd_m: float,
    dims: int,
) -> NDArray[np.float64]:
    """Return by how many standard deviations of the ranges the ranges of each image float64 (n, 3) differ from those of a position.

    The first `dims` coordinates of an image and the common offset of the ranges are changed so that the difference becomes as
    small as possible.
    """
    unit, distance = unit_vectors(np.concatenate([images, position[None]])[:, None], anchors)
    difference = (distance[:-1] - distance[-1])[..., None] / sd_m
    rows = np.full((*distance[:-1].shape, dims + 1), 1.0 / sd_m)
    rows[..., :dims] = unit[:-1, :, :dims] / sd_m
    columns = rows.transpose(0, 2, 1)
    normal, right = columns @ rows, columns @ difference
    diagonal = normal.reshape(len(images), -1)[:, :: dims + 2]
    diagonal += [*[IMAGE_SHIFT_M**-2] * dims, max(offset_sd_m, 1e-3) ** -2]
    squared = (difference**2).sum(axis=1) - (right * np.linalg.solve(normal, right)).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(squared[:, 0], 0.0)), np.float64)


def constant_error_gain(
    anchors: NDArray[np.float64], position: NDArray[np.float64], dims: int, offset_sd_m: float
) -> NDArray[np.float64]:
    """Return the covariance of a position float64 (3,) for constant errors of the ranges.

    These are the sensitivities of least squares for a position and a common offset, for independent errors with a variance of 1.

    Args:
        anchors: float64 (m, 3), at least one.
        position: float64 (3,).
        dims: number of unknown coordinates; the covariance of the others is zero.
        offset_sd_m: prior of the common offset.
    """
    rows = np.ones((len(anchors), dims + 1))
    rows[:, :dims] = unit_vectors(position, anchors)[0][:, :dims]
    # The method `dot` is faster here than the operator.
    normal = rows.T.dot(rows)
    prior = [(CONSTANT_ERROR_M / sd) ** 2 for sd in (*POSITION_SD_M[:dims], max(offset_sd_m, 1e-3))]
    normal.reshape(-1)[:: dims + 2] += prior
    gain = np.linalg.solve(normal, rows.T)
    covariance = np.zeros((3, 3))
    covariance[:dims, :dims] = gain[:dims].dot(gain[:dims].T)
    return covariance


def dop(anchors: NDArray[np.float64], position: NDArray[np.float64], *, level: bool = False) -> Dop:
    """Return the dilution of precision for anchors float64 (m, 3) at a position float64 (3,).

    Args:
        anchors: positions of the anchors, float64 (m, 3), m.
        position: position of the tag, float64 (3,), m.
        level: the height is known: only x and y are estimated, and VDOP is 0.
    """
    slope = unit_vectors(position, anchors)[0][:, : 2 if level else 3]
    normal = slope.T @ slope
    size = len(normal)
    if len(anchors) < size or np.linalg.cond(normal) > 1e10:
        return Dop(math.inf, 0.0 if level else math.inf)
    spread = np.diag(np.linalg.inv(normal))
    return Dop(math.sqrt(spread[0] + spread[1]), 0.0 if level else math.sqrt(spread[2]))


CHI2_95 = 5.991
"""Squared radius of the 95 % ellipse in two dimensions, for a covariance of 1."""


def horizontal_ellipse(covariance: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return half axes (m, the larger first) and angle of the larger one (rad) of the 95 % ellipse; NaN: invalid covariance.

    Args:
        covariance: covariance of a position, float64 (d, d) with d of at least 2, m^2.
    """
    horizontal = covariance[:2, :2]
    if not (np.abs(horizontal) < 1e30).all():
        return math.nan, math.nan, math.nan
    values, vectors = np.linalg.eigh((horizontal + horizontal.T) / 2)
    if values[0] < 0.0:
        return math.nan, math.nan, math.nan
    minor, major = np.sqrt(CHI2_95 * values).tolist()
    return major, minor, math.atan2(vectors[1, 1], vectors[0, 1])


PROTECTION = 3.29
"""Deviations that a normal error exceeds once in a thousand times (two-sided)."""


def protection_levels(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return bounds float64 (..., 3) of the errors in x, y and z, m, from covariances (..., d, d).

    The covariance includes the considered offsets, so that these bounds cover persisting errors. They follow from the model
    and are no certified integrity figures as in aviation.
    """
    variances = np.einsum("...ii->...i", covariance)[..., :3]
    return np.asarray(PROTECTION * np.sqrt(variances), np.float64)
