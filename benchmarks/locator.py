"""Measure processor time of the position filter, and latency and loss of the node at 1000 ranges per second."""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from uwb_mitigation_msgs.msg import RangeCorrected

from benchmarks.equipment import processes
from benchmarks.equipment.probe import Probe
from benchmarks.equipment.processes import wait
from uwb_mitigation.nodes.support.spinning import spinning_node
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.filter import RangeFilter
from uwb_mitigation.types.anchors import Anchor, AnchorMap, dump_anchors
from uwb_mitigation.types.measurement import Cir, CorrectedBy, CorrectedRange, RangeMeasurement, Status
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import encode_corrected
from uwb_mitigation.types.stamps import to_ns

ANCHORS = AnchorMap(
    [
        Anchor(n, position)
        for n, position in enumerate([(0.0, 0.0, 2.0), (9.0, 0.0, 1.0), (9.0, 7.0, 2.0), (0.0, 7.0, 1.0)], 1)
    ]
)
_NOISE_M = 0.03
_WARM_S = 2.0


@dataclass(frozen=True, slots=True)
class NodeFigures:
    """Numbers of sent ranges, received poses and lost ranges, and latency percentiles in ms.

    The latency is the time from publishing a range to receiving its pose.
    """

    sent: int
    received: int
    lost: int
    p50_ms: float
    p99_ms: float


def _drive(n: int, rate_hz: float) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    time_s = np.arange(n) / rate_hz
    position = np.stack([4.5 + 3 * np.cos(0.3 * time_s), 3.5 + 2 * np.sin(0.3 * time_s), np.ones(n)], axis=1)
    row = np.arange(n) % len(ANCHORS)
    noise = np.random.default_rng(1).normal(0.0, _NOISE_M, n)
    return row, np.linalg.norm(position - ANCHORS.position[row], axis=1) + noise


def filter_us() -> float:
    """Return the processor time of a prediction and an update, us: best of five rounds, four anchors."""
    ranges = 5000
    row, range_m = _drive(ranges, 40.0)
    rows, values = row.tolist(), range_m.tolist()
    best = float("inf")
    for _ in range(5):
        range_filter = RangeFilter(ANCHORS, NoiseModel(), 0.0, np.array([7.5, 3.5, 1.0]), np.eye(3))
        began = time.process_time()
        for i in range(ranges):
            range_filter.predict(i / 40.0)
            range_filter.update(rows[i], values[i], 0.01, True)
        best = min(best, (time.process_time() - began) / ranges * 1e6)
    return best


def node(rate_hz: float, seconds: float, show: Callable[[str], None]) -> NodeFigures:
    """Start a locator process, send ranges at a fixed rate and receive a pose for each.

    Raises:
        UwbMitigationError: the locator does not start.
    """
    processes.isolate()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "anchors.yaml"
        path.write_text(dump_anchors(ANCHORS))
        locator = processes.start("locator", f"anchors:={path}", "rate:=0.0")
        try:
            with spinning_node(Probe) as probe:
                return _measure(probe, locator, rate_hz, seconds, show)
        finally:
            processes.stop(locator)


def _measure(
    probe: Probe,
    locator: subprocess.Popen[bytes],
    rate_hz: float,
    seconds: float,
    show: Callable[[str], None],
) -> NodeFigures:
    n = round((seconds + _WARM_S) * rate_hz)
    row, range_m = _drive(n, rate_hz)
    arrived: dict[int, int] = {}

    def on_pose(message: PoseWithCovarianceStamped) -> None:
        arrived.setdefault(to_ns(message.header.stamp), time.time_ns())

    probe.subscribe(PoseWithCovarianceStamped, topics.POSE, on_pose)
    publisher = probe.publisher(RangeCorrected, topics.RANGE_CORRECTED)
    wait(
        lambda: publisher.get_subscription_count() > 0, "the locator does not subscribe to ranges", [locator]
    )
    show(f"{rate_hz:.0f} ranges per second for {seconds:.0f} s")
    empty = Cir(np.zeros(0, np.int16))
    sent: list[int] = []
    start_s = time.perf_counter() + 0.1
    for i in range(n):
        while (remaining_s := start_s + i / rate_hz - time.perf_counter()) > 0:
            time.sleep(min(remaining_s, 0.001))
        stamp_ns = time.time_ns()
        measured = RangeMeasurement(stamp_ns, 1, ANCHORS.anchors[row[i]].id, i, 0, float(range_m[i]), empty)
        corrected = CorrectedRange(
            float(range_m[i]), float(range_m[i]), 0.0, 0.01, Status.OK, CorrectedBy.HOST, 1
        )
        publisher.publish(encode_corrected(measured, corrected))
        sent.append(stamp_ns)
    counted = sent[round(_WARM_S * rate_hz) :]
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline and any(stamp not in arrived for stamp in counted):
        time.sleep(0.05)
    latency = np.array([arrived[stamp] - stamp for stamp in counted if stamp in arrived]) / 1e6
    p50, p99 = np.percentile(latency, (50, 99)) if len(latency) else (np.inf, np.inf)
    return NodeFigures(len(counted), len(latency), len(counted) - len(latency), float(p50), float(p99))
