"""The clock that paces a replay."""

from __future__ import annotations

import time

from rclpy.clock import Clock, ClockType

from uwb_mitigation.nodes.support.lifecycle import clock_reader

CLOCK_STEP_NS = 1_000_000
"""If the node's clock shifts by more than this relative to the steady clock, it was set, and stamps follow it."""


class ReplayClock:
    """The clock that paces a replay, and its stamps on a node's clock.

    This is simulated time if it is active, else a steady clock: setting the system clock does not affect the replay.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._stamp_now_ns = clock_reader(clock)
        self._offset_ns: int | None = None

    def now_ns(self) -> int:
        """Return the time of the replay clock."""
        return self._stamp_now_ns() if self._simulated else time.monotonic_ns()

    def stamp_ns(self, replay_ns: int) -> int:
        """Convert a time of the replay clock to the node's clock; intervals are the same on both."""
        if self._simulated:
            return replay_ns
        offset_ns, uncertainty_ns = self._read_both()
        while self._offset_ns is None and uncertainty_ns > CLOCK_STEP_NS:
            offset_ns, uncertainty_ns = self._read_both()
        if self._offset_ns is None or abs(offset_ns - self._offset_ns) > CLOCK_STEP_NS + uncertainty_ns:
            self._offset_ns = offset_ns
        return replay_ns + self._offset_ns

    def _read_both(self) -> tuple[int, int]:
        """Return the offset of the node's clock to the steady clock, and its uncertainty, ns.

        The uncertainty distinguishes an interruption of the process between the two readings from a clock that was set.
        """
        before_ns = time.monotonic_ns()
        offset_ns = self._stamp_now_ns() - before_ns
        return offset_ns, time.monotonic_ns() - before_ns

    @property
    def _simulated(self) -> bool:
        return self._clock.clock_type == ClockType.ROS_TIME and bool(self._clock.ros_time_is_active)
