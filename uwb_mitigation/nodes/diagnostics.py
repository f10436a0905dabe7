"""What a node tells `/diagnostics`: one status, its level chosen by the node, its facts as text."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping

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
        name=f"{node.get_fully_qualified_name().lstrip('/')}: ranges",
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in facts.items()],
    )
    array = DiagnosticArray(status=[status])
    array.header.stamp = node.get_clock().now().to_msg()
    return array


class Meter:
    """Rate and latency of what passes, over the time since it was last asked."""

    def __init__(self) -> None:
        # Appending and clearing a deque are atomic: one thread adds, another asks.
        self._latencies_ns: deque[int] = deque(maxlen=20_000)
        self._since_s = time.monotonic()

    def add(self, latency_ns: int) -> None:
        self._latencies_ns.append(latency_ns)

    def facts(self) -> dict[str, object]:
        """Rate, and percentiles of the latency where anything passed; begins a new period."""
        latencies = [self._latencies_ns.popleft() for _ in range(len(self._latencies_ns))]
        now_s = time.monotonic()
        period_s, self._since_s = now_s - self._since_s, now_s
        facts: dict[str, object] = {"rate Hz": f"{len(latencies) / max(period_s, 1e-9):.1f}"}
        if latencies:
            p50, p99 = np.percentile(latencies, (50, 99)) / 1e6
            facts |= {"latency p50 ms": f"{p50:.3f}", "latency p99 ms": f"{p99:.3f}"}
        return facts
