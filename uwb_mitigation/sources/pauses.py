"""Recordings made playable: long pauses are cut, and what bears no date begins on a given one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.measurement import Record

FIRST_DATE_NS = 946_684_800 * 10**9
"""2000-01-01T00:00:00Z: stamps before it are of a clock that knows no date."""


@dataclass(slots=True)
class Pauses:
    """Moves the stamps of records that come one after the other; ranges, ids and `device_time` stay.

    Attributes:
        longest_s: what is longer is cut to this; infinite = nothing is cut.
        start_ns: where records without a date begin.
        cut: how many pauses were cut.
        cut_s: how much in all.
    """

    longest_s: float
    start_ns: int
    cut: int = 0
    cut_s: float = 0.0
    _last_ns: int | None = field(default=None, init=False)
    _shift_ns: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if not self.longest_s >= 0:
            raise ParameterError(f"longest pause = {self.longest_s} s", valid="0 or more; inf cuts none")

    def without(self, record: Record) -> Record:
        """The record at its new time."""
        stamp_ns = record.measurement.stamp_ns
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if stamp_ns < FIRST_DATE_NS and (last_ns is None or last_ns >= FIRST_DATE_NS):
            # Behind what has a date, what has none goes on.
            start_ns = self.start_ns if last_ns is None else last_ns + self._shift_ns
            self._shift_ns = start_ns - stamp_ns
        elif last_ns is not None and stamp_ns - last_ns > self.longest_s * 1e9:
            excess_ns = stamp_ns - last_ns - round(self.longest_s * 1e9)
            self._shift_ns -= excess_ns
            self.cut += 1
            self.cut_s += excess_ns / 1e9
        if self._shift_ns == 0:
            return record
        return replace(record, measurement=replace(record.measurement, stamp_ns=stamp_ns + self._shift_ns))
