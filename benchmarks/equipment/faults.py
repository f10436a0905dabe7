"""A channel that damages bytes, with a seeded generator. No I/O."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError


@dataclass(frozen=True, slots=True)
class Faults:
    """Probabilities of transmission faults, per byte and per block of data sent together.

    Attributes:
        flip: one bit of the byte is inverted.
        drop: the byte is lost.
        insert: a random byte is inserted before the byte.
        lose, duplicate: the block is lost, or arrives twice.

    Raises:
        ParameterError: a probability is outside 0 to 1.
    """

    flip: float = 0.0
    drop: float = 0.0
    insert: float = 0.0
    lose: float = 0.0
    duplicate: float = 0.0

    def __post_init__(self) -> None:
        for name in ("flip", "drop", "insert", "lose", "duplicate"):
            if not 0 <= getattr(self, name) <= 1:
                raise ParameterError(f"{name} = {getattr(self, name)}", valid="0 to 1")


@dataclass(frozen=True, slots=True)
class DamagedData:
    """Received bytes, and the positions of the damage in the sent bytes.

    Attributes:
        data: the received bytes.
        changed: sorted positions of bytes that were flipped or dropped.
        inserted: sorted positions of bytes before which a byte was inserted.
    """

    data: bytes
    changed: NDArray[np.intp]
    inserted: NDArray[np.intp]


def damage(data: bytes, faults: Faults, random: np.random.Generator) -> DamagedData:
    """Send `data` through a channel with `faults`."""
    sent = np.frombuffer(data, np.uint8)
    draws = random.random((3, len(sent)), dtype=np.float32)
    flips = np.flatnonzero(draws[0] < faults.flip)
    dropped = draws[1] < faults.drop
    inserted = np.flatnonzero(draws[2] < faults.insert)

    received = sent.copy()
    received[flips] ^= np.uint8(1) << random.integers(0, 8, len(flips), dtype=np.uint8)
    # An insertion at i goes before byte i: subtract the number of bytes dropped before it.
    kept_before = np.cumsum(~dropped) - ~dropped
    received = np.insert(
        received[~dropped], kept_before[inserted], random.integers(0, 256, len(inserted), dtype=np.uint8)
    )
    changed = np.union1d(flips, np.flatnonzero(dropped))
    return DamagedData(received.tobytes(), changed, inserted)
