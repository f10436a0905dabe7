"""Measure the driver on a serial link with an emulated board, a driver process, and a subscriber.

There are two parts: a steady stream, of which every range should arrive, and a cable that is repeatedly unplugged, after
which ranges should resume immediately without leaked resources.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from uwb_mitigation_msgs.msg import RangeCir

from benchmarks.equipment import processes
from benchmarks.equipment.emulated_board import EmulatedBoard
from benchmarks.equipment.probe import Probe
from benchmarks.equipment.processes import wait
from benchmarks.nodes import process_usage
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.nodes.support.spinning import spinning_node
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import to_ns

WINDOW = 157
"""Number of complex samples per range that the network reads."""


@dataclass(frozen=True, slots=True)
class SteadyResult:
    """Results of the steady stream.

    Attributes:
        sent, received, lost: number of ranges from the board, at the subscriber, and lost in between.
        seconds: duration of sending.
        driver_cpu: share of one core that the driver used.
        late_ms_p50, late_ms_p99: latency from the stamp to the arrival at the subscriber.
    """

    sent: int
    received: int
    lost: int
    seconds: float
    driver_cpu: float
    late_ms_p50: float
    late_ms_p99: float


@dataclass(frozen=True, slots=True)
class UnplugResult:
    """Results of unplugging the cable.

    Attributes:
        cycles: number of repetitions.
        resumed_ms_p50, resumed_ms_max: time from the return of the port to the next range at the subscriber.
        descriptors, threads: numbers of the driver before and after.
        memory_mb: resident memory of the driver, before and after.
    """

    cycles: int
    resumed_ms_p50: float
    resumed_ms_max: float
    descriptors: tuple[int, int]
    threads: tuple[int, int]
    memory_mb: tuple[float, float]


class _Window(Source):
    """Simulated ranges cut to the window, generated in advance so that playing them takes little time."""

    simulated = True
    name = "simulated windows"

    def __init__(self, count: int) -> None:
        self.skipped: Counter[str] = Counter()
        self._records = [self._cut_to_window(record) for record in islice(SimulatedSource(seed=1), count)]

    @staticmethod
    def _cut_to_window(record: Record) -> Record:
        cir = record.measurement.cir
        start = int(cir.first_path_index) - WINDOW_LEAD
        cut = replace(cir, samples=cir.samples[2 * start : 2 * (start + WINDOW)], start_index=start)
        return Record(replace(record.measurement, cir=cut))

    def __iter__(self) -> Iterator[Record]:
        return iter(self._records)


class _Listener:
    """Counts ranges and records their latencies."""

    def __init__(self, probe: Probe) -> None:
        self.late_ns: list[int] = []
        self.last_ns = 0
        probe.subscribe(RangeCir, topics.RANGE_RAW, self._on_range)

    def _on_range(self, message: RangeCir) -> None:
        self.last_ns = time.monotonic_ns()
        self.late_ns.append(time.time_ns() - to_ns(message.header.stamp))


@contextmanager
def _bench(rate_hz: float) -> Iterator[tuple[EmulatedBoard, _Listener, int]]:
    """Start a board, a driver and a listener; yield board, listener and process id of the driver."""
    processes.isolate()
    with tempfile.TemporaryDirectory() as folder, spinning_node(Probe) as probe:
        listener = _Listener(probe)
        link = Path(folder, "port")
        with EmulatedBoard(_Window(500), rate_hz=rate_hz, link=link) as board:
            driver = processes.start("driver", "source:=serial", f"port:={link}", log_level="error")
            try:
                wait(lambda: len(listener.late_ns) > rate_hz, "the driver publishes nothing", [driver])
                yield board, listener, driver.pid
            finally:
                processes.stop(driver)


def steady(rate_hz: float, seconds: float) -> SteadyResult:
    """Stream ranges of 157 complex samples at `rate_hz` through the driver.

    Raises:
        UwbMitigationError: no ranges arrive.
    """
    with _bench(rate_hz) as (board, listener, pid):
        # Count while the stream is paused: ranges before the driver was connected are not losses.
        sent, received = _pause_and_count(board, listener)
        cpu_s, began_s = process_usage(pid).cpu_s, time.monotonic()
        board.resume()
        time.sleep(seconds)
        cpu_s, passed_s = process_usage(pid).cpu_s - cpu_s, time.monotonic() - began_s
        all_sent, all_received = _pause_and_count(board, listener)
    late_ms = sorted(late / 1e6 for late in listener.late_ns[received:])
    return SteadyResult(
        sent=all_sent - sent,
        received=all_received - received,
        lost=all_sent - sent - (all_received - received),
        seconds=passed_s,
        driver_cpu=cpu_s / passed_s,
        late_ms_p50=_percentile(late_ms, 50),
        late_ms_p99=_percentile(late_ms, 99),
    )


def unplug(cycles: int, rate_hz: float = 200.0) -> UnplugResult:
    """Unplug the cable `cycles` times while ranges stream, and wait until they resume.

    Raises:
        UwbMitigationError: the ranges do not resume.
    """
    resumed_ms = []
    with _bench(rate_hz) as (board, listener, pid):
        before = process_usage(pid)
        for cycle in range(cycles):
            board.unplug()
            # Long enough that the driver can be in any state of its back-off.
            time.sleep(0.1 + 0.37 * (cycle % 7))
            board.plug()
            returned_ns = time.monotonic_ns()

            def resumed(since: int = returned_ns) -> bool:
                return listener.last_ns > since

            wait(resumed, "no range after the port's return")
            resumed_ms.append((listener.last_ns - returned_ns) / 1e6)
        after = process_usage(pid)
    resumed_ms.sort()
    return UnplugResult(
        cycles=cycles,
        resumed_ms_p50=_percentile(resumed_ms, 50),
        resumed_ms_max=resumed_ms[-1],
        descriptors=(before.descriptors, after.descriptors),
        threads=(before.threads, after.threads),
        memory_mb=(before.memory_mb, after.memory_mb),
    )


def _pause_and_count(board: EmulatedBoard, listener: _Listener) -> tuple[int, int]:
    board.pause()
    time.sleep(1.0)
    return board.sent_measurements, len(listener.late_ns)


def _percentile(ordered: list[float], percent: int) -> float:
    return ordered[min(len(ordered) * percent // 100, len(ordered) - 1)] if ordered else float("nan")
