"""What a node tells `/diagnostics`: one status, its level chosen by the node, its facts as text."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR


def report(
    node: Node, hardware_id: str, level: bytes, message: str, facts: Mapping[str, object]
) -> DiagnosticArray:
    """The message of one status, stamped on the node's clock and named after the node."""
    status = DiagnosticStatus(
        level=level,
        name=name_of(node),
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in facts.items()],
    )
    array = DiagnosticArray(status=[status])
    array.header.stamp = node.get_clock().now().to_msg()
    return array


def name_of(node: Node) -> str:
    """Return the name of the node's status."""
    return f"{node.get_fully_qualified_name().lstrip('/')}: ranges"


def percentiles(name: str, values_ns: list[int]) -> dict[str, object]:
    """Facts `NAME p50 ms` and `NAME p99 ms`; none without values."""
    if not values_ns:
        return {}
    p50, p99 = np.percentile(values_ns, (50, 99)) / 1e6
    return {f"{name} p50 ms": f"{p50:.3f}", f"{name} p99 ms": f"{p99:.3f}"}


def model_id(identity: int) -> str:
    """As the tools print it, in hexadecimal, and as `ros2 topic echo` does."""
    return f"{identity:08x} ({identity})"


class Meter:
    """Rate and latency of what passes, over the time since it was last asked.

    Args:
        now_ns: the clock that the rate is counted on, the node's: ranges that a recording plays at ten
            times its speed come at ten times their rate only by a clock that is not simulated.
    """

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        # Appending and clearing a deque are atomic: one thread adds, another asks.
        self._latencies_ns: deque[int] = deque(maxlen=20_000)
        self._now_ns = now_ns
        self._since_ns = now_ns()
        self._passed = self._reported = 0

    def add(self, latency_ns: int) -> None:
        self._latencies_ns.append(latency_ns)
        self._passed += 1

    def facts(self) -> dict[str, object]:
        """Rate, and percentiles of the latency where anything passed; begins a new period."""
        latencies = [self._latencies_ns.popleft() for _ in range(len(self._latencies_ns))]
        now_ns = self._now_ns()
        period_s, self._since_ns = (now_ns - self._since_ns) / 1e9, now_ns
        passed, self._reported = self._passed - self._reported, self._passed
        # A simulated clock may stand still, or jump back when a recording starts over.
        rate = f"{passed / period_s:.1f}" if period_s > 0 else "unknown"
        return {"rate Hz": rate} | percentiles("latency", latencies)
