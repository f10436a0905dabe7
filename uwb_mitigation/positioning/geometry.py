"""Geometry: where a tag can be, the arrangement of anchors, dilution of precision, and protection levels."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError

FLAT = 0.05
"""Anchors whose spread in a direction is a smaller part of their largest one have no extent in it."""


class Shape(enum.Enum):
    """How a set of anchors is spread."""

    POINT = "fewer than two places"
    LINE = "all on a line"
    PLANE = "all in a plane"
    SPACE = "spread in space"


@dataclass(frozen=True, slots=True)
class Geometry:
    """What a metre of range error becomes.

    Attributes:
        anchors: how many were heard.
        hdop, vdop: dilution of precision, horizontal and vertical; inf = the ranges do not tell.
        shape: of the anchors that were heard.
    """

    anchors: int
    hdop: float
    vdop: float
    shape: Shape


@dataclass(frozen=True, slots=True)
class Height:
    """The tag's height, as far as known: m, and its standard deviation."""

    value: float
    sd: float = 0.1

    def __post_init__(self) -> None:
        if not (abs(self.value) <= 1e5 and 0.0 < self.sd <= 1e3):
            raise ParameterError(
                f"height {self.value} with deviation {self.sd}", valid="metres, deviation over 0"
            )


@dataclass(frozen=True, slots=True)
class Area:
    """Where a tag can be: two opposite corners of a box, m."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ParameterError(
                f"area from {self.low} to {self.high}", valid="three smaller, then three larger"
            )

    @classmethod
    def parse(cls, text: str) -> Area | None:
        """The box that `X,Y,Z,X,Y,Z` says, m; None where it is empty.

        Raises:
            ParameterError: it says no box.
        """
        if not text:
            return None
        try:
            x, y, z, x1, y1, z1 = (float(word) for word in text.split(","))
        except ValueError as error:
            raise ParameterError(f"area {text!r}", valid="six numbers: X,Y,Z,X,Y,Z") from error
        return cls((x, y, z), (x1, y1, z1))

    def holds(self, position: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of the places float64 (n, 3) lie in it."""
        inside: NDArray[np.bool_] = np.all((position >= self.low) & (position <= self.high), axis=-1)
        return inside

    def clip(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the nearest point of the box to each position float64 (..., 3)."""
        nearest: NDArray[np.float64] = np.clip(position, self.low, self.high)
        return nearest


def directions(
    tag: NDArray[np.float64], anchor: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors (n, 3) from anchors to tags, and distances (n,), 0.05 m at least."""
    away = tag - anchor
    distance = np.maximum(np.sqrt(np.einsum("ni,ni->n", away, away)), 0.05)
    return away / distance[:, None], distance


def shape(position: NDArray[np.float64]) -> Shape:
    """How anchors at float64 (m, 3) are spread."""
    if len(position) < 2:
        return Shape.POINT
    spread = np.linalg.svd(position - position.mean(axis=0), compute_uv=False)
    spread = np.pad(spread, (0, 3 - len(spread)))
    if spread[0] < 1e-6:
        return Shape.POINT
    extents = int((spread > FLAT * spread[0]).sum())
    return (Shape.LINE, Shape.PLANE, Shape.SPACE)[extents - 1]


def geometry(anchors: NDArray[np.float64], position: NDArray[np.float64], *, level: bool = False) -> Geometry:
    """The geometry of anchors float64 (m, 3) as seen from a position float64 (3,).

    Args:
        anchors, position: m.
        level: the height is known: only x and y are sought, and VDOP is 0.
    """
    kind = shape(anchors)
    slope = directions(position, anchors)[0][:, : 2 if level else 3]
    normal = slope.T @ slope
    size = len(normal)
    if len(anchors) < size or np.linalg.cond(normal) > 1e10:
        return Geometry(len(anchors), math.inf, 0.0 if level else math.inf, kind)
    spread = np.diag(np.linalg.inv(normal))
    vdop = 0.0 if level else math.sqrt(spread[2])
    return Geometry(len(anchors), math.sqrt(spread[0] + spread[1]), vdop, kind)


PROTECTION = 3.29
"""Deviations that a normal error exceeds once in a thousand times (two-sided)."""


def protection_levels(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bounds float64 (..., 3) of the error in x, y and z that covariances (..., d, d) stand for, m.

    The covariance holds the considered offsets too, so that these bounds cover errors that last. They are a
    statement of the model, not a certified integrity figure as in aviation.
    """
    variances = np.einsum("...ii->...i", covariance)[..., :3]
    levels: NDArray[np.float64] = PROTECTION * np.sqrt(variances)
    return levels
