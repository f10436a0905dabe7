"""What a monitor adds up from raw, corrected and true ranges: per-pair figures, losses, latency, errors.

Pure bookkeeping over plain numbers; messages and the screen are the monitor's business.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from uwb_mitigation.measurement import CorrectedRange, Status, Truth
from uwb_mitigation.viewer.scene import History, Pair, Sample, Truths

LATENCIES = 100_000
"""The latest of so many are summed up: a monitor may run for days."""


@dataclass(slots=True)
class ErrorSums:
    """Sums of absolute errors before and after mitigation, over ranges whose truth is known."""

    n: int = 0
    raw_m: float = 0.0
    corrected_m: float = 0.0


class Tally:
    """Everything received so far. Keys identify an exchange across the three topics."""

    def __init__(self) -> None:
        self.pairs: dict[Pair, History] = {}
        self.raw = 0
        self.corrected = 0
        self.statuses: Counter[Status] = Counter()
        self.errors: dict[str, ErrorSums] = {}
        self._latencies_s: deque[float] = deque(maxlen=LATENCIES)
        self._truths = Truths()

    @property
    def missing(self) -> int:
        """Raw ranges that no corrected range has followed."""
        return self.raw - self.corrected

    @property
    def total(self) -> ErrorSums:
        return ErrorSums(
            sum(e.n for e in self.errors.values()),
            sum(e.raw_m for e in self.errors.values()),
            sum(e.corrected_m for e in self.errors.values()),
        )

    def latency_ms(self, percentile: float) -> float:
        """Percentile of the time from stamp to arrival of corrected ranges; NaN without any."""
        if not self._latencies_s:
            return float("nan")
        return float(np.percentile(self._latencies_s, percentile)) * 1e3

    def add_raw(self) -> None:
        self.raw += 1

    def add_truth(self, key: Hashable, truth: Truth) -> None:
        self._truths.add(key, truth)

    def add_corrected(
        self, key: Hashable, pair: Pair, corrected: CorrectedRange, arrival_s: float, latency_s: float
    ) -> None:
        """A corrected range of a pair, that arrived `latency_s` after its stamp."""
        sample = Sample.of(arrival_s, corrected, self._truths.take(key))
        self.corrected += 1
        self.statuses[sample.status] += 1
        self._latencies_s.append(latency_s)
        self.pairs.setdefault(pair, History()).add(sample, arrival_s)
        if math.isfinite(sample.true_m) and math.isfinite(sample.raw_m):
            errors = self.errors.setdefault(sample.label, ErrorSums())
            errors.n += 1
            errors.raw_m += abs(sample.raw_m - sample.true_m)
            errors.corrected_m += abs(sample.range_m - sample.true_m)
