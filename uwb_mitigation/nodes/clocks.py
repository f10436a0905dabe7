"""Reads ROS clocks cheaply: rclpy takes several times as long as the system to say the same."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.clock import Clock, ClockType


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
