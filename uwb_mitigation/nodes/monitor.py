"""The node `monitor`: shows raw and corrected ranges live in the terminal, and a summary at the end."""

from __future__ import annotations

import contextlib
import math
import sys

from rclpy.context import Context
from rclpy.node import Node
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.bag.codec import decode_corrected, decode_truth
from uwb_mitigation.errors import RecordingError, UwbMitigationError, format_id
from uwb_mitigation.measurement import Status
from uwb_mitigation.nodes import topics
from uwb_mitigation.nodes.probe import watching
from uwb_mitigation.nodes.signals import stop_event
from uwb_mitigation.nodes.tally import Tally

REFRESH_HZ = 5


class Monitor(Node):
    """Feeds a tally from the three range topics."""

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("monitor", context=context)
        self.tally = Tally()
        for kind, topic, callback in (
            (RangeTruth, topics.RANGE_TRUTH, self._on_truth),
            (RangeCir, topics.RANGE_RAW, self._on_raw),
            (RangeCorrected, topics.RANGE_CORRECTED, self._on_corrected),
        ):
            self.create_subscription(kind, topic, callback, topics.RANGES, raw=True)

    def _on_raw(self, data: bytes) -> None:
        self.tally.add_raw()

    def _on_truth(self, data: bytes) -> None:
        with contextlib.suppress(RecordingError):
            self.tally.add_truth(*decode_truth(data))

    def _on_corrected(self, data: bytes) -> None:
        now_ns = self.get_clock().now().nanoseconds
        # What cannot be read is missing, and is counted as such.
        with contextlib.suppress(RecordingError):
            key, corrected = decode_corrected(data)
            pair = (key.anchor_id, key.tag_id)
            self.tally.add_corrected(key, pair, corrected, now_ns / 1e9, (now_ns - key.stamp_ns) / 1e9)


def metres(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


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
        table.add_column(
            column, justify="left" if column in ("status", "label") else "right", overflow="fold"
        )
    for (anchor, tag), history in sorted(tally.pairs.copy().items()):
        sample, rate_hz = history.samples[-1], history.rate_hz()
        table.add_row(
            format_id(anchor),
            format_id(tag),
            f"{rate_hz:.1f}" if math.isfinite(rate_hz) else "-",
            metres(sample.raw_m),
            metres(sample.range_m),
            metres(sample.sigma_m),
            metres(sample.true_m),
            Text(sample.status.name, style="green" if sample.status is Status.OK else "yellow"),
            sample.label,
        )
    return table


def summary(tally: Tally) -> Group:
    """Counts, latency, and mean absolute errors where the truth is known."""
    statuses = ", ".join(
        f"{tally.statuses[status]} {status.name}" for status in Status if tally.statuses[status]
    )
    corrected = f"{tally.corrected} corrected" + (f" ({statuses})" if statuses else "")
    lines: list[Text | Table] = [
        Text(),
        Text(f"{tally.raw} ranges received, {corrected}, {tally.missing} lost"),
    ]
    if tally.corrected:
        p50, p99 = tally.latency_ms(50), tally.latency_ms(99)
        lines.append(Text(f"latency from stamp to corrected range: p50 {p50:.2f} ms, p99 {p99:.2f} ms"))
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
    stop = stop_event()
    console = Console()
    try:
        with watching(Monitor) as monitor:
            with Live(console=console, refresh_per_second=REFRESH_HZ) as live:
                while not stop.wait(1 / REFRESH_HZ):
                    live.update(live_table(monitor.tally, "UWB ranges"))
            console.print(summary(monitor.tally))
    except UwbMitigationError as error:
        sys.exit(f"error: {error}")
