"""The clock that paces a replay."""

from __future__ import annotations

import time

from rclpy.clock import Clock, ClockType

from uwb_mitigation.nodes.support.lifecycle import clock_reader

MAX_INTERRUPTION_NS = 1_000_000
"""Maximum time between the readings of two clocks that are compared."""


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
        """Convert a time of the replay clock to the node's clock; intervals are the same on both.

        If the node's clock is set during the replay, the stamps stay on the old time.
        """
        if self._simulated:
            return replay_ns
        while self._offset_ns is None:
            before_ns = time.monotonic_ns()
            offset_ns = self._stamp_now_ns() - before_ns
            # The process may be interrupted between the two readings.
            if time.monotonic_ns() - before_ns <= MAX_INTERRUPTION_NS:
                self._offset_ns = offset_ns
        return replay_ns + self._offset_ns

    @property
    def _simulated(self) -> bool:
        return self._clock.clock_type == ClockType.ROS_TIME and bool(self._clock.ros_time_is_active)
