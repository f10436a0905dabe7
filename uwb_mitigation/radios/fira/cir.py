"""Conversion of the diagnostics of an exchange to a `Cir`. No I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from uwb_mitigation.radios.fira.messages import CirBlock, Diagnostics, FrameReport, RxFrame
from uwb_mitigation.types.measurement import Cir, RadioType, Segment

_PEAK_SHARE = 0.5
"""Minimum amplitude at the reported position of the peak, relative to the largest tap."""

_MAX_COUNT = np.iinfo(np.int16).max - 1
_NO_SAMPLES = np.zeros(0, np.int16)
_EXCHANGE_FRAMES = frozenset(RxFrame)
_SEGMENTS = {0: Segment.IPATOV} | dict.fromkeys(range(1, 5), Segment.STS)


@dataclass(frozen=True, slots=True)
class CirReport:
    """A CIR and its agreement with the segment metrics.

    Attributes:
        cir: without samples if the board reported none.
        consistent: False if the reported first path contradicts the samples; `cir.first_path_index` is then NaN.
        clock_offset_ppm: carrier frequency offset of the peer; NaN = unknown.
    """

    cir: Cir
    consistent: bool = True
    clock_offset_ppm: float = math.nan


def read_cir(diagnostics: Diagnostics | None, channel: int, rssi_dbm: float) -> CirReport:
    """Return the CIR of the last received frame of an exchange that has one.

    Args:
        diagnostics: diagnostics of the exchange; None: not received.
        channel: UWB channel.
        rssi_dbm: receive level for an exchange without segment metrics.
    """
    received = [
        frame
        for frame in (diagnostics.frames if diagnostics is not None else ())
        if frame.received and frame.frame in _EXCHANGE_FRAMES
    ]
    # The final frame is the last one of the exchange, as in other recordings.
    received.sort(key=lambda frame: frame.frame)
    with_cir = [frame for frame in received if any(len(block.taps) for block in frame.cirs)]
    chosen = (with_cir or [frame for frame in received if frame.metrics] or received)[-1:]
    radio = RadioType.QM35 if chosen and chosen[0].confidence else RadioType.DW3000
    cir = Cir(_NO_SAMPLES, rx_power_dbm=rssi_dbm, channel=channel, prf_mhz=64, radio=radio)
    return _read(chosen[0], cir) if chosen else CirReport(cir)


def _read(frame: FrameReport, cir: Cir) -> CirReport:
    """Return the CIR with levels and samples of a frame."""
    blocks = sorted((block for block in frame.cirs if len(block.taps)), key=lambda block: not block.primary)
    metrics = sorted(frame.metrics, key=lambda each: not each.primary)
    if blocks:
        source = blocks[0].receiver, blocks[0].segment
        metrics = [each for each in metrics if (each.receiver, each.segment) == source]
    levels = metrics[0] if metrics else None
    if levels is not None:
        rx_dbm = cir.rx_power_dbm if math.isnan(levels.rx_dbm) else levels.rx_dbm
        cir = replace(cir, rx_power_dbm=rx_dbm, first_path_power_dbm=levels.first_path_dbm)
    segment = blocks[0].segment if blocks else levels.segment if levels is not None else -1
    cir = replace(cir, segment=_SEGMENTS.get(segment, Segment.UNKNOWN))
    if not blocks:
        return CirReport(cir, clock_offset_ppm=frame.clock_offset_ppm)
    block, lead = blocks[0], abs(blocks[0].offset)
    consistent = lead < len(block.taps)
    start, first_path = 0, float(lead)
    if levels is not None:
        start = levels.first_path_index - lead
        near = abs(levels.first_path - levels.first_path_index) <= 1
        first_path = levels.first_path if near else float(levels.first_path_index)
        consistent &= _peak_fits(block, lead + levels.peak_index - levels.first_path_index)
    samples, scale = _samples(block)
    first_path = first_path if consistent else math.nan
    cir = replace(cir, samples=samples, scale=scale, start_index=start, first_path_index=first_path)
    return CirReport(cir, consistent, frame.clock_offset_ppm)


def _peak_fits(block: CirBlock, expected: int) -> bool:
    """Return whether the amplitude at the reported peak is large; True if the window does not contain the peak."""
    if not 0 <= expected < len(block.taps):
        return True
    amplitude = np.hypot(*block.taps.T.astype(np.float64))
    near = amplitude[max(expected - 1, 0) : expected + 2]
    return bool(near.max() >= _PEAK_SHARE * amplitude.max())


def _samples(block: CirBlock) -> tuple[np.ndarray, float]:
    """Return the taps as int16, and their scale: a power of two, so that the samples keep 15 bits."""
    taps = block.taps.reshape(-1)
    largest = int(np.abs(taps.astype(np.int64)).max())
    shift = max(0, (largest // (_MAX_COUNT + 1)).bit_length())
    return (taps >> shift).astype(np.int16), float(1 << shift)
