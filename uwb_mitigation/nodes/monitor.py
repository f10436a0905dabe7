"""The node `monitor`: shows raw and corrected ranges live in the terminal, and a summary at the end."""

from __future__ import annotations

import math
import threading
import time

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.measurement import Status
from uwb_mitigation.nodes import topics
from uwb_mitigation.nodes.messages import NANOSECONDS, key_of
from uwb_mitigation.nodes.running import spin
from uwb_mitigation.nodes.tally import Tally

REFRESH_HZ = 5


class Monitor(Node):
    """Feeds a tally from the three range topics."""

    def __init__(self) -> None:
        super().__init__("monitor")
        self.tally = Tally()
        self.create_subscription(RangeTruth, topics.RANGE_TRUTH, self._on_truth, topics.RANGES)
        self.create_subscription(RangeCir, topics.RANGE_RAW, self._on_raw, topics.RANGES)
        self.create_subscription(RangeCorrected, topics.RANGE_CORRECTED, self._on_corrected, topics.RANGES)

    def _on_raw(self, message: RangeCir) -> None:
        self.tally.add_raw()

    def _on_truth(self, message: RangeTruth) -> None:
        self.tally.add_truth(key_of(message), message.range, message.label)

    def _on_corrected(self, message: RangeCorrected) -> None:
        now_ns = self.get_clock().now().nanoseconds
        stamp = message.header.stamp
        self.tally.add_corrected(
            key_of(message),
            (message.anchor_id, message.tag_id),
            arrival_s=now_ns / NANOSECONDS,
            latency_s=(now_ns - stamp.sec * NANOSECONDS - stamp.nanosec) / NANOSECONDS,
            range_raw_m=message.range_raw,
            range_m=message.range,
            variance_m2=message.variance,
            status=Status(message.status),
        )


def metres(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


def short_id(identity: int) -> str:
    """Small ids as they are; EUI-64 addresses by their last four digits."""
    return str(identity) if identity < 1_000_000 else f"...{identity & 0xFFFF:04x}"


def live_table(tally: Tally, title: str) -> Table:
    """One row for each anchor-tag pair."""
    table = Table(title=title, title_justify="left")
    for column in (
        "anchor",
        "tag",
        "Hz",
        "raw",
        "corrected",
        "sigma",
        "true",
        "status",
        "label",
    ):
        table.add_column(column, justify="left" if column in ("status", "label") else "right")
    for (anchor, tag), pair in sorted(tally.pairs.copy().items()):
        style = "green" if pair.status is Status.OK else "yellow"
        table.add_row(
            short_id(anchor),
            short_id(tag),
            f"{pair.rate_hz:.1f}" if math.isfinite(pair.rate_hz) else "-",
            metres(pair.range_raw_m),
            metres(pair.range_m),
            metres(pair.sigma_m),
            metres(pair.true_m),
            Text(pair.status.name, style=style),
            pair.label,
        )
    return table


def summary(tally: Tally) -> Group:
    """Counts, latency, and mean absolute errors where the truth is known."""
    statuses = ", ".join(
        f"{tally.statuses[status]} {status.name}" for status in Status if tally.statuses[status]
    )
    lines: list[Text | Table] = [
        Text(),
        Text(f"{tally.raw} ranges received, {tally.corrected} corrected ({statuses}), {tally.missing} lost"),
        Text(
            "latency from stamp to corrected range: "
            f"p50 {tally.latency_ms(50):.2f} ms, p99 {tally.latency_ms(99):.2f} ms"
        ),
    ]
    if tally.errors:
        table = Table(title="mean absolute error, m", title_justify="left")
        for column in ("label", "ranges", "raw MAE", "corrected MAE", "ratio"):
            table.add_column(column, justify="left" if column == "label" else "right")
        for label, errors in [*sorted(tally.errors.items()), ("all", tally.total)]:
            if label == "all":
                table.add_section()
            ratio = errors.corrected_m / errors.raw_m if errors.raw_m else math.nan
            table.add_row(
                label or "-",
                str(errors.n),
                f"{errors.raw_m / errors.n:.3f}",
                f"{errors.corrected_m / errors.n:.3f}",
                f"{ratio:.2f}",
            )
        lines.append(table)
    return Group(*lines)


def main() -> None:
    """Show what passes on the topics until Ctrl-C."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Monitor()
    stop = threading.Event()
    # The screen is drawn by this thread, messages are counted by another.
    thread = threading.Thread(target=spin, args=(node, stop), daemon=True)
    thread.start()
    console = Console()
    try:
        with Live(console=console, refresh_per_second=REFRESH_HZ) as live:
            while True:
                live.update(live_table(node.tally, "UWB ranges"))
                time.sleep(1 / REFRESH_HZ)
    except KeyboardInterrupt:
        pass
    stop.set()
    thread.join()
    console.print(summary(node.tally))
    node.destroy_node()
    rclpy.try_shutdown()
