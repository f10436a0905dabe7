"""Statistics of an import (counts, pairs, times, warnings) in one pass, and shortening of long pauses."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import FIRST_DATE_NS, NS_PER_S


class RecordingSummary:
    """Statistics of the records read so far.

    Attributes:
        ranges: number of records.
        with_truth: number of records with a true range.
        skipped: warnings, {kind: count}.
    """

    def __init__(self) -> None:
        self.ranges = self.with_truth = 0
        self.skipped: Counter[str] = Counter()
        self._rows: dict[tuple[int, int, str], tuple[array[int], array[float], array[float]]] = {}

    def watch(self, source: Source) -> Iterator[Record]:
        """Yield and count the records of `source`; its warnings are added even if reading ends in an error."""
        try:
            for record in source:
                measured, truth = record.measurement, record.truth
                key = (measured.anchor_id, measured.tag_id, truth.label if truth else "")
                true_m = truth.range_m if truth else math.nan
                if key not in self._rows:
                    self._rows[key] = array("q"), array("d"), array("d")
                stamps, ranges_m, truths_m = self._rows[key]
                stamps.append(measured.stamp_ns)
                ranges_m.append(measured.range_m)
                truths_m.append(true_m)
                self.ranges += 1
                self.with_truth += math.isfinite(true_m)
                yield record
        finally:
            self.skipped += source.skipped

    def as_json(self) -> dict[str, Any]:
        """Return the result for JSON, with null for unknown values; pairs in the order of their first exchange."""
        first = min((min(stamps) for stamps, _, _ in self._rows.values()), default=0)
        last = max((max(stamps) for stamps, _, _ in self._rows.values()), default=0)
        return {
            "ranges": self.ranges,
            "with_truth": self.with_truth,
            "pairs": len({key[:2] for key in self._rows}),
            "duration_s": (last - first) / NS_PER_S,
            "skipped": dict(self.skipped),
            "by_pair": [_pair(*key, rows) for key, rows in self._rows.items()],
        }


def _pair(anchor_id: int, tag_id: int, label: str, rows: tuple[Any, Any, Any]) -> dict[str, Any]:
    stamps, ranges_m, true_m = rows
    span_ns = max(stamps) - min(stamps)
    return {
        "anchor_id": anchor_id,
        "tag_id": tag_id,
        "label": label,
        "ranges": len(stamps),
        "rate_hz": (len(stamps) - 1) * NS_PER_S / span_ns if span_ns > 0 else None,
        "mean_range_m": _mean(np.array(ranges_m)),
        "mean_true_range_m": _mean(np.array(true_m)),
    }


def _mean(values: NDArray[np.float64]) -> float | None:
    """Return the mean of the finite values; None without any."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


@dataclass(slots=True)
class PauseShortener:
    """Shifts the stamps of consecutive records; ranges, ids and `device_time` are unchanged.

    Attributes:
        longest_s: longer pauses are shortened to this; infinite = never.
        start_ns: first stamp, if records start without a date; None: their stamps are kept.
        cut: number of shortened pauses.
        cut_s: total time removed.
        shifts_s: shifts of records without a date that follow others.
        is_new_source: the next record is the first one of another recording.
    """

    longest_s: float
    start_ns: int | None = None
    cut: int = 0
    cut_s: float = 0.0
    shifts_s: list[float] = field(default_factory=list)
    is_new_source: bool = False
    _last_ns: int | None = field(default=None, init=False)
    _shift_ns: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if not self.longest_s >= 0:
            raise ParameterError(f"longest pause = {self.longest_s} s", valid="0 or more; inf cuts none")

    def without(self, record: Record) -> Record:
        """Return the record with its new stamp."""
        stamp_ns = record.measurement.stamp_ns
        last_ns, self._last_ns = self._last_ns, stamp_ns
        is_new_source, self.is_new_source = self.is_new_source, False
        if last_ns is None:
            if stamp_ns < FIRST_DATE_NS and self.start_ns is not None:
                self._shift_ns = self.start_ns - stamp_ns
        elif stamp_ns < FIRST_DATE_NS and (
            last_ns >= FIRST_DATE_NS or (is_new_source and stamp_ns < last_ns)
        ):
            # Records without a date continue after the others.
            self._shift_ns += last_ns - stamp_ns
            self.shifts_s.append(self._shift_ns / 1e9)
        elif stamp_ns - last_ns > self.longest_s * 1e9:
            excess_ns = stamp_ns - last_ns - round(self.longest_s * 1e9)
            self._shift_ns -= excess_ns
            self.cut += 1
            self.cut_s += excess_ns / 1e9
        if self._shift_ns == 0:
            return record
        return replace(record, measurement=replace(record.measurement, stamp_ns=stamp_ns + self._shift_ns))
