"""What a monitor adds up from raw, corrected and true ranges: per-pair figures, losses, latency, errors.

Pure bookkeeping over plain numbers; messages and the screen are the monitor's business.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np

from uwb_mitigation.measurement import Status

RATE_WINDOW = 20
LATENCIES = 100_000
"""The latest of so many are summed up: a monitor may run for days."""


@dataclass(slots=True)
class Pair:
    """The latest of one anchor-tag pair."""

    arrivals_s: deque[float] = field(default_factory=lambda: deque(maxlen=RATE_WINDOW))
    ranges: int = 0
    range_raw_m: float = float("nan")
    range_m: float = float("nan")
    sigma_m: float = float("nan")
    true_m: float = float("nan")
    label: str = ""
    status: Status = Status.OK

    @property
    def rate_hz(self) -> float:
        """Arrivals a second over the last few; NaN before the second one."""
        if len(self.arrivals_s) < 2:
            return float("nan")
        span = self.arrivals_s[-1] - self.arrivals_s[0]
        return (len(self.arrivals_s) - 1) / span if span > 0 else float("nan")


@dataclass(slots=True)
class Errors:
    """Sums of absolute errors before and after mitigation, over ranges whose truth is known."""

    n: int = 0
    raw_m: float = 0.0
    corrected_m: float = 0.0


class Tally:
    """Everything received so far. Keys identify an exchange across the three topics."""

    def __init__(self) -> None:
        self.pairs: dict[tuple[int, int], Pair] = {}
        self.raw = 0
        self.corrected = 0
        self.statuses: Counter[Status] = Counter()
        self.errors: dict[str, Errors] = {}
        self._latencies_s: deque[float] = deque(maxlen=LATENCIES)
        # Truth comes first and is kept until its corrected range does; bounded, should that be lost.
        self._truths: dict[Hashable, tuple[float, str]] = {}

    @property
    def missing(self) -> int:
        """Raw ranges that no corrected range has followed."""
        return self.raw - self.corrected

    @property
    def total(self) -> Errors:
        return Errors(
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

    def add_truth(self, key: Hashable, true_m: float, label: str) -> None:
        self._truths[key] = (true_m, label)
        if len(self._truths) > 10_000:
            self._truths.pop(next(iter(self._truths)))

    def add_corrected(
        self,
        key: Hashable,
        pair_ids: tuple[int, int],
        *,
        arrival_s: float,
        latency_s: float,
        range_raw_m: float,
        range_m: float,
        variance_m2: float,
        status: Status,
    ) -> None:
        self.corrected += 1
        self.statuses[status] += 1
        self._latencies_s.append(latency_s)
        pair = self.pairs.setdefault(pair_ids, Pair())
        pair.ranges += 1
        pair.arrivals_s.append(arrival_s)
        pair.range_raw_m, pair.range_m, pair.status = range_raw_m, range_m, status
        pair.sigma_m = variance_m2**0.5
        truth = self._truths.pop(key, None)
        if truth is None:
            pair.true_m, pair.label = float("nan"), ""
            return
        pair.true_m, pair.label = truth
        if np.isfinite(range_raw_m):
            errors = self.errors.setdefault(pair.label, Errors())
            errors.n += 1
            errors.raw_m += abs(range_raw_m - pair.true_m)
            errors.corrected_m += abs(range_m - pair.true_m)
