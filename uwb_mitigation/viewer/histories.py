"""Ranges of one pair in columns, live and recorded, and what they show about it. No ROS, no page, no I/O here."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import OrderedDict, namedtuple
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.health import NO_DATA_INTERVALS, NO_DATA_S
from uwb_mitigation.positioning.residual_directions import ResidualDirections
from uwb_mitigation.types.measurement import FAULTS, LINE_OF_SIGHT_DB, Cir, Encoding

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
LeverArm = tuple[float, float, float]
"""An antenna in the frame of the robot, m."""
Column = NDArray[np.float64]
Values = Any
"""A number of one row, or those of n rows, float64 (n,)."""

K = TypeVar("K")
V = TypeVar("V")
R = TypeVar("R", bound="Rows[Any]")


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


class Rows(Generic[V]):
    """Rows of float64 in the order in which they are added; the last column is the time of reception on the scene's clock.

    Args:
        rows: float64 (n, k); None: without rows.

    Attributes:
        kind: named tuple of one row, or of all columns.
    """

    kind: Any

    def __init__(self, rows: NDArray[np.float64] | None = None) -> None:
        self._data = np.empty((0, len(self.kind._fields))) if rows is None else rows
        self._begin, self._end = 0, len(self._data)

    @property
    def rows(self) -> NDArray[np.float64]:
        """A view, float64 (n, k)."""
        return self._data[self._begin : self._end]

    @property
    def columns(self) -> V:
        """The columns; a change of a value is kept."""
        columns: V = self.kind(*self.rows.T)
        return columns

    @property
    def last(self) -> V:
        """The last row; NaN: there is none."""
        has_rows = self._end > self._begin
        values = self._data[self._end - 1].tolist() if has_rows else [math.nan] * self._data.shape[1]
        last: V = self.kind(*values)
        return last

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
        received_s = self.rows[:, -1]
        end = bisect_right(received_s, end_s + 1e-6)
        begin = max(min(bisect_right(received_s, begin_s), end - 1), 0)
        return type(self)(self.rows[begin:end])


class Pose(NamedTuple):
    """Estimated position of a tag, or positions, m; NaN: unknown.

    Attributes:
        major_m, minor_m, angle_rad: half axes of the horizontal 95 % ellipse, and angle of the major one.
        stamp_s, sd_m: time of the estimate, s, and horizontal standard deviation.
        speed: m/s, from the pose before; `Scene.add_pose` sets it, and the time of reception on the scene's clock.
    """

    x: Values
    y: Values
    z: Values = math.nan
    major_m: Values = math.nan
    minor_m: Values = math.nan
    angle_rad: Values = math.nan
    heading_rad: Values = math.nan
    stamp_s: Values = math.nan
    sd_m: Values = math.nan
    speed: Values = 0.0
    received_s: Values = math.nan

    def antenna(self, arm: LeverArm) -> Pose:
        """Return the antenna of a robot whose pose the locator publishes; without a heading, its x and y are those of the antenna."""
        turned = np.nan_to_num(np.exp(1j * self.heading_rad) * complex(*arm[:2]))
        return self._replace(x=self.x + turned.real, y=self.y + turned.imag, z=self.z + arm[2])


class Trail(Rows[Pose]):
    """Positions of one tag."""

    kind = Pose


class Outages(Rows[Any]):
    """Intervals, by stamps of a tag, in which the viewer has dropped ranges."""

    kind = namedtuple("kind", "begin_s, end_s")


class Sample(NamedTuple):
    """A corrected range of one pair, or ranges, live and recorded; NaN: unknown.

    Attributes:
        raw_m, corrected_m, sigma_m: measured and corrected range, and standard deviation of the corrected one.
        true_m: true range, which may arrive later.
        gap_db: level of the CIR above that of its first path. rx_dbm: its receive level.
        residual_m: corrected range minus the distance of the anchor from the estimated position.
        interval_s: time since the previous range of the pair; unknown if the viewer has dropped ranges.
        received_s: time of reception on the scene's clock.
    """

    stamp_s: Values
    raw_m: Values
    corrected_m: Values
    sigma_m: Values
    status: Values
    true_m: Values = math.nan
    gap_db: Values = math.nan
    rx_dbm: Values = math.nan
    sequence: Values = 0
    residual_m: Values = math.nan
    interval_s: Values = math.nan
    received_s: Values = math.nan


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


class History(Rows[Sample]):
    """Ranges of one pair: of the last minute, or of a recording.

    Args:
        rows: see `Sample`; None: without ranges.
        outages: those of its tag; None: none.

    Attributes:
        cir: the last CIR of a stream.
        directions: its residuals at the latest places of the tag.
    """

    kind = Sample

    def __init__(self, rows: NDArray[np.float64] | None = None, outages: Outages | None = None) -> None:
        super().__init__(rows)
        self._outages = outages or Outages()
        self.cir: Cir | None = None
        self.directions = ResidualDirections()

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
    def latest_stamp_s(self) -> float:
        """Stamp of the last range; NaN: there is none."""
        return float(self._data[self._end - 1, 0]) if self._end > self._begin else math.nan

    def add(self, sample: Sample, residual_m: float, received_s: float, limit: int | None = None) -> None:
        """Add a range; see `Sample` and `append`."""
        interval_s = math.nan if self.is_interrupted else sample.stamp_s - self.latest_stamp_s
        self.append((*sample[:-3], residual_m, interval_s, received_s), limit)

    def remove_before(self, stamp_s: float) -> None:
        """Remove ranges with earlier stamps from the beginning."""
        while self._begin < self._end and self._data[self._begin, 0] < stamp_s:
            self._begin += 1

    def statistics(self) -> dict[str, float]:
        """Return means and shares (%) of the latest ranges; NaN: unknown."""
        columns = Sample(*self.rows[-STATISTICS:].T)
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


def _plausible_values(values: Column) -> Column:
    return values[np.abs(values) < MAX_RANGE_M]


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else math.nan
