"""How anchors lie, as seen from a tag and among themselves."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    slope = _slopes(anchors, position, level)
    normal = slope.T @ slope
    size = len(normal)
    if len(anchors) < size or np.linalg.cond(normal) > 1e10:
        return Geometry(len(anchors), math.inf, 0.0 if level else math.inf, kind)
    spread = np.diag(np.linalg.inv(normal))
    vdop = 0.0 if level else math.sqrt(spread[2])
    return Geometry(len(anchors), math.sqrt(spread[0] + spread[1]), vdop, kind)


def gdop(anchors: NDArray[np.float64], position: NDArray[np.float64], *, level: bool = False) -> float:
    """Dilution of the place and of an offset that all ranges share, together; inf = the ranges do not tell.

    As in satellite navigation, whose receivers have a clock to find too.
    """
    slope = _slopes(anchors, position, level)
    slope = np.concatenate([slope, np.ones((len(slope), 1))], axis=1)
    normal = slope.T @ slope
    if len(anchors) < len(normal) or np.linalg.cond(normal) > 1e10:
        return math.inf
    return math.sqrt(np.trace(np.linalg.inv(normal)))


def _slopes(anchors: NDArray[np.float64], position: NDArray[np.float64], level: bool) -> NDArray[np.float64]:
    """By how much each range grows with x, y and, unless `level`, z."""
    away = position - anchors
    distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    slopes: NDArray[np.float64] = (away / distance)[:, : 2 if level else 3]
    return slopes


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
