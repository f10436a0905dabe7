"""Random simulated sites, and drives through them.

The buildings are small enough that every anchor receives a tag almost everywhere. Sizes, clearances and positions of anchors
are assumed; everything else is as in the simulated buildings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from uwb_mitigation.simulation.antenna_pairs import draw_fields
from uwb_mitigation.simulation.buildings import (
    INDUSTRIAL,
    KINDS,
    RADIO,
    RESIDENTIAL,
    draw_plan,
    mean_level_dbm,
    mean_powers_db,
)
from uwb_mitigation.simulation.odometry import SimulatedMotion
from uwb_mitigation.simulation.scene import (
    ANCHORS,
    BRICK,
    CONCRETE,
    FLAT,
    MORE_ANCHORS,
    PLASTERBOARD,
    ROUTE,
    Building,
    Point,
)
from uwb_mitigation.simulation.simulated import SimulatedSource, TwrBatch
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import Record

SITES = ("flat", "office")
"""Types of buildings, with equal probability."""

SIDE_M = (6.0, 20.0)
MIN_RECEIVED_SHARE = 0.75
"""Minimum share of the reachable positions at which each anchor receives a tag."""

MIN_REACHABLE_SHARE = 0.5
"""Minimum share of the plan that a tag can reach through doorways."""

BEFORE_WALL_M = 0.3
CLEARANCE_M = 0.3
"""Distance of the tag from walls and obstacles."""

CELL_M = 0.15
WAYPOINTS = 12

UNSEEN = 7_000_000
"""Added to the seed of a building: the seeds of the universal model begin at 0 and at 1 000 003."""

RATE_HZ = 40.0

FLATS = {"open": replace(FLAT, walls=(), screens=())} | {
    material.name: replace(
        FLAT, walls=tuple(replace(wall, material=material, thickness_m=thickness_m) for wall in FLAT.walls)
    )
    for material, thickness_m in ((PLASTERBOARD, 0.025), (BRICK, 0.12), (CONCRETE, 0.20))
}
"""The flat of the simulator with inner walls of one material, and without walls and obstacles."""

ROOMS = {"open_hall": Building((24.0, 16.0)), "drone_room": Building((7.0, 6.0))}
"""Rooms without obstacles."""

DRONE_RADIO, DRONE_SLOW_M, DRONE_LENGTH_M = replace(RADIO, timestamp_std_m=0.06), 0.05, 0.5
"""White noise of ranges to drones; standard deviation and length of errors that change with their position. 80 % of the variance are white."""

GAIN_DB, ANCHOR_GAIN_DB = 5.0, 3.0
"""Other boards at `site_gains`: common gain, whose sign alternates with the seed, and bound of the additional gains of the anchors."""


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """A building with anchors along its outer walls.

    Attributes:
        plan: the building.
        anchors: positions, m.
        cells: float64 (c, 2), reachable positions of a tag; `ways`: distances between neighbours, m,
            float64 (c, c) sparse.
    """

    plan: Building
    anchors: tuple[Point, ...]
    cells: NDArray[np.float64]
    ways: csr_array

    def route(self, rng: np.random.Generator) -> tuple[Point, ...]:
        """Return a closed route along the shortest paths between `WAYPOINTS` random positions."""
        stops = rng.choice(len(self.cells), WAYPOINTS, replace=False)
        _, before = dijkstra(self.ways, directed=False, indices=stops, return_predecessors=True)
        found: list[int] = []
        for number in range(WAYPOINTS):
            # The tree of each stop gives the path back from the next one.
            here, leg = int(stops[(number + 1) % WAYPOINTS]), list[int]()
            while here != stops[number]:
                here = int(before[number, here])
                leg.append(here)
            found += leg[::-1]
        return tuple((float(x), float(y)) for x, y in self.cells[found])


def draw_site(anchors: int, rng: np.random.Generator) -> Site:
    """Return a random site with walls, anchors that receive the tag, and doorways that connect its rooms.

    Args:
        anchors: number of anchors, evenly spaced along the outer walls.
        rng: random generator.
    """
    name = SITES[int(rng.integers(len(SITES)))]
    kind = next(one for one in KINDS if one.name == name)
    while True:
        plan = draw_plan(kind, rng)
        positions = _along_walls(plan.size, anchors, rng)
        if not plan.walls or not all(SIDE_M[0] <= side <= SIDE_M[1] for side in plan.size):
            continue
        cells, ways = _free(plan)
        if len(cells) * CELL_M**2 < MIN_REACHABLE_SHARE * math.prod(plan.size):
            continue
        if all(_received_share(plan, position, cells) >= MIN_RECEIVED_SHARE for position in positions):
            return Site(plan, positions, cells, ways)


def _along_walls(size: Point, count: int, rng: np.random.Generator) -> tuple[Point, ...]:
    """Return evenly spaced points at `BEFORE_WALL_M` from the outer walls."""
    x, y = (side - 2.0 * BEFORE_WALL_M for side in size)
    corners = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y], [0.0, 0.0]]) + BEFORE_WALL_M
    reached = np.array([0.0, x, x + y, 2.0 * x + y, 2.0 * (x + y)])
    along = (np.arange(count) + rng.uniform()) / count * reached[-1]
    positions = np.stack([np.interp(along, reached, axis) for axis in corners.T], axis=1)
    return tuple((float(a), float(b)) for a, b in positions)


def _free(plan: Building) -> tuple[NDArray[np.float64], csr_array]:
    """Return the largest connected part of a grid, and the distances between neighbours."""
    columns, rows = (np.arange(CELL_M, side, CELL_M) for side in plan.size)
    grid = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1)
    free = np.all((grid > CLEARANCE_M) & (grid < np.subtract(plan.size, CLEARANCE_M)), axis=-1)
    lines = [(wall.start, wall.end) for wall in plan.walls]
    for start, end in lines + [(screen.start, screen.end) for screen in plan.screens]:
        free &= _away(grid, np.array(start), np.array(end)) > CLEARANCE_M
    number = np.arange(free.size).reshape(free.shape)
    starts, ends, lengths = [], [], []
    for step in ((1, 0), (0, 1), (1, 1), (1, -1)):
        here, there = _shifted(number, step)
        both = free.ravel()[here] & free.ravel()[there]
        starts.append(here[both])
        ends.append(there[both])
        lengths.append(np.full(int(both.sum()), CELL_M * math.hypot(*step)))
    links = (np.concatenate(starts), np.concatenate(ends))
    ways = coo_array((np.concatenate(lengths), links), shape=(free.size, free.size)).tocsr()
    _, part = connected_components(ways, directed=False)
    sizes = np.bincount(part[free.ravel()], minlength=1)
    kept = np.flatnonzero(free.ravel() & (part == int(np.argmax(sizes))))
    return grid.reshape(-1, 2)[kept], ways[kept][:, kept]


def _shifted(number: NDArray[np.intp], step: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the cells that have a neighbour one step away, and that neighbour."""
    along, up = step
    here = number[: len(number) - along, max(-up, 0) : number.shape[1] - max(up, 0)]
    there = number[along:, max(up, 0) : number.shape[1] + min(up, 0)]
    return here.ravel(), there.ravel()


def _away(
    grid: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the distances of points (..., 2) from a line segment."""
    along = end - start
    part = np.clip((grid - start) @ along / (along @ along), 0.0, 1.0)
    away: NDArray[np.float64] = np.linalg.norm(grid - start - part[..., None] * along, axis=-1)
    return away


def _received_share(plan: Building, anchor: Point, cells: NDArray[np.float64]) -> float:
    """Return the share of positions from which a frame is received according to its mean level."""
    n = len(cells)
    boards = RADIO.boards(n)
    here = np.tile(anchor, (n, 1))
    powers = mean_powers_db(RESIDENTIAL, here, cells, plan.direct_path(here, cells))
    return float((mean_level_dbm(*powers, boards) >= RADIO.sensitivities_dbm(boards)).mean())


class Standing(SimulatedSource):
    """A robot at a random place of the route: clusters and fading of each pair stay the same."""

    def _batches(self) -> Iterator[tuple[TwrBatch, np.random.Generator]]:
        rng = np.random.default_rng([self._seed, 0])
        batch = self._exchanges(
            np.arange(self._count), 0, draw_fields(self._environments, len(self._anchors), rng)
        )
        pairs = batch.pairs
        place = np.broadcast_to(rng.choice(pairs.tag), pairs.tag.shape)
        path = self._plan.direct_path(pairs.anchor, place)
        yield replace(batch, pairs=replace(pairs, tag=place, path=path, stationary=True)), rng

    def __iter__(self) -> Iterator[Record]:
        place = next(iter(self._batches()))[0].pairs.tag[0]
        position = (float(place[0]), float(place[1]), 0.0)
        return (replace(record, tag_position=position) for record in super().__iter__())


class Drive:
    """A drive at a simulated site; a `Source` whose pairs have offsets.

    Args:
        kind: "site", a random building; "site_gains", the same with other boards; or one of `FLATS` or `ROOMS`.
        source: `Standing` for a robot at rest.
    """

    simulated = True

    def __init__(
        self,
        seed: int,
        drive: int,
        anchors: int,
        seconds: float,
        kind: str = "site",
        source: type[SimulatedSource] = SimulatedSource,
    ) -> None:
        rng = np.random.default_rng(UNSEEN + seed)
        self.offset_m = 0.2 + rng.normal(0.0, 0.12, anchors)
        if kind in FLATS:
            plan, places = FLATS[kind], (ANCHORS + MORE_ANCHORS)[:anchors]
            route = ROUTE[drive * 5 :] + ROUTE[: drive * 5]
        else:
            if kind in ROOMS:
                room = ROOMS[kind]
                site = Site(room, _along_walls(room.size, anchors, rng), *_free(room))
            else:
                site = draw_site(anchors, rng)
            plan, places = site.plan, site.anchors
            route = site.route(np.random.default_rng([UNSEEN + seed, drive]))
        gains_db = np.zeros(anchors)
        if kind == "site_gains":
            gains_db = (-1) ** seed * GAIN_DB + rng.uniform(-ANCHOR_GAIN_DB, ANCHOR_GAIN_DB, anchors)
        self._slow_m = DRONE_SLOW_M * (kind == "drone_room")
        self._waves = rng.normal(0.0, 1.0 / DRONE_LENGTH_M, (anchors, 2))
        self._inner = source(
            seed=seed * 1000 + drive, count=round(seconds * RATE_HZ), rate_hz=RATE_HZ,
            anchors=places, plan=plan, radio=DRONE_RADIO if kind == "drone_room" else RADIO, route=route,
            environments=INDUSTRIAL if kind == "open_hall" else RESIDENTIAL, gains_db=gains_db.tolist(),
        )  # fmt: skip
        self.plan = plan
        self.anchors: AnchorMap = self._inner.anchors
        self.name = self._inner.name

    def motion(self) -> SimulatedMotion:
        """Return the motion of the robot that carries the tag, with its odometry."""
        return self._inner.motion()

    def __iter__(self) -> Iterator[Record]:
        for record in self._inner:
            measured = record.measurement
            off = float(self.offset_m[measured.anchor_id - 1])
            if self._slow_m and record.tag_position:
                angle = self._waves[measured.anchor_id - 1] @ record.tag_position[:2]
                off += self._slow_m * math.sqrt(2.0) * math.sin(angle)
            yield replace(record, measurement=replace(measured, range_m=measured.range_m + off))
