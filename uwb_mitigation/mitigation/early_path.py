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

SEARCH_TAPS, EDGE_TAPS, NOISE_TAPS = 19, 3, 128
"""The search begins `SEARCH_TAPS` before the reported first path and ends `EDGE_TAPS` before it, where its edge begins. The
taps before the search contain noise. A missed path is at most 20 taps, 6 m, early: of the simulated peaks that are further
away, most are not a path (docs/experiments/early_peaks.py)."""

MIN_NOISE_RATIO, MAX_NOISE_RATIO, MAX_WINDOW_RATIO = 3, 64, 400
"""The power of an early path is more than 3 times that of the strongest noise tap (4.8 dB), and more than 1/400 of that of
the strongest tap in the window (-26 dB). No detector misses a path of more than 64 times the noise: its threshold is at most
31 standard deviations (NTM of LDE_CFG1, DW1000 user manual). The reported index is then wrong, and the range may be right."""

MIN_RANGE_M = np.float32(0.3)
"""A range that an early path would make shorter than this keeps the prediction of the network: the peak is false."""

TAP_M = np.float32(299_792_458.0 * SAMPLE_PERIOD_S)


def find_early_paths(
    ranges: RangeColumns, rows: NDArray[np.generic] | slice, samples: int
) -> dict[int, np.float32]:
    """Return the range errors that missed direct paths cause, {index in `rows`: m}, for the ranges that have one.

    Args:
        ranges: measured ranges.
        rows: index of the rows whose window is inside the CIR. If fewer than `SEARCH_TAPS + NOISE_TAPS` taps precede the
            first path, no early path is detected.
        samples: window length K.
    """
    lead = NOISE_TAPS + SEARCH_TAPS
    width = 2 if ranges.encoding == Encoding.COMPLEX_INT16 else 1
    size = width * (lead - EDGE_TAPS + 1)
    first_paths, cirs = ranges.first_path_index[rows].tolist(), ranges.samples[rows]
    # As in the preprocessing: for a batch of one, loops are faster than operations on arrays.
    starts = [
        width * (int(math.floor(first_path) - start_index) - lead)
        for first_path, start_index in zip(first_paths, ranges.start_index[rows].tolist(), strict=True)
    ]
    errors: dict[int, np.float32] = {}
    indices = [index for index, start in enumerate(starts) if start >= 0]
    if not indices:
        return errors
    # The magnitude of -32768 needs an unsigned integer.
    components = np.abs(np.array([cirs[i, starts[i] : starts[i] + size] for i in indices])).view(np.uint16)
    strongest = np.maximum.reduceat(components, (0, width * NOISE_TAPS), axis=1).tolist()
    # The power of a tap is at most `width` times the square of its larger component.
    candidates = [
        index
        for index, (noise, search) in zip(indices, strongest, strict=True)
        if width * search * search > MIN_NOISE_RATIO * noise * noise
    ]
    for index in candidates:
        stop = starts[index] + width * (lead - WINDOW_LEAD + samples)
        power = np.square(cirs[index, starts[index] : stop], dtype=np.int64)
        error_m = _error_m(power[0::2] + power[1::2] if width == 2 else power, first_paths[index])
        if error_m is not None:
            errors[index] = error_m
    return errors


def early_path_error_m(ranges: RangeColumns, rows: NDArray[np.intp], samples: int) -> NDArray[np.float32]:
    """Return the errors of `find_early_paths` as an array, m, float32 (len(rows),); NaN without an early path."""
    errors = np.full(len(rows), np.nan, np.float32)
    early = find_early_paths(ranges, rows, samples)
    errors[list(early)] = list(early.values())
    return errors


def _error_m(power: NDArray[np.int64], first_path: float) -> np.float32 | None:
    """Return the error of a range that a missed direct path causes, m; None without one.

    Args:
        power: power of the taps from `SEARCH_TAPS + NOISE_TAPS` before the reported first path to the end of the window.
        first_path: index of the reported first path.
    """
    lead = NOISE_TAPS + SEARCH_TAPS
    search, window = power[NOISE_TAPS : lead - EDGE_TAPS + 1], power[lead - WINDOW_LEAD :]
    noise = int(power[:NOISE_TAPS].max())
    above = search > max(MIN_NOISE_RATIO * noise, int(window.max()) // MAX_WINDOW_RATIO)
    if not above.any():
        return None
    edge = _half_amplitude(power, NOISE_TAPS + int(above.argmax()), MAX_NOISE_RATIO * noise)
    if edge is None:
        return None
    low, fraction = edge
    taps = np.float32(lead - low)
    single = np.float32(first_path)
    error_m: np.float32 = ((taps + (single - np.floor(single))) - fraction) * TAP_M
    return error_m


def _half_amplitude(power: NDArray[np.int64], tap: int, limit: int) -> tuple[int, np.float32] | None:
    """Return where a rising edge reaches half the amplitude of its first maximum: the tap before, and the fraction.

    None if the edge begins before the search, or if the power of the maximum exceeds `limit`.
    """
    top = tap
    while top + 1 < len(power) and power[top + 1] > power[top]:
        top += 1
    if power[top] > limit:
        return None
    low = top
    while low > NOISE_TAPS and 4 * power[low] > power[top]:
        low -= 1
    if 4 * power[low] > power[top]:
        return None
    half = np.sqrt(np.float32(power[top])) * np.float32(0.5)
    below, above = np.sqrt(np.float32(power[low])), np.sqrt(np.float32(power[low + 1]))
    fraction = (half - below) / (above - below) if above > below else np.float32(0.0)
    return low, fraction
