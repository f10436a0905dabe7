"""Five environments like those of DeepUWB, with obstacles between the antennas.

Sizes come from the paper (section III-A) or are assumptions; the frequency of obstacles is an assumption. `RANGE_OFFSET_M`
and `REFLECTION_DELAY` were fitted to the two figures that the paper publishes of the raw errors in the medium room (MAE and
standard deviation, section III-C), on the data of seed 1. No value was fitted to DeepUWB itself or to the results of a network.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.simulation.buildings import mean_free_path_m
from uwb_mitigation.simulation.channel import RESIDENTIAL_LOS, RESIDENTIAL_NLOS, Environment
from uwb_mitigation.simulation.scene import (
    BRICK,
    FLAT,
    GLASS,
    WOOD,
    Building,
    DirectPath,
    Material,
    Point,
    Screen,
    Wall,
)


@dataclass(frozen=True, slots=True)
class Obstacle:
    """An obstacle between two antennas.

    Attributes:
        name: name in DeepUWB.
        material: of a slab that the path goes through; None = opaque, the path is diffracted around it.
        thickness_m, width_m: bounds of the random values of each placement.
    """

    name: str
    material: Material | None
    thickness_m: tuple[float, float] = (0.0, 0.0)
    width_m: tuple[float, float] = (0.8, 1.4)


# Materials that are not in ITU-R P.2040-1 are assumptions: foam, hard plastic, and a cardboard box with goods.
OBSTACLES = (
    Obstacle("wall", BRICK, (0.10, 0.25), (6.0, 12.0)),
    Obstacle("polystyrene plate", Material("polystyrene", 1.03, 0.0001), (0.05, 0.20)),
    Obstacle("plastic", Material("plastic", 2.5, 0.005), (0.003, 0.05)),
    Obstacle("plywood plate", WOOD, (0.01, 0.04)),
    Obstacle("cardboard box", Material("cardboard", 1.4, 0.005), (0.2, 0.6)),
    Obstacle("LCD TV", None, width_m=(0.7, 1.2)),
    Obstacle("metal plate", None),
    Obstacle("wood door", WOOD, (0.03, 0.05)),
    Obstacle("glass plate", GLASS, (0.004, 0.012)),
    Obstacle("metal window", None, width_m=(1.0, 2.0)),
)
"""Obstacles in the order of DeepUWB's column `Obstacles`."""

OBSTACLE_COUNT_SHARES = (0.35, 0.45, 0.20)
"""Probabilities of zero, one and two obstacles in a path."""

RANGE_OFFSET_M = 0.028
"""Mean error of the antenna delays: it mostly determines the MAE of the raw ranges."""

REFLECTION_DELAY = 0.34
"""Delay of the first reflection behind an obstacle, relative to that of the furnished flat: it mostly determines their standard
deviation. With 1, errors of ranges without a direct path are three times as large."""

WALL = 0
"""Index in `OBSTACLES` of the wall in the cross-room measurements."""

NEAR_END, SLANT, OFF_CENTRE = 0.2, math.radians(30.0), 0.3
"""Limits of an obstacle's pose: minimum distance from both ends as a share of the path, maximum angle from the path's
normal, and maximum distance of its centre from the path as a share of its width."""


@dataclass(frozen=True, slots=True)
class Room:
    """One environment.

    Attributes:
        name: display name. size: m.
        los, nlos: the diffuse field without and with obstacles between the antennas.
        divided: there is always a wall between them.
    """

    name: str
    size: Point
    los: Environment
    nlos: Environment
    divided: bool = False


def _furnished(name: str, size: Point) -> Room:
    """Return a room whose decays and delays are the residential ones scaled with the mean free path.

    An obstacle attenuates only the direct path: the reflections keep their power, and the first of them is
    delayed (`REFLECTION_DELAY`).
    """
    size_ratio = mean_free_path_m(size) / mean_free_path_m(FLAT.size)
    los = replace(
        RESIDENTIAL_LOS,
        name=f"{name}, LOS",
        cluster_decay_ns=size_ratio * RESIDENTIAL_LOS.cluster_decay_ns,
        ray_decay_ns=size_ratio * RESIDENTIAL_LOS.ray_decay_ns,
    )
    delay_ns = REFLECTION_DELAY * size_ratio * RESIDENTIAL_NLOS.first_cluster_delay_ns
    nlos = replace(los, name=f"{name}, NLOS", first_cluster_delay_ns=delay_ns)
    return Room(name, size, los, nlos)


def _outdoor() -> Room:
    """Return an environment with few reflections: 4 dB less than in a room, the first from twice the distance."""
    name = "outdoor"
    los = replace(RESIDENTIAL_LOS, name=f"{name}, LOS", path_loss_1m_db=RESIDENTIAL_LOS.path_loss_1m_db + 4.0)
    delay_ns = 2.0 * RESIDENTIAL_NLOS.first_cluster_delay_ns
    nlos = replace(los, name=f"{name}, NLOS", first_cluster_delay_ns=delay_ns)
    return Room(name, (12.0, 12.0), los, nlos)


ROOMS = (
    Room("cross-room", (10.0, 5.0), RESIDENTIAL_LOS, RESIDENTIAL_NLOS, divided=True),
    _furnished("big room", (10.0, 5.0)),
    _furnished("medium room", (5.0, 5.0)),
    _furnished("small room", (5.0, 3.5)),
    _outdoor(),
)
"""Environments in the order of DeepUWB's column `Room`."""


def draw_obstacles(room: Room, rng: np.random.Generator) -> tuple[int, ...]:
    """Draw the indices in `OBSTACLES` between the antennas of one placement, ascending."""
    count = int(rng.choice(len(OBSTACLE_COUNT_SHARES), p=OBSTACLE_COUNT_SHARES))
    chosen = set(rng.choice(len(OBSTACLES), count, replace=False).tolist())
    return tuple(sorted(chosen | {WALL} if room.divided else chosen))


def obstruct(
    a: NDArray[np.float64], b: NDArray[np.float64], chosen: tuple[int, ...], rng: np.random.Generator
) -> DirectPath:
    """Return the obstacles on the line between antennas at `a` and `b`, float64 (2,) in m: arrays of one row."""
    walls, screens = [], []
    for number in chosen:
        obstacle = OBSTACLES[number]
        middle = a + rng.uniform(NEAR_END, 1.0 - NEAR_END) * (b - a)
        angle = math.atan2(*(b - a)[::-1]) + math.pi / 2.0 + rng.uniform(-SLANT, SLANT)
        along = rng.uniform(*obstacle.width_m) * np.array([math.cos(angle), math.sin(angle)])
        middle = middle + rng.uniform(-OFF_CENTRE, OFF_CENTRE) * along
        start, end = ((float(x), float(y)) for x, y in (middle - along / 2.0, middle + along / 2.0))
        thickness_m = rng.uniform(*obstacle.thickness_m)
        if obstacle.material is None:
            screens.append(Screen(obstacle.name, start, end))
        else:
            walls.append(Wall(start, end, obstacle.material, thickness_m))
    # Obstacles may extend beyond the room; they only have to cross the line.
    return Building((1.0, 1.0), tuple(walls), tuple(screens)).direct_path(a[None], b[None])
