"""Measures the driver on a serial link: an emulated board, a driver process, and a subscriber.

Two parts: a steady stream, of which every range is to arrive, and a cable that is pulled again and again,
after which ranges are to come back at once and nothing is to be left behind.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from uwb_mitigation_msgs.msg import RangeCir

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.link.emulated_board import EmulatedBoard
from uwb_mitigation.nodes import topics
from uwb_mitigation.nodes.running import spin
from uwb_mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.sources.simulated import SimulatedSource
from uwb_mitigation.sources.source import Record

WINDOW = 157
"""Complex samples of each range: what the network reads."""

_START_S = 20.0
_CLOCK_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class SteadyResult:
    """Of the steady stream.

    Attributes:
        sent, received, lost: ranges from the board, at the subscriber, and in between.
        seconds: of sending.
        driver_cpu: share of one core that the driver took.
        late_ms_p50, late_ms_p99: from the stamp to the arrival at the subscriber.
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
    """Of the cable that is pulled.

    Attributes:
        cycles: how often.
        resumed_ms_p50, resumed_ms_max: from the port's return to the next range at the subscriber.
        descriptors, threads: of the driver, before and after.
        memory_kb: resident memory of the driver, before and after.
    """

    cycles: int
    resumed_ms_p50: float
    resumed_ms_max: float
    descriptors: tuple[int, int]
    threads: tuple[int, int]
    memory_kb: tuple[int, int]


class _Window:
    """Simulated ranges, prepared once so that playing them costs the board little, cut to the window."""

    simulated = True
    name = "simulated windows"

    def __init__(self, count: int) -> None:
        self.skipped: Counter[str] = Counter()
        self._records = [self._cut(record) for record in islice(SimulatedSource(seed=1), count)]

    @staticmethod
    def _cut(record: Record) -> Record:
        cir = record.measurement.cir
        start = int(cir.first_path_index) - WINDOW_LEAD
        cut = replace(cir, samples=cir.samples[2 * start : 2 * (start + WINDOW)], start_index=start)
        return Record(replace(record.measurement, cir=cut))

    def __iter__(self) -> Iterator[Record]:
        return iter(self._records)

    def close(self) -> None:
        """Nothing is open."""

    def __enter__(self) -> _Window:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class _Listener:
    """Counts ranges and notes how late they are, in a thread."""

    def __init__(self) -> None:
        self.node = Node("bench_listener")
        self.late_ns: list[int] = []
        self.last_ns = 0
        self._clock = self.node.get_clock()
        self.node.create_subscription(RangeCir, topics.RANGE_RAW, self._on_range, topics.RANGES)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=spin, args=(self.node, self._stop), daemon=True)
        self._thread.start()

    def _on_range(self, message: RangeCir) -> None:
        stamp = message.header.stamp
        self.last_ns = time.monotonic_ns()
        self.late_ns.append(self._clock.now().nanoseconds - stamp.sec * 10**9 - stamp.nanosec)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.node.destroy_node()


@contextmanager
def _bench(rate_hz: float) -> Iterator[tuple[EmulatedBoard, _Listener, int]]:
    """A board, a listener, and the process id of a driver between the two."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    listener = _Listener()
    try:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder, "port")
            code = "from uwb_mitigation.nodes.driver import main; main()"
            command = [sys.executable, "-c", code, "--ros-args", "--log-level", "error"]
            with EmulatedBoard(_Window(500), rate_hz=rate_hz, link=link) as board:
                driver = subprocess.Popen([*command, "-p", "source:=serial", "-p", f"port:={link}"])
                try:
                    _wait(lambda: len(listener.late_ns) > rate_hz, "the driver publishes nothing")
                    yield board, listener, driver.pid
                finally:
                    driver.terminate()
                    driver.wait(10)
    finally:
        listener.close()
        rclpy.try_shutdown()


def _wait(condition: Callable[[], bool], failure: str) -> None:
    deadline = time.monotonic() + _START_S
    while not condition():
        if time.monotonic() > deadline:
            raise UwbMitigationError(failure)
        time.sleep(0.001)


def steady(rate_hz: float, seconds: float) -> SteadyResult:
    """Stream ranges of 157 complex samples at `rate_hz` through the driver.

    Raises:
        UwbMitigationError: nothing arrives.
    """
    with _bench(rate_hz) as (board, listener, pid):
        # Counted from rest to rest: what was sent before the driver was connected is none of the loss.
        sent, received = _at_rest(board, listener)
        cpu_s, began_s = _cpu_s(pid), time.monotonic()
        board.resume()
        time.sleep(seconds)
        cpu_s, passed_s = _cpu_s(pid) - cpu_s, time.monotonic() - began_s
        all_sent, all_received = _at_rest(board, listener)
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
    """Pull the cable `cycles` times while ranges stream, and see them come back.

    Raises:
        UwbMitigationError: they do not.
    """
    resumed_ms = []
    with _bench(rate_hz) as (board, listener, pid):
        before = _descriptors(pid), _threads(pid), _memory_kb(pid)
        for cycle in range(cycles):
            board.unplug()
            # Long enough for the driver to be in any state of its back-off.
            time.sleep(0.1 + 0.37 * (cycle % 7))
            board.plug()
            returned_ns = time.monotonic_ns()

            def resumed(since: int = returned_ns) -> bool:
                return listener.last_ns > since

            _wait(resumed, "no range after the port's return")
            resumed_ms.append((listener.last_ns - returned_ns) / 1e6)
        after = _descriptors(pid), _threads(pid), _memory_kb(pid)
    resumed_ms.sort()
    return UnplugResult(
        cycles=cycles,
        resumed_ms_p50=_percentile(resumed_ms, 50),
        resumed_ms_max=resumed_ms[-1],
        descriptors=(before[0], after[0]),
        threads=(before[1], after[1]),
        memory_kb=(before[2], after[2]),
    )


def _at_rest(board: EmulatedBoard, listener: _Listener) -> tuple[int, int]:
    board.pause()
    time.sleep(1.0)
    return board.sent_measurements, len(listener.late_ns)


def _percentile(ordered: list[float], percent: int) -> float:
    return ordered[min(len(ordered) * percent // 100, len(ordered) - 1)] if ordered else float("nan")


def _cpu_s(pid: int) -> float:
    """User and system time of a process so far (proc(5), /proc/PID/stat fields 14 and 15)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _CLOCK_TICKS_PER_S


def _descriptors(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))


def _threads(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/task"))


def _memory_kb(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0])
