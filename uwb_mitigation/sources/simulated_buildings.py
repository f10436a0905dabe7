"""Simulated measurements in random buildings, with boards that differ from placement to placement."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from uwb_mitigation.sources.simulated import (
    BATCH,
    FIRST_TAG_ID,
    SURVEY_RATE_HZ,
    Exchanges,
    OneStream,
    check_seed,
)
from uwb_mitigation.sources.simulation.buildings import PLACEMENTS, RADIO, block_of
from uwb_mitigation.sources.simulation.channel import check_range


class SimulatedBuildings(OneStream):
    """Placements at rest in random buildings, about as many in line of sight as behind obstacles; a `Source`.

    A configuration is one placement: "simulated buildings seed 1/flat 12/placement 801". The range error is the
    channel's alone: antenna delays are calibrated.

    Args:
        seed: 0 to 2^32 - 1.
        placements: 1 to 10^7. exchanges: 1 to 1000 for each.

    Raises:
        ParameterError: an argument is out of its range.
    """

    def __init__(self, *, seed: int = 1, placements: int = 20_000, exchanges: int = 1) -> None:
        check_seed(seed)
        check_range("simulated buildings", "placements", placements, 1, 10**7, whole=True)
        check_range("simulated buildings", "exchanges", exchanges, 1, 1000, whole=True)
        super().__init__(f"simulated buildings, seed {seed}", SURVEY_RATE_HZ, RADIO, placements * exchanges)
        self._seed = seed
        self._exchanges = exchanges

    def _batches(self) -> Iterator[tuple[Exchanges, np.random.Generator]]:
        each = self._exchanges
        together = max(1, BATCH // each)
        for number in range(-(-self._count // (PLACEMENTS * each))):
            block, rng = block_of(self._seed, number)
            for first in range(0, PLACEMENTS, together):
                rows = np.arange(first, min(first + together, PLACEMENTS))
                of = np.repeat(np.arange(len(rows)), each)
                links = block.links.take(rows, of)
                names = [block.configuration(self._seed, number, k) for k in rows.tolist()]
                ids = np.ones(len(of), np.int64)
                sequence = (number * PLACEMENTS + first) * each + np.arange(len(of))
                exchanges = Exchanges(
                    sequence,
                    ids,
                    FIRST_TAG_ID * ids,
                    [names[k] for k in of.tolist()],
                    links,
                    block.boards.take(rows[of]),
                )
                yield exchanges, rng
