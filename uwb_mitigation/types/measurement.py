"""Measurements of UWB ranging exchanges, and corrected ranges: plain immutable values.

Sign convention, everywhere: error = measured - true; corrected = measured - predicted error.
Units are SI (REP-103) unless a name says otherwise. No I/O and no ROS here.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.types.columns import Columns

DEVICE_TICK_HZ = 128 * 499.2e6
"""Rate of the DW1000's timestamp counter (DW1000 user manual, section 2.5.8: 1 / 15.65 ps)."""

DEVICE_TIME_WRAP = 1 << 40
"""The DW1000's timestamp counter has 40 bits: it wraps every 17.2 s."""

SAMPLE_PERIOD_S = 1.0 / (2 * 499.2e6)
"""Spacing of accumulator samples: half a chip, 1.0016 ns (DW1000 user manual, section 7.2.38)."""

LINE_OF_SIGHT_DB = 6.0
"""If the first path is less than this below the receive level, the link is probably LOS; at 10 dB it is NLOS (Decawave
APS006, part 3)."""


class Encoding(enum.IntEnum):
    """Encoding of the channel impulse response in `Cir.samples`; the values of `Cir.msg`."""

    COMPLEX_INT16 = 0
    MAGNITUDE = 1


class RadioType(enum.IntEnum):
    """Type of the radio that measured a CIR; the values of `Cir.msg`."""

    UNKNOWN = 0
    DW1000 = 1
    DW3000 = 2
    QM35 = 3


class Segment(enum.IntEnum):
    """Part of the frame on which a CIR was measured; the values of `Cir.msg`."""

    UNKNOWN = 0
    IPATOV = 1
    STS = 2


class Status(enum.IntEnum):
    """Status of a corrected range; the values of `RangeCorrected.msg`.

    UNRELIABLE: corrected, but the standard deviation exceeds half a metre; the direct path was probably lost. With NO_CIR,
    BAD_CIR, OUT_OF_DISTRIBUTION and MODEL_ERROR, the raw range minus the offset of its radios is passed through.
    """

    OK = 0
    NO_CIR = 1
    BAD_CIR = 2
    OUT_OF_DISTRIBUTION = 3
    MODEL_ERROR = 4
    UNRELIABLE = 5

    @property
    def is_corrected(self) -> bool:
        """Whether a model corrected the range."""
        return self in (Status.OK, Status.UNRELIABLE)

    @property
    def is_fault(self) -> bool:
        """Whether the status needs attention; a radio without CIRs does not."""
        return self not in (Status.OK, Status.NO_CIR)


CORRECTED = tuple(status for status in Status if status.is_corrected)
"""Statuses of ranges that a model corrected."""

FAULTS = tuple(status for status in Status if status.is_fault)
"""Statuses that need attention."""

LINEAR_MAGNITUDES = "linear magnitudes: 10 ** (level / 20)"


class CirFault(enum.IntEnum):
    """Reason why a channel impulse response is unusable; up to NO_POWER the values of `uwb_status` in the firmware.

    The firmware does not distinguish TOO_SHORT from OUTSIDE, and gets no magnitudes in dB from its radio.
    """

    EMPTY = 3, "the CIR has no samples"
    ODD_LENGTH = 4, "a complex CIR has an odd number of values"
    BAD_SCALE = 5, "a sample or the scale of the CIR is NaN, infinite, or outside of float32"
    NO_FIRST_PATH = 6, "the first-path index is not finite"
    OUTSIDE = 7, "the first-path index is outside the CIR"
    ALL_ZERO = 8, "the window contains only zeros"
    NEGATIVE = 9, "a magnitude is negative"
    SATURATED = 10, "the window contains a saturated sample"
    NO_PREAMBLE_COUNT = 11, "the preamble count is unknown, and the model's scaling needs it"
    NO_POWER = 12, "the receive or first-path power is unknown, and the model needs it"
    TOO_SHORT = (
        13,
        "the CIR is too short before or after the first path: the window around it is partly outside",
    )
    DECIBELS = 14, f"the CIR is in dB; valid: {LINEAR_MAGNITUDES}"

    text: str

    def __new__(cls, value: int, text: str = "") -> CirFault:
        """Return a member with its reason as text."""
        member = int.__new__(cls, value)
        member._value_, member.text = value, text
        return member


MAX_REACH_M = 1000.0
"""A radio reaches a few hundred metres: larger numbers are probably millimetres."""


def reason(status: int, fault: int, range_m: float, offset_m: float = 0.0) -> str:
    """Return why a measured range was not corrected; empty: it was.

    Args:
        status: its `Status`.
        fault: its `CirFault`; 0: none.
        range_m: the measured range.
        offset_m: the offset that was subtracted.
    """
    if status in (Status.OK, Status.UNRELIABLE):
        return ""
    if range_m > MAX_REACH_M:
        return f"range of {range_m:,.2f} m, beyond {MAX_REACH_M:,.0f} m: divide millimetres by 1000"
    if not range_m >= 0.0:
        return f"range of {range_m:.2f} m; valid: 0 or more"
    if range_m < offset_m - 1e-6:
        return f"range of {range_m:.2f} m, below the offset of {offset_m:.2f} m"
    return CirFault(fault).text if fault else _STATUS_TEXTS[Status(status)]


_STATUS_TEXTS = {
    Status.NO_CIR: CirFault.EMPTY.text,
    Status.BAD_CIR: CirFault.NO_POWER.text,  # not a fault of the samples
    Status.OUT_OF_DISTRIBUTION: "unlike the training data of the model",
    Status.MODEL_ERROR: "the network failed",
}


class CorrectedBy(enum.IntEnum):
    """Device that computed a correction; the values of the `source` field of `RangeCorrected.msg`."""

    HOST = 0
    DEVICE = 1


_INT16 = np.dtype(np.int16)


def int16_samples(values: NDArray[Any]) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """Return real or complex samples (n, m) as those of `Cir`, int16 (n, m or 2 m), and their scales (n,).

    Integers of 16 bits remain unchanged; other values are rounded to 1/30,000 of the largest component of their row, which is
    below that of a saturated sample. The scale of a row that is not finite is NaN.
    """
    kind = np.complex128 if np.iscomplexobj(values) else np.float64
    numbers = np.ascontiguousarray(values, kind).view(np.float64)
    largest = np.maximum(numbers.max(axis=1, initial=0.0), -numbers.min(axis=1, initial=0.0))
    is_finite = np.isfinite(largest)
    rounded = np.rint(numbers)
    is_int16 = (largest <= np.iinfo(np.int16).max) & (numbers == rounded).all(axis=1)
    scale = np.where(is_int16 | ~is_finite, 1.0, largest / 30_000.0)
    if not is_int16.all():
        np.rint(np.divide(numbers, scale[:, None], out=rounded), out=rounded)
    rounded[~is_finite], scale[~is_finite] = 0.0, np.nan
    return rounded.astype(np.int16), scale


@dataclass(frozen=True, slots=True, eq=False)
class Cir:
    """A channel impulse response from the radio's accumulator.

    Attributes:
        samples: int16. COMPLEX_INT16: shape (2 n,), interleaved real, imaginary. MAGNITUDE: (n,). A complex array (n,), or other
            magnitudes, are converted with `int16_samples`.
        encoding: encoding of `samples`.
        start_index: accumulator index of the first sample.
        first_path_index: accumulator index of the first path, sub-sample; NaN = unknown.
        sample_period_s: spacing of the samples.
        scale: accumulator units per count of `samples`.
        preamble_count: accumulated preamble symbols (RXPACC); 0 = unknown.
        noise_threshold: the leading-edge detector's threshold (LDE_THRESH), accumulator units.
        rx_power_dbm: receive signal level; NaN = unknown.
        first_path_power_dbm: first-path signal level; NaN = unknown.
        channel: UWB channel number; 0 = unknown.
        prf_mhz: pulse repetition frequency, 16 or 64; 0 = unknown.
        radio: type of the radio; UNKNOWN if other software measured it, and in recordings of earlier versions: models assume the DW1000.
        segment: part of the frame; UNKNOWN as for `radio`.

    Raises:
        ParameterError: the samples are neither complex numbers, nor magnitudes, nor integers, in one dimension.
    """

    samples: NDArray[np.int16]
    encoding: Encoding = Encoding.COMPLEX_INT16
    start_index: int = 0
    first_path_index: float = math.nan
    sample_period_s: float = SAMPLE_PERIOD_S
    scale: float = 1.0
    preamble_count: int = 0
    noise_threshold: int = 0
    rx_power_dbm: float = math.nan
    first_path_power_dbm: float = math.nan
    channel: int = 0
    prf_mhz: int = 0
    radio: RadioType = RadioType.UNKNOWN
    segment: Segment = Segment.UNKNOWN

    def __post_init__(self) -> None:
        # The type of arrays from messages and radios, of which each range has one.
        if getattr(self.samples, "dtype", None) != _INT16:
            self._convert()

    def _convert(self) -> None:
        values: NDArray[Any] = np.asarray(self.samples)
        is_complex, is_magnitude = np.iscomplexobj(values), self.encoding == Encoding.MAGNITUDE
        if values.ndim != 1 or not (
            is_complex or not values.size or values.dtype.kind in ("iuf" if is_magnitude else "iu")
        ):
            valid = "complex `i + 1j * q`, int16 pairs, or magnitudes with encoding=Encoding.MAGNITUDE; one dimension"
            raise ParameterError(f"samples of type {values.dtype}, shape {values.shape}", valid=valid)
        (samples,), (scale,) = int16_samples(values[None])
        object.__setattr__(self, "samples", samples)
        object.__setattr__(self, "scale", self.scale * float(scale))
        if is_complex:
            object.__setattr__(self, "encoding", Encoding.COMPLEX_INT16)

    def __len__(self) -> int:
        """The number of samples in time (a complex sample counts once)."""
        return len(self.samples) // (2 if self.encoding == Encoding.COMPLEX_INT16 else 1)

    @property
    def power_gap_db(self) -> float:
        """Receive level minus first-path level; NaN = unknown."""
        return self.rx_power_dbm - self.first_path_power_dbm


@dataclass(frozen=True, slots=True, eq=False)
class RangeMeasurement:
    """One ranging exchange between an anchor and a tag.

    Attributes:
        stamp_ns: reception time of the exchange, ns since the epoch of the source's clock.
        tag_id, anchor_id: 64-bit ids.
        sequence: 32-bit counter of the exchanges of a source.
        device_time: 40-bit DW1000 ticks (`DEVICE_TICK_HZ`), as received.
        range_m: the measured range; NaN = invalid.
        cir: the channel impulse response of the range; may have no samples.
        frame_id: coordinate frame of the receiving antenna; empty = the consumer's default.
    """

    stamp_ns: int
    tag_id: int
    anchor_id: int
    sequence: int
    device_time: int
    range_m: float
    cir: Cir
    frame_id: str = ""


@dataclass(frozen=True, slots=True)
class Truth:
    """Ground truth of a measurement in a surveyed recording.

    Attributes:
        range_m: true distance.
        label: propagation condition, such as `LOS`, `NLOS` or `NDP NLOS`; may be empty.
        configuration: name of the placement of both antennas. Measurements of one configuration
            are not independent: a train/held-out split never divides it.
    """

    range_m: float
    label: str = ""
    configuration: str = ""


@dataclass(frozen=True, slots=True)
class Record:
    """One measurement with its ground truth, if known.

    Attributes:
        measurement: the measurement.
        truth: ground truth of the range; None = unknown.
        tag_position: true position of the tag's antenna at the measurement's stamp, x, y, z in m in the
            anchors' frame; None = unknown.
        tag_yaw: true heading of the robot with the tag, rad; None = unknown.
    """

    measurement: RangeMeasurement
    truth: Truth | None = None
    tag_position: tuple[float, float, float] | None = None
    tag_yaw: float | None = None


@dataclass(frozen=True, slots=True)
class CorrectedRange:
    """A range after mitigation: `range_m = range_raw_m - correction_m`.

    Attributes:
        range_m: corrected range.
        range_raw_m: measured range, including the offset of its radios.
        correction_m: offset of the two radios + predicted error; only the offset if the range is passed through.
        variance_m2: variance of `range_m`; infinite if the range is invalid.
        status: status of the correction.
        origin: source of the correction.
        model_id: id of the model; 0 = none.
        reason: why the range was not corrected; empty: it was, or a board sent the result.
    """

    range_m: float
    range_raw_m: float
    correction_m: float
    variance_m2: float
    status: Status
    origin: CorrectedBy
    model_id: int
    reason: str = field(default="", compare=False)


_CIR_NUMBERS = attrgetter(
    "start_index", "first_path_index", "scale", "preamble_count", "rx_power_dbm", "first_path_power_dbm"
)
"""Returns the columns of a CIR in `RangeColumns`, in their order."""


# Not frozen, because this takes 1 % of the time of a correction.
@dataclass(slots=True, eq=False)
class RangeColumns(Columns):
    """Columns of n exchanges whose CIRs have the same encoding, length, radio, segment and channel: inputs of the correction.

    Attributes:
        tag_id, anchor_id: uint64 (n,).
        range_m: float (n,), as in `RangeMeasurement`: float32 from messages, or float64.
        encoding: encoding of all CIRs; the fields below are those of `Cir`.
        samples: int16 (n, m).
        start_index, preamble_count: integer or float64 (n,).
        first_path_index, scale, rx_power_dbm, first_path_power_dbm: float (n,), of the type of `range_m`.
        radio, segment, channel: those of all CIRs.
    """

    tag_id: NDArray[np.uint64]
    anchor_id: NDArray[np.uint64]
    range_m: NDArray[Any]
    encoding: Encoding
    samples: NDArray[np.int16]
    start_index: NDArray[Any]
    first_path_index: NDArray[Any]
    scale: NDArray[Any]
    preamble_count: NDArray[Any]
    rx_power_dbm: NDArray[Any]
    first_path_power_dbm: NDArray[Any]
    radio: RadioType = RadioType.UNKNOWN
    segment: Segment = Segment.UNKNOWN
    channel: int = 0

    @staticmethod
    def grouped(measurements: Sequence[RangeMeasurement]) -> Iterator[tuple[list[int], RangeColumns]]:
        """Yield columns of measurements whose CIRs have the same form and source, with their indices."""
        groups: dict[tuple[int, ...], list[int]] = {}
        for index, measurement in enumerate(measurements):
            cir = measurement.cir
            form = (cir.encoding, len(cir.samples), cir.radio, cir.segment, cir.channel)
            groups.setdefault(form, []).append(index)
        for indices in groups.values():
            members = [measurements[index] for index in indices]
            cirs = [measurement.cir for measurement in members]
            tag_id = np.array([m.tag_id for m in members], np.uint64)
            anchor_id = np.array([m.anchor_id for m in members], np.uint64)
            numbers = [(m.range_m, *_CIR_NUMBERS(m.cir)) for m in members]
            range_m, *others = np.array(numbers, np.float64).T
            samples = np.array([cir.samples for cir in cirs]) if len(cirs) > 1 else cirs[0].samples[None]
            columns = RangeColumns(tag_id, anchor_id, range_m, cirs[0].encoding, samples, *others)
            columns.radio, columns.segment = cirs[0].radio, cirs[0].segment
            columns.channel = cirs[0].channel
            yield indices, columns

    def __len__(self) -> int:
        """The number of exchanges."""
        return len(self.range_m)


_MIN_SAMPLES, _MIN_MEAN, _MIN_LOW = 32, 0.3, 0.62


def is_logarithmic(magnitudes: NDArray[Any]) -> NDArray[np.bool_]:
    """Return whether the magnitudes (..., m) of CIRs are probably in dB, also as 20 log10(magnitude + 1): bool (...).

    The logarithm reduces differences: the mean of linear magnitudes is at most 0.24 times the maximum in the real logs and
    in simulation, in dB at least 0.45. Noise alone has a large mean, too, but its tenth percentile is 0.39 times its
    median (Rayleigh distribution), at most 0.56 in windows of 157 samples; in dB at least 0.65.
    """
    if magnitudes.shape[-1] < _MIN_SAMPLES:
        return np.zeros(magnitudes.shape[:-1], np.bool_)
    values = np.nan_to_num(magnitudes.astype(np.float64), posinf=0.0, neginf=0.0)
    highest = values.max(axis=-1)
    is_flat = (values.mean(axis=-1) > _MIN_MEAN * highest) & (values.min(axis=-1) < highest)
    if is_flat.any():
        low, middle = np.quantile(values, (0.1, 0.5), axis=-1)
        is_flat &= low > _MIN_LOW * middle
    return np.asarray(is_flat)


# Not frozen, because this takes 1 % of the time of a correction.
@dataclass(slots=True, eq=False)
class CorrectedColumns(Columns):
    """Columns of n corrected ranges of one origin; the fields are those of `CorrectedRange`.

    Attributes:
        range_m: (n,), of the type of `RangeColumns.range_m`.
        correction_m, variance_m2: float32 (n,).
        status: uint8 (n,), of `Status`.
        origin: that of all ranges.
        model_id: uint32 (n,).
        fault: uint8 (n,), of `CirFault`; 0: none.
    """

    range_m: NDArray[Any]
    correction_m: NDArray[np.float32]
    variance_m2: NDArray[np.float32]
    status: NDArray[np.uint8]
    origin: CorrectedBy
    model_id: NDArray[np.uint32]
    fault: NDArray[np.uint8]

    @property
    def reason(self) -> NDArray[np.str_]:
        """Why each range was not corrected, text (n,); empty: it was."""
        columns = (self.status, self.fault, self.range_m + self.correction_m, self.correction_m)
        return np.array([reason(*row) for row in zip(*(c.tolist() for c in columns), strict=True)], np.str_)

    def __len__(self) -> int:
        """The number of ranges."""
        return len(self.range_m)
