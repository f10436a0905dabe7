"""Conversion of channel impulse responses to the network's inputs, as in training and firmware.

Every step is a single correctly rounded IEEE-754 binary32 operation, so that a microcontroller with
a single-precision unit computes the same bits: exact integer power re^2 + im^2, converted to float32,
square root, times `scale`, then the scaling. No I/O here.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.types.measurement import (
    CirFault,
    Encoding,
    RangeColumns,
    RangeMeasurement,
    is_logarithmic,
)

WINDOW_LEAD = 5
"""Samples of the window before floor(first path): enough to include the noise before the path."""

PREAMBLE_DIVISOR = 60
"""Scales `magnitude / preamble_count` of the DW1000 to the order of one before the square root."""

MIN_SCALE, MAX_SCALE = 1e-30, 1e30
"""Accumulator units per count: any int16 magnitude times these is a normal float32."""

SATURATED = np.iinfo(np.int16).max


class Scaling(str, enum.Enum):
    """Scaling of a window of magnitudes to the network's input.

    MAX divides by the window's maximum, the only option for normalised amplitudes.
    PREAMBLE is sqrt(magnitude / (60 preamble_count)), which preserves the received level.
    """

    MAX = "max"
    PREAMBLE = "preamble"


@dataclass(frozen=True, slots=True)
class Preprocessing:
    """Window and scaling of a model.

    Attributes:
        samples: window length K, from 1 to 1016.
        scaling: scaling of the magnitudes.

    Raises:
        ParameterError: the window length is out of its range.
    """

    samples: int = 157
    scaling: Scaling = Scaling.PREAMBLE

    def __post_init__(self) -> None:
        if not 1 <= self.samples <= 1016:
            raise ParameterError(f"window of {self.samples} samples", valid="1 to 1016")

    def apply(self, ranges: RangeColumns) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the network's inputs.

        Returns:
            `CirFault` of each row, uint8 (n,), 0 = usable; and the inputs of the u usable rows, float32 (u, samples).
        """
        is_complex = ranges.encoding == Encoding.COMPLEX_INT16
        width = 2 if is_complex else 1
        size, total = width * self.samples, ranges.samples.shape[1]
        numbers = (ranges.first_path_index, ranges.start_index, ranges.scale, ranges.preamble_count)
        first_paths, start_indices, scales, counts = (column.tolist() for column in numbers)
        least = 0.0 if self.scaling is Scaling.PREAMBLE else -math.inf
        # Loops over Python numbers: for a live range, a batch of one, they are faster than operations on arrays.
        starts = [
            width * int(math.floor(first_path) - WINDOW_LEAD - start_index)
            if MIN_SCALE <= scale <= MAX_SCALE and count > least and -math.inf < first_path < math.inf
            else -1
            for first_path, start_index, scale, count in zip(
                first_paths, start_indices, scales, counts, strict=True
            )
        ]
        windows = [
            samples[start : start + size]
            for samples, start in zip(ranges.samples, starts, strict=True)
            if 0 <= start <= total - size
        ]
        faults = np.zeros(len(starts), np.uint8)
        usable = range(len(starts))
        if len(windows) < len(starts):
            faults[:] = [
                0 if 0 <= start <= total - size else self._fault(total // width, *row)
                for start, *row in zip(starts, first_paths, start_indices, scales, counts, strict=True)
            ]
            usable = np.flatnonzero(faults == 0).tolist()
            if not windows:
                return faults, np.empty((0, self.samples), np.float32)
        stacked = np.array(windows)
        # Squares of the components of complex samples, or magnitudes.
        values = np.multiply(stacked, stacked, dtype=np.int32) if is_complex else stacked
        if not _are_usable(values, total, is_complex):
            faults[usable] = [_content_fault(window, total, is_complex) for window in windows]
            values = values[faults[usable] == 0]
            usable = np.flatnonzero(faults == 0).tolist()
        if len(usable) < len(starts):
            scales, counts = ([column[row] for row in usable] for column in (scales, counts))

        if is_complex:
            inputs = (values[:, 0::2] + values[:, 1::2]).astype(np.float32)
            np.sqrt(inputs, out=inputs)
        else:
            inputs = values.astype(np.float32)
        if scales.count(1.0) < len(scales):
            np.multiply(inputs, np.array(scales, np.float32)[:, None], out=inputs)
        if self.scaling is Scaling.MAX:
            np.divide(inputs, inputs.max(axis=1, keepdims=True), out=inputs)
        else:
            symbols = [PREAMBLE_DIVISOR * count for count in counts]
            np.divide(inputs, np.array(symbols, np.float32)[:, None], out=inputs)
            np.sqrt(inputs, out=inputs)
        return faults, inputs

    def _fault(
        self, samples: int, first_path: float, start_index: float, scale: float, count: float
    ) -> CirFault:
        """Return why a CIR with the number of `samples` in time has no window."""
        if samples == 0:
            return CirFault.EMPTY
        if not MIN_SCALE <= scale <= MAX_SCALE:
            return CirFault.BAD_SCALE
        if not math.isfinite(first_path):
            return CirFault.NO_FIRST_PATH
        if self.scaling is Scaling.PREAMBLE and not count > 0:
            return CirFault.NO_PREAMBLE_COUNT
        return CirFault.TOO_SHORT if 0 <= first_path - start_index < samples else CirFault.OUTSIDE

    def windows_of(self, measurements: Sequence[RangeMeasurement]) -> tuple[list[int], NDArray[np.float32]]:
        """Return `CirFault` of each measurement (0 = usable), and the inputs, float32 (n, samples), zeros if unusable."""
        faults = np.zeros(len(measurements), np.uint8)
        inputs = np.zeros((len(measurements), self.samples), np.float32)
        for indices, ranges in RangeColumns.grouped(measurements):
            group_faults, windows = self.apply(ranges)
            faults[indices] = group_faults
            inputs[np.array(indices)[group_faults == 0]] = windows
        return faults.tolist(), inputs


def _are_usable(values: NDArray[np.int32 | np.int16], total: int, is_complex: bool) -> bool:
    """Return whether no window has a `_content_fault`, from squares of complex components or magnitudes (n, k)."""
    highest = np.maximum.reduce(values, axis=1).tolist()
    if is_complex:
        return total % 2 == 0 and min(highest) > 0 and max(highest) < SATURATED**2
    lowest = int(np.minimum.reduce(values, axis=None))
    in_range = lowest >= 0 and min(highest) > 0 and max(highest) < SATURATED
    return in_range and not is_logarithmic(values).any()


def _content_fault(window: NDArray[np.int16], total: int, is_complex: bool) -> int:
    """Return the `CirFault` of the samples in a window of a CIR with `total` values; 0 = usable."""
    # int16 has no +32768: compare the extremes instead of magnitudes.
    highest, lowest = int(np.maximum.reduce(window)), int(np.minimum.reduce(window))
    if is_complex and total % 2:
        return CirFault.ODD_LENGTH
    if not is_complex and lowest < 0:
        return CirFault.NEGATIVE
    if highest == 0 and lowest == 0:
        return CirFault.ALL_ZERO
    if highest >= SATURATED or lowest <= -SATURATED:
        return CirFault.SATURATED
    return CirFault.DECIBELS if not is_complex and is_logarithmic(window) else 0
