"""Ranges and CIRs of the last minute of one pair, and what they tell about it. No ROS, no page, no I/O here."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.types.measurement import LINE_OF_SIGHT_DB, Cir, Encoding, Status

MAX_SAMPLES, MAX_CIRS = 6000, 50
"""Ranges (100 per second for a minute) and CIRs of a pair that are kept."""
MAX_VALUES = 2 * 1016
"""Of a CIR: the DW1000's complete accumulator, real and imaginary."""
MAX_RANGE_M = 10_000.0
"""A longer range is shown in the table only; a larger error is not counted."""
HISTORY_S = 60.0
"""Length of the strip chart of a pair."""
NO_DATA_S, NO_DATA_INTERVALS = 3.0, 3.0
"""A pair or a tag has no data after this time, or after this number of its mean intervals if that is longer."""
STATISTICS, RATE_RANGES = 100, 20
"""Numbers of latest ranges in the statistics of a pair and in its rate."""

Pair = tuple[int, int]
"""Anchor and tag."""

K = TypeVar("K")
V = TypeVar("V")


class BoundedDict(OrderedDict[K, V]):
    """A dictionary that keeps the latest `limit` entries that were added."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._limit = limit

    def add(self, key: K, value: V) -> V:
        self[key] = value
        self.move_to_end(key)
        if len(self) > self._limit:
            self.popitem(last=False)
        return value


class RangeColumns(NamedTuple):
    """Ranges, each float64 (n,); NaN: unknown. See `Sample`; `time_s` is on the clock of the figures."""

    time_s: NDArray[np.float64]
    stamp_s: NDArray[np.float64]
    raw_m: NDArray[np.float64]
    corrected_m: NDArray[np.float64]
    true_m: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    interval_s: NDArray[np.float64]
    gap_db: NDArray[np.float64]
    status: NDArray[np.float64]

    def quality(self) -> NDArray[np.float64]:
        """Return time (s), residual (m), rate (Hz) and NLOS share (%) of one pair, float64 (n, 4)."""
        residual_m = np.where(np.abs(self.residual_m) < MAX_RANGE_M, self.residual_m, np.nan)
        is_nlos = np.where(np.isfinite(self.gap_db), self.gap_db >= LINE_OF_SIGHT_DB, np.nan)
        rate_hz, nlos = 1.0 / _rolling_mean(self.interval_s), 100.0 * _rolling_mean(is_nlos)
        return np.column_stack([self.time_s, residual_m, rate_hz, nlos])


@dataclass(slots=True)
class Sample:
    """One corrected range of a pair; its truth may arrive later.

    Attributes:
        time_s: stamp.
        raw_m, range_m, sigma_m: measured and corrected range, and standard deviation of the corrected one.
        true_m: true range; NaN: unknown.
        residual_m: corrected range minus the distance of the anchor from the estimated position; NaN: unknown.
        interval_s: time since the previous range of the pair; NaN: unknown, because the viewer has dropped ranges.
        gap_db: level of the CIR above that of its first path; NaN: unknown.
    """

    time_s: float
    raw_m: float
    range_m: float
    sigma_m: float
    status: Status
    true_m: float = math.nan
    residual_m: float = math.nan
    interval_s: float = math.nan
    gap_db: float = math.nan


_VALUES = attrgetter(
    "time_s", "time_s", "raw_m", "range_m", "true_m", "residual_m", "interval_s", "gap_db", "status"
)


@dataclass(frozen=True, eq=False)
class Trace:
    """One CIR; its magnitudes are computed only if it is shown."""

    cir: Cir

    @classmethod
    def from_cir(cls, cir: Cir) -> Trace | None:
        """Return the trace of a CIR; None if it is empty, too long or implausible."""
        odd = cir.encoding is Encoding.COMPLEX_INT16 and len(cir.samples) % 2
        if odd or not 0 < len(cir.samples) <= MAX_VALUES:
            return None
        # The largest sample times the scale must fit a float32, and the index of the first path an int32.
        is_far = math.isfinite(cir.first_path_index) and abs(cir.first_path_index) >= 2**31
        if is_far or not abs(cir.scale) < 1e30:
            return None
        # Copy the samples: they may be a view into a large message.
        return cls(replace(cir, samples=cir.samples.copy()))

    @cached_property
    def magnitude(self) -> NDArray[np.float32]:
        """Magnitudes in accumulator units, float32 (n,)."""
        values = self.cir.samples.astype(np.float32)
        if self.cir.encoding is Encoding.COMPLEX_INT16:
            values = np.hypot(values[0::2], values[1::2])
        magnitude: NDArray[np.float32] = values * np.float32(self.cir.scale)
        return magnitude

    @property
    def origin(self) -> int:
        """Accumulator index of the first path; the first sample if it is unknown."""
        first = self.cir.first_path_index
        return math.floor(first) if math.isfinite(first) else self.cir.start_index


@dataclass(slots=True)
class History:
    """The last minute of one pair.

    Attributes:
        received_s: time of the last range on the scene's clock.
        lost, received: number of missing sequence numbers, and of ranges.
    """

    received_s: float = math.nan
    lost: int = 0
    received: int = 0
    _sequence: int = -1
    _is_interrupted: bool = False
    _steps: deque[int] = field(default_factory=lambda: deque(maxlen=20))
    samples: deque[Sample] = field(default_factory=lambda: deque(maxlen=MAX_SAMPLES))
    traces: deque[Trace] = field(default_factory=lambda: deque(maxlen=MAX_CIRS))

    def add(self, sample: Sample, now_s: float) -> None:
        """Add a range, and remove ranges that are older than a minute."""
        if self.samples and not self._is_interrupted:
            sample.interval_s = sample.time_s - self.samples[-1].time_s
        self._is_interrupted = False
        self.samples.append(sample)
        self.received += 1
        while self.samples[0].time_s < now_s - HISTORY_S:
            self.samples.popleft()

    def columns(self) -> RangeColumns:
        """Return the ranges; their times are the stamps."""
        rows = np.array(list(map(_VALUES, self.samples)), np.float64).reshape(-1, len(RangeColumns._fields))
        return RangeColumns(*rows.T)

    def count_lost(self, sequence: int) -> None:
        """Count missing ranges. Anchors are polled in turn, so the usual step is the median of the latest steps."""
        step = (sequence - self._sequence) & 0xFFFFFFFF
        if self._sequence >= 0 and 0 < step < 1000:
            self._steps.append(step)
            self.lost += max(round(step / sorted(self._steps)[len(self._steps) // 2]) - 1, 0)
        self._sequence = sequence

    def restart_count(self) -> None:
        """Exclude the time until the next range from losses and rate: the viewer itself has dropped ranges."""
        self._sequence, self._is_interrupted = -1, True

    def statistics(self) -> dict[str, float]:
        """Return means and shares (%) of the latest ranges and CIRs; NaN: unknown."""
        samples = list(islice(reversed(self.samples), STATISTICS))
        cirs = [trace.cir for trace in self.traces]
        gap_db = _plausible_values([cir.power_gap_db for cir in cirs])
        correction_m = _plausible_values([sample.raw_m - sample.range_m for sample in samples])
        return {
            "lost": 100.0 * self.lost / max(self.lost + self.received, 1),
            "not_ok": _mean(np.array([100.0 * sample.status.is_fault for sample in samples])),
            "nlos": _mean(100.0 * (gap_db >= LINE_OF_SIGHT_DB)),
            "correction": _mean(correction_m),
            "rx": _mean(_plausible_values([cir.rx_power_dbm for cir in cirs])),
            **residual_means([sample.residual_m for sample in samples]),
        }

    @property
    def latest(self) -> Sample | None:
        return self.samples[-1] if self.samples else None

    def rate_hz(self, age_s: float = 0.0) -> float:
        """Return the rate of the last `RATE_RANGES` ranges by their stamps; NaN before the second one.

        Args:
            age_s: time since the last range by stamps; the rate decreases if this is several mean intervals, unless the viewer
                has dropped ranges since then.
        """
        # Copy in one step: the monitor draws its table in another thread than the one that adds ranges.
        recent = list(islice(reversed(self.samples), RATE_RANGES))
        intervals_s = [sample.interval_s for sample in recent[:-1] if math.isfinite(sample.interval_s)]
        span_s = sum(intervals_s)
        if not span_s > 0:
            return math.nan
        rate_hz = len(intervals_s) / span_s
        is_recent = age_s * rate_hz <= NO_DATA_INTERVALS or self._is_interrupted
        return rate_hz if is_recent else (len(intervals_s) + 1) / (span_s + age_s)

    @property
    def max_gap_s(self) -> float:
        """Age of the last range from which the pair has no data, relative to its mean interval."""
        rate_hz = self.rate_hz()
        return max(NO_DATA_S, NO_DATA_INTERVALS / rate_hz if rate_hz > 0 else 0.0)


def residual_means(residuals_m: Sequence[float]) -> dict[str, float]:
    """Return mean and number of the known residuals of the last `STATISTICS` ranges."""
    known_m = _plausible_values(residuals_m)
    return {"residual": _mean(known_m), "evidence": float(len(known_m))}


def _plausible_values(values: Sequence[float]) -> NDArray[np.float64]:
    """Return the finite values, float64 (n,)."""
    array = np.array(values, np.float64)
    return array[np.abs(array) < MAX_RANGE_M]


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _rolling_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means of the last `RATE_RANGES` known values, float64 (n,); NaN: there is none."""
    is_known, window = np.isfinite(values), np.ones(RATE_RANGES)
    if not len(values):
        return values
    sums = np.convolve(np.where(is_known, values, 0.0), window)[: len(values)]
    counts = np.convolve(is_known.astype(np.float64), window)[: len(values)]
    mean: NDArray[np.float64] = np.divide(sums, counts, out=np.full(len(values), np.nan), where=counts > 0.0)
    return mean
