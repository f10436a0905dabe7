"""Random buildings with random boards, and placements balanced over LOS, NLOS and a lost direct path.

Distributions without a source are assumptions; docs/background/how_it_works.md lists those that were tuned on real ranges.
The chip is always the same: pulse, detector and compression are those of `simulation.radio`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.simulation import channel, scene
from uwb_mitigation.simulation.antenna_pairs import AntennaPairs, Environments, draw_fields, place
from uwb_mitigation.simulation.channel import Environment
from uwb_mitigation.simulation.radio import Boards, Receiver
from uwb_mitigation.simulation.scene import FLAT, Building, DirectPath, Point, Screen, Wall

RESIDENTIAL: Environments = (channel.RESIDENTIAL_LOS, channel.RESIDENTIAL_NLOS)
OFFICE: Environments = (channel.OFFICE_LOS, channel.OFFICE_NLOS)
INDUSTRIAL: Environments = (channel.INDUSTRIAL_LOS, channel.INDUSTRIAL_NLOS)
OUTDOOR: Environments = (channel.OUTDOOR_LOS, channel.RESIDENTIAL_NLOS)


@dataclass(frozen=True, slots=True)
class BuildingType:
    """Distribution of buildings of one type.

    Attributes:
        name: display name. share: share of all buildings.
        length_m, width_m, room_m: bounds of the sides of the plan and of a room.
        environments: of the diffuse field, {environment: share}.
        screens_per_m2: mean density of metal furniture and machines.
    """

    name: str
    share: float
    length_m: tuple[float, float]
    width_m: tuple[float, float]
    room_m: tuple[float, float]
    environments: tuple[tuple[Environments, float], ...]
    screens_per_m2: float


KINDS = (
    BuildingType("flat", 0.55, (5.0, 14.0), (4.0, 10.0), (2.5, 5.0), ((RESIDENTIAL, 1.0),), 0.12),
    BuildingType("office", 0.2, (10.0, 30.0), (8.0, 18.0), (3.0, 7.0), ((RESIDENTIAL, 0.3), (OFFICE, 0.7)), 0.08),
    BuildingType("corridor", 0.15, (12.0, 40.0), (6.0, 14.0), (3.0, 6.0), ((RESIDENTIAL, 0.3), (OFFICE, 0.7)), 0.06),
    BuildingType("hall", 0.1, (10.0, 40.0), (8.0, 30.0), (10.0, 25.0), ((INDUSTRIAL, 1.0),), 0.06),
)  # fmt: skip

_OPEN = ((RESIDENTIAL, 0.35), (OFFICE, 0.25), (INDUSTRIAL, 0.2), (OUTDOOR, 0.2))
WIDE_KINDS = (
    *(replace(kind, share=0.7 * kind.share) for kind in KINDS),
    BuildingType("open", 0.3, (5.0, 40.0), (4.0, 30.0), (60.0, 60.0), _OPEN, 0.02),
)
"""Open sites have no inner walls: laboratories, arenas, halls, and places outdoors. About half of the placements are LOS."""

HEAVY = ((scene.CONCRETE, (0.15, 0.40)), (scene.BRICK, (0.20, 0.50)))
LIGHT = ((scene.PLASTERBOARD, (0.02, 0.05)), (scene.WOOD, (0.03, 0.06)), (scene.GLASS, (0.006, 0.02)))
"""Materials of ITU-R P.2040-1 with bounds of their thickness, m: load-bearing walls, and partitions."""

HEAVY_SHARE = 0.85
"""Share of load-bearing walls."""

DOORWAY_SHARE = 0.8
DOORWAY_M = (0.8, 1.2)
METAL_M = (0.5, 2.0)
PERSON_M = 0.45
MEAN_PEOPLE = 1.0
"""Mean number per building."""

RADIO = Receiver(range_offset_m=0.0)
"""The chip with calibrated antenna delays: the range error comes only from the channel."""

GAIN_DB = (-6.0, 6.0)
"""Transmit power and both antennas, relative to the EVB1000: a DW1000's power is adjustable in steps over 30 dB and
limited by regulations; small antennas have a gain of -2 to 3 dB."""

WIDE_GAIN_SHARE, WIDE_GAIN_DB = 0.1, (-15.0, 15.0)
"""Share of blocks with a power amplifier, an external antenna or attenuation."""

SELF_NOISE_CHANGE_DB, NOISE_MULTIPLIER = (-3.0, 9.0), (10.0, 24.0)
"""Bounds for boards: change of the residue of the preamble's correlation, and factor from the noise to the detection
threshold (NTM)."""

DECAY_FACTOR = (0.7, 2.2)
"""Bounds of the factor of the decay times of clusters and rays of a block. In halls and open sites the decay times are
also proportional to the mean free path, if it is longer than in the flat of the other parameters."""

WIDE_SHARE = 0.5
"""Share of the blocks with open sites, other decay times, tilted antennas, and other boards than the EVB1000."""

TILTED_SHARE, TILTED_LOSS_DB = 0.6, (2.0, 12.0)
"""Share of blocks whose antennas move or are tilted, as on drones: the direct path loses an exponentially distributed
number of dB, with a mean between these bounds; reflections do not."""

NOISE_FIGURE_DB, WIDE_NOISE_FIGURE_DB = (8.0, 12.0), (7.0, 14.0)
DETOUR_M = 4.0
MAX_DELAY_FACTOR = 3.0
"""Behind obstacles, the delay of the first cluster is proportional to the distance, because detours scale with it. It
equals the environment's delay at `DETOUR_M` and is at most `MAX_DELAY_FACTOR` times as long: 8.1 ns (the report's program:
8.3). An assumption, kept because it improved the results on the real logs (docs/background/how_it_works.md)."""

PLACEMENTS, BUILDINGS = 256, 4
"""Placements and buildings per block; each block has one random generator."""

CANDIDATES = 16
"""Candidate placements for each one that is kept."""


def mean_free_path_m(size: Point) -> float:
    """Return the mean free path of rays in a rectangle: pi area / perimeter (Kosten, 1960)."""
    return math.pi * size[0] * size[1] / (2.0 * (size[0] + size[1]))


def draw_plan(kind: BuildingType, rng: np.random.Generator) -> Building:
    """Draw a rectangle divided into rooms, most with a doorway, with metal furniture and people."""
    size = (float(rng.uniform(*kind.length_m)), float(rng.uniform(*kind.width_m)))
    room_m = float(rng.uniform(*kind.room_m))
    walls: list[Wall] = []
    if kind.name == "corridor":
        half = rng.uniform(1.2, 2.5) / 2.0
        low, high = size[1] / 2.0 - half, size[1] / 2.0 + half
        for y, bottom, top in ((low, 0.0, low), (high, high, size[1])):
            doors = np.arange(room_m / 2.0, size[0], room_m)
            walls += _wall((0.0, y), (size[0], y), rng, doors)
            _divide((0.0, bottom), (size[0], top), room_m, rng, walls)
    else:
        _divide((0.0, 0.0), size, room_m, rng, walls)
    screens = [
        _screen("metal", float(rng.uniform(*METAL_M)), size, rng)
        for _ in range(rng.poisson(kind.screens_per_m2 * size[0] * size[1]))
    ]
    screens += [_screen("person", PERSON_M, size, rng) for _ in range(rng.poisson(MEAN_PEOPLE))]
    return Building(size, tuple(walls), tuple(screens))


def _divide(low: Point, high: Point, room_m: float, rng: np.random.Generator, walls: list[Wall]) -> None:
    """Halve a rectangle across its longer side, about in the middle, until rooms are small enough."""
    sides = high[0] - low[0], high[1] - low[1]
    axis = 0 if sides[0] >= sides[1] else 1
    if sides[axis] < 1.6 * room_m:
        return
    split = low[axis] + float(rng.uniform(0.35, 0.65)) * sides[axis]
    start, end = ((split, low[1]), (split, high[1])) if axis == 0 else ((low[0], split), (high[0], split))
    door = [float(rng.uniform(0.1, 0.9)) * sides[1 - axis]] if rng.random() < DOORWAY_SHARE else []
    walls += _wall(start, end, rng, np.array(door))
    _divide(low, (split, high[1]) if axis == 0 else (high[0], split), room_m, rng, walls)
    _divide((split, low[1]) if axis == 0 else (low[0], split), high, room_m, rng, walls)


def _wall(start: Point, end: Point, rng: np.random.Generator, doors_m: NDArray[np.float64]) -> list[Wall]:
    """Return the pieces of a wall of one material between doorways at `doors_m` from its start."""
    choices = HEAVY if rng.random() < HEAVY_SHARE else LIGHT
    material, bounds = choices[int(rng.integers(len(choices)))]
    thickness = float(rng.uniform(*bounds))
    length = math.dist(start, end)
    half = float(rng.uniform(*DOORWAY_M)) / 2.0
    edges = [0.0, *(edge for door in doors_m.tolist() for edge in (door - half, door + half)), length]
    unit = ((end[0] - start[0]) / length, (end[1] - start[1]) / length)
    return [
        Wall(_along(start, unit, first), _along(start, unit, last), material, thickness)
        for first, last in zip(edges[::2], edges[1::2], strict=True)
        if last - first > 0.05
    ]


def _along(start: Point, unit: Point, by: float) -> Point:
    return start[0] + by * unit[0], start[1] + by * unit[1]


def _screen(name: str, length_m: float, size: Point, rng: np.random.Generator) -> Screen:
    x, y, angle = (float(v) for v in rng.uniform((0.0, 0.0, 0.0), (*size, math.pi)))
    half = (length_m / 2.0 * math.cos(angle), length_m / 2.0 * math.sin(angle))
    return Screen(name, (x - half[0], y - half[1]), (x + half[0], y + half[1]))


def draw_boards(n: int, rng: np.random.Generator, *, wide: bool = False, radio: Receiver = RADIO) -> Boards:
    """Draw n pairs of boards: transmit power and antennas, noise, number of accumulated symbols."""
    gain_db = WIDE_GAIN_DB if wide and rng.random() < WIDE_GAIN_SHARE else GAIN_DB
    return Boards(
        rng.uniform(*gain_db, n),
        rng.uniform(*(WIDE_NOISE_FIGURE_DB if wide else NOISE_FIGURE_DB), n),
        rng.choice(np.array(radio.symbol_counts, np.float64), n),
        radio.self_noise_db + (rng.uniform(*SELF_NOISE_CHANGE_DB, n) if wide else np.zeros(n)),
        rng.uniform(*NOISE_MULTIPLIER, n) if wide else np.full(n, radio.noise_multiplier),
    )


@dataclass(frozen=True, slots=True)
class Block:
    """Placements of one kind of building; `building`, int (n,), counts from 0."""

    kind: str
    building: NDArray[np.int64]
    pairs: AntennaPairs
    boards: Boards

    def configuration(self, seed: int, number: int, placement: int) -> str:
        """Return the name of a placement (from 0) of block `number`."""
        building = number * BUILDINGS + int(self.building[placement])
        return f"simulated buildings seed {seed}/{self.kind} {building}/placement {number * PLACEMENTS + placement}"


def block_of(
    seed: int, number: int, *, radio: Receiver = RADIO, wide_share: float = WIDE_SHARE
) -> tuple[Block, np.random.Generator]:
    """Draw a block of `PLACEMENTS` placements in one type of building; also return the generator for fading and noise.

    About a third of the placements each is in line of sight, behind obstacles, and behind obstacles with a lost direct path.
    Sixteen times as many candidates are drawn, and the required number of each condition is kept. Candidates below the
    sensitivity are used only if there are no others.

    Args:
        seed: seed of all blocks.
        number: number of the block, from 0.
        radio: type of all radios.
        wide_share: probability of a block with open sites and other boards.
    """
    rng = np.random.default_rng([seed, number])
    wide = bool(rng.random() < wide_share)
    kinds = WIDE_KINDS if wide else KINDS
    kind = kinds[int(rng.choice(len(kinds), p=[kind.share for kind in kinds]))]
    environment_pairs, shares = zip(*kind.environments, strict=True)
    environments = environment_pairs[int(rng.choice(len(environment_pairs), p=shares))]
    per_building = CANDIDATES * PLACEMENTS // BUILDINGS
    plans = [draw_plan(kind, rng) for _ in range(BUILDINGS)]
    if wide:
        factor = float(rng.uniform(*DECAY_FACTOR))
        if kind.name in ("hall", "open"):
            path_m = float(np.mean([mean_free_path_m(plan.size) for plan in plans]))
            factor *= max(1.0, path_m / mean_free_path_m(FLAT.size))
        environments = tuple(_with_decay(environment, factor) for environment in environments)
    places = [place(plan.size, per_building, rng) for plan in plans]
    path = DirectPath.joined(
        [
            plan.direct_path(anchor, tag, radio.channel)
            for plan, (anchor, tag) in zip(plans, places, strict=True)
        ]
    )
    anchor, tag = (np.concatenate(ends) for ends in zip(*places, strict=True))
    boards = draw_boards(len(anchor), rng, wide=wide, radio=radio)
    if wide and rng.random() < TILTED_SHARE:
        loss_db = rng.exponential(rng.uniform(*TILTED_LOSS_DB), len(anchor))
        path = replace(path, loss_db=path.loss_db + loss_db)
    chosen = _balanced(_conditions(environments, anchor, tag, path, boards, radio), PLACEMENTS, rng)
    anchor, tag = anchor[chosen], tag[chosen]
    delay_factor = np.minimum(np.hypot(*(tag - anchor).T) / DETOUR_M, MAX_DELAY_FACTOR)
    fields = draw_fields(environments, PLACEMENTS, rng, delay_factor)
    pairs = AntennaPairs(
        anchor, tag, path.take(chosen), environments, fields, np.arange(PLACEMENTS), stationary=True
    )
    return Block(kind.name, chosen // per_building, pairs, boards.take(chosen)), rng


def _with_decay(environment: Environment, factor: float) -> Environment:
    """Return an environment with decay times of clusters and rays that are multiplied by `factor`, within the valid limits."""
    return replace(
        environment,
        cluster_decay_ns=min(factor * environment.cluster_decay_ns, channel.MAX_DECAY_NS),
        ray_decay_ns=min(factor * environment.ray_decay_ns, channel.MAX_DECAY_NS),
    )


LOS, NLOS, NDP_NLOS, WEAK = range(4)


def _conditions(
    environments: tuple[Environment, Environment],
    anchor: NDArray[np.float64],
    tag: NDArray[np.float64],
    path: DirectPath,
    boards: Boards,
    radio: Receiver,
) -> NDArray[np.int64]:
    """Predict the condition of each candidate from mean levels."""
    powers = mean_powers_db(environments, anchor, tag, path)
    is_detected = radio.direct_margin_db(*powers, boards) > 0
    condition = np.where(path.crossings == 0, LOS, np.where(is_detected, NLOS, NDP_NLOS))
    condition[mean_level_dbm(*powers, boards, radio) < radio.sensitivities_dbm(boards)] = WEAK
    return condition


def mean_level_dbm(
    direct_db: NDArray[np.float64], diffuse_db: NDArray[np.float64], boards: Boards, radio: Receiver = RADIO
) -> NDArray[np.float64]:
    """Return the mean receive level, dBm (n,), from `mean_powers_db`."""
    power = 10.0 ** (direct_db / 10.0) + 10.0 ** (diffuse_db / 10.0)
    return radio.sent_dbm + boards.gain_db + 10.0 * np.log10(power)


def mean_powers_db(
    environments: Environments, anchor: NDArray[np.float64], tag: NDArray[np.float64], path: DirectPath
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean power of the direct path and of all others relative to the transmit power, dB (n,), for antennas at (n, 2) in m."""
    distance = np.hypot(*(tag - anchor).T)
    direct = channel.direct_power_db(
        distance, path.loss_db + math.prod(channel.PATTERN_LOSS_DB), path.channel
    )
    diffuse = -np.where(
        path.crossings > 0, *(e.path_loss_db(distance, path.channel) for e in environments[::-1])
    )
    return direct, diffuse


def _balanced(conditions: NDArray[np.int64], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return `count` rows, ascending: the three conditions in turn as long as available, weak ones last."""
    order = rng.permutation(len(conditions))
    turn = np.empty(len(conditions), np.int64)
    for condition in (LOS, NLOS, NDP_NLOS, WEAK):
        rows = order[conditions[order] == condition]
        turn[rows] = np.arange(len(rows)) + (len(conditions) if condition == WEAK else 0)
    return np.sort(order[np.argsort(turn[order], kind="stable")][:count])
