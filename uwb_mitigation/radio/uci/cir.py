"""Conversion of the diagnostics of an exchange to a `Cir`. No I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from uwb_mitigation.measurement import Cir, RadioType, Segment
from uwb_mitigation.radio.uci.messages import CirBlock, Diagnostics, Frame, FrameReport, SegmentMetrics

_PEAK_SHARE = 0.5
"""Minimum amplitude at the reported position of the peak, relative to the largest tap."""

_MAX_COUNT = np.iinfo(np.int16).max - 1
_NO_SAMPLES = np.zeros(0, np.int16)
_EXCHANGE_FRAMES = frozenset(Frame)


@dataclass(frozen=True, slots=True)
class Reading:
    """A CIR and its agreement with the segment metrics.

    Attributes:
        cir: without samples if the board reported none.
        consistent: False if the reported first path contradicts the samples; `cir.first_path_index` is then NaN.
        clock_offset_ppm: carrier frequency offset of the peer; NaN = unknown.
    """

    cir: Cir
    consistent: bool = True
    clock_offset_ppm: float = math.nan


def read_cir(diagnostics: Diagnostics | None, channel: int, rssi_dbm: float) -> Reading:
    """Return the CIR of the last received frame of an exchange that has one.

    Args:
        diagnostics: diagnostics of the exchange; None: not received.
        channel: UWB channel.
        rssi_dbm: receive level for an exchange without segment metrics.
    """
    frames = [
        frame
        for frame in (diagnostics.frames if diagnostics is not None else ())
        if frame.received and frame.frame in _EXCHANGE_FRAMES
    ]
    # The final frame is the last one of the exchange, as in other recordings.
    frames.sort(key=lambda frame: frame.frame)
    with_cir = [frame for frame in frames if any(len(block.taps) for block in frame.cirs)]
    chosen = (with_cir or [frame for frame in frames if frame.metrics] or frames)[-1:]
    if not chosen:
        return Reading(_cir(RadioType.DW3000, channel, rssi_dbm))
    return _read(chosen[0], channel, rssi_dbm)


def _read(frame: FrameReport, channel: int, rssi_dbm: float) -> Reading:
    radio = RadioType.QM35 if frame.confidence else RadioType.DW3000
    blocks = sorted((block for block in frame.cirs if len(block.taps)), key=lambda block: not block.primary)
    if not blocks:
        metrics = next(iter(sorted(frame.metrics, key=lambda each: not each.primary)), None)
        cir = _cir(radio, channel, rssi_dbm, metrics)
        return Reading(cir, clock_offset_ppm=frame.clock_offset_ppm)
    block = blocks[0]
    metrics = next(
        (each for each in frame.metrics if (each.receiver, each.segment) == (block.receiver, block.segment)),
        None,
    )
    lead = abs(block.offset)
    consistent = lead < len(block.taps)
    start, first_path = 0, float(lead)
    if metrics is not None:
        start = metrics.first_path_index - lead
        near = abs(metrics.first_path - metrics.first_path_index) <= 1
        first_path = metrics.first_path if near else float(metrics.first_path_index)
        consistent &= _peak_fits(block, lead + metrics.peak_index - metrics.first_path_index)
    samples, scale = _samples(block)
    return Reading(
        _cir(
            radio, channel, rssi_dbm, metrics, block.segment, samples, scale, start, first_path if consistent else math.nan
        ),
        consistent,
        frame.clock_offset_ppm,
    )  # fmt: skip


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


def _cir(
    radio: RadioType,
    channel: int,
    rssi_dbm: float,
    metrics: SegmentMetrics | None = None,
    segment: int | None = None,
    samples: np.ndarray = _NO_SAMPLES,
    scale: float = 1.0,
    start: int = 0,
    first_path: float = math.nan,
) -> Cir:
    if segment is None and metrics is not None:
        segment = metrics.segment
    kind = Segment.UNKNOWN
    if segment is not None and segment <= 4:
        kind = Segment.STS if segment else Segment.IPATOV
    rx_dbm = metrics.rx_dbm if metrics is not None else math.nan
    return Cir(
        samples,
        start_index=start,
        first_path_index=first_path,
        scale=scale,
        rx_power_dbm=rssi_dbm if math.isnan(rx_dbm) else rx_dbm,
        first_path_power_dbm=metrics.first_path_dbm if metrics is not None else math.nan,
        channel=channel,
        prf_mhz=64,
        radio=radio,
        segment=kind,
    )
