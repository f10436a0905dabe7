"""Joins the ranges of a session with the diagnostics of the same exchange. No I/O.

Both notifications contain the sequence number of the exchange. UCI has no checksum: after a notification was lost
or damaged, equal numbers alone do not prove that two notifications belong together.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from uwb_mitigation.radios.fira.messages import Diagnostics, RangeRecord, merge

STRICT_MESSAGES = 64
"""Number of messages without losses or damage after which equal sequence numbers are sufficient again."""

ORDER_MESSAGES = 8
"""Number of pairs from which the usual order of the two notifications is known."""

ORDER_SHARE = 0.9
MAX_WAITING = 8
"""Maximum number of ranges, and of diagnostics, that wait for their counterpart."""

UNSUPPORTED_RANGES = 32
"""Number of ranges without diagnostics after which ranges no longer wait for them."""

SPLIT_EXCHANGES, MAX_PARTS = 2, 3
"""Number of exchanges with a further notification of diagnostics after which ranges wait for it; one for each frame."""

MIN_TIMEOUT_NS = 50 * 10**6
"""Minimum time that a range waits for its diagnostics; otherwise two intervals."""

_Content = TypeVar("_Content")


@dataclass(frozen=True, slots=True)
class RangeArrival:
    """A range and the time of its arrival on the clock of the stamps."""

    record: RangeRecord
    stamp_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class MatchedRange:
    """A range with the diagnostics of its exchange; None = they were lost."""

    sequence: int
    arrival: RangeArrival
    diagnostics: Diagnostics | None


@dataclass(frozen=True, slots=True)
class _Waiting(Generic[_Content]):
    """A notification whose counterpart has not arrived.

    Attributes:
        at_ns: time of arrival.
        gap_ns: time since the message before it.
        strict: notifications were lost or damaged shortly before.
        follows: the message before it belongs to the previous exchange.
        damages: number of damaged places in the stream before it.
        parts: number of notifications in the content.
    """

    content: _Content
    at_ns: int
    gap_ns: int
    strict: bool
    follows: bool
    damages: int
    parts: int = 1


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
        self._timeout_ns = max(2 * interval_ns, MIN_TIMEOUT_NS)
        self._ranges: dict[int, _Waiting[RangeArrival]] = {}
        self._diagnostics: dict[int, _Waiting[Diagnostics]] = {}
        self._held: dict[int, tuple[int, RangeArrival, Diagnostics, int]] = {}
        self._parts, self._further = 1, 0
        self._completed: int | None = None
        self._step = 1
        self._steps = (1, 0)
        self._latest: tuple[bool, int] | None = None
        self._latest_ns = 0
        self._latest_of: dict[bool, int] = {}
        self._range_first: Counter[bool] = Counter()
        self._damages = 0
        self._strict = 0
        self._unanswered = 0

    def add_range(
        self, sequence: int, arrival: RangeArrival, damages: int, now_ns: int
    ) -> list[MatchedRange]:
        """Add a range.

        Args:
            sequence: sequence number of the exchange.
            arrival: the range.
            damages: number of damaged places in the stream so far.
            now_ns: time of the arrival.

        Returns:
            Ranges that are complete, or have waited too long.
        """
        adjacent, strict, follows, gap_ns = self._observe(True, sequence, damages, now_ns)
        waiting = self._diagnostics.pop(sequence, None)
        diagnostics = None
        if waiting is not None and self._accept(
            waiting, adjacent, strict, damages, gap_ns, range_first=False
        ):
            diagnostics = waiting.content
        elif waiting is None and self._unanswered < UNSUPPORTED_RANGES and sequence not in self._ranges:
            self._ranges[sequence] = _Waiting(arrival, now_ns, gap_ns, strict, follows, damages)
            return self.expire(now_ns)
        parts = waiting.parts if waiting is not None else 0
        return [*self.expire(now_ns), *self._complete(sequence, arrival, diagnostics, parts, now_ns)]

    def add_diagnostics(self, diagnostics: Diagnostics, damages: int, now_ns: int) -> list[MatchedRange]:
        """Add diagnostics; see `add_range`."""
        sequence = diagnostics.sequence
        adjacent, strict, follows, gap_ns = self._observe(False, sequence, damages, now_ns)
        self._unanswered = 0
        if (held := self._held.pop(sequence, None)) is not None:
            _, arrival, whole, parts = held
            whole = whole if strict else merge(whole, diagnostics)
            return [*self.expire(now_ns), *self._complete(sequence, arrival, whole, parts + 1, now_ns)]
        waiting = self._ranges.pop(sequence, None)
        if waiting is None:
            arrived = _Waiting(diagnostics, now_ns, gap_ns, strict, follows, damages)
            if sequence == self._completed and not strict:
                self._further += 1
                if self._further >= SPLIT_EXCHANGES:
                    self._parts, self._further = min(self._parts + 1, MAX_PARTS), 0
            elif (before := self._diagnostics.get(sequence)) is not None and not strict:
                arrived = replace(before, content=merge(before.content, diagnostics), parts=before.parts + 1)
            self._diagnostics[sequence] = arrived
            return self.expire(now_ns)
        accepted = self._accept(waiting, adjacent, strict, damages, gap_ns, range_first=True)
        complete = self._complete(sequence, waiting.content, diagnostics if accepted else None, 1, now_ns)
        return [*self.expire(now_ns), *complete]

    def expire(self, now_ns: int) -> list[MatchedRange]:
        """Return the ranges that have waited too long for their diagnostics."""
        for sequence, old in list(self._diagnostics.items()):
            if now_ns - old.at_ns > self._timeout_ns or len(self._diagnostics) > MAX_WAITING:
                del self._diagnostics[sequence]
        expired = []
        for sequence, (at_ns, arrival, diagnostics, _) in list(self._held.items()):
            if now_ns - at_ns > self._timeout_ns or len(self._held) > MAX_WAITING:
                del self._held[sequence]
                self._parts = max(self._parts - 1, 1)
                expired.append(self._joined(sequence, arrival, diagnostics))
        for sequence, waiting in list(self._ranges.items()):
            if now_ns - waiting.at_ns > self._timeout_ns or len(self._ranges) > MAX_WAITING:
                del self._ranges[sequence]
                self._unanswered += 1
                expired.append(self._joined(sequence, waiting.content, None))
        return expired

    def _observe(
        self, is_range: bool, sequence: int, damages: int, now_ns: int
    ) -> tuple[bool, bool, bool, int]:
        """Return whether a message follows its counterpart, may be damaged, follows the previous exchange; and the gap."""
        before = self._latest_of.get(is_range)
        second = not is_range and sequence == before
        if is_range and before is not None:
            # Sessions may share a counter: learn the step between the exchanges of this session.
            step, count = self._steps
            self._steps = (step, count + 1) if sequence - before == step else (sequence - before, 1)
            if self._steps[1] >= ORDER_MESSAGES and self._steps[0] > 0:
                self._step = self._steps[0]
        gap = before is not None and sequence != before + self._step and not second
        self.counts["gaps"] += gap
        if gap or damages != self._damages:
            self._strict = STRICT_MESSAGES
        elif self._strict:
            self._strict -= 1
        latest, self._latest = self._latest, (is_range, sequence)
        gap_ns, self._latest_ns = now_ns - self._latest_ns, now_ns
        self._latest_of[is_range], self._damages = sequence, damages
        adjacent = latest == (not is_range, sequence) and not second
        if adjacent:
            self._range_first[not is_range] += 1
        return adjacent, self._strict > 0, latest is not None and latest[1] == sequence - self._step, gap_ns

    def _accept(
        self,
        waiting: _Waiting[_Content],
        adjacent: bool,
        strict: bool,
        damages: int,
        gap_ns: int,
        *,
        range_first: bool,
    ) -> bool:
        pairs = self._range_first.total()
        usual = pairs >= ORDER_MESSAGES and self._range_first[range_first] >= ORDER_SHARE * pairs
        simultaneous = 2 * gap_ns < min(waiting.gap_ns, self._interval_ns)
        accepted = not (strict or waiting.strict) or (
            adjacent and waiting.follows and (simultaneous or (usual and waiting.damages == damages))
        )
        self.counts["refused"] += not accepted
        return accepted

    def _complete(
        self, sequence: int, arrival: RangeArrival, diagnostics: Diagnostics | None, parts: int, now_ns: int
    ) -> list[MatchedRange]:
        """Return a range with its diagnostics, or keep it until their last part."""
        if diagnostics is not None and parts < self._parts:
            self._held[sequence] = now_ns, arrival, diagnostics, parts
            return []
        return [self._joined(sequence, arrival, diagnostics)]

    def _joined(self, sequence: int, arrival: RangeArrival, diagnostics: Diagnostics | None) -> MatchedRange:
        if diagnostics is not None:
            self._completed = sequence
        self.counts["joined" if diagnostics is not None else "without_diagnostics"] += 1
        return MatchedRange(sequence, arrival, diagnostics)
