"""Measure losses and speed of the decoder with a channel that corrupts bytes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.equipment.faults import DamagedData, Faults, damage
from uwb_mitigation.radios.wire.framing import FrameDecoder, WireFrame, encode_frame
from uwb_mitigation.radios.wire.layout import MessageType

_FRAMES_PER_ROUND = 4096
_LARGEST_READ = 4096


@dataclass(frozen=True, slots=True)
class LoopbackResult:
    """Result of sending numbered frames through a channel that corrupts bytes.

    Attributes:
        sent: frames sent.
        intact: frames that arrived completely and unchanged, including both delimiters.
        delivered: frames that the decoder delivered unchanged.
        lost: frames that were sent, but not delivered.
        intact_lost: frames that arrived intact, but were not delivered; 0 for a correct decoder.
        corrupt_delivered: delivered frames that were corrupted or never sent; 0 for a correct decoder.
        bytes_received: bytes fed to the decoder.
        decoder_s: processor time spent in the decoder.
    """

    sent: int
    intact: int
    delivered: int
    lost: int
    intact_lost: int
    corrupt_delivered: int
    bytes_received: int
    decoder_s: float

    @property
    def decoder_mb_per_s(self) -> float:
        """Encoded bytes decoded per second of one core, in units of 10^6."""
        return self.bytes_received / max(self.decoder_s, 1e-9) / 1e6


def loopback(
    frames: int,
    faults: Faults,
    *,
    payload_bytes: int = 700,
    seed: int = 0,
    advance: Callable[[int], None] = lambda _: None,
) -> LoopbackResult:
    """Send `frames` frames of random payloads, up to `payload_bytes` long, and compare the decoded frames.

    The decoder reads chunks of random sizes. `advance` is called with the number of finished frames.
    """
    random = np.random.default_rng(seed)
    noise = random.integers(0, 256, 4 * payload_bytes + 1, dtype=np.uint8)
    noise[random.random(len(noise)) < 0.1] = 0
    pool = noise.tobytes()
    decoder = FrameDecoder()
    intact = delivered = intact_lost = corrupt = 0
    decoder_s = 0.0
    for first in range(0, frames, _FRAMES_PER_ROUND):
        count = min(_FRAMES_PER_ROUND, frames - first)
        begins = random.integers(0, len(pool) - payload_bytes, count)
        sizes = random.integers(0, payload_bytes + 1, count)
        sent = [
            WireFrame(MessageType.RANGE_CIR, 0, first + i, first * 7, pool[begin : begin + size])
            for i, (begin, size) in enumerate(zip(begins.tolist(), sizes.tolist(), strict=True))
        ]
        wires = [encode_frame(frame) for frame in sent]
        ends = np.cumsum([len(wire) for wire in wires])
        starts = ends - [len(wire) for wire in wires]
        arrived = damage(b"".join(wires), faults, random)
        is_intact = _is_unchanged(arrived, starts, ends)
        body_is_intact = _is_unchanged(arrived, starts + 1, ends - 1)

        received: list[WireFrame] = []
        offset = 0
        while offset < len(arrived.data):
            size = int(random.integers(1, _LARGEST_READ + 1))
            chunk = arrived.data[offset : offset + size]
            began = time.thread_time()
            received += decoder.feed(chunk)
            decoder_s += time.thread_time() - began
            offset += size

        delivered_mask = np.zeros(count, dtype=bool)
        for frame in received:
            i = frame.sequence - first
            if 0 <= i < count and frame == sent[i] and body_is_intact[i] and not delivered_mask[i]:
                delivered_mask[i] = True
            else:
                corrupt += 1
        intact += int(is_intact.sum())
        delivered += int(delivered_mask.sum())
        intact_lost += int((is_intact & ~delivered_mask).sum())
        advance(first + count)
    return LoopbackResult(
        sent=frames,
        intact=intact,
        delivered=delivered,
        lost=frames - delivered,
        intact_lost=intact_lost,
        corrupt_delivered=corrupt,
        bytes_received=decoder.counts["bytes_received"],
        decoder_s=decoder_s,
    )


def _is_unchanged(
    arrived: DamagedData, starts: NDArray[np.intp], ends: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return the mask of segments [start, end) that arrived without a change or an insertion."""
    unchanged = np.searchsorted(arrived.changed, starts) == np.searchsorted(arrived.changed, ends)
    # An insertion before the first byte is outside of the segment.
    closed = np.searchsorted(arrived.inserted, starts + 1) == np.searchsorted(arrived.inserted, ends)
    return np.asarray(unchanged & closed)
