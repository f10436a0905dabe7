"""Conversion of the diagnostics of an exchange to a `Cir`. No I/O."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.radios.fira.messages import CirBlock, Diagnostics, FrameReport, SegmentMetrics
from uwb_mitigation.types.measurement import SAMPLE_PERIOD_S, Cir, RadioType, Segment

_PEAK_SHARE = 0.5
"""Minimum amplitude at the reported position of the peak, relative to the largest tap, and maximum before the first path."""

_EDGE_RATIO = 2.0
"""Minimum ratio of the amplitude at the first path to the noise before it."""

_TAP_NS = SAMPLE_PERIOD_S * 1e9

_MAX_COUNT = np.iinfo(np.int16).max - 1
_NO_SAMPLES = np.zeros(0, np.int16)
_EXCHANGE_FRAMES = range(3)
"""`msg_id` of the frames on which a radio reports a CIR."""

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


class PositionUnit:
    """Unit of the first-path positions of a board: taps, or nanoseconds as in Qorvo's headers.

    A board also reports the whole tap. A position in taps is less than one tap after it, and one in nanoseconds is
    further away by 0.0016 per tap. Positions that both units allow do not count.

    Attributes:
        votes: number of positions that only one unit allows, and of `contradictory` ones that none allows.
    """

    def __init__(self) -> None:
        self.votes: Counter[str] = Counter(taps=0, nanoseconds=0, contradictory=0)

    @property
    def name(self) -> str:
        """The more frequent unit; empty while it is unknown."""
        (first, count), (_, second_count), *_ = self.votes.most_common()
        return first if count > second_count else ""

    def add(self, metrics: SegmentMetrics) -> float:
        """Add a position; return the first path in taps: the whole tap if the position contradicts it."""
        index, position = metrics.first_path_index, metrics.first_path
        # A rounded whole tap may be half a tap after the position.
        is_taps = -0.5 <= position - index <= 1.0
        is_ns = -0.5 <= position / _TAP_NS - index <= 1.0
        if not (is_taps or is_ns):
            self.votes["contradictory"] += 1
        elif position - index >= 1.0:
            self.votes["nanoseconds"] += 1
        elif position / _TAP_NS < index:
            self.votes["taps"] += 1
        if self.name == "nanoseconds":
            return position / _TAP_NS if is_ns else float(index)
        return position if is_taps else float(index)


def read_cir(
    diagnostics: Diagnostics | None, channel: int, rssi_dbm: float, unit: PositionUnit | None = None
) -> CirReport:
    """Return the CIR of the last received frame of an exchange that has one.

    Args:
        diagnostics: diagnostics of the exchange; None: not received.
        channel: UWB channel.
        rssi_dbm: receive level for an exchange without segment metrics.
        unit: unit of the positions of this board, which it updates; None = taps, unless the position excludes it.
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
    return _read(chosen[0], cir, unit or PositionUnit()) if chosen else CirReport(cir)


def _priority(segment: CirBlock | SegmentMetrics) -> tuple[bool, bool]:
    """Return the sort key of segments: the primary one first; of two, the STS, from which SP3 frames have their range."""
    return not segment.primary, segment.segment == 0


def _read(frame: FrameReport, cir: Cir, unit: PositionUnit) -> CirReport:
    """Return the CIR with levels and samples of a frame."""
    blocks = sorted((block for block in frame.cirs if len(block.taps)), key=_priority)
    metrics = sorted(frame.metrics, key=_priority)
    if blocks:
        source = blocks[0].receiver, blocks[0].segment
        metrics = [levels for levels in metrics if (levels.receiver, levels.segment) == source]
    levels = metrics[0] if metrics else None
    if levels is not None:
        rx_dbm = cir.rx_power_dbm if math.isnan(levels.rx_dbm) else levels.rx_dbm
        cir = replace(cir, rx_power_dbm=rx_dbm, first_path_power_dbm=levels.first_path_dbm)
    segment = blocks[0].segment if blocks else levels.segment if levels is not None else -1
    cir = replace(cir, segment=_SEGMENTS.get(segment, Segment.UNKNOWN))
    if not blocks:
        return CirReport(cir, clock_offset_ppm=frame.clock_offset_ppm)
    block, lead = blocks[0], abs(blocks[0].offset)
    amplitude = np.hypot(*block.taps.T.astype(np.float64))
    consistent = lead < len(amplitude) and _edge_fits(amplitude, lead)
    start, first_path = 0, float(lead)
    if levels is not None:
        start, first_path = levels.first_path_index - lead, unit.add(levels)
        consistent &= _peak_fits(amplitude, lead + levels.peak_index - levels.first_path_index)
    samples, scale = _samples(block)
    first_path = first_path if consistent else math.nan
    cir = replace(cir, samples=samples, scale=scale, start_index=start, first_path_index=first_path)
    return CirReport(cir, consistent, frame.clock_offset_ppm)


def _edge_fits(amplitude: NDArray[np.float64], lead: int) -> bool:
    """Return whether the amplitude rises at the reported first path, and not before; True without taps before it."""
    before, edge = amplitude[: max(lead - 1, 0)], amplitude[max(lead - 1, 0) : lead + 2]
    if not len(before):
        return True
    noise = float(np.sqrt(np.mean(before**2)))
    return bool(edge.max() >= _EDGE_RATIO * noise and before.max() <= _PEAK_SHARE * amplitude.max())


def _peak_fits(amplitude: NDArray[np.float64], expected: int) -> bool:
    """Return whether the amplitude at the reported peak is large; True if the window does not contain the peak."""
    if not 0 <= expected < len(amplitude):
        return True
    peak = amplitude[max(expected - 1, 0) : expected + 2].max()
    return bool(peak >= _PEAK_SHARE * amplitude.max())


def _samples(block: CirBlock) -> tuple[np.ndarray, float]:
    """Return the taps as int16, and their scale: a power of two, so that the samples keep 15 bits."""
    taps = block.taps.reshape(-1)
    largest = int(np.abs(taps.astype(np.int64)).max())
    shift = max(0, (largest // (_MAX_COUNT + 1)).bit_length())
    return (taps >> shift).astype(np.int16), float(1 << shift)
