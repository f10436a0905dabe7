"""What a recording holds, gathered in one pass: counts, pairs, times, oddities."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from uwb_mitigation.measurement import Record
from uwb_mitigation.sources.source import Source

_SECOND_NS = 1e9


@dataclass(slots=True)
class Pair:
    """The exchanges of one anchor with one tag under one label.

    Attributes:
        anchor_id, tag_id: the two radios, or the places they stood at.
        label: propagation condition; empty = unknown.
        ranges: how many.
        first_ns, last_ns: stamps of the earliest and the latest.
        sum_m, finite: sum and count of the ranges that are finite.
        true_sum_m, known: sum and count of the true distances that are known.
    """

    anchor_id: int
    tag_id: int
    label: str
    ranges: int = 0
    first_ns: int = 0
    last_ns: int = 0
    sum_m: float = 0.0
    finite: int = 0
    true_sum_m: float = 0.0
    known: int = 0

    def add(self, record: Record) -> None:
        """Take in one record."""
        measurement = record.measurement
        stamp_ns = measurement.stamp_ns
        self.first_ns = min(self.first_ns, stamp_ns) if self.ranges else stamp_ns
        self.last_ns = max(self.last_ns, stamp_ns) if self.ranges else stamp_ns
        self.ranges += 1
        if math.isfinite(measurement.range_m):
            self.sum_m += measurement.range_m
            self.finite += 1
        if record.truth is not None:
            self.true_sum_m += record.truth.range_m
            self.known += 1

    @property
    def mean_m(self) -> float:
        """Mean of the finite ranges; NaN = there is none."""
        return self.sum_m / self.finite if self.finite else math.nan

    @property
    def mean_true_m(self) -> float:
        """Mean of the true distances; NaN = none is known."""
        return self.true_sum_m / self.known if self.known else math.nan

    @property
    def rate_hz(self) -> float:
        """Exchanges a second between the first and the last; NaN = no time passes between them."""
        span_ns = self.last_ns - self.first_ns
        return (self.ranges - 1) * _SECOND_NS / span_ns if span_ns > 0 else math.nan


@dataclass(slots=True)
class Inventory:
    """What has been read of a source so far.

    Attributes:
        ranges: records.
        with_truth: records whose true distance is known.
        pairs: by (anchor, tag, label), in the order of their first exchange.
        skipped: oddities, {kind: count}.
    """

    ranges: int = 0
    with_truth: int = 0
    pairs: dict[tuple[int, int, str], Pair] = field(default_factory=dict)
    skipped: Counter[str] = field(default_factory=Counter)

    def watch(self, source: Source) -> Iterator[Record]:
        """Pass the records of `source` on, and count them; oddities join even when reading ends in an error."""
        try:
            for record in source:
                self._add(record)
                yield record
        finally:
            self.skipped += source.skipped

    @property
    def pair_count(self) -> int:
        """Pairs of an anchor and a tag, whatever their labels."""
        return len({(pair.anchor_id, pair.tag_id) for pair in self.pairs.values()})

    @property
    def duration_s(self) -> float:
        """Time from the earliest to the latest exchange; 0 when there are fewer than two."""
        if not self.pairs:
            return 0.0
        first = min(pair.first_ns for pair in self.pairs.values())
        return (max(pair.last_ns for pair in self.pairs.values()) - first) / _SECOND_NS

    def as_json(self) -> dict[str, Any]:
        """The result as JSON knows it: what is not known is null."""
        return {
            "ranges": self.ranges,
            "with_truth": self.with_truth,
            "pairs": self.pair_count,
            "duration_s": self.duration_s,
            "skipped": dict(self.skipped),
            "by_pair": [
                {
                    "anchor_id": pair.anchor_id,
                    "tag_id": pair.tag_id,
                    "label": pair.label,
                    "ranges": pair.ranges,
                    "rate_hz": _known(pair.rate_hz),
                    "mean_range_m": _known(pair.mean_m),
                    "mean_true_range_m": _known(pair.mean_true_m),
                }
                for pair in self.pairs.values()
            ],
        }

    def _add(self, record: Record) -> None:
        measurement = record.measurement
        label = record.truth.label if record.truth is not None else ""
        key = (measurement.anchor_id, measurement.tag_id, label)
        pair = self.pairs.get(key)
        if pair is None:
            pair = self.pairs[key] = Pair(*key)
        pair.add(record)
        self.ranges += 1
        self.with_truth += record.truth is not None


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
