"""How well the mitigator is doing: what it counts of every range, and the levels that follow. No ROS here."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass

from uwb_mitigation.measurement import Status

SEQUENCE_WRAP = 1 << 32
LARGEST_GAP = 1000
"""A larger step in a source's sequence is a restart or a seek, not ranges that were lost."""


@dataclass(frozen=True, slots=True)
class Threshold:
    """When the diagnostics warn.

    Attributes:
        fact: what is looked at, over the last period.
        limit: the highest value that is still OK.
        text: the message above it.
    """

    fact: str
    limit: float
    text: str


OUT_OF_DISTRIBUTION = Threshold(
    "share of ranges OUT_OF_DISTRIBUTION", 0.2, "many ranges are unlike the model's training data"
)
UNUSABLE = Threshold("share of ranges NO_CIR or BAD_CIR", 0.2, "many ranges have no usable CIR")
MISSING = Threshold("share of ranges missing or lost", 0.01, "ranges are missing: the queue is too short")
SLOW = Threshold("p99 of the processing time, ms", 20.0, "correcting takes long: the processor is overloaded")
SILENT = Threshold("s without a range", 5.0, "no ranges arrive")
THRESHOLDS = (OUT_OF_DISTRIBUTION, UNUSABLE, MISSING, SLOW, SILENT)


@dataclass(frozen=True, slots=True)
class Period:
    """What happened since the last time it was asked.

    Attributes:
        statuses: ranges by status.
        missing: ranges missing from a source's sequence, or lost by the middleware.
        processing_ns: from taking a range to having published it, for each.
        silent_s: since the last range.
    """

    statuses: Counter[Status]
    missing: int
    processing_ns: list[int]
    silent_s: float

    @property
    def total(self) -> int:
        return sum(self.statuses.values())

    def share(self, *statuses: Status) -> float:
        """The share of ranges with these statuses; 0 without any range."""
        return sum(self.statuses[status] for status in statuses) / max(self.total, 1)

    def warnings(self) -> list[str]:
        """The texts of the thresholds that are passed."""
        values = {
            OUT_OF_DISTRIBUTION: self.share(Status.OUT_OF_DISTRIBUTION),
            UNUSABLE: self.share(Status.NO_CIR, Status.BAD_CIR),
            MISSING: self.missing / max(self.total + self.missing, 1),
            SLOW: _p99(self.processing_ns) / 1e6,
            SILENT: self.silent_s,
        }
        return [threshold.text for threshold, value in values.items() if value > threshold.limit]


class Health:
    """Counts ranges. One thread adds, another asks.

    Attributes:
        statuses: ranges by status, since the start.
        missing: gaps in the sources' sequences: ranges that never came here. A source is told by its frame_id.
        lost: ranges that the middleware says it has dropped; some of them are in `missing` too.
        malformed: messages that could not be read at all.
    """

    def __init__(self) -> None:
        self.statuses: Counter[Status] = Counter()
        self.missing = 0
        self.lost = 0
        self.malformed = 0
        self._sequences: dict[str, int] = {}
        self._processing_ns: deque[int] = deque(maxlen=20_000)
        self._last_s = time.monotonic()
        self._before: tuple[Counter[Status], int] = (Counter(), 0)

    def add(self, frame_id: str, sequence: int, status: Status) -> None:
        """Count a range that was published."""
        self.statuses[status] += 1
        expected = self._sequences.get(frame_id, sequence)
        gap = (sequence - expected) % SEQUENCE_WRAP
        if 0 < gap <= LARGEST_GAP:
            self.missing += gap
        self._sequences[frame_id] = (sequence + 1) % SEQUENCE_WRAP
        if len(self._sequences) > LARGEST_GAP:
            # Frame ids that never repeat must not fill the memory.
            self._sequences.pop(next(iter(self._sequences)))

    def add_time(self, processing_ns: int) -> None:
        """Note how long a range, or each of a batch, took."""
        self._processing_ns.append(processing_ns)
        self._last_s = time.monotonic()

    def period(self) -> Period:
        """Begin a new period, and return the one that ends."""
        statuses, missing = self.statuses.copy(), max(self.missing, self.lost)
        before, missing_before = self._before
        self._before = statuses, missing
        times = [self._processing_ns.popleft() for _ in range(len(self._processing_ns))]
        return Period(statuses - before, missing - missing_before, times, time.monotonic() - self._last_s)


def _p99(values: list[int]) -> float:
    return sorted(values)[int(0.99 * (len(values) - 1))] if values else 0.0
