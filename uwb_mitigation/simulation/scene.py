"""Two-dimensional floor plan with obstacles between antennas, such as a furnished flat.

A wall is a lossy slab that delays and attenuates the direct path; a screen (a metal cabinet, a person) is opaque,
and the path is diffracted around its nearer edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.simulation.channel import CHANNEL_2, Channel
from uwb_mitigation.types.columns import Columns

Point = tuple[float, float]

FREE_SPACE_IMPEDANCE_OHM = 376.73


@dataclass(frozen=True, slots=True)
class Material:
    """A building material: relative permittivity, and conductivity c f^d in S/m with the frequency f in GHz."""

    name: str
    permittivity: float
    c: float
    d: float = 0.0

    def conductivity(self, channel: Channel) -> float:
        """Return the conductivity at the centre frequency of a channel, S/m."""
        return self.c * float((channel.centre_hz / 1e9) ** self.d)


# ITU-R P.2040-1, table 3.
PLASTERBOARD = Material("plasterboard", 2.94, 0.0116, 0.7076)
BRICK = Material("brick", 3.75, 0.038)
CONCRETE = Material("concrete", 5.31, 0.0326, 0.8095)
WOOD = Material("wood", 1.99, 0.0047, 1.0718)
GLASS = Material("glass", 6.27, 0.0043, 1.1925)


@dataclass(frozen=True, slots=True)
class Wall:
    """A slab along a line from `start` to `end` (m)."""

    start: Point
    end: Point
    material: Material
    thickness_m: float


@dataclass(frozen=True, slots=True)
class Screen:
    """An opaque obstacle from `start` to `end` (m); paths are diffracted around it."""

    name: str
    start: Point
    end: Point


@dataclass(frozen=True, slots=True)
class DirectPath(Columns):
    """Effects of obstacles on n direct paths on a UWB channel, arrays of shape (n,).

    Contains the loss in dB and the extra optical length in m as float64, and the number of crossed obstacles as int64.
    """

    loss_db: NDArray[np.float64]
    excess_m: NDArray[np.float64]
    crossings: NDArray[np.int64]
    channel: Channel


@dataclass(frozen=True, slots=True)
class Building:
    """Walls and screens inside a rectangle from the origin to `size` (m)."""

    size: Point
    walls: tuple[Wall, ...] = ()
    screens: tuple[Screen, ...] = ()

    def direct_path(
        self, a: NDArray[np.float64], b: NDArray[np.float64], channel: Channel = CHANNEL_2
    ) -> DirectPath:
        """Return the obstacles on straight lines between antennas at `a` and `b`, float64 (n, 2) in m."""
        loss, excess = np.zeros(len(a)), np.zeros(len(a))
        crossings = np.zeros(len(a), np.int64)
        for wall in self.walls:
            hit = _crosses(a, b, wall.start, wall.end)
            lost, longer = through_slab(wall, _incidence_cosine(a, b, wall), channel)
            loss += np.where(hit, lost, 0.0)
            excess += np.where(hit, longer, 0.0)
            crossings += hit
        for screen in self.screens:
            hit = _crosses(a, b, screen.start, screen.end)
            detour = np.minimum(_detour(a, b, screen.start), _detour(a, b, screen.end))
            loss += np.where(hit, knife_edge_loss_db(detour, channel), 0.0)
            excess += np.where(hit, detour, 0.0)
            crossings += hit
        return DirectPath(loss, excess, crossings, channel)


def through_slab(
    wall: Wall, cosine: NDArray[np.float64], channel: Channel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return loss (dB) and extra optical length (m) of a path through a slab; `cosine`: of the angle of incidence.

    The loss is the absorption along the refracted path plus the reflection of both faces at normal incidence. The length
    is t (sqrt(eps - sin^2) - cos), or (sqrt(eps) - 1) t at normal incidence. Reflections inside the slab
    are neglected.
    """
    root = math.sqrt(wall.material.permittivity)
    sine_squared = 1.0 - cosine * cosine
    inside = np.sqrt(1.0 - sine_squared / wall.material.permittivity)
    # 4.343 dB per neper of power, sigma Z0 / sqrt(eps) nepers of power per metre.
    per_metre = 4.343 * wall.material.conductivity(channel) * FREE_SPACE_IMPEDANCE_OHM / root
    reflected = ((root - 1.0) / (root + 1.0)) ** 2
    loss = per_metre * wall.thickness_m / inside - 20.0 * math.log10(1.0 - reflected)
    return loss, wall.thickness_m * (root * inside - cosine)


def knife_edge_loss_db(detour_m: NDArray[np.float64], channel: Channel) -> NDArray[np.float64]:
    """Return the diffraction loss in dB at an edge that lengthens the path by `detour_m`.

    ITU-R P.526-15, section 4.1, with v = 2 sqrt(detour / wavelength).
    """
    v = 2.0 * np.sqrt(np.maximum(detour_m, 0.0) / channel.wavelength_m) - 0.1
    return 6.9 + 20.0 * np.log10(np.sqrt(v * v + 1.0) + v)


def _crosses(a: NDArray[np.float64], b: NDArray[np.float64], p: Point, q: Point) -> NDArray[np.bool_]:
    def side(o: NDArray[np.float64], u: NDArray[np.float64], w: NDArray[np.float64]) -> NDArray[np.float64]:
        return (u[..., 0] - o[..., 0]) * (w[..., 1] - o[..., 1]) - (u[..., 1] - o[..., 1]) * (
            w[..., 0] - o[..., 0]
        )

    p_, q_ = np.asarray(p), np.asarray(q)
    return (side(a, b, p_) * side(a, b, q_) < 0) & (side(p_, q_, a) * side(p_, q_, b) < 0)


def _incidence_cosine(a: NDArray[np.float64], b: NDArray[np.float64], wall: Wall) -> NDArray[np.float64]:
    along, line = np.subtract(wall.end, wall.start), b - a
    length = np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-12) * math.hypot(*along)
    return np.asarray(np.abs(line[:, 0] * along[1] - line[:, 1] * along[0]) / length, np.float64)


def _detour(a: NDArray[np.float64], b: NDArray[np.float64], edge: Point) -> NDArray[np.float64]:
    return np.asarray(np.hypot(*(a - edge).T) + np.hypot(*(b - edge).T) - np.hypot(*(a - b).T), np.float64)


FLAT = Building(
    size=(7.6, 6.8),
    walls=(
        # Load-bearing concrete walls, each with a doorway in the wall or at its end.
        Wall((0.0, 3.6), (3.0, 3.6), CONCRETE, 0.24),
        Wall((3.9, 3.6), (7.6, 3.6), CONCRETE, 0.24),
        Wall((4.6, 3.6), (4.6, 5.8), CONCRETE, 0.20),
        Wall((2.4, 0.9), (2.4, 3.6), CONCRETE, 0.20),
        Wall((5.3, 0.0), (5.3, 2.6), PLASTERBOARD, 0.025),
        # A brick shaft in the northern room.
        Wall((1.8, 4.6), (3.0, 4.6), BRICK, 0.12),
        Wall((1.8, 5.7), (3.0, 5.7), BRICK, 0.12),
        Wall((1.8, 4.6), (1.8, 5.7), BRICK, 0.12),
        Wall((3.0, 4.6), (3.0, 5.7), BRICK, 0.12),
    ),
    screens=(
        Screen("metal cabinet", (5.8, 3.9), (7.2, 3.9)),
        Screen("metal cabinet", (0.4, 3.2), (1.6, 3.2)),
        Screen("person", (3.9, 1.6), (4.3, 1.85)),
    ),
)
"""The default scene: a concrete-panel flat of the size of the apartment in the EVK1000 logs, with two
metal cabinets and a standing person."""

ANCHORS: tuple[Point, ...] = ((1.6, 1.8), (5.9, 1.4), (5.6, 5.3), (1.3, 5.4))

MORE_ANCHORS: tuple[Point, ...] = ((0.3, 0.3), (7.3, 6.5), (7.3, 0.3), (3.7, 3.4))
"""Additional anchors, for drives with five to eight."""

ROUTE: tuple[Point, ...] = (
    (3.4, 0.9), (4.6, 1.0), (4.6, 3.0), (6.5, 3.1), (6.6, 1.3), (6.3, 3.0), (3.5, 2.9),
    (3.4, 4.2), (3.7, 6.3), (5.6, 6.3), (6.5, 4.8), (5.6, 6.4), (3.6, 6.3), (1.0, 6.2),
    (1.0, 4.2), (3.4, 4.1), (3.4, 2.6), (2.9, 0.45), (1.4, 0.5), (1.2, 2.6), (1.5, 0.5),
)  # fmt: skip
"""Closed route of a robot through the rooms and the doorways."""

_BLOCK_ROWS = 1 << 16


def along_route(route: tuple[Point, ...], travelled_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions float64 (n, 2) after `travelled_m` on a closed route with rounded corners.

    Each position is the mean of the polygon over half a metre around it, which rounds the
    corners.
    """
    corners = np.asarray([*route, route[0]])
    reached = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    position = np.empty((len(travelled_m), 2))
    # In blocks: for a drive of days, the arrays would take gigabytes, and signals would wait for the end of the call.
    for begin in range(0, len(travelled_m), _BLOCK_ROWS):
        block = slice(begin, begin + _BLOCK_ROWS)
        where = (travelled_m[block, None] + np.linspace(-0.25, 0.25, 9)) % reached[-1]
        for axis in (0, 1):
            position[block, axis] = np.interp(where, reached, corners[:, axis]).mean(axis=1)
    return position
