"""How well the mitigator is doing: what it counts of every range, and the levels that follow. No ROS here."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable
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
UNCOUNTED = Threshold(
    "share of ranges without the preamble count that the model needs",
    0.2,
    "many CIRs have no preamble count, and this model needs it: set model to universal_amplitude",
)
DROPPED = Threshold("share of ranges dropped", 0.0, "ranges were dropped: the queue was too short")
SLOW = Threshold("p99 of the processing time, ms", 20.0, "correcting takes long: the processor is overloaded")
SILENT = Threshold("s without a range", 5.0, "no ranges arrive")
OFFSET = Threshold(
    "size of the median predicted error of ranges that look like line of sight, m",
    0.15,
    "the model takes much off ranges that look like line of sight: it holds other boards' offset",
)

MOST_DIRECT = 1000
FEWEST_DIRECT = 200
"""The latest ranges that look like line of sight, and how many say something: the place counts less over many."""


@dataclass(frozen=True, slots=True)
class Period:
    """What happened since the last time it was asked.

    Attributes:
        statuses: ranges by status.
        dropped: ranges that a queue has dropped.
        processing_ns: from taking a range to having published it, for each.
        silent_s: since the last range.
        uncounted: ranges whose CIR lacks the preamble count that the model needs.
        direct_ranges: of the latest ranges, not only of the period, those that look like line of sight.
        direct_m: their median predicted error, beside the radios' offset; NaN without any.
        predicts_excess_alone: whether that ought to be near 0.
    """

    statuses: Counter[Status]
    dropped: int
    processing_ns: list[int]
    silent_s: float
    uncounted: int = 0
    direct_ranges: int = 0
    direct_m: float = math.nan
    predicts_excess_alone: bool = False

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
            UNUSABLE: self.share(Status.NO_CIR, Status.BAD_CIR) - self.uncounted / max(self.total, 1),
            UNCOUNTED: self.uncounted / max(self.total, 1),
            DROPPED: self.dropped / max(self.total + self.dropped, 1),
            SLOW: _p99(self.processing_ns) / 1e6,
            SILENT: self.silent_s,
            OFFSET: abs(self.direct_m)
            if self.predicts_excess_alone and self.direct_ranges >= FEWEST_DIRECT
            else 0.0,
        }
        return [threshold.text for threshold, value in values.items() if value > threshold.limit]


NOT_NUMBERED = 2**64 - 1
"""What rmw has for a number where the middleware gives none (RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED)."""


class Numbering:
    """Finds what was dropped, by the numbers that each publisher gives its messages.

    A queue that keeps the last ones drops the others without a word. Messages do not say whose they are: a
    number that follows on one that was seen belongs to its publisher; one that follows on none begins a new
    publisher where there are more than were heard, and is otherwise a gap behind the nearest number below it.
    Which publisher a gap is counted for may be wrong, but not how much is missing in all.

    Args:
        publishers: how many there are; asked only when a number follows on none.

    Attributes:
        missing: numbers that never came.
        told: False once a message came without a number.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        self.missing = 0
        self.told = True
        self._publishers = publishers
        # The last number of each publisher, that of the one heard last at the end.
        self._last: list[int] = []

    def add(self, number: int) -> None:
        """Note a message."""
        last = self._last
        if last and last[-1] == number - 1:
            last[-1] = number
        elif number == NOT_NUMBERED:
            self.told = False
        elif number - 1 in last:
            last.remove(number - 1)
            last.append(number)
        else:
            self._add_stranger(number)

    def _add_stranger(self, number: int) -> None:
        known = self._publishers()
        before = [last for last in self._last if last < number]
        if len(self._last) < known or not before:
            # It has joined or started anew; of those that are gone, the one unheard the longest goes.
            self._last.append(number)
            del self._last[: max(len(self._last) - max(known, 1), 0)]
            return
        nearest = max(before)
        self.missing += number - nearest - 1
        self._last.remove(nearest)
        self._last.append(number)


class MitigatorHealth:
    """Counts ranges. One thread adds, another asks.

    Args:
        publishers: how many publish ranges now.
        now_s: a steady clock.

    Attributes:
        statuses: ranges by status, since the start.
        lost: ranges that the middleware says it has lost: the publisher's queue was too short.
        numbering: finds those, and what the subscription's own queue has dropped.
        malformed: messages that could not be read at all.
        uncounted: ranges whose CIR lacks the preamble count that the model needs, since the last period.
        direct_m: predicted errors of the latest ranges that look like line of sight, beside the radios' offset.
        predicts_excess_alone: see `Period`.
    """

    def __init__(
        self, publishers: Callable[[], int] = lambda: 1, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.statuses: Counter[Status] = Counter()
        self.lost = 0
        self.numbering = Numbering(publishers)
        self.malformed = 0
        self.uncounted = 0
        self.direct_m: deque[float] = deque(maxlen=MOST_DIRECT)
        self.predicts_excess_alone = False
        self._processing_ns: deque[int] = deque(maxlen=20_000)
        self._now_s = now_s
        self._last_s = now_s()
        self._before: tuple[Counter[Status], int] = (Counter(), 0)

    @property
    def dropped(self) -> int:
        """Ranges that a queue has dropped, as far as can be told."""
        return max(self.lost, self.numbering.missing)

    @property
    def dropped_text(self) -> str:
        """The same for a person: a middleware that numbers no messages hides what its queues drop."""
        if self.numbering.told:
            return str(self.dropped)
        return f"{self.dropped} told by the middleware; the rest cannot be told here"

    def add_time(self, processing_ns: int) -> None:
        """Note how long a range, or each of a batch, took."""
        self._processing_ns.append(processing_ns)
        self._last_s = self._now_s()

    def period(self) -> Period:
        """Begin a new period, and return the one that ends."""
        statuses, dropped = self.statuses.copy(), self.dropped
        before, dropped_before = self._before
        self._before = statuses, dropped
        times = [self._processing_ns.popleft() for _ in range(len(self._processing_ns))]
        direct = self.direct_m.copy()
        uncounted, self.uncounted = self.uncounted, 0
        return Period(
            statuses - before,
            dropped - dropped_before,
            times,
            self._now_s() - self._last_s,
            uncounted,
            len(direct),
            statistics.median(direct) if direct else math.nan,
            self.predicts_excess_alone,
        )


def _p99(values: list[int]) -> float:
    return sorted(values)[int(0.99 * (len(values) - 1))] if values else 0.0
