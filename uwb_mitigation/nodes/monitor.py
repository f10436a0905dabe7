"""The node `monitor`: shows ranges and what the nodes report live in the terminal, and a summary at the end."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections import Counter, defaultdict, deque

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.node import Node
from rich.console import Console, Group, JustifyMethod
from rich.live import Live
from rich.table import Table
from rich.text import Text
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.errors import RecordingError, UwbMitigationError, format_id
from uwb_mitigation.nodes.support import diagnostics, endpoints
from uwb_mitigation.nodes.support.spinning import spinning_node, stop_event
from uwb_mitigation.types.measurement import CorrectedRange, Status, Truth
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import MeasurementKey, decode_corrected, decode_range, decode_truth
from uwb_mitigation.types.stamps import NS_PER_S

REFRESH_HZ = 5

MAX_LATENCIES = 100_000
"""Number of latest latencies in the summary; bounds the memory of a monitor that runs for days."""

MAX_TRUTHS = 10_000
"""Number of latest truths that wait for their corrected ranges."""

STALE_S = 5.0
"""Nodes publish diagnostics each second: after this time one was stopped."""

MAX_REPORTS = 20
"""Number of nodes whose reports are kept."""

_COLUMNS = ("anchor", "tag", "rate\nHz", "raw\nm", "corrected\nm", "sigma\nm", "status", "true\nm", "label")

_RECENT = 1000
"""Number of latest stamps of a topic that are stored while the other topic is not received yet."""


class PairStatistics:
    """The latest range of one pair.

    Attributes:
        corrected, truth: of the latest range; `truth` is None if unknown.
        arrivals_s: arrival times of the latest ranges.
    """

    def __init__(self) -> None:
        self.corrected: CorrectedRange | None = None
        self.truth: Truth | None = None
        self.arrivals_s: deque[float] = deque(maxlen=20)

    def rate_hz(self) -> float:
        """Return the rate of the latest ranges; NaN before the second one."""
        # Copy in one step: another thread adds ranges.
        arrivals_s = list(self.arrivals_s)
        span_s = arrivals_s[-1] - arrivals_s[0] if arrivals_s else 0.0
        return (len(arrivals_s) - 1) / span_s if span_s > 0.0 else math.nan


class RangeStatistics:
    """Counts, latencies and errors of the received ranges, by pair.

    Attributes:
        raw, corrected: numbers of received ranges.
        early: the numbers of them from before the first range of the other topic.
        errors: {label: (number, sum of raw, sum of corrected absolute errors in m)} of ranges with known truth.
    """

    def __init__(self) -> None:
        self.pairs: dict[tuple[int, int], PairStatistics] = {}
        self.raw = self.corrected = 0
        self.early = {"raw": 0, "corrected": 0}
        self._recent_ns: dict[str, deque[int]] = {topic: deque(maxlen=_RECENT) for topic in self.early}
        self._both_since_ns: int | None = None
        self.statuses: Counter[Status] = Counter()
        self.errors: defaultdict[str, NDArray[np.float64]] = defaultdict(lambda: np.zeros(3))
        self._latencies_s: deque[float] = deque(maxlen=MAX_LATENCIES)
        self._truths: dict[MeasurementKey, Truth] = {}

    @property
    def missing(self) -> int:
        """Number of raw ranges without a corrected range, since both topics are received."""
        return max(self.raw - self.early["raw"] - self.corrected + self.early["corrected"], 0)

    def latency_ms(self, percentile: float) -> float:
        """Return a percentile of the time from stamp to reception; NaN without data."""
        return float(np.percentile(self._latencies_s or [math.nan], percentile)) * 1e3

    def add_truth(self, key: MeasurementKey, truth: Truth) -> None:
        self._truths[key] = truth
        if len(self._truths) > MAX_TRUTHS:
            self._truths.pop(next(iter(self._truths)))

    def add_raw(self, stamp_ns: int) -> None:
        self.raw += 1
        self._add_stamp("raw", stamp_ns)

    def _add_stamp(self, topic: str, stamp_ns: int) -> None:
        if self._both_since_ns is not None:
            self.early[topic] += stamp_ns < self._both_since_ns
            return
        self._recent_ns[topic].append(stamp_ns)
        if all(self._recent_ns.values()):
            # Discovery of two publishers takes different times: compare from the later first range.
            self._both_since_ns = since_ns = max(stamps[0] for stamps in self._recent_ns.values())
            totals = {"raw": self.raw, "corrected": self.corrected}
            for name, stamps in self._recent_ns.items():
                self.early[name] = totals[name] - sum(stamp >= since_ns for stamp in stamps)

    def add_corrected(self, key: MeasurementKey, corrected: CorrectedRange, arrival_s: float) -> None:
        """Add a corrected range; `arrival_s` is on the clock of its stamp."""
        truth = self._truths.pop(key, None)
        self.corrected += 1
        self._add_stamp("corrected", key.stamp_ns)
        self.statuses[corrected.status] += 1
        self._latencies_s.append(arrival_s - key.stamp_ns / NS_PER_S)
        pair = self.pairs.setdefault((key.anchor_id, key.tag_id), PairStatistics())
        pair.truth, pair.corrected = truth, corrected
        pair.arrivals_s.append(arrival_s)
        if truth is not None and math.isfinite(truth.range_m) and math.isfinite(corrected.range_raw_m):
            raw_m, corrected_m = corrected.range_raw_m - truth.range_m, corrected.range_m - truth.range_m
            self.errors[truth.label] += (1, abs(raw_m), abs(corrected_m))


class Monitor(Node):
    """Collects statistics of the three range topics, and the diagnostics of the nodes of this package.

    Attributes:
        reports: {node: (time of reception on the steady clock, s; level; message)}.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("monitor", context=context)
        self.statistics = RangeStatistics()
        self.reports: dict[str, tuple[float, bytes, str]] = {}
        self.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, 10)
        for kind, topic, callback in (
            (RangeTruth, topics.RANGE_TRUTH, self._on_truth),
            (RangeCir, topics.RANGE_RAW, self._on_raw),
            (RangeCorrected, topics.RANGE_CORRECTED, self._on_corrected),
        ):
            self.create_subscription(kind, topics.relative(topic), callback, endpoints.RANGES, raw=True)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.removesuffix(diagnostics.NAME_END)
            if name != status.name:
                self.reports[name] = time.monotonic(), status.level, status.message
                if len(self.reports) > MAX_REPORTS:
                    del self.reports[min(self.reports, key=lambda name: self.reports[name][0])]

    def _on_raw(self, data: bytes) -> None:
        with contextlib.suppress(RecordingError):
            self.statistics.add_raw(decode_range(data).stamp_ns)

    def _on_truth(self, data: bytes) -> None:
        with contextlib.suppress(RecordingError):
            self.statistics.add_truth(*decode_truth(data))

    def _on_corrected(self, data: bytes) -> None:
        now_s = self.get_clock().now().nanoseconds / NS_PER_S
        with contextlib.suppress(RecordingError):
            self.statistics.add_corrected(*decode_corrected(data), now_s)


def _text(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def live_table(statistics: RangeStatistics, title: str, width: int = 80) -> Table:
    """Return a table with one row for each anchor-tag pair, which fits into `width` columns if ids are short."""
    omitted: set[str] = set()
    if all(pair.truth is None for pair in statistics.pairs.copy().values()):
        omitted |= {"true\nm", "label"}
    if width < 80:
        omitted |= {"rate\nHz", "label"}
    shown = [column for column in _COLUMNS if column not in omitted]
    table = Table(title=title, title_justify="left")
    for column in shown:
        is_id = column in ("anchor", "tag")
        justify: JustifyMethod = "left" if column in ("status", "label") else "right"
        table.add_column(column, justify=justify, overflow="fold", no_wrap=not is_id)
    for (anchor, tag), pair in sorted(statistics.pairs.copy().items()):
        corrected, truth = pair.corrected, pair.truth
        if corrected is None:
            continue
        sigma_m = math.sqrt(corrected.variance_m2) if corrected.variance_m2 >= 0.0 else math.nan
        true_m = math.nan if truth is None else truth.range_m
        cells: list[str | Text] = [
            format_id(anchor),
            format_id(tag),
            _text(pair.rate_hz(), 1),
            *map(_text, (corrected.range_raw_m, corrected.range_m, sigma_m)),
            Text(corrected.status.name, style="green" if corrected.status is Status.OK else "yellow"),
            _text(true_m),
            "" if truth is None else truth.label,
        ]
        cell_of = dict(zip(_COLUMNS, cells, strict=True))
        table.add_row(*(cell_of[column] for column in shown))
    return table


def report_lines(reports: dict[str, tuple[float, bytes, str]], now_s: float) -> list[Text]:
    """Return one line for each node: its name and message; `reports`: see `Monitor`, `now_s`: on the steady clock."""
    styles = {diagnostics.OK: "green", diagnostics.WARN: "yellow", diagnostics.ERROR: "red"}
    lines = []
    for name, (received_s, level, text) in sorted(reports.copy().items()):
        age_s = now_s - received_s
        silent = f"no diagnostics for {age_s:.0f} s; last: " if age_s > STALE_S else ""
        style = styles.get(max(level, diagnostics.WARN) if silent else level, "")
        lines.append(Text(f"{name}: {silent}{text}", style=style))
    return lines


def summary(statistics: RangeStatistics) -> Group:
    """Return counts, latency, and mean absolute errors of ranges whose truth is known."""
    statuses = ", ".join(
        f"{statistics.statuses[status]} {status.name}" for status in Status if statistics.statuses[status]
    )
    corrected = f"{statistics.corrected} corrected" + (f" ({statuses})" if statuses else "")
    lost = (
        f"{statistics.missing} lost"
        if statistics.corrected
        else f"no {topics.RANGE_CORRECTED}: is the mitigator running?"
    )
    lines: list[Text | Table] = [Text(), Text(f"{statistics.raw} ranges received, {corrected}, {lost}")]
    for topic, reference in (("corrected", "raw"), ("raw", "corrected")):
        if early := statistics.early[topic]:
            lines.append(Text(f"{early} of the {topic} ranges came before the first {reference} range"))
    if statistics.corrected:
        p50, p99 = statistics.latency_ms(50), statistics.latency_ms(99)
        lines.append(Text(f"latency from stamp to corrected range: p50 {p50:.2f} ms, p99 {p99:.2f} ms"))
    if statistics.errors:
        table = Table(title="Mean absolute error (MAE)", title_justify="left")
        for column in ("label", "ranges", "raw MAE, m", "corrected MAE, m", "ratio"):
            table.add_column(column, justify="left" if column == "label" else "right")
        for label, errors in [*sorted(statistics.errors.items()), ("all", sum(statistics.errors.values()))]:
            if label == "all":
                table.add_section()
            n, raw_m, corrected_m = np.asarray(errors).tolist()
            ratio = corrected_m / raw_m if raw_m else math.nan
            table.add_row(
                label or "-", f"{n:.0f}", f"{raw_m / n:.3f}", f"{corrected_m / n:.3f}", f"{ratio:.2f}"
            )
        lines.append(table)
    return Group(*lines)


def run_monitor() -> None:
    """Show ranges and reports until Ctrl-C."""
    stop = stop_event()
    console = Console()
    try:
        with spinning_node(Monitor) as monitor:
            with Live(console=console, refresh_per_second=REFRESH_HZ) as live:
                while not stop.wait(1 / REFRESH_HZ):
                    table = live_table(monitor.statistics, "UWB ranges", console.width)
                    live.update(Group(*report_lines(monitor.reports, time.monotonic()), table))
            console.print(summary(monitor.statistics))
    except UwbMitigationError as error:
        sys.exit(f"error: {error}")
