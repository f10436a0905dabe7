"""OOD score of a measurement relative to the training data, cheap enough for a microcontroller.

Six features, each with a band of values that are in distribution: the range, the receive power normalised to 1 m by
free-space propagation (Friis, "A note on a simple transmission formula", Proc. IRE 1946), its excess over the
first-path power, two levels of the CIR minus the powers that the radio reports for the same signal, and the energy
before the first path relative to the whole window. A model for CIRs without levels has bands for the first and the last.
The power at 1 m distinguishes a weaker or stronger radio from walls in the training data; the received power does not.
The radio computes both powers from the accumulator, so the two level differences hardly vary (DW1000 user manual,
section 4.7) unless the CIR is noise, clipped, or cut at the wrong position. The energy before the first path needs no
level: if it is a large part of the energy of the window, the window is noise or starts too late.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.preprocessing import Scaling

FIRST_PATH_TAPS = slice(6, 9)
"""The three taps of a window from which the first-path power is computed."""

LEAD_TAPS = 3
"""Number of taps before the rising edge of the first path if the window is cut correctly."""

MIN_POWER, MAX_POWER = float(np.float32(1e-30)), float(np.float32(1e30))
"""Bounds of powers before conversion to levels, so that levels are finite."""

Values = NDArray[np.float32] | float

_DB_PER_OCTAVE = float(np.float32(10 * math.log10(2)))
_SQUARE, _LINEAR, _CONSTANT = float(np.float32(-4 / 3)), 4.0, float(np.float32(8 / 3))


def check_float32(name: str, value: float) -> None:
    """Raise ModelError unless a value is finite and exact in float32, in which host and firmware compute."""
    if not math.isfinite(value) or float(np.float32(value)) != value:
        raise ModelError(f"{name} = {value!r}", valid="a finite float32 value")


# The model should also work at larger distances, and the error itself increases the range. A signal that is weaker
# or stronger than distance and the walls of the training data explain, or a first path that is stronger than in LOS,
# comes from another radio.
_WIDENINGS = ((1.0, 2.0, 1.0), (0.0, 0.0, 3.0), (0.0, 1.0, 3.0), (1.0, 1.0, 1.5), (1.0, 1.0, 1.5))
"""The last three arguments of `Band.of`, for each feature except for the lead level."""


@dataclass(frozen=True, slots=True)
class Band:
    """Values from `low` to `high` are in distribution; at `margin` beyond, the OOD score is 1."""

    low: float
    high: float
    margin: float

    def __post_init__(self) -> None:
        for value in astuple(self):
            check_float32("value of a band", value)
        if self.low > self.high or self.margin <= 0 or not math.isfinite(np.float32(1) / self.margin):
            raise ModelError(f"band {astuple(self)}", valid="low <= high, and a positive margin")

    @classmethod
    def of(cls, values: NDArray[np.floating], below: float, above: float, min_half_width: float) -> Band:
        """Return the band of finite values (n,), extended below and above by multiples of half its width, which is its margin."""
        low, high = float(values.min()), float(values.max())
        half_width = max((high - low) / 2, min_half_width)
        bounds = (low - below * half_width, high + above * half_width, half_width)
        return cls(*(float(np.float32(value)) for value in bounds))


LEAD, LEAD_WITHOUT_LEVELS = Band(-1000.0, -16.0, 4.0), Band(-1000.0, -20.0, 4.0)
"""Minimum bands of `lead_level_db`. They do not follow the training data downwards, because a detector reports the
first energy above its noise threshold: in the simulated buildings 99 % of the values are below -24 dB. 75 % of the
windows that start 5 taps too late are above -10 dB. Without levels no other feature detects them, so the band ends
earlier."""


@dataclass(frozen=True, slots=True)
class OodBands:
    """Bands of the training data, and the value to which the correction shrinks outside of them.

    Attributes:
        known_offset_m: the median error over the configurations of the training data.
        range_m: measured range.
        power_at_1m_dbm: receive power + 20 log10 of the measured range.
        power_gap_db: receive power minus first-path power.
        cir_level_db: energy of the window minus receive power.
        first_path_level_db: energy at the first path minus first-path power.
        lead_level_db: energy before the first path relative to the energy of the window.

    A feature without a band (None) is not checked.
    """

    known_offset_m: float
    range_m: Band | None
    power_at_1m_dbm: Band | None = None
    power_gap_db: Band | None = None
    cir_level_db: Band | None = None
    first_path_level_db: Band | None = None
    lead_level_db: Band | None = None

    def __post_init__(self) -> None:
        check_float32("known_offset_m", self.known_offset_m)

    @property
    def bands(self) -> tuple[Band | None, ...]:
        """Bands in the order of `ood_features`."""
        return tuple(getattr(self, field.name) for field in fields(self)[1:])

    @property
    def needs_levels(self) -> bool:
        """Whether a band is for a feature that needs receive levels."""
        return any(band is not None for band in self.bands[1:-1])

    @classmethod
    def of(cls, known_offset_m: float, values: NDArray[np.float32]) -> OodBands:
        """Compute the bands of training data with these `ood_features`.

        A feature without finite values has no band; rows in which another feature is not finite are ignored.

        Raises:
            ModelError: no row is complete.
        """
        finite: NDArray[np.bool_] = np.isfinite(values)
        has_values: NDArray[np.bool_] = np.any(finite, axis=0)
        rows: NDArray[np.bool_] = np.all(finite[:, has_values], axis=1)
        if not has_values.any() or not rows.any():
            raise ModelError("no measurement has all features of the OOD score")
        bands = (
            Band.of(column, *widening) if is_known else None
            for column, is_known, widening in zip(
                values[rows].T[:-1], has_values[:-1], _WIDENINGS, strict=True
            )
        )
        lead = LEAD if has_values[1:-1].any() else LEAD_WITHOUT_LEVELS
        # The training data is in distribution, regardless of the meaning of its first-path index.
        highest = max(lead.high, float(np.float32(np.percentile(values[rows, -1], 99))))
        lead = replace(lead, high=highest)
        return cls(float(np.float32(known_offset_m)), *(*bands, lead))


def ood_features(
    windows: NDArray[np.float32], scaling: Scaling, *reported: NDArray[np.floating]
) -> tuple[Values, ...]:
    """Return the six features of n measurements, each float32 (n,).

    Args:
        windows: inputs of the network, (n, K). Energy is their square; with the scaling PREAMBLE, which takes a
            square root, it is their fourth power.
        scaling: of the windows.
        reported: range (m), receive power and first-path power (dBm), each (n,); converted to float32. If one is
            not finite or exceeds float32, the features that depend on it are not finite.

    Every step is one float32 operation, and sums run from the first tap to the last.
    """
    taps = _energy(windows, scaling).T
    total = np.add.accumulate(taps)
    first_path = np.add.accumulate(taps[FIRST_PATH_TAPS])[-1]
    return _features(np.array(reported, np.float32), total[-1], first_path, total[LEAD_TAPS - 1])


def approximate_features(
    window: NDArray[np.float32], scaling: Scaling, *reported: float
) -> tuple[Values, ...]:
    """Return the features of one measurement up to rounding, as Python numbers, in half the time of `ood_features`."""
    energy = _energy(window, scaling)
    taps = energy[: FIRST_PATH_TAPS.stop].tolist()
    total, first_path, lead = float(np.add.reduce(energy)), sum(taps[FIRST_PATH_TAPS]), sum(taps[:LEAD_TAPS])
    return _features(reported, total, first_path, lead)


def _energy(windows: NDArray[np.float32], scaling: Scaling) -> NDArray[np.float32]:
    energy: NDArray[np.float32] = windows * windows
    if scaling is Scaling.PREAMBLE:
        np.multiply(energy, energy, out=energy)
    return energy


def _features(
    reported: Iterable[Values], total: Values, first_path: Values, lead: Values
) -> tuple[Values, ...]:
    """Return the features from the reported values (see `ood_features`) and energies."""
    range_m, rx_power, first_path_power = reported
    level = _level_db(total)
    return (
        range_m,
        rx_power + _level_db(range_m * range_m),
        rx_power - first_path_power,
        level - rx_power,
        _level_db(first_path) - first_path_power,
        _level_db(lead) - level,
    )


class OodDetector:
    """Computes OOD scores of features with the bands of an `OodBands`."""

    def __init__(self, bands: Iterable[Band | None]) -> None:
        # Python numbers with the values of float32: in operations with arrays, they do not change the type.
        self._bands = [
            None if band is None else (band.low, band.high, float(np.float32(1) / np.float32(band.margin)))
            for band in bands
        ]

    def score(self, features: Iterable[Values]) -> Values:
        """Return the largest excess over a band, in margins, of `ood_features`: float32 (n,), or a number.

        0 or less: in distribution; 1 or more, or NaN: out of distribution.
        """
        score: Values = -math.inf
        for value, band in zip(features, self._bands, strict=True):
            if band is not None:
                low, high, per_unit = band
                score = _maximum(score, _maximum(low - value, value - high) * per_unit)
        return score


def _maximum(a: Values, b: Values) -> Values:
    """Return the larger value, or NaN if one is NaN."""
    if isinstance(b, np.ndarray):
        return np.maximum(a, b)
    return a if a >= b or a != a else b


def _level_db(power: Values) -> Values:
    """Return 10 log10 of a power within 0.03 dB: exact exponent, parabola for the logarithm of the mantissa."""
    if isinstance(power, np.ndarray):
        mantissas: Any
        mantissas, exponents = np.frexp(np.minimum(np.maximum(power, MIN_POWER), MAX_POWER))
        octaves = (_SQUARE * mantissas + _LINEAR) * mantissas - _CONSTANT
        return np.asarray((exponents.astype(np.float32) + octaves) * _DB_PER_OCTAVE, np.float32)
    mantissa, exponent = math.frexp(min(max(power, MIN_POWER), MAX_POWER))
    return (exponent + (_SQUARE * mantissa + _LINEAR) * mantissa - _CONSTANT) * _DB_PER_OCTAVE
