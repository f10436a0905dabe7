"""From a channel impulse response to the network's input: the one definition that training, host and
firmware share.

Every step is a single correctly rounded IEEE-754 binary32 operation, so that a microcontroller with
a single-precision unit gets the same bits: exact integer power re^2 + im^2, converted to float32,
square root, times `scale`, then the scaling. No I/O here.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.measurement import Cir, Encoding, RangeColumns, Status

WINDOW_LEAD = 5
"""Samples of the window before floor(first path): enough to see the noise the path rises from."""


PREAMBLE_DIVISOR = 60
"""Brings `magnitude / preamble_count` of the DW1000 to order one before the square root."""

MIN_SCALE, MAX_SCALE = 1e-30, 1e30
"""Accumulator units per count: any int16 magnitude times these is a normal float32."""

SATURATED = np.iinfo(np.int16).max


class Scaling(str, enum.Enum):
    """How a window of magnitudes becomes the network's input.

    MAX divides by the window's maximum, which is all that normalised amplitudes allow.
    PREAMBLE is sqrt(magnitude / (60 preamble_count)): it keeps the received level.
    """

    MAX = "max"
    PREAMBLE = "preamble"


class CirFault(str, enum.Enum):
    """Why a channel impulse response cannot be corrected from."""

    EMPTY = "the CIR holds no samples"
    ODD_LENGTH = "a complex CIR holds an odd number of values"
    BAD_SCALE = "the CIR's scale is no positive number that float32 can multiply with"
    NO_FIRST_PATH = "the first-path index is not finite"
    OUTSIDE = "the window around the first path lies outside the CIR"
    ALL_ZERO = "the window holds only zeros"
    NEGATIVE = "a magnitude is negative"
    SATURATED = "the window holds a saturated sample"
    NO_PREAMBLE_COUNT = "the preamble count is unknown, and the model's scaling needs it"
    NO_POWER = "the receive or first-path power is unknown, and the model's prior needs it"

    @property
    def status(self) -> Status:
        """The status that a corrected range carries for this fault."""
        return Status.NO_CIR if self is CirFault.EMPTY else Status.BAD_CIR


@dataclass(frozen=True, slots=True)
class Preprocessing:
    """The window and the scaling that one model was trained with.

    Attributes:
        samples: window length K, from 1 to 1016.
        scaling: how magnitudes are scaled.

    Raises:
        ParameterError: the window length is out of its range.
    """

    samples: int = 157
    scaling: Scaling = Scaling.PREAMBLE

    def __post_init__(self) -> None:
        if not 1 <= self.samples <= 1016:
            raise ParameterError(f"window of {self.samples} samples", valid="1 to 1016")

    def apply(self, cir: Cir, out: NDArray[np.float32]) -> CirFault | None:
        """Write the network's input for `cir` to `out`, float32 of shape (samples,).

        Returns None, or what makes the CIR unusable; `out` is then undefined.
        """
        total = len(cir.samples)
        if total == 0:
            return CirFault.EMPTY
        if not MIN_SCALE <= cir.scale <= MAX_SCALE:
            return CirFault.BAD_SCALE
        if not math.isfinite(cir.first_path_index):
            return CirFault.NO_FIRST_PATH
        if self.scaling is Scaling.PREAMBLE and cir.preamble_count <= 0:
            return CirFault.NO_PREAMBLE_COUNT
        start = math.floor(cir.first_path_index) - WINDOW_LEAD - cir.start_index
        stop = start + self.samples
        if start < 0 or stop > len(cir):
            return CirFault.OUTSIDE

        # One reduction finds both an all-zero and a saturated window, before anything can overflow.
        if cir.encoding == Encoding.COMPLEX_INT16:
            if total % 2:
                return CirFault.ODD_LENGTH
            power = cir.samples[2 * start : 2 * stop].astype(np.int32)
            np.multiply(power, power, out=power)
            peak = math.isqrt(int(np.maximum.reduce(power)))
            if 0 < peak < SATURATED:
                out[:] = power[0::2] + power[1::2]
                np.sqrt(out, out=out)
        else:
            window = cir.samples[start:stop]
            if int(np.minimum.reduce(window)) < 0:
                return CirFault.NEGATIVE
            peak = int(np.maximum.reduce(window))
            out[:] = window
        if peak == 0:
            return CirFault.ALL_ZERO
        if peak >= SATURATED:
            return CirFault.SATURATED

        if cir.scale != 1.0:
            np.multiply(out, np.float32(cir.scale), out=out)
        if self.scaling is Scaling.MAX:
            np.divide(out, np.maximum.reduce(out), out=out)
        else:
            np.divide(out, np.float32(PREAMBLE_DIVISOR * cir.preamble_count), out=out)
            np.sqrt(out, out=out)
        return None

    def apply_batch(self, ranges: RangeColumns) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """The inputs of many CIRs at once, to the bit those of `apply`.

        Returns which rows are usable, ascending, shape (u,), and their inputs, float32 (u, samples). A row
        is left out exactly where `apply` names a fault; ask `apply` for the fault.
        """
        complex_ = ranges.encoding == Encoding.COMPLEX_INT16
        width = 2 if complex_ else 1
        length, odd = divmod(ranges.samples.shape[1], width)
        # In float64 every index, and every difference that decides, is exact.
        first_path = ranges.first_path_index.astype(np.float64)
        start = np.floor(first_path) - WINDOW_LEAD - ranges.start_index
        scale = ranges.scale.astype(np.float64)
        usable = (start >= 0) & (start + self.samples <= length) & (scale >= MIN_SCALE) & (scale <= MAX_SCALE)
        if self.scaling is Scaling.PREAMBLE:
            usable &= ranges.preamble_count > 0
        rows = np.flatnonzero(usable)
        if odd or not len(rows):
            return np.empty(0, np.intp), np.empty((0, self.samples), np.float32)

        every_start = np.lib.stride_tricks.sliding_window_view(ranges.samples, width * self.samples, axis=1)
        windows = every_start[rows, width * start[rows].astype(np.intp)]
        # -32768 has no negative of its own in int16: the extremes are compared, not magnitudes.
        highest, lowest = windows.max(axis=1), windows.min(axis=1)
        sound = (highest < SATURATED) & ((highest > 0) | (lowest < 0))
        sound &= (lowest > -SATURATED) if complex_ else (lowest >= 0)
        if not sound.all():
            rows, windows = rows[sound], windows[sound]
        if complex_:
            power = windows.astype(np.int32)
            np.multiply(power, power, out=power)
            inputs = (power[:, 0::2] + power[:, 1::2]).astype(np.float32)
            np.sqrt(inputs, out=inputs)
        else:
            inputs = windows.astype(np.float32)

        np.multiply(inputs, ranges.scale[rows, None].astype(np.float32, copy=False), out=inputs)
        if self.scaling is Scaling.MAX:
            np.divide(inputs, inputs.max(axis=1, keepdims=True), out=inputs)
        else:
            symbols = PREAMBLE_DIVISOR * ranges.preamble_count[rows].astype(np.int64)
            np.divide(inputs, symbols.astype(np.float32)[:, None], out=inputs)
            np.sqrt(inputs, out=inputs)
        return rows, inputs
