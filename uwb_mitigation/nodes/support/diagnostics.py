"""Diagnostics of the nodes: the message, rate and latency."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from uwb_mitigation.types.stamps import NS_PER_S

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR

Description = tuple[str, bytes, str, dict[str, object]]
"""Hardware id, level, message and values of a diagnostic status."""

NAME_END = ": ranges"
"""End of the name of a status of this package, after the name of the node."""

MAX_LATENCIES = 20_000
"""Number of latencies that are kept."""


def diagnostic_array(
    node: Node, hardware_id: str, level: bytes, message: str, entries: Mapping[str, object]
) -> DiagnosticArray:
    """Return a message with one status, stamped on the node's clock and named after the node."""
    status = DiagnosticStatus(
        level=level,
        name=f"{node.get_fully_qualified_name().lstrip('/')}{NAME_END}",
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in entries.items()],
    )
    array = DiagnosticArray(status=[status])
    array.header.stamp = node.get_clock().now().to_msg()
    return array


def percentiles(name: str, values_ns: list[int]) -> dict[str, object]:
    """Return the values `NAME p50 ms` and `NAME p99 ms`; empty without data."""
    if not values_ns:
        return {}
    p50, p99 = np.percentile(values_ns, (50, 99)) / 1e6
    return {f"{name} p50 ms": f"{p50:.3f}", f"{name} p99 ms": f"{p99:.3f}"}


def model_id(identity: int) -> str:
    """Return a model id in hexadecimal, as the tools print it, and in decimal, as `ros2 topic echo` does."""
    return f"{identity:08x} ({identity})"


class RateMonitor:
    """Rate and latency since the previous call of `entries`.

    Args:
        now_ns: the node's clock, ns. If it is simulated, the rate is that of the recording.
    """

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        # deque.append and popleft are atomic: one thread adds, another reads.
        self._latencies_ns: deque[int] = deque(maxlen=MAX_LATENCIES)
        self._now_ns = now_ns
        self._since_ns = now_ns()
        self._passed = self._reported = 0

    def add(self, latency_ns: int) -> None:
        self._latencies_ns.append(latency_ns)
        self._passed += 1

    def entries(self) -> dict[str, object]:
        """Return rate and percentiles of the latency, and begin a new period."""
        now_ns = self._now_ns()
        period_s, self._since_ns = (now_ns - self._since_ns) / NS_PER_S, now_ns
        passed, self._reported = self._passed - self._reported, self._passed
        # A simulated clock may pause, or jump back when a recording restarts.
        rate = f"{passed / period_s:.1f}" if period_s > 0 else "unknown"
        return {"rate Hz": rate} | percentiles("latency", drain(self._latencies_ns))


def drain(values: deque[int]) -> list[int]:
    """Remove and return all values; another thread may append meanwhile."""
    return [values.popleft() for _ in range(len(values))]
