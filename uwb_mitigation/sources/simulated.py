"""Measurements from the simulator: a robot driving through a flat, a survey of placements at rest, or one in
DeepUWB's shape.

All yield the same for the same arguments, however much is consumed: every stretch of the scene draws
from a generator of its own. Stamps begin at 0 and follow the rate; nothing waits for a clock.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import count as counting
from itertools import islice
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.measurement import (
    DEVICE_TICK_HZ,
    DEVICE_TIME_WRAP,
    Cir,
    Encoding,
    RangeMeasurement,
    Truth,
)
from uwb_mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.simulation.channel import (
    RESIDENTIAL_LOS,
    RESIDENTIAL_NLOS,
    DiffuseField,
    Environment,
    Multipath,
    check_range,
    draw_diffuse_field,
    propagate,
)
from uwb_mitigation.simulation.radio import Radio, Reception
from uwb_mitigation.simulation.rooms import OBSTACLES, ROOMS, draw_obstacles, obstruct
from uwb_mitigation.simulation.scene import ANCHORS, FLAT, ROUTE, DirectPath, FloorPlan, Point, along_route
from uwb_mitigation.sources.deepuwb import (
    CIR_SAMPLES,
    FIRST_ANCHOR_ID,
    FIRST_PATH_INDEX,
    FULL_SCALE,
    ROOM_ROWS,
    configuration_of,
)
from uwb_mitigation.sources.source import Record

BATCH = 256
"""Exchanges simulated together: enough to vectorise, little enough to stay in cache."""

SEGMENT_S = 2.0
SPEED_M_PER_S = 0.5
"""A segment is a metre of the route: clusters keep their places over it, fading does not."""

BORDER_M = 0.2
CLOSEST_M = 0.5
FIRST_TAG_ID = 101
NOT_RECEIVED = "frame too weak to be received"
LATE = "first path too late for a whole window"

RESIDENTIAL = (RESIDENTIAL_LOS, RESIDENTIAL_NLOS)
"""Diffuse fields in line of sight and out of it."""

SURVEY_RATE_HZ = 20.0


@dataclass(frozen=True, slots=True)
class _Exchanges:
    """n exchanges before the radio: who, where, and which diffuse field they share.

    `anchor`, `tag` are float64 (n, 2) positions in m, and `path` is what stands between them;
    `environments` and `fields` are the diffuse fields in line of sight and out of it, and `field_of`, int
    (n,), says which of their rows an exchange has.
    """

    sequence: NDArray[np.int64]
    anchor_id: NDArray[np.int64]
    tag_id: NDArray[np.int64]
    anchor: NDArray[np.float64]
    tag: NDArray[np.float64]
    path: DirectPath
    configuration: list[str]
    environments: tuple[Environment, Environment]
    fields: tuple[DiffuseField, DiffuseField]
    field_of: NDArray[np.intp]
    at_rest: bool


class _Simulated(ABC):
    """What the sources share: a `sources.source.Source` over batches of exchanges."""

    simulated = True

    def __init__(self, name: str, rate_hz: float, radio: Radio, count: int) -> None:
        check_range("simulated source", "rate_hz", rate_hz, 0.1, 100_000)
        self.name = name
        self.skipped: Counter[str] = Counter()
        self._rate_hz = rate_hz
        self._count = count
        self._radio = radio

    @abstractmethod
    def _measurements(self) -> Iterator[Record]:
        """All of them in order of time; what is left out is counted in `skipped`."""

    def __iter__(self) -> Iterator[Record]:
        self.skipped = Counter()
        yield from self._measurements()

    def close(self) -> None:
        """Return at once: no file or port is held."""
        return

    def __enter__(self) -> _Simulated:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _received(self, batches: Iterable[tuple[_Exchanges, np.random.Generator]]) -> Iterator[Record]:
        """What the radio makes of batches, each with the generator that it is to draw from."""
        for exchanges, rng in batches:
            yield from self._records(exchanges, rng)

    def _records(self, exchanges: _Exchanges, rng: np.random.Generator) -> Iterator[Record]:
        distance = np.hypot(*(exchanges.tag - exchanges.anchor).T)
        reception = self._radio.receive(_multipath(exchanges, distance, rng), rng)
        for i, sequence in enumerate(exchanges.sequence.tolist()):
            # A batch is always simulated whole: what it draws must not depend on `count`.
            if self._count and sequence >= self._count:
                return
            if np.isnan(reception.first_path_index[i]):
                self.skipped[NOT_RECEIVED] += 1
                continue
            stamp_ns = round(sequence * 1e9 / self._rate_hz)
            anchor_id = int(exchanges.anchor_id[i])
            measurement = RangeMeasurement(
                stamp_ns=stamp_ns,
                tag_id=int(exchanges.tag_id[i]),
                anchor_id=anchor_id,
                sequence=sequence & 0xFFFFFFFF,
                device_time=round(stamp_ns * DEVICE_TICK_HZ / 1e9) % DEVICE_TIME_WRAP,
                range_m=float(distance[i] + reception.error_m[i]),
                cir=_cir(reception, i),
                frame_id=f"anchor_{anchor_id}",
            )
            label = _label(bool(exchanges.path.crossings[i]), bool(reception.direct_above_threshold[i]))
            yield Record(measurement, Truth(float(distance[i]), label, exchanges.configuration[i]))


class _OneStream(_Simulated):
    """A source that simulates a single row of batches, up to its count."""

    @abstractmethod
    def _batches(self) -> Iterator[tuple[_Exchanges, np.random.Generator]]:
        """In order of time, each with the generator that the radio is to draw from."""

    def _measurements(self) -> Iterator[Record]:
        return self._received(self._batches())


class SimulatedSource(_OneStream):
    """Tags on a robot's route through a flat, ranging to fixed anchors in turn; a `Source`.

    Each metre of the route is a configuration of its own for each pair, "simulated seed 1/tag 101/
    anchor 3/segment 7": within it the clusters of the diffuse field stay, the fading changes.

    Args:
        seed: 0 to 2^32 - 1.
        count: exchanges to simulate; 0 = endless. One too weak to be received yields nothing and is
            counted in `skipped`.
        rate_hz: exchanges a second over all pairs, 0.1 to 100000.
        tags: 1 to 64, spread evenly along the route.
        anchors: positions in m; their identities are 1, 2, ... in this order.
        plan, radio, route: the scene, the receiver, the closed route (m).

    Raises:
        ParameterError: an argument is out of its range.
    """

    def __init__(
        self,
        *,
        seed: int = 1,
        count: int = 0,
        rate_hz: float = 20.0,
        tags: int = 1,
        anchors: tuple[Point, ...] = ANCHORS,
        plan: FloorPlan = FLAT,
        radio: Radio | None = None,
        route: tuple[Point, ...] = ROUTE,
    ) -> None:
        _check_seed(seed)
        check_range("simulated source", "count", count, 0, 2**40, whole=True)
        check_range("simulated source", "tags", tags, 1, 64, whole=True)
        _check_positions("anchors", anchors, 1, 64)
        _check_positions("route", route, 3, 10_000)
        super().__init__(f"simulated flat, seed {seed}", rate_hz, radio or Radio(), count)
        self._plan = plan
        self._seed = seed
        self._tags = tags
        self._anchors = np.asarray(anchors, np.float64)
        self._route = route
        closed = np.asarray([*route, route[0]])
        self._spacing_m = float(np.hypot(*np.diff(closed, axis=0).T).sum()) / tags

    def _batches(self) -> Iterator[tuple[_Exchanges, np.random.Generator]]:
        pairs = self._tags * len(self._anchors)
        for segment in counting():
            first, stop = (math.ceil(s * SEGMENT_S * self._rate_hz) for s in (segment, segment + 1))
            if self._count and first >= self._count:
                return
            rng = np.random.default_rng([self._seed, segment, 0])
            fields = _draw_fields(RESIDENTIAL, pairs, rng)
            for batch, start in enumerate(range(first, stop, BATCH)):
                sequence = np.arange(start, min(start + BATCH, stop))
                rng = np.random.default_rng([self._seed, segment, 1 + batch])
                yield self._exchanges(sequence, segment, fields), rng

    def _exchanges(
        self, sequence: NDArray[np.int64], segment: int, fields: tuple[DiffuseField, DiffuseField]
    ) -> _Exchanges:
        anchor = sequence % len(self._anchors)
        tag = sequence // len(self._anchors) % self._tags
        travelled = SPEED_M_PER_S * sequence / self._rate_hz + tag * self._spacing_m
        tag_id, anchor_id = FIRST_TAG_ID + tag, 1 + anchor
        names = [
            f"simulated seed {self._seed}/tag {t}/anchor {a}/segment {segment}"
            for t, a in zip(tag_id.tolist(), anchor_id.tolist(), strict=True)
        ]
        pair = tag * len(self._anchors) + anchor
        anchors, positions = self._anchors[anchor], along_route(self._route, travelled)
        path = self._plan.direct_path(anchors, positions)
        return _Exchanges(
            sequence,
            anchor_id,
            tag_id,
            anchors,
            positions,
            path,
            names,
            RESIDENTIAL,
            fields,
            pair,
            at_rest=False,
        )


class SimulatedSurvey(_OneStream):
    """Independent placements at rest, many exchanges each, like a surveyed data set; a `Source`.

    Both antennas lie anywhere in the plan, 0.2 m from its border and at least `CLOSEST_M` apart. A
    placement has one channel: its exchanges differ by noise and sampling phase alone.

    Args:
        seed: 0 to 2^32 - 1.
        configurations: 1 to 10^7 placements. exchanges: 1 to 1000 for each.
        rate_hz: exchanges a second, 0.1 to 100000.
        plan, radio: the scene, the receiver.

    Raises:
        ParameterError: an argument is out of its range, or the plan is too small.
    """

    def __init__(
        self,
        *,
        seed: int = 1,
        configurations: int = 100,
        exchanges: int = 20,
        rate_hz: float = 20.0,
        plan: FloorPlan = FLAT,
        radio: Radio | None = None,
    ) -> None:
        _check_seed(seed)
        check_range("simulated survey", "configurations", configurations, 1, 10**7, whole=True)
        check_range("simulated survey", "exchanges", exchanges, 1, 1000, whole=True)
        for axis, extent in zip("xy", plan.size, strict=True):
            check_range("simulated survey", f"plan size in {axis}", extent, 2.0, 1000.0)
        super().__init__(
            f"simulated survey, seed {seed}", rate_hz, radio or Radio(), configurations * exchanges
        )
        self._plan = plan
        self._seed = seed
        self._exchanges = exchanges

    def _batches(self) -> Iterator[tuple[_Exchanges, np.random.Generator]]:
        placements = -(-BATCH // self._exchanges)
        size = placements * self._exchanges
        for batch in range(-(-self._count // size)):
            rng = np.random.default_rng([self._seed, batch])
            fields = _draw_fields(RESIDENTIAL, placements, rng)
            anchor, tag = _place(self._plan.size, placements, rng)
            of = np.repeat(np.arange(placements), self._exchanges)
            names = [
                f"simulated survey seed {self._seed}/placement {batch * placements + k}" for k in of.tolist()
            ]
            sequence = batch * size + np.arange(size)
            ids = np.ones(size, np.int64)
            path = self._plan.direct_path(anchor, tag).take(of)
            yield (
                _Exchanges(
                    sequence,
                    ids,
                    FIRST_TAG_ID * ids,
                    anchor[of],
                    tag[of],
                    path,
                    names,
                    RESIDENTIAL,
                    fields,
                    of,
                    at_rest=True,
                ),
                rng,
            )


class SimulatedDeepUwb(_Simulated):
    """Placements at rest in five environments, in DeepUWB's shape; a `Source`.

    Rooms in DeepUWB's order, each with its share of the rows, obstacles among the ten materials between the
    antennas, and CIRs as DeepUWB has them: 157 amplitudes from five samples before the first path, the largest
    being 1, without a preamble count. Beyond DeepUWB, distances are true and the radio's levels known, and a
    configuration is one placement: "simulated seed 1/deepuwb/room2/wall/placement 7", with 7 counted in its room.

    Args:
        seed: 0 to 2^32 - 1.
        ranges: rows, 100 to 1,000,000; by default as many as in DeepUWB, with its number in each room.
        exchanges: 1 to 1000 for each placement.

    Attributes:
        rows: of each room.

    Raises:
        ParameterError: an argument is out of its range.
    """

    def __init__(self, *, seed: int = 1, ranges: int = sum(ROOM_ROWS), exchanges: int = 20) -> None:
        _check_seed(seed)
        check_range("simulated DeepUWB", "ranges", ranges, 100, 1_000_000, whole=True)
        check_range("simulated DeepUWB", "exchanges", exchanges, 1, 1000, whole=True)
        # Their raw error leaves no room for delays that were not calibrated.
        radio = Radio(range_offset_m=0.0)
        super().__init__(f"simulated in the shape of DeepUWB, seed {seed}", SURVEY_RATE_HZ, radio, 0)
        self._seed = seed
        self._exchanges = exchanges
        ends = np.rint(np.cumsum(ROOM_ROWS) * (ranges / sum(ROOM_ROWS))).astype(int)
        self.rows: tuple[int, ...] = tuple(np.diff(ends, prepend=0).tolist())

    def _measurements(self) -> Iterator[Record]:
        for room, rows in enumerate(self.rows):
            # Without end: how many frames are lost is known only as they are.
            batches = (self._batch(room, batch) for batch in counting())
            yield from islice(self._shaped(self._received(batches)), rows)

    def _shaped(self, records: Iterable[Record]) -> Iterator[Record]:
        for record in records:
            cir, truth = _cut(record.measurement.cir), record.truth
            if cir is None or truth is None:
                self.skipped[LATE] += 1
                continue
            # DeepUWB tells what stands in the path, not what was received over it.
            label = "LOS" if truth.label == "LOS" else "NLOS"
            yield Record(replace(record.measurement, cir=cir), replace(truth, label=label))

    def _batch(self, number: int, batch: int) -> tuple[_Exchanges, np.random.Generator]:
        room = ROOMS[number]
        placements = -(-BATCH // self._exchanges)
        size = placements * self._exchanges
        rng = np.random.default_rng([self._seed, number, batch])
        environments = (room.in_sight, room.blocked)
        fields = _draw_fields(environments, placements, rng)
        anchor, tag = _place(room.size, placements, rng)
        chosen = [draw_obstacles(room, rng) for _ in range(placements)]
        path = DirectPath.joined(
            [obstruct(a, b, between, rng) for a, b, between in zip(anchor, tag, chosen, strict=True)]
        )
        of = np.repeat(np.arange(placements), self._exchanges)
        names = [
            f"simulated seed {self._seed}/{configuration_of(number, _digits(between))}"
            f"/placement {batch * placements + k}"
            for k, between in enumerate(chosen)
        ]
        # Each room on a day of its own.
        sequence = round(number * 86_400 * SURVEY_RATE_HZ) + batch * size + np.arange(size)
        ids = np.ones(size, np.int64)
        return (
            _Exchanges(
                sequence,
                (FIRST_ANCHOR_ID + number) * ids,
                FIRST_TAG_ID * ids,
                anchor[of],
                tag[of],
                path.take(of),
                [names[k] for k in of.tolist()],
                environments,
                fields,
                of,
                at_rest=True,
            ),
            rng,
        )


def _digits(chosen: tuple[int, ...]) -> str:
    return "".join("1" if number in chosen else "0" for number in range(len(OBSTACLES)))


def _cut(cir: Cir) -> Cir | None:
    """A CIR as DeepUWB has it, and the levels that it does not have; None where it ends before the window."""
    start = math.floor(cir.first_path_index) - WINDOW_LEAD
    if start < 0 or start + CIR_SAMPLES > len(cir):
        return None
    taps = cir.samples[2 * start : 2 * (start + CIR_SAMPLES)].astype(np.float64).reshape(-1, 2)
    magnitude = np.hypot(*taps.T)
    samples = np.rint(magnitude * (FULL_SCALE / magnitude.max())).astype(np.int16)
    return replace(
        cir,
        samples=samples,
        encoding=Encoding.MAGNITUDE,
        first_path_index=FIRST_PATH_INDEX,
        scale=1.0 / FULL_SCALE,
        preamble_count=0,
        noise_threshold=0,
    )


def _draw_fields(
    environments: tuple[Environment, Environment], n: int, rng: np.random.Generator
) -> tuple[DiffuseField, DiffuseField]:
    in_sight, blocked = environments
    return draw_diffuse_field(in_sight, n, rng), draw_diffuse_field(blocked, n, rng)


def _place(size: Point, n: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw n pairs of positions, float64 (n, 2) each; pairs too close are drawn again."""
    pair = np.empty((n, 2, 2))
    again = np.ones(n, np.bool_)
    while again.any():
        pair[again] = rng.uniform((BORDER_M, BORDER_M), np.subtract(size, BORDER_M), (int(again.sum()), 2, 2))
        again = np.hypot(*(pair[:, 0] - pair[:, 1]).T) < CLOSEST_M
    return pair[:, 0], pair[:, 1]


def _multipath(exchanges: _Exchanges, distance: NDArray[np.float64], rng: np.random.Generator) -> Multipath:
    """Each exchange's multipath: of the line-of-sight environment where nothing blocks its path."""
    path = exchanges.path
    rays = exchanges.fields[0].delay_ns.shape[1]
    delay = np.empty((len(distance), 1 + rays))
    gain = np.empty((len(distance), 1 + rays), np.complex128)
    for environment, field, blocked in zip(
        exchanges.environments, exchanges.fields, (False, True), strict=True
    ):
        # At rest the fading is drawn once for a field, in motion once for an exchange.
        (here,) = np.nonzero((path.crossings > 0) == blocked)
        of = exchanges.field_of[here]
        fading = field.fade(rng)[of] if exchanges.at_rest else field.take(of).fade(rng)
        arriving = propagate(
            distance[here], path.loss_db[here], path.excess_m[here], environment, field.take(of), fading, rng
        )
        delay[here], gain[here] = arriving.delay_ns, arriving.gain
    return Multipath(delay, gain)


def _cir(reception: Reception, i: int) -> Cir:
    return Cir(
        samples=reception.samples[i].copy(),
        first_path_index=float(reception.first_path_index[i]),
        preamble_count=int(reception.preamble_count[i]),
        noise_threshold=int(reception.noise_threshold[i]),
        rx_power_dbm=float(reception.rx_power_dbm[i]),
        first_path_power_dbm=float(reception.first_path_power_dbm[i]),
        channel=2,
        prf_mhz=64,
    )


def _label(blocked: bool, direct_above_threshold: bool) -> str:
    if not blocked:
        return "LOS"
    return "NLOS" if direct_above_threshold else "NDP NLOS"


def _check_positions(name: str, points: tuple[Point, ...], low: int, high: int) -> None:
    try:
        array = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim != 2 or array.shape[1] != 2 or not np.isfinite(array).all():
        raise ParameterError(f"{name} = {points!r}", where="simulated source", valid="pairs of finite x, y")
    check_range("simulated source", f"number of {name}", len(array), low, high)


def _check_seed(seed: int) -> None:
    check_range("simulated source", "seed", seed, 0, 2**32 - 1, whole=True)
