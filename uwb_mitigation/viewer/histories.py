"""Ranges of one pair in columns, live and recorded, and what they show about it. No ROS, no page, no I/O here."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.health import NO_DATA_INTERVALS, NO_DATA_S
from uwb_mitigation.types.measurement import FAULTS, LINE_OF_SIGHT_DB, Cir, Encoding, Status

MAX_SAMPLES = 6000
"""Number of ranges of a pair of a stream that are kept: 100 per second for a minute."""
MAX_VALUES = 2 * 1016
"""Of a CIR: the DW1000's complete accumulator, real and imaginary."""
MAX_RANGE_M = 10_000.0
"""A longer range is shown in the table only; a larger error is not counted."""
HISTORY_S = 60.0
"""Length of the strip chart of a pair."""
STATISTICS, RATE_RANGES = 100, 20
"""Numbers of latest ranges in the statistics of a pair and in its rate."""

Pair = tuple[int, int]
"""Anchor and tag."""
Column = NDArray[np.float64]

K = TypeVar("K")
V = TypeVar("V")
R = TypeVar("R", bound="Rows")


class BoundedDict(OrderedDict[K, V]):
    """A dictionary that keeps the latest `limit` entries that were added."""

    def __init__(self, limit: float) -> None:
        super().__init__()
        self._limit = limit

    def touch(self, key: K, new: Callable[[], V]) -> V:
        """Return the value of a key, or a new one, as the latest entry."""
        return self.add(key, self[key] if key in self else new())

    def add(self, key: K, value: V) -> V:
        self[key] = value
        self.move_to_end(key)
        if len(self) > self._limit:
            self.popitem(last=False)
        return value


class Rows:
    """Rows of float64 in the order in which they are added; the first column is the time of reception on the scene's clock.

    Args:
        rows: float64 (n, k).
    """

    def __init__(self, rows: NDArray[np.float64]) -> None:
        self._data, self._begin, self._end = rows, 0, len(rows)

    @property
    def rows(self) -> NDArray[np.float64]:
        """A view, float64 (n, k)."""
        return self._data[self._begin : self._end]

    @property
    def last(self) -> list[Any]:
        """The values of the last row; NaN: there is none."""
        has_rows = self._end > self._begin
        return list(self._data[self._end - 1].tolist()) if has_rows else [math.nan] * self._data.shape[1]

    @property
    def received_s(self) -> float:
        """Time of reception of the last row; NaN: there is none."""
        return float(self.last[0])

    def append(self, row: Sequence[float], limit: int | None = None) -> None:
        """Append a row, and remove the first ones above a limit."""
        if self._end == len(self._data):
            rows = self.rows
            self._data = np.empty((2 * len(rows) + 16, rows.shape[1]))
            self._data[: len(rows)] = rows
            self._begin, self._end = 0, len(rows)
        self._data[self._end] = row
        self._end += 1
        if limit is not None:
            self._begin = max(self._begin, self._end - limit)

    def until(self: R, end_s: float, begin_s: float = -math.inf) -> R:
        """Return the rows that were received in an interval; at least the last one before its end."""
        received_s = self.rows[:, 0]
        end = bisect_right(received_s, end_s + 1e-6)
        begin = max(min(bisect_right(received_s, begin_s), end - 1), 0)
        return type(self)(self.rows[begin:end])


class RangeColumns(NamedTuple):
    """Ranges of one pair, each float64 (n,), live and recorded; NaN: unknown.

    Attributes:
        received_s: time of reception on the scene's clock.
        residual_m: corrected range minus the distance of the anchor from the estimated position.
        interval_s: time since the previous range of the pair; NaN: unknown, because the viewer has dropped ranges.
        raw_m, corrected_m, sigma_m: measured and corrected range, and standard deviation of the corrected one.
        true_m: true range, which may arrive later.
        gap_db: level of the CIR above that of its first path. rx_dbm: its receive level.
    """

    received_s: Column
    residual_m: Column
    interval_s: Column
    stamp_s: Column
    raw_m: Column
    corrected_m: Column
    sigma_m: Column
    status: Column
    true_m: Column
    gap_db: Column
    rx_dbm: Column
    sequence: Column


STAMP = RangeColumns._fields.index("stamp_s")


class Sample(NamedTuple):
    """One corrected range of a pair; see `RangeColumns`, whose last fields these are."""

    stamp_s: float
    raw_m: float
    range_m: float
    sigma_m: float
    status: Status
    true_m: float = math.nan
    gap_db: float = math.nan
    rx_dbm: float = math.nan
    sequence: int = 0


def plausible_cir(cir: Cir) -> Cir | None:
    """Return a CIR that can be drawn; None if it is empty, too long or implausible."""
    odd = cir.encoding is Encoding.COMPLEX_INT16 and len(cir.samples) % 2
    if odd or not 0 < len(cir.samples) <= MAX_VALUES:
        return None
    # The largest sample times the scale must fit a float32, and the index of the first path an int32.
    is_far = math.isfinite(cir.first_path_index) and abs(cir.first_path_index) >= 2**31
    if is_far or not abs(cir.scale) < 1e30:
        return None
    # Copy the samples: they may be a view into a large message.
    return replace(cir, samples=cir.samples.copy())


class History(Rows):
    """Ranges of one pair: of the last minute, or of a recording.

    Args:
        rows: see `RangeColumns`; None: without ranges.
        outages: see `new_outages`; None: none.

    Attributes:
        cir: the last CIR of a stream.
    """

    def __init__(self, rows: NDArray[np.float64] | None = None, outages: Rows | None = None) -> None:
        super().__init__(np.empty((0, len(RangeColumns._fields))) if rows is None else rows)
        self._outages = new_outages() if outages is None else outages
        self.cir: Cir | None = None

    @property
    def is_interrupted(self) -> bool:
        """Whether the viewer itself has dropped ranges since the last one: the time until the next one is no interval."""
        outages = self._outages.rows
        return len(outages) > 0 and bool(outages[-1, 1] > self.latest_stamp_s)

    def outage_s(self, age_s: float) -> float:
        """Return for how long the viewer has dropped ranges since the last one, `age_s` ago."""
        begin_s, end_s = np.clip(self._outages.rows.T - self.latest_stamp_s, 0.0, age_s)
        return float((end_s - begin_s).sum())

    @property
    def columns(self) -> RangeColumns:
        """The ranges; a change of a value is kept."""
        return RangeColumns(*self.rows.T)

    @property
    def latest(self) -> Sample | None:
        """The last range."""
        if self._end == self._begin:
            return None
        sample = Sample(*self.last[STAMP:])
        return sample._replace(status=Status(int(sample.status)))

    @property
    def latest_stamp_s(self) -> float:
        """Stamp of the last range; NaN: there is none."""
        return float(self.last[STAMP])

    def add(self, sample: Sample, received_s: float, residual_m: float, limit: int | None) -> None:
        """Add a range; see `RangeColumns` and `append`."""
        interval_s = math.nan if self.is_interrupted else sample.stamp_s - self.latest_stamp_s
        self.append((received_s, residual_m, interval_s, *sample), limit)

    def remove_before(self, stamp_s: float) -> None:
        """Remove ranges with earlier stamps from the beginning."""
        while self._begin < self._end and self.columns.stamp_s[0] < stamp_s:
            self._begin += 1

    def statistics(self) -> dict[str, float]:
        """Return means and shares (%) of the latest ranges; NaN: unknown."""
        columns = RangeColumns(*(column[-STATISTICS:] for column in self.columns))
        residual_m, gap_db = _plausible_values(columns.residual_m), _plausible_values(columns.gap_db)
        return {
            "lost": self._lost_percent(),
            "not_ok": _mean(100.0 * np.isin(columns.status, FAULTS)),
            "nlos": _mean(100.0 * (gap_db >= LINE_OF_SIGHT_DB)),
            "correction": _mean(_plausible_values(columns.raw_m - columns.corrected_m)),
            "rx": _mean(_plausible_values(columns.rx_dbm)),
            "residual": _mean(residual_m),
            "evidence": float(len(residual_m)),
        }

    def _lost_percent(self) -> float:
        """Return the share of missing sequence numbers while the viewer has dropped no ranges; NaN: unknown.

        Anchors are polled in turn: the usual step is the median of all. Also without the ranges half an interval before and
        after an outage: it begins and ends with a range that was not lost.
        """
        stamp_s, interval_s = self.columns.stamp_s, self.columns.interval_s[1:]
        steps, is_interval = np.diff(self.columns.sequence) % 2**32, np.isfinite(interval_s)
        is_step = (steps > 0) & (steps < 1000)
        if not (is_step & is_interval).any():
            return math.nan
        polls = np.where(is_step, np.rint(steps / np.median(steps[is_step & is_interval])), 1.0).clip(1.0)
        number, margin_s = np.append(0.0, np.cumsum(polls)), 0.5 * np.median(interval_s[is_interval])
        outages_s = self._outages.rows.T + np.array([[-margin_s], [margin_s]])
        outages_s[1, :-1] = np.minimum(outages_s[1, :-1], outages_s[0, 1:])
        numbers = np.ceil(np.interp(outages_s, stamp_s, number, right=number[-1] + 1.0))
        polled = number[-1] + 1.0 - np.diff(numbers, axis=0).sum()
        received = len(stamp_s) - np.diff(np.searchsorted(stamp_s, outages_s), axis=0).sum()
        return 100.0 * float(np.clip(1.0 - received / polled, 0.0, 1.0)) if polled > 0.0 else math.nan

    def rate_hz(self, age_s: float = 0.0) -> float:
        """Return the rate of the last `RATE_RANGES` ranges whose intervals are known, by their stamps; NaN: unknown.

        Args:
            age_s: time since the last range by stamps; the rate decreases if this is several mean intervals, unless the viewer
                has dropped ranges since then.
        """
        intervals_s = self.columns.interval_s[-STATISTICS:][1:]
        intervals_s = intervals_s[np.isfinite(intervals_s)][1 - RATE_RANGES :]
        span_s = float(intervals_s.sum())
        if not span_s > 0:
            return math.nan
        rate_hz = len(intervals_s) / span_s
        is_recent = age_s * rate_hz <= NO_DATA_INTERVALS or self.is_interrupted
        return rate_hz if is_recent else (len(intervals_s) + 1) / (span_s + age_s)

    @property
    def max_gap_s(self) -> float:
        """Age of the last range from which the pair has no data, relative to its mean interval."""
        rate_hz = self.rate_hz()
        return max(NO_DATA_S, NO_DATA_INTERVALS / rate_hz if rate_hz > 0 else 0.0)

    def quality(self) -> NDArray[np.float64]:
        """Return time of reception (s), residual (m), rate (Hz) and NLOS share (%), float64 (n, 4)."""
        # A live page needs pandas only here: its import takes 0.4 s.
        import pandas as pd

        columns = self.columns
        residual_m = np.where(np.abs(columns.residual_m) < MAX_RANGE_M, columns.residual_m, np.nan)
        is_nlos = np.where(np.isfinite(columns.gap_db), columns.gap_db >= LINE_OF_SIGHT_DB, np.nan)
        latest = pd.DataFrame({"interval": columns.interval_s, "nlos": is_nlos}).rolling(
            RATE_RANGES, min_periods=1
        )
        interval_s, nlos = latest.mean().to_numpy().T
        return np.column_stack([columns.received_s, residual_m, 1.0 / interval_s, 100.0 * nlos])


def new_outages() -> Rows:
    """Return the intervals, by stamps of a tag, in which the viewer has dropped ranges: begin and end, s."""
    return Rows(np.empty((0, 2)))


def _plausible_values(values: Column) -> Column:
    return values[np.abs(values) < MAX_RANGE_M]


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else math.nan
