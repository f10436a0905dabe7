"""How well the mitigator is doing: what it counts of every range, and the levels that follow. No ROS here."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass

from uwb_mitigation.measurement import Status


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
DROPPED = Threshold("share of ranges dropped", 0.0, "ranges were dropped: the queue was too short")
SLOW = Threshold("p99 of the processing time, ms", 20.0, "correcting takes long: the processor is overloaded")
SILENT = Threshold("s without a range", 5.0, "no ranges arrive")
THRESHOLDS = (OUT_OF_DISTRIBUTION, UNUSABLE, DROPPED, SLOW, SILENT)


@dataclass(frozen=True, slots=True)
class Period:
    """What happened since the last time it was asked.

    Attributes:
        statuses: ranges by status.
        dropped: ranges that a queue has dropped.
        processing_ns: from taking a range to having published it, for each.
        silent_s: since the last range.
    """

    statuses: Counter[Status]
    dropped: int
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
            DROPPED: self.dropped / max(self.total + self.dropped, 1),
            SLOW: _p99(self.processing_ns) / 1e6,
            SILENT: self.silent_s,
        }
        return [threshold.text for threshold, value in values.items() if value > threshold.limit]


class Numbering:
    """Finds what was dropped, by the numbers that a publisher gives its messages.

    A queue that keeps the last ones drops the others without a word. Not every message comes with its
    number; a gap is what is left of a step once those in between are counted.

    Attributes:
        missing: numbers that never came.
    """

    def __init__(self) -> None:
        self.missing = 0
        self._last: int | None = None
        self._between = 0

    def add(self) -> None:
        """Note a message whose number is not known."""
        self._between += 1

    def add_number(self, number: int) -> None:
        """Note a message with its number."""
        if self._last is not None:
            # A publisher that has started anew counts from 1 again.
            self.missing += max(number - self._last - 1 - self._between, 0)
        self._last, self._between = number, 0

    def restart(self) -> None:
        """Forget the number of the last message: the publishers have changed, or are several."""
        self._last, self._between = None, 0


class Health:
    """Counts ranges. One thread adds, another asks.

    Attributes:
        statuses: ranges by status, since the start.
        lost: ranges that the middleware says it has lost: the publisher's queue was too short.
        numbering: finds those, and what the subscription's own queue has dropped.
        malformed: messages that could not be read at all.
    """

    def __init__(self) -> None:
        self.statuses: Counter[Status] = Counter()
        self.lost = 0
        self.numbering = Numbering()
        self.malformed = 0
        self._processing_ns: deque[int] = deque(maxlen=20_000)
        self._last_s = time.monotonic()
        self._before: tuple[Counter[Status], int] = (Counter(), 0)

    @property
    def dropped(self) -> int:
        """Ranges that a queue has dropped, as far as can be told."""
        return max(self.lost, self.numbering.missing)

    def add_time(self, processing_ns: int) -> None:
        """Note how long a range, or each of a batch, took."""
        self._processing_ns.append(processing_ns)
        self._last_s = time.monotonic()

    def period(self) -> Period:
        """Begin a new period, and return the one that ends."""
        statuses, dropped = self.statuses.copy(), self.dropped
        before, dropped_before = self._before
        self._before = statuses, dropped
        times = [self._processing_ns.popleft() for _ in range(len(self._processing_ns))]
        return Period(statuses - before, dropped - dropped_before, times, time.monotonic() - self._last_s)


def _p99(values: list[int]) -> float:
    return sorted(values)[int(0.99 * (len(values) - 1))] if values else 0.0
