"""Measurements of UWB ranging exchanges, and corrected ranges: plain immutable values.

Sign convention, everywhere: error = measured - true; corrected = measured - predicted error.
Units are SI (REP-103) unless a name says otherwise. No I/O and no ROS here.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError, check_name

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


class CorrectedBy(enum.IntEnum):
    """Device that computed a correction; the values of the `source` field of `RangeCorrected.msg`."""

    HOST = 0
    DEVICE = 1


@dataclass(frozen=True, slots=True, eq=False)
class Cir:
    """A channel impulse response from the radio's accumulator.

    Attributes:
        samples: int16. COMPLEX_INT16: shape (2 n,), interleaved real, imaginary. MAGNITUDE: (n,).
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
        radio: type of the radio; UNKNOWN in recordings of earlier versions, which contain only the DW1000.
        segment: part of the frame; UNKNOWN as for `radio`.
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
    """

    range_m: float
    range_raw_m: float
    correction_m: float
    variance_m2: float
    status: Status
    origin: CorrectedBy
    model_id: int


# Not frozen, because this takes 1 % of the time of a correction.
@dataclass(slots=True, eq=False)
class RangeColumns:
    """Columns of n exchanges whose CIRs have the same encoding, length, radio and segment: inputs of the correction.

    Attributes:
        tag_id, anchor_id: uint64 (n,).
        range_m: float (n,), as in `RangeMeasurement`: float32 from messages, or float64.
        encoding: encoding of all CIRs; the fields below are those of `Cir`.
        samples: int16 (n, m).
        start_index, preamble_count: integer or float64 (n,).
        first_path_index, scale, rx_power_dbm, first_path_power_dbm: float (n,), of the type of `range_m`.
        radio, segment: those of all CIRs.
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

    @classmethod
    def from_arrays(
        cls,
        range_m: Any,
        cir: Any,
        first_path_index: Any,
        *,
        preamble_count: Any = 0,
        rx_power_dbm: Any = math.nan,
        first_path_power_dbm: Any = math.nan,
        **constants: Any,
    ) -> RangeColumns:
        """Return the columns of n ranges from arrays; numbers are valid for all ranges.

        The arguments are those of `Mitigation.correct_arrays`.

        Raises:
            ParameterError: the arrays have other shapes, the CIRs are not numbers, negative or in dB, or a field is unknown.
        """
        samples = _checked_samples(cir)
        for name in constants:
            check_name("field", name, _ARRAY_FIELDS)
        encoding = Encoding.COMPLEX_INT16 if np.iscomplexobj(samples) else Encoding.MAGNITUDE
        int16, scale = _as_int16(samples)

        def column(name: str, value: Any, dtype: Any = np.float64) -> NDArray[Any]:
            try:
                return np.broadcast_to(np.asarray(value, dtype), len(samples))
            except (ValueError, TypeError, OverflowError) as error:
                shape = f"{name} of shape {np.shape(value)} with a cir of shape {samples.shape}"
                raise ParameterError(shape, valid="one number, or one for each row of the cir") from error

        tag_id, anchor_id = (
            column(name, constants.pop(name, 0), np.uint64) for name in ("tag_id", "anchor_id")
        )
        return cls(
            tag_id,
            anchor_id,
            column("range_m", range_m),
            encoding,
            int16,
            np.zeros(len(samples)),
            column("first_path_index", first_path_index),
            scale,
            column("preamble_count", preamble_count),
            column("rx_power_dbm", rx_power_dbm),
            column("first_path_power_dbm", first_path_power_dbm),
            **constants,
        )

    @staticmethod
    def grouped(measurements: Sequence[RangeMeasurement]) -> Iterator[tuple[list[int], RangeColumns]]:
        """Yield columns of measurements whose CIRs have the same form and source, with their indices."""
        groups: dict[tuple[int, ...], list[int]] = {}
        for index, measurement in enumerate(measurements):
            cir = measurement.cir
            form = (cir.encoding, len(cir.samples), cir.radio, cir.segment)
            groups.setdefault(form, []).append(index)
        for indices in groups.values():
            members = [measurements[index] for index in indices]
            cirs = [measurement.cir for measurement in members]
            numbers = [
                (
                    m.range_m,
                    m.cir.start_index,
                    m.cir.first_path_index,
                    m.cir.scale,
                    m.cir.preamble_count,
                    m.cir.rx_power_dbm,
                    m.cir.first_path_power_dbm,
                )
                for m in members
            ]
            range_m, start, first_path, scale, preamble_count, rx_power, first_path_power = np.array(
                numbers, np.float64
            ).T
            yield (
                indices,
                RangeColumns(
                    np.array([measurement.tag_id for measurement in members], np.uint64),
                    np.array([measurement.anchor_id for measurement in members], np.uint64),
                    range_m,
                    cirs[0].encoding,
                    np.array([cir.samples for cir in cirs]) if len(cirs) > 1 else cirs[0].samples[None],
                    start,
                    first_path,
                    scale,
                    preamble_count,
                    rx_power,
                    first_path_power,
                    cirs[0].radio,
                    cirs[0].segment,
                ),
            )

    def take(self, rows: list[int]) -> RangeColumns:
        """Return the selected exchanges."""
        columns: dict[str, Any] = {
            name: value[rows] if isinstance(value := getattr(self, name), np.ndarray) else value
            for name in self.__slots__
        }
        return RangeColumns(**columns)

    def __len__(self) -> int:
        """The number of exchanges."""
        return len(self.range_m)


_ARRAY_FIELDS = (
    *("preamble_count", "rx_power_dbm", "first_path_power_dbm"),
    *("tag_id", "anchor_id", "radio", "segment"),
)

LINEAR_MAGNITUDES = "linear magnitudes: 10 ** (level / 20)"

_MIN_SAMPLES, _FACTOR = 32, 1.3


def is_logarithmic(magnitudes: NDArray[Any]) -> bool:
    """Return whether the magnitudes (m,) of a CIR are probably in dB: their mean is almost their maximum.

    Linear magnitudes vary least if they are noise (Rayleigh distribution): the mean is sqrt(pi / 2) and the maximum about
    sqrt(2 ln m) standard deviations of a component. The limit is 1.3 times their quotient: 0.44 for 1016 samples. The real
    logs have at most 0.08, and at least 0.47 in dB.
    """
    finite = magnitudes[np.isfinite(magnitudes)].astype(np.float64)
    if len(finite) < _MIN_SAMPLES or finite.min() == finite.max():
        return False
    share = _FACTOR * math.sqrt(math.pi / 2.0) / math.sqrt(2.0 * math.log(len(finite)))
    return bool(finite.mean() > share * finite.max() > 0.0)


def _checked_samples(cir: Any) -> NDArray[Any]:
    """Return the samples (n, m) of n CIRs from a caller; raises ParameterError, see `RangeColumns.from_arrays`."""
    try:
        samples = np.asarray(cir)
    except ValueError as error:
        raise ParameterError("rows of the cir have different lengths", valid="(n, m) samples") from error
    if not np.issubdtype(samples.dtype, np.number):
        raise ParameterError(f"cir of type {samples.dtype}", valid="real or complex numbers")
    if samples.ndim != 2:
        valid = "(n, m) samples: `cir[None]` for one range, `i + 1j * q` for pairs"
        raise ParameterError(f"cir of shape {samples.shape}", valid=valid)
    if np.isrealobj(samples) and samples.size and (samples < 0).any(axis=1).all():
        valid = "magnitudes, or complex samples: `i + 1j * q`"
        raise ParameterError("every row of the real cir has negative samples", valid=valid)
    if np.isrealobj(samples) and len(samples) and all(map(is_logarithmic, samples)):
        raise ParameterError("the cir is in dB", valid=LINEAR_MAGNITUDES)
    return samples


def _as_int16(cir: NDArray[Any]) -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """Return samples for `Cir.samples`, int16 (n, m or 2 m), and scales (n,), NaN for rows that are not finite."""
    values = (np.stack([cir.real, cir.imag], axis=2) if np.iscomplexobj(cir) else cir).astype(np.float64)
    values = values.reshape(len(cir), math.prod(values.shape[1:]))
    largest = np.abs(values).max(axis=1, initial=0.0)
    is_int16 = (largest <= np.iinfo(np.int16).max) & (values == np.rint(values)).all(axis=1)
    scale = np.where(is_int16, 1.0, largest / 30_000.0)  # below the limit of saturated samples
    is_finite = np.isfinite(largest)
    scale[~is_finite] = np.nan
    scaled = np.where(is_finite[:, None], values, 0.0) / np.where(is_finite, scale, 1.0)[:, None]
    return np.rint(scaled).astype(np.int16), scale


# Not frozen, because this takes 1 % of the time of a correction.
@dataclass(slots=True, eq=False)
class CorrectedColumns:
    """Columns of n corrected ranges of one origin; the fields are those of `CorrectedRange`.

    Attributes:
        range_m: (n,), of the type of `RangeColumns.range_m`.
        correction_m, variance_m2: float32 (n,).
        status: uint8 (n,), of `Status`.
        origin: that of all ranges.
        model_id: uint32 (n,).
    """

    range_m: NDArray[Any]
    correction_m: NDArray[np.float32]
    variance_m2: NDArray[np.float32]
    status: NDArray[np.uint8]
    origin: CorrectedBy
    model_id: NDArray[np.uint32]

    def __len__(self) -> int:
        """The number of ranges."""
        return len(self.range_m)
