"""Five environments shaped like DeepUWB's, and the obstacles that are put between antennas in them.

Sizes are those that the paper gives (section III-A) or, where it gives none, assumed; so is how often
something stands between the antennas. Nothing here was fitted to DeepUWB or to what a network makes of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.sources.simulation.channel import RESIDENTIAL_LOS, RESIDENTIAL_NLOS, Environment
from uwb_mitigation.sources.simulation.scene import (
    BRICK,
    FLAT,
    GLASS,
    WOOD,
    DirectPath,
    FloorPlan,
    Material,
    Point,
    Screen,
    Wall,
)


@dataclass(frozen=True, slots=True)
class Obstacle:
    """What is put between two antennas.

    Attributes:
        name: as DeepUWB calls it.
        material: of a slab that the path goes through; None = opaque, and gone around.
        thickness_m, width_m: bounds, of which each placement draws its own.
    """

    name: str
    material: Material | None
    thickness_m: tuple[float, float] = (0.0, 0.0)
    width_m: tuple[float, float] = (0.8, 1.4)


# Materials beyond ITU-R P.2040-1's are assumed: foam, hard plastic, and a box of cardboard with goods in it.
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
"""In the order of DeepUWB's column `Obstacles`."""

HOW_MANY = (0.35, 0.45, 0.20)
"""Probabilities that none, one or two of them stand in a path."""

WALL = 0
"""Of `OBSTACLES`: what divides the cross-room measurements."""

NEAR_END, SLANT, OFF_CENTRE = 0.2, math.radians(30.0), 0.3
"""An obstacle stands between `NEAR_END` of the path and as much before its end, at most so far from square to it,
and its middle at most this share of its width from the path."""


@dataclass(frozen=True, slots=True)
class Room:
    """One environment.

    Attributes:
        name: for people. size: m.
        in_sight, blocked: the diffuse field where nothing stands between the antennas, and where something does.
        divided: a wall always stands between them.
    """

    name: str
    size: Point
    in_sight: Environment
    blocked: Environment
    divided: bool = False


def _mean_free_path_m(size: Point) -> float:
    """Of rays in a rectangle: pi area / perimeter (Kosten, 1960)."""
    return math.pi * size[0] * size[1] / (2.0 * (size[0] + size[1]))


def _furnished(name: str, size: Point) -> Room:
    """A room in which decays and delays of the residential field shrink with the mean free path.

    An obstacle takes the direct path only: the room's reflections come as loud as without it, the first of
    them after a delay.
    """
    share = _mean_free_path_m(size) / _mean_free_path_m(FLAT.size)
    in_sight = replace(
        RESIDENTIAL_LOS,
        name=f"{name}, in sight",
        cluster_decay_ns=share * RESIDENTIAL_LOS.cluster_decay_ns,
        ray_decay_ns=share * RESIDENTIAL_LOS.ray_decay_ns,
    )
    delay_ns = share * RESIDENTIAL_NLOS.first_cluster_delay_ns
    blocked = replace(in_sight, name=f"{name}, blocked", first_cluster_delay_ns=delay_ns)
    return Room(name, size, in_sight, blocked)


def _outdoor() -> Room:
    """Few reflections: 4 dB less than in a room, the first of them from twice as far."""
    name = "outdoor"
    in_sight = replace(
        RESIDENTIAL_LOS, name=f"{name}, in sight", path_loss_1m_db=RESIDENTIAL_LOS.path_loss_1m_db + 4.0
    )
    delay_ns = 2.0 * RESIDENTIAL_NLOS.first_cluster_delay_ns
    blocked = replace(in_sight, name=f"{name}, blocked", first_cluster_delay_ns=delay_ns)
    return Room(name, (12.0, 12.0), in_sight, blocked)


ROOMS = (
    Room("cross-room", (10.0, 5.0), RESIDENTIAL_LOS, RESIDENTIAL_NLOS, divided=True),
    _furnished("big room", (10.0, 5.0)),
    _furnished("medium room", (5.0, 5.0)),
    _furnished("small room", (5.0, 3.5)),
    _outdoor(),
)
"""In the order of DeepUWB's column `Room`."""


def draw_obstacles(room: Room, rng: np.random.Generator) -> tuple[int, ...]:
    """Which of `OBSTACLES` stand between the antennas of one placement, ascending."""
    count = int(rng.choice(len(HOW_MANY), p=HOW_MANY))
    chosen = set(rng.choice(len(OBSTACLES), count, replace=False).tolist())
    return tuple(sorted(chosen | {WALL} if room.divided else chosen))


def obstruct(
    a: NDArray[np.float64], b: NDArray[np.float64], chosen: tuple[int, ...], rng: np.random.Generator
) -> DirectPath:
    """What the straight line between antennas at `a` and `b`, float64 (2,) in m, meets: arrays of one row."""
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
    # Obstacles may reach beyond the room: what counts is that they cross the line.
    return FloorPlan((1.0, 1.0), tuple(walls), tuple(screens)).direct_path(a[None], b[None])
