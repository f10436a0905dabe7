"""`make demo`: replay a recording through `driver` and `mitigator`, two processes over DDS, and show it live.

python -m benchmarks demo [--recording PATH] [--rate FACTOR]
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rich.console import Console
from rich.live import Live

from benchmarks.equipment.processes import NodeProcesses, run_demo
from uwb_mitigation.errors import DatasetError, UwbMitigationError
from uwb_mitigation.nodes.monitor import REFRESH_HZ, Monitor, live_table, summary
from uwb_mitigation.nodes.support import endpoints
from uwb_mitigation.nodes.support.spinning import spinning_node
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.anchors import AnchorMap, dump_anchors
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import to_ns
from uwb_mitigation.types.tracks import TruePath

SIMULATED_EXCHANGES = 600
SIMULATED_RATE_HZ = 40.0
LONGEST_PAUSE_S = 5.0
TARGET_S = 15.0
SETTLE_S = 3.0


@dataclass(frozen=True, slots=True)
class DemoPlan:
    """A demo: title, parameters of the driver, speed, and if known the anchors and the offset of the boards."""

    title: str
    parameters: tuple[str, ...]
    rate: float
    anchors: AnchorMap | None = None
    offset_m: float | None = None


def simulated(rate: float) -> DemoPlan:
    """Return the demo of the simulator's default scene, in which weak signals give no range."""
    source = SimulatedSource(count=SIMULATED_EXCHANGES, rate_hz=SIMULATED_RATE_HZ)
    return DemoPlan(
        f"simulated recording, {len(list(source))} ranges",
        ("source:=simulated", f"count:={SIMULATED_EXCHANGES}", f"simulated_rate:={SIMULATED_RATE_HZ}"),
        rate or 1.0,
        source.anchors,
        offset_of(source),
    )


def offset_of(source: Source) -> float | None:
    """Return the offset of the boards (m) from LOS ranges with truth; None if it is unknown."""
    from uwb_mitigation.calibration.radio_offsets import estimate_offset
    from uwb_mitigation.mitigation.correction import Mitigation
    from uwb_mitigation.mitigation.model.shipped import load_model

    try:
        return estimate_offset(Mitigation(load_model()), source).offset_m
    except DatasetError:
        return None


def recorded(path: Path, rate: float) -> DemoPlan:
    """Return the demo of a recording; at the default rate it lasts about 15 s."""
    from uwb_mitigation.recordings.formats import open_recording
    from uwb_mitigation.recordings.mcap import McapRecording

    count, length_s, last_ns = 0, 0.0, None
    with open_recording(path) as source:
        for record in source:
            stamp_ns = record.measurement.stamp_ns
            if last_ns is not None:
                length_s += min((stamp_ns - last_ns) / 1e9, LONGEST_PAUSE_S)
            count, last_ns = count + 1, stamp_ns
        offset_m = offset_of(source) if count else None
        name = source.name
        kind = "mcap" if isinstance(source, McapRecording) else "decaranging"
    if not count:
        raise UwbMitigationError("the recording contains no ranges", where=str(path))
    rate = rate or max(1.0, length_s / TARGET_S)
    return DemoPlan(
        f"{name}, {count} ranges, {rate:.1f} x recorded speed",
        (f"source:={kind}", f"path:={path.resolve()}", f"longest_pause:={LONGEST_PAUSE_S}"),
        rate,
        offset_m=offset_m,
    )


def position_rmse(poses: list[Any], truth: list[Any]) -> float:
    """Return the horizontal RMSE (m) of poses where the truth is known."""
    (stamps, positions), (true_stamps, true_positions) = _stamped(poses), _stamped(truth)
    offset = positions - TruePath(true_stamps, true_positions).position_at(stamps)
    return float(np.sqrt(np.nanmean(np.sum(offset[:, :2] ** 2, axis=1))))


def _stamped(messages: list[Any]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    rows = {}
    for message in messages:
        position = message.pose.pose.position
        rows[to_ns(message.header.stamp)] = (position.x, position.y, position.z)
    stamps = sorted(rows)
    return np.array(stamps, np.int64), np.array([rows[stamp] for stamp in stamps], np.float64)


def watch(plan: DemoPlan, console: Console) -> list[str]:
    """Run the nodes and show their ranges; return the failures."""
    with spinning_node(Monitor) as monitor, tempfile.TemporaryDirectory() as folder:
        statistics = monitor.statistics
        poses: list[Any] = []
        truth: list[Any] = []
        monitor.create_subscription(
            PoseWithCovarianceStamped, topics.relative(topics.POSE), poses.append, endpoints.RANGES
        )
        monitor.create_subscription(
            Odometry, topics.relative(topics.ODOMETRY_TRUTH), truth.append, endpoints.RANGES
        )
        raw, corrected, anchors = (
            monitor.resolve_topic_name(topics.relative(name))
            for name in (topics.RANGE_RAW, topics.RANGE_CORRECTED, topics.ANCHORS)
        )
        title, offset_m = plan.title, plan.offset_m
        with NodeProcesses() as nodes:
            if offset_m is None:
                nodes.start("mitigator")
            else:
                title += f", {offset_m:.2f} m of antenna delays subtracted"
                nodes.start("mitigator", f"offsets:={offset_m:.4f}")
            if plan.anchors is not None:
                file = Path(folder) / "anchors.yaml"
                file.write_text(dump_anchors(plan.anchors), encoding="utf-8")
                # A replay at another speed changes the speed of the robot, and the noise of its motion.
                acceleration = min(NoiseModel().acceleration * plan.rate**1.5, 1000.0)
                nodes.start(
                    "locator",
                    f"anchors:={file}",
                    "level:=true",
                    "rate:=0.0",
                    f"acceleration:={acceleration:.6f}",
                )
                nodes.wait(
                    lambda: monitor.count_publishers(anchors) > 0, "the locator did not start: see above"
                )
            nodes.wait(
                lambda: monitor.count_publishers(corrected) > 0 and monitor.count_subscribers(raw) > 1,
                "the mitigator did not start: see above",
            )
            # The mitigator and this process must receive the first range.
            nodes.start("driver", *plan.parameters, f"rate:={plan.rate}", "wait_for_subscribers:=2")
            with Live(console=console, refresh_per_second=REFRESH_HZ) as live:
                while nodes.running:
                    live.update(live_table(statistics, title, console.width))
                    time.sleep(1 / REFRESH_HZ)
                # The last corrected ranges may arrive after the end of the driver.
                deadline = time.monotonic() + SETTLE_S
                while statistics.corrected < statistics.raw and time.monotonic() < deadline:
                    time.sleep(0.05)
                live.update(live_table(statistics, title, console.width))
        console.print(summary(statistics))
        if len(poses) > 1 and len(truth) > 1:
            speed = "" if plan.rate == 1.0 else f" (at {plan.rate:g} x speed, for which it is not tuned)"
            console.print(
                f"horizontal position error of the locator: {position_rmse(poses, truth):.3f} m RMSE{speed}"
            )
    if statistics.corrected < statistics.raw or not statistics.corrected:
        nodes.failures.append(f"{statistics.corrected} of {statistics.raw} ranges were corrected")
    return nodes.failures


def main(recording: Path | None, rate: float) -> int:
    """Run the demo of a recording or of the simulator; return the exit code."""
    return run_demo(
        "demo",
        lambda console: watch(simulated(rate) if recording is None else recorded(recording, rate), console),
    )
