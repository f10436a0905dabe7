"""A direct path before the reported first path, which the radio's detector missed because of its threshold.

The network reads 5 taps before the reported first path and does not learn such paths: windows with 15 or 40 earlier taps
did not reduce the error in simulation. The strongest of the noise taps adapts the threshold to noise that is not white.
The firmware computes the same bits: powers are integers, and the rest is one float32 operation per step.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.types.measurement import SAMPLE_PERIOD_S, Encoding, RangeColumns

SEARCH_TAPS, EDGE_TAPS, NOISE_TAPS = 40, 3, 128
"""The search begins `SEARCH_TAPS` before the reported first path and ends `EDGE_TAPS` before it, where its edge begins. The
taps before the search contain noise."""

MIN_NOISE_RATIO, MAX_NOISE_RATIO, MAX_WINDOW_RATIO = 3, 64, 400
"""The power of an early path is more than 3 times that of the strongest noise tap (4.8 dB), and more than 1/400 of that of
the strongest tap in the window (-26 dB). No detector misses a path of more than 64 times the noise: its threshold is at most
31 standard deviations (NTM of LDE_CFG1, DW1000 user manual). The reported index is then wrong, and the range may be right."""

TAP_M = np.float32(299_792_458.0 * SAMPLE_PERIOD_S)


def early_path_error_m(ranges: RangeColumns, rows: NDArray[np.intp], samples: int) -> NDArray[np.float32]:
    """Return the range errors that missed direct paths cause, m, float32 (len(rows),); NaN without an early path.

    Args:
        ranges: measured ranges.
        rows: rows whose window is inside the CIR. If fewer than `SEARCH_TAPS + NOISE_TAPS` taps precede the first path,
            no early path is detected.
        samples: window length K.
    """
    errors = np.full(len(rows), np.nan, np.float32)
    is_complex = ranges.encoding == Encoding.COMPLEX_INT16
    for index, row in enumerate(rows.tolist()):
        first_path = float(ranges.first_path_index[row])
        # Position of the tap before the reported first path in the CIR.
        first = math.floor(first_path) - int(ranges.start_index[row])
        start = first - SEARCH_TAPS - NOISE_TAPS
        if start < 0:
            continue
        stop = first - WINDOW_LEAD + samples
        values = ranges.samples[row, 2 * start : 2 * stop] if is_complex else ranges.samples[row, start:stop]
        power = np.square(values, dtype=np.int64)
        if is_complex:
            power = power[0::2] + power[1::2]
        noise, search = power[:NOISE_TAPS], power[NOISE_TAPS : NOISE_TAPS + SEARCH_TAPS - EDGE_TAPS + 1]
        window = power[NOISE_TAPS + SEARCH_TAPS - WINDOW_LEAD :]
        threshold = max(MIN_NOISE_RATIO * int(noise.max()), int(window.max()) // MAX_WINDOW_RATIO)
        above = search > threshold
        if above.any():
            edge = _half_amplitude(
                power, NOISE_TAPS + int(above.argmax()), MAX_NOISE_RATIO * int(noise.max())
            )
            if edge is not None:
                low, fraction = edge
                taps = np.float32(NOISE_TAPS + SEARCH_TAPS - low)
                single = np.float32(first_path)
                errors[index] = ((taps + (single - np.floor(single))) - fraction) * TAP_M
    return errors


def _half_amplitude(power: NDArray[np.int64], tap: int, limit: int) -> tuple[int, np.float32] | None:
    """Return where a rising edge reaches half the amplitude of its first maximum: the tap before, and the fraction.

    None if there is no such tap, or if the power of the maximum exceeds `limit`.
    """
    top = tap
    while top + 1 < len(power) and power[top + 1] > power[top]:
        top += 1
    if power[top] > limit:
        return None
    low = top
    while low > 0 and 4 * power[low] > power[top]:
        low -= 1
    if 4 * power[low] > power[top]:
        return None
    half = np.sqrt(np.float32(power[top])) * np.float32(0.5)
    below, above = np.sqrt(np.float32(power[low])), np.sqrt(np.float32(power[low + 1]))
    fraction = (half - below) / (above - below) if above > below else np.float32(0.0)
    return low, fraction
