"""What a recording holds, gathered in one pass: counts, pairs, times, oddities."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.measurement import Record
from uwb_mitigation.sources.source import Source

_SECOND_NS = 1e9


class Inventory:
    """What has been read so far.

    Attributes:
        ranges: number of records.
        with_truth: number of records with a true range.
        skipped: oddities, {kind: count}.
    """

    def __init__(self) -> None:
        self.ranges = self.with_truth = 0
        self.skipped: Counter[str] = Counter()
        self._rows: dict[tuple[int, int, str], list[tuple[int, float, float]]] = {}

    def watch(self, source: Source) -> Iterator[Record]:
        """Pass on the records of `source` and count them; oddities are added even if reading ends in an error."""
        try:
            for record in source:
                measured, truth = record.measurement, record.truth
                key = (measured.anchor_id, measured.tag_id, truth.label if truth else "")
                row = (measured.stamp_ns, measured.range_m, truth.range_m if truth else np.nan)
                self._rows.setdefault(key, []).append(row)
                self.ranges += 1
                self.with_truth += truth is not None
                yield record
        finally:
            self.skipped += source.skipped

    def as_json(self) -> dict[str, Any]:
        """Return the result for JSON, with null for unknown values; pairs in the order of their first exchange."""
        stamps = [row[0] for rows in self._rows.values() for row in rows]
        return {
            "ranges": self.ranges,
            "with_truth": self.with_truth,
            "pairs": len({key[:2] for key in self._rows}),
            "duration_s": (max(stamps) - min(stamps)) / _SECOND_NS if stamps else 0.0,
            "skipped": dict(self.skipped),
            "by_pair": [_pair(*key, rows) for key, rows in self._rows.items()],
        }


def _pair(anchor_id: int, tag_id: int, label: str, rows: list[tuple[int, float, float]]) -> dict[str, Any]:
    stamps = [row[0] for row in rows]
    span_ns = max(stamps) - min(stamps)
    return {
        "anchor_id": anchor_id,
        "tag_id": tag_id,
        "label": label,
        "ranges": len(rows),
        "rate_hz": (len(rows) - 1) * _SECOND_NS / span_ns if span_ns > 0 else None,
        "mean_range_m": _mean(np.array([row[1] for row in rows])),
        "mean_true_range_m": _mean(np.array([row[2] for row in rows])),
    }


def _mean(values: NDArray[np.float64]) -> float | None:
    """The mean of the finite values; None if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None
