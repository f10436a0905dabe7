"""Reads ROS clocks cheaply: rclpy takes several times as long as the system to say the same."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.clock import Clock, ClockType

STEP_NS = 1_000_000
"""A clock that has moved so much against the steady one was set, or has drifted: stamps go along."""


def reader(clock: Clock) -> Callable[[], int]:
    """A function that returns the clock's time, ns: from rclpy only while it is simulated."""
    if clock.clock_type == ClockType.STEADY_TIME:
        return time.monotonic_ns
    if clock.clock_type == ClockType.SYSTEM_TIME:
        return time.time_ns

    def now_ns() -> int:
        # Parameter use_sim_time may be set at any time.
        return int(clock.now().nanoseconds) if clock.ros_time_is_active else time.time_ns()

    return now_ns


class Pace:
    """Time to keep pace by, and its stamps on a node's clock.

    The pace is kept by a steady clock: one that is set must not stop a replay, or hurry it. Only simulated
    time is followed as it goes.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._stamp_now_ns = reader(clock)
        self._offset_ns: int | None = None

    def now_ns(self) -> int:
        """The time to keep pace by."""
        return self._stamp_now_ns() if self._simulated else time.monotonic_ns()

    def stamp_ns(self, pace_ns: int) -> int:
        """The time on the node's clock of a moment of the pace; moments are as far apart on both."""
        if self._simulated:
            return pace_ns
        offset_ns, unsure_ns = self._read_both()
        while self._offset_ns is None and unsure_ns > STEP_NS:
            offset_ns, unsure_ns = self._read_both()
        if self._offset_ns is None or abs(offset_ns - self._offset_ns) > STEP_NS + unsure_ns:
            self._offset_ns = offset_ns
        return pace_ns + self._offset_ns

    def _read_both(self) -> tuple[int, int]:
        """How far the node's clock is ahead of the steady one, and how far off that may be, ns.

        A process that was held up between the two readings must not take it for a clock that was set.
        """
        before_ns = time.monotonic_ns()
        offset_ns = self._stamp_now_ns() - before_ns
        return offset_ns, time.monotonic_ns() - before_ns

    @property
    def _simulated(self) -> bool:
        return self._clock.clock_type == ClockType.ROS_TIME and bool(self._clock.ros_time_is_active)
