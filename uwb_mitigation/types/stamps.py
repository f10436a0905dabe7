"""Time stamps: integer nanoseconds, since 1970 if they are those of a clock."""

from __future__ import annotations

from typing import Any

NS_PER_S = 1_000_000_000
"""Nanoseconds per second."""

FIRST_DATE_NS = 946_684_800 * NS_PER_S
"""2000-01-01T00:00:00Z: earlier stamps come from a clock without a date."""


def to_ns(stamp: Any) -> int:
    """Return the time of a `builtin_interfaces/Time`, ns."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
