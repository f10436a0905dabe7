"""Joins the ranges of a session with the diagnostics of the same exchange. No I/O.

Both notifications contain the sequence number of the exchange. UCI has no checksum: after a notification was lost
or damaged, equal numbers alone do not prove that two notifications belong together.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, TypeVar

from uwb_mitigation.radios.fira.messages import Diagnostics, RangeRecord, merge

STRICT_MESSAGES = 64
"""Number of messages without losses or damage after which equal sequence numbers are sufficient again."""

ORDER_MESSAGES = 8
"""Number of pairs from which the usual order and the usual delay of the two notifications are known."""

ORDER_SHARE = 0.9
MAX_WAITING = 8
"""Maximum number of ranges, and of diagnostics, that wait for their counterpart."""

UNSUPPORTED_RANGES = 32
"""Number of ranges without diagnostics after which ranges no longer wait for them."""

SPLIT_EXCHANGES, MAX_NOTIFICATIONS = 2, 3
"""Number of exchanges with a further notification of diagnostics after which ranges wait for it; one for each frame."""

MIN_TIMEOUT_NS = 50 * 10**6
"""Minimum time that a range waits for its diagnostics while their delay is unknown; otherwise two intervals."""

SHORT_TIMEOUT_NS, DELAY_FACTOR = 5 * 10**6, 3
"""Later it waits for this multiple of the longest of the latest delays, and at least this time."""

_Content = TypeVar("_Content")


@dataclass(slots=True, eq=False)
class RangeArrival:
    """A range, the time of its arrival, and the diagnostics that were joined.

    Attributes:
        sequence: number of the exchange.
        record: the range.
        arrived_ns, stamp_ns: time of the arrival, monotonic, and on the clock of the stamps.
        diagnostics: diagnostics of the exchange; None = they have not arrived.
        is_complete: the range does not wait for diagnostics any more.
    """

    sequence: int
    record: RangeRecord
    arrived_ns: int
    stamp_ns: int
    diagnostics: Diagnostics | None = None
    is_complete: bool = False


class _Arrival(NamedTuple):
    """How a notification has arrived.

    Attributes:
        arrived_ns: time of arrival.
        gap_ns: time since the message before it.
        adjacent: the message before it is its counterpart.
        strict: notifications were lost or damaged shortly before.
        follows: the message before it belongs to the previous exchange.
        damages: number of damaged places in the stream before it.
    """

    arrived_ns: int
    gap_ns: int
    adjacent: bool
    strict: bool
    follows: bool
    damages: int


@dataclass(frozen=True, slots=True)
class _Waiting(Generic[_Content]):
    """A content whose counterpart has not arrived, from a number of notifications."""

    content: _Content
    arrival: _Arrival
    notifications: int = 1


class DiagnosticsMatcher:
    """Joins the notifications of one session with one peer, in any order.

    After losses or damage, two notifications are joined only if they arrived one after the other, after a notification
    of the previous exchange, and either at nearly the same time, or in the order that is usual for the board without
    damage between them. A single damaged sequence number then cannot join notifications of different exchanges.
    A board may report the diagnostics of an exchange in several notifications.

    Args:
        interval_ns: time between two exchanges.

    Attributes:
        counts: number of ranges that were `joined`, of ranges `without_diagnostics`, of `refused` pairs whose sequence
            numbers may be damaged, and of `gaps` in the sequence.
    """

    def __init__(self, interval_ns: int) -> None:
        self.counts = Counter(joined=0, without_diagnostics=0, refused=0, gaps=0)
        self._interval_ns = interval_ns
        self._max_timeout_ns = max(2 * interval_ns, MIN_TIMEOUT_NS)
        self._delays_ns: deque[int] = deque(maxlen=32)
        self._expired_ns: dict[int, int] = {}
        self._ranges: dict[int, _Waiting[RangeArrival]] = {}
        self._diagnostics: dict[int, _Waiting[Diagnostics]] = {}
        self._incomplete: dict[int, tuple[int, RangeArrival, Diagnostics, int]] = {}
        self._expected_notifications, self._further = 1, 0
        self._completed: int | None = None
        self._step, self._is_step_known = 1, False
        self._steps = (1, 0)
        self._latest: tuple[bool, int] | None = None
        self._latest_ns = 0
        self._latest_sequences: dict[bool, int] = {}
        self._range_first: Counter[bool] = Counter()
        self._damages = 0
        self._strict = 0
        self._unanswered = 0

    def add_range(self, arrival: RangeArrival, damages: int, now_ns: int) -> None:
        """Add a range; it becomes complete at once, with its diagnostics, or in `expire`.

        Args:
            arrival: the range.
            damages: number of damaged places in the stream so far.
            now_ns: time of the arrival.
        """
        sequence = arrival.sequence
        observed = self._observe(True, sequence, damages, now_ns)
        waiting = self._diagnostics.pop(sequence, None)
        if waiting is not None:
            diagnostics = (
                waiting.content if self._accept(waiting.arrival, observed, range_first=False) else None
            )
            self._complete(arrival, diagnostics, waiting.notifications, now_ns)
        elif self._unanswered < UNSUPPORTED_RANGES and sequence not in self._ranges:
            self._ranges[sequence] = _Waiting(arrival, observed)
        else:
            self._finish(arrival, None)
        self.expire(now_ns)

    def add_diagnostics(self, diagnostics: Diagnostics, damages: int, now_ns: int) -> None:
        """Add diagnostics; see `add_range`."""
        sequence = diagnostics.sequence
        observed = self._observe(False, sequence, damages, now_ns)
        strict, self._unanswered = observed.strict, 0
        if (incomplete := self._incomplete.pop(sequence, None)) is not None:
            since_ns, arrival, first, notifications = incomplete
            self._delays_ns.append(now_ns - since_ns)
            merged = first if strict else merge(first, diagnostics)
            self._complete(arrival, merged, notifications + 1, now_ns)
        elif (waiting := self._ranges.pop(sequence, None)) is not None:
            accepted = self._accept(waiting.arrival, observed, range_first=True)
            self._delays_ns.append(now_ns - waiting.arrival.arrived_ns)
            self._complete(waiting.content, diagnostics if accepted else None, 1, now_ns)
        else:
            arrived = _Waiting(diagnostics, observed)
            if (expired_ns := self._expired_ns.pop(sequence, None)) is not None:
                self._delays_ns.append(now_ns - expired_ns)
            if sequence == self._completed and not strict:
                self._further += 1
                if self._further >= SPLIT_EXCHANGES:
                    self._expected_notifications = min(self._expected_notifications + 1, MAX_NOTIFICATIONS)
                    self._further = 0
            elif (before := self._diagnostics.get(sequence)) is not None and not strict:
                merged = merge(before.content, diagnostics)
                arrived = replace(before, content=merged, notifications=before.notifications + 1)
            self._diagnostics[sequence] = arrived
        self.expire(now_ns)

    def expire(self, now_ns: int) -> None:
        """Complete the ranges that have waited too long for their diagnostics."""
        for sequence, old in list(self._diagnostics.items()):
            if now_ns - old.arrival.arrived_ns > self._max_timeout_ns or len(self._diagnostics) > MAX_WAITING:
                del self._diagnostics[sequence]
        timeout_ns = self._timeout_ns()
        for sequence, (since_ns, arrival, diagnostics, _) in list(self._incomplete.items()):
            if now_ns - since_ns > timeout_ns or len(self._incomplete) > MAX_WAITING:
                del self._incomplete[sequence]
                self._expected_notifications = max(self._expected_notifications - 1, 1)
                self._finish(arrival, diagnostics)
        for sequence, waiting in list(self._ranges.items()):
            if now_ns - waiting.arrival.arrived_ns > timeout_ns or len(self._ranges) > MAX_WAITING:
                del self._ranges[sequence]
                self._unanswered += 1
                self._expired_ns[sequence] = waiting.arrival.arrived_ns
                if len(self._expired_ns) > MAX_WAITING:
                    del self._expired_ns[next(iter(self._expired_ns))]
                self._finish(waiting.content, None)

    def _timeout_ns(self) -> int:
        """Return how long a range waits: a multiple of the usual delay of the diagnostics once that is known."""
        if len(self._delays_ns) < ORDER_MESSAGES:
            return self._max_timeout_ns
        return min(max(DELAY_FACTOR * max(self._delays_ns), SHORT_TIMEOUT_NS), self._max_timeout_ns)

    def _observe(self, is_range: bool, sequence: int, damages: int, now_ns: int) -> _Arrival:
        before = self._latest_sequences.get(is_range)
        second = not is_range and sequence == before
        if is_range and before is not None:
            # Sessions may share a counter: learn the step between the exchanges of this session.
            step, count = self._steps
            self._steps = (step, count + 1) if sequence - before == step else (sequence - before, 1)
            if self._steps[1] >= ORDER_MESSAGES and self._steps[0] > 0:
                self._step, self._is_step_known = self._steps[0], True
        gap = before is not None and sequence != before + self._step and not second
        self.counts["gaps"] += gap and self._is_step_known
        if gap or damages != self._damages:
            self._strict = STRICT_MESSAGES
        elif self._strict:
            self._strict -= 1
        latest, self._latest = self._latest, (is_range, sequence)
        gap_ns, self._latest_ns = now_ns - self._latest_ns, now_ns
        self._latest_sequences[is_range], self._damages = sequence, damages
        adjacent = latest == (not is_range, sequence) and not second
        if adjacent:
            self._range_first[not is_range] += 1
        follows = latest is not None and latest[1] == sequence - self._step
        return _Arrival(now_ns, gap_ns, adjacent, self._strict > 0, follows, damages)

    def _accept(self, first: _Arrival, second: _Arrival, *, range_first: bool) -> bool:
        """Return whether two notifications with one sequence number belong together."""
        pairs = self._range_first.total()
        usual = pairs >= ORDER_MESSAGES and self._range_first[range_first] >= ORDER_SHARE * pairs
        simultaneous = 2 * second.gap_ns < min(first.gap_ns, self._interval_ns)
        is_likely = simultaneous or (usual and first.damages == second.damages)
        accepted = not (first.strict or second.strict) or (second.adjacent and first.follows and is_likely)
        self.counts["refused"] += not accepted
        return accepted

    def _complete(
        self, arrival: RangeArrival, diagnostics: Diagnostics | None, notifications: int, now_ns: int
    ) -> None:
        """Complete a range, or keep it until the last notification of its diagnostics."""
        if diagnostics is not None and notifications < self._expected_notifications:
            self._incomplete[arrival.sequence] = now_ns, arrival, diagnostics, notifications
        else:
            self._finish(arrival, diagnostics)

    def _finish(self, arrival: RangeArrival, diagnostics: Diagnostics | None) -> None:
        if diagnostics is not None:
            self._completed = arrival.sequence
        self.counts["joined" if diagnostics is not None else "without_diagnostics"] += 1
        arrival.diagnostics, arrival.is_complete = diagnostics, True
