"""Simulated measurements with the format, rooms and size of DeepUWB."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, islice
from itertools import count as counting

import numpy as np

from benchmarks.paper.environments import OBSTACLES, RANGE_OFFSET_M, ROOMS, draw_obstacles, obstruct
from benchmarks.paper.rooms import ROOM_ROWS
from uwb_mitigation.errors import check_range
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.simulation.antenna_pairs import AntennaPairs, draw_fields, place
from uwb_mitigation.simulation.radio import Receiver
from uwb_mitigation.simulation.scene import DirectPath
from uwb_mitigation.simulation.simulated import (
    BATCH,
    PLACEMENTS_RATE_HZ,
    Simulated,
    TwrBatch,
    check_seed,
)
from uwb_mitigation.training.data.deepuwb import (
    CIR_SAMPLES,
    FIRST_ANCHOR_ID,
    FIRST_PATH_INDEX,
    FULL_SCALE,
    configuration_of,
)
from uwb_mitigation.types.measurement import Cir, Encoding, Record

LATE_FIRST_PATH = "first path too late for a whole window"


class SimulatedDeepUwb(Simulated):
    """Static placements in five environments, in the format of DeepUWB; a `Source`.

    The rooms are in DeepUWB's order, each with its share of the rows, with obstacles of the ten materials between the
    antennas. The CIRs are cut and normalised like DeepUWB's: 157 amplitudes from five samples before the first path,
    the largest is 1, no preamble count. In addition to DeepUWB, true ranges and received powers are known, and a
    configuration is one placement: "simulated seed 1/deepuwb/room2/wall/placement 7" (numbered within the room).

    Args:
        seed: 0 to 2^32 - 1.
        ranges: number of rows, 100 to 1,000,000; by default that of DeepUWB in each room.
        exchanges: 1 to 1000 for each placement.

    Attributes:
        rows: number of rows of each room.

    Raises:
        ParameterError: an argument is out of its range.
    """

    def __init__(self, *, seed: int = 1, ranges: int = sum(ROOM_ROWS), exchanges: int = 20) -> None:
        check_seed(seed)
        check_range("simulated DeepUWB", "ranges", ranges, 100, 1_000_000, whole=True)
        check_range("simulated DeepUWB", "exchanges", exchanges, 1, 1000, whole=True)
        radio = Receiver(range_offset_m=RANGE_OFFSET_M)
        super().__init__(f"simulated like DeepUWB, seed {seed}", PLACEMENTS_RATE_HZ, radio, 0)
        self._seed = seed
        self._exchanges = exchanges
        row_ends = np.rint(np.cumsum(ROOM_ROWS) * (ranges / sum(ROOM_ROWS))).astype(int)
        self.rows: tuple[int, ...] = tuple(np.diff(row_ends, prepend=0).tolist())

    def __iter__(self) -> Iterator[Record]:
        self.skipped = Counter()
        for room, rows in enumerate(self.rows):
            # The source is endless, because the number of lost frames is not known in advance.
            records = chain.from_iterable(self._records(*self._batch(room, batch)) for batch in counting())
            yield from islice(self._like_deepuwb(records), rows)

    def _like_deepuwb(self, records: Iterable[Record]) -> Iterator[Record]:
        for record in records:
            cir, truth = _cut(record.measurement.cir), record.truth
            if cir is None or truth is None:
                self.skipped[LATE_FIRST_PATH] += 1
                continue
            # DeepUWB labels the obstacles, not the received path.
            label = "LOS" if truth.label == "LOS" else "NLOS"
            yield Record(replace(record.measurement, cir=cir), replace(truth, label=label))

    def _batch(self, number: int, batch: int) -> tuple[TwrBatch, np.random.Generator]:
        room = ROOMS[number]
        placements = -(-BATCH // self._exchanges)
        size = placements * self._exchanges
        rng = np.random.default_rng([self._seed, number, batch])
        environments = (room.los, room.nlos)
        fields = draw_fields(environments, placements, rng)
        anchor, tag = place(room.size, placements, rng)
        obstacles = [draw_obstacles(room, rng) for _ in range(placements)]
        path = DirectPath.joined(
            [obstruct(a, b, between, rng) for a, b, between in zip(anchor, tag, obstacles, strict=True)]
        )
        placement_of_row = np.repeat(np.arange(placements), self._exchanges)
        names = [
            f"simulated seed {self._seed}/{configuration_of(number, _obstacle_digits(between))}"
            f"/placement {batch * placements + k}"
            for k, between in enumerate(obstacles)
        ]
        # One day per room.
        sequence = round(number * 86_400 * PLACEMENTS_RATE_HZ) + batch * size + np.arange(size)
        return (
            TwrBatch(
                sequence,
                np.full(size, FIRST_ANCHOR_ID + number),
                [names[k] for k in placement_of_row.tolist()],
                AntennaPairs(
                    anchor[placement_of_row],
                    tag[placement_of_row],
                    path.take(placement_of_row),
                    environments,
                    fields,
                    placement_of_row,
                    stationary=True,
                ),
            ),
            rng,
        )


def _obstacle_digits(obstacles: tuple[int, ...]) -> str:
    return "".join("1" if number in obstacles else "0" for number in range(len(OBSTACLES)))


def _cut(cir: Cir) -> Cir | None:
    """Return the CIR cut and normalised like DeepUWB's, with the received powers; None if it ends before the window."""
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
