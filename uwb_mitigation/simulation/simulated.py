"""Simulated measurements of a drive through a flat, and of static placements in random buildings with different boards.

The same arguments give the same measurements, independent of how many are consumed: each segment of the scene
has its own random generator. Stamps begin at 0 and follow the rate, not a clock.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count as counting
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError, check_range
from uwb_mitigation.simulation.antenna_pairs import AntennaPairs, Environments, draw_fields, label
from uwb_mitigation.simulation.buildings import PLACEMENTS, RESIDENTIAL, Block, block_of
from uwb_mitigation.simulation.buildings import RADIO as BUILDINGS_RADIO
from uwb_mitigation.simulation.channel import CHANNEL_2, Channel, DiffuseField
from uwb_mitigation.simulation.odometry import SimulatedMotion, simulate_motion, yaw_along_route
from uwb_mitigation.simulation.radio import Boards, Receiver, Reception
from uwb_mitigation.simulation.scene import ANCHORS, FLAT, MORE_ANCHORS, ROUTE, Building, Point, along_route
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.measurement import (
    DEVICE_TICK_HZ,
    DEVICE_TIME_WRAP,
    Cir,
    RangeMeasurement,
    Record,
    Truth,
)
from uwb_mitigation.types.source import Source

BATCH = 256
"""Exchanges per batch: large enough for vectorisation, small enough for the cache."""

SEGMENT_S = 4.0
SPEED_M_PER_S = 0.5
"""A segment is two metres of the route, in which all rays are replaced one after another; fading changes with each exchange. The errors of
ranges then stay similar over about a metre, as in the Hanyang recordings (docs/experiments/simulator_against_logs.py)."""

ROBOT_FRAME = "base_link"
"""Frame of the ranges of a robot: its antenna is at its origin."""

TAG_ID = 101
NOT_RECEIVED = "frame too weak to be received"

PLACEMENTS_RATE_HZ = 20.0


@dataclass(frozen=True, slots=True)
class TwrBatch:
    """n exchanges before the radio model: their numbers, anchors, configurations and pairs, and headings of moving tags."""

    sequence: NDArray[np.int64]
    anchor_id: NDArray[np.int64]
    configuration: list[str]
    pairs: AntennaPairs
    boards: Boards | None = None
    tag_yaw: NDArray[np.float64] | None = None


class Simulated(Source):
    """Common base of these sources: a `types.source.Source` over batches of exchanges."""

    simulated = True

    def __init__(self, name: str, rate_hz: float, radio: Receiver, count: int) -> None:
        check_range("simulated source", "rate_hz", rate_hz, 0.1, 100_000)
        self.name = name
        self.skipped: Counter[str] = Counter()
        self._rate_hz = rate_hz
        self._count = count
        self._radio = radio

    def _batches(self) -> Iterable[tuple[TwrBatch, np.random.Generator]]:
        """Yield batches in the order of time, each with the radio's random generator."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[Record]:
        self.skipped = Counter()
        for exchanges, rng in self._batches():
            yield from self._records(exchanges, rng)

    def _records(self, exchanges: TwrBatch, rng: np.random.Generator) -> Iterator[Record]:
        pairs = exchanges.pairs
        distance = pairs.distance_m
        reception = self._radio.receive(pairs.multipath(rng), rng, exchanges.boards)
        for i, sequence in enumerate(exchanges.sequence.tolist()):
            # Always simulate a complete batch: its random numbers must not depend on `count`.
            if self._count and sequence >= self._count:
                return
            if np.isnan(reception.first_path_index[i]):
                self.skipped[NOT_RECEIVED] += 1
                continue
            stamp_ns = round(sequence * 1e9 / self._rate_hz)
            anchor_id = int(exchanges.anchor_id[i])
            measurement = RangeMeasurement(
                stamp_ns=stamp_ns,
                tag_id=TAG_ID,
                anchor_id=anchor_id,
                sequence=sequence & 0xFFFFFFFF,
                device_time=round(stamp_ns * DEVICE_TICK_HZ / 1e9) % DEVICE_TIME_WRAP,
                range_m=float(distance[i] + reception.error_m[i]),
                cir=_cir(reception, i, self._radio),
                frame_id=f"simulated_anchor_{anchor_id}" if exchanges.tag_yaw is None else ROBOT_FRAME,
            )
            condition = label(bool(pairs.path.crossings[i]), bool(reception.direct_above_threshold[i]))
            truth = Truth(float(distance[i]), condition, exchanges.configuration[i])
            x, y = pairs.tag[i].tolist()
            yaw = None if exchanges.tag_yaw is None else float(exchanges.tag_yaw[i])
            yield Record(measurement, truth, None if pairs.stationary else (x, y, 0.0), yaw)


class SimulatedSource(Simulated):
    """A tag on a robot's route through a flat, ranging to fixed anchors in turn; a `Source`.

    Every two metres of the route are a separate configuration for each pair, "simulated seed 1/tag 101/
    anchor 3/segment 7". The diffuse field of each pair changes continuously, and the fading with each exchange:
    neighbouring segments have correlated fields.

    Args:
        seed: 0 to 2^32 - 1.
        count: exchanges to simulate; 0 = endless. An exchange below the sensitivity is not yielded but
            counted in `skipped`.
        rate_hz: exchanges per second over all pairs, 0.1 to 100000.
        anchors: positions in m; their identities are 1, 2, ... in this order.
        plan, radio, route: the scene, the receiver, the closed route (m).
        environments: diffuse fields.
        gains_db: of the tag and each anchor together, relative to the receiver's power and antennas; one for all, or one for each anchor.

    Attributes:
        anchors: their positions; all antennas are at z = 0.

    Raises:
        ParameterError: an argument is out of its range.
    """

    def __init__(
        self,
        *,
        seed: int = 1,
        count: int = 0,
        rate_hz: float = 20.0,
        anchors: tuple[Point, ...] = ANCHORS,
        plan: Building = FLAT,
        radio: Receiver | None = None,
        route: tuple[Point, ...] = ROUTE,
        environments: Environments = RESIDENTIAL,
        gains_db: Sequence[float] | float = 0.0,
    ) -> None:
        check_seed(seed)
        check_range("simulated source", "count", count, 0, 2**40, whole=True)
        _check_positions("anchors", anchors, 1, 64)
        _check_positions("route", route, 3, 10_000)
        super().__init__(f"simulated flat, seed {seed}", rate_hz, radio or Receiver(), count)
        self._plan = plan
        self._seed = seed
        self._anchors = np.asarray(anchors, np.float64)
        self.anchors = AnchorMap([Anchor(n, (x, y, 0.0)) for n, (x, y) in enumerate(anchors, 1)])
        self._route = route
        self._environments = environments
        self._gains_db = np.broadcast_to(np.asarray(gains_db, np.float64), len(anchors))

    @classmethod
    def with_anchors(
        cls, number: int, *, seed: int, count: int, rate_hz: float = 20.0, channel: Channel = CHANNEL_2
    ) -> SimulatedSource:
        """Return a drive through the default flat past 4 to 8 anchors.

        Raises:
            ParameterError: an argument is out of its range.
        """
        anchors = ANCHORS + MORE_ANCHORS
        check_range("simulated source", "anchors", number, len(ANCHORS), len(anchors), whole=True)
        radio = Receiver(channel=channel)
        return cls(seed=seed, count=count, rate_hz=rate_hz, anchors=anchors[:number], radio=radio)

    def _batches(self) -> Iterator[tuple[TwrBatch, np.random.Generator]]:
        generators = (np.random.default_rng([self._seed, segment, 0]) for segment in counting())
        knots = ((draw_fields(self._environments, len(self._anchors), rng), rng) for rng in generators)
        for segment, ((fields, rng), (next_fields, _)) in enumerate(pairwise(knots)):
            first, stop = (math.ceil(s * SEGMENT_S * self._rate_hz) for s in (segment, segment + 1))
            if self._count and first >= self._count:
                return
            changes_at = rng.random(fields[0].delay_ns.shape)
            for batch, start in enumerate(range(first, stop, BATCH)):
                sequence = np.arange(start, min(start + BATCH, stop))
                progress = sequence / (SEGMENT_S * self._rate_hz) - segment
                exchanges = self._exchanges(sequence, segment, fields)
                moved = exchanges.pairs.moved(next_fields, progress, changes_at)
                rng = np.random.default_rng([self._seed, segment, 1 + batch])
                yield replace(exchanges, pairs=moved), rng

    def _exchanges(
        self, sequence: NDArray[np.int64], segment: int, fields: tuple[DiffuseField, DiffuseField]
    ) -> TwrBatch:
        anchor = sequence % len(self._anchors)
        travelled = np.asarray(SPEED_M_PER_S * sequence / self._rate_hz, np.float64)
        anchor_id = 1 + anchor
        names = [
            f"simulated seed {self._seed}/tag {TAG_ID}/anchor {number}/segment {segment}"
            for number in anchor_id.tolist()
        ]
        anchors, positions = self._anchors[anchor], along_route(self._route, travelled)
        path = self._plan.direct_path(anchors, positions, self._radio.channel)
        return TwrBatch(
            sequence,
            anchor_id,
            names,
            AntennaPairs(anchors, positions, path, self._environments, fields, anchor, stationary=False),
            replace(self._radio.boards(len(anchor)), gain_db=self._gains_db[anchor]),
            tag_yaw=yaw_along_route(self._route, travelled),
        )

    def motion(self) -> SimulatedMotion:
        """Return odometry and IMU data of the robot with the tag, for the duration of a source with a `count`."""
        return simulate_motion(self._route, SPEED_M_PER_S, self._count / self._rate_hz, self._seed)


class SimulatedBuildings(Simulated):
    """Static placements in random buildings, about as many LOS as NLOS; a `Source`.

    A configuration is one placement: "simulated buildings seed 1/flat 12/placement 801". The range error comes
    only from the channel: antenna delays are calibrated.

    Args:
        seed: 0 to 2^32 - 1.
        placements: 1 to 10^7. exchanges: 1 to 1000 for each.
        channel: UWB channel.

    Raises:
        ParameterError: an argument is out of its range.
    """

    def __init__(
        self, seed: int = 1, placements: int = 20_000, exchanges: int = 1, channel: Channel = CHANNEL_2
    ) -> None:
        check_seed(seed)
        check_range("simulated buildings", "placements", placements, 1, 10**7, whole=True)
        check_range("simulated buildings", "exchanges", exchanges, 1, 1000, whole=True)
        count, radio = placements * exchanges, replace(BUILDINGS_RADIO, channel=channel)
        super().__init__(f"simulated buildings, seed {seed}", PLACEMENTS_RATE_HZ, radio, count)
        self._seed = seed
        self._exchanges = exchanges

    def _batches(self) -> Iterator[tuple[TwrBatch, np.random.Generator]]:
        together = max(1, BATCH // self._exchanges)
        for number in range(-(-self._count // (PLACEMENTS * self._exchanges))):
            block, rng = block_of(self._seed, number, radio=self._radio)
            for first in range(0, PLACEMENTS, together):
                rows = np.arange(first, min(first + together, PLACEMENTS))
                names = [block.configuration(self._seed, number, k) for k in rows.tolist()]
                of_all = number * PLACEMENTS + first
                yield self._exchange(block, rows, of_all, names), rng

    def _exchange(self, block: Block, rows: NDArray[np.intp], first: int, names: list[str]) -> TwrBatch:
        """Return the exchanges of some placements; `first`: number of the first of them among all placements."""
        index = np.repeat(np.arange(len(rows)), self._exchanges)
        return TwrBatch(
            first * self._exchanges + np.arange(len(index)),
            np.ones(len(index), np.int64),
            [names[k] for k in index.tolist()],
            block.pairs.take(rows, index),
            block.boards.take(rows[index]),
        )


def _cir(reception: Reception, i: int, radio: Receiver) -> Cir:
    return Cir(
        samples=reception.samples[i].copy(),
        first_path_index=float(reception.first_path_index[i]),
        preamble_count=int(reception.preamble_count[i]),
        noise_threshold=int(reception.noise_threshold[i]),
        rx_power_dbm=float(reception.rx_power_dbm[i]),
        first_path_power_dbm=float(reception.first_path_power_dbm[i]),
        channel=radio.channel.number,
        prf_mhz=64,
        radio=radio.kind,
        segment=radio.segment,
    )


def _check_positions(name: str, points: tuple[Point, ...], low: int, high: int) -> None:
    try:
        array = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim != 2 or array.shape[1] != 2 or not np.isfinite(array).all():
        raise ParameterError(f"{name} = {points!r}", where="simulated source", valid="pairs of finite x, y")
    check_range("simulated source", f"number of {name}", len(array), low, high)


def check_seed(seed: int) -> None:
    """Raise ParameterError if the seed is out of range."""
    check_range("simulated source", "seed", seed, 0, 2**32 - 1, whole=True)
