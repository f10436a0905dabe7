"""Measure the overhead of the nodes relative to rclpy: latency, maximum rate, processor time, memory.

Four subjects process the same recorded ranges in turns, so that other load on the machine affects all of them: a relay
that republishes messages, a relay that republishes serialised messages, the mitigator, and the one-process pipeline.
The first three have a separate driver process. All drivers loop over one bag, and their live parameters set the
rate.
"""

from __future__ import annotations

import math
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import median

import numpy as np
import psutil
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from benchmarks.equipment import processes
from benchmarks.equipment.probe import Probe
from benchmarks.equipment.processes import wait
from benchmarks.equipment.relay import RELAYED
from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.nodes.support.spinning import spinning_node
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import first_field_offset
from uwb_mitigation.types.stamps import NS_PER_S

WINDOW = 157
"""Number of complex samples per range that the network reads."""
RANGES = 5000
RECORDED_HZ = 1000.0
RATES_HZ = (100, 500, 1000)

_DISTINCT_RANGES = 500
_SETTLE_S = 0.3
_TRIAL_S = 1.0
_MAX_LATENCY_NS = 100_000_000
_MIN_HZ, _STEP, _BISECTIONS, _MAX_HZ = 1000.0, 1.5, 3, 50_000.0
_SEARCH_S = 12.0
_STAMP = struct.Struct("<4xiII")
_SEQUENCE = struct.Struct("<16xI")


@dataclass(frozen=True, slots=True)
class ProcessUsage:
    """Processor time so far, s, of all threads; resident memory, MB; open file descriptors; threads."""

    cpu_s: float
    memory_mb: float
    descriptors: int
    threads: int


def process_usage(pid: int) -> ProcessUsage:
    """Return the resources that a process uses.

    Raises:
        UwbMitigationError: there is no such process.
    """
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times = process.cpu_times()
            return ProcessUsage(
                times.user + times.system,
                process.memory_info().rss / 2**20,
                process.num_fds(),
                process.num_threads(),
            )
    except psutil.Error as error:
        raise UwbMitigationError(f"process {pid} has ended", valid="see its output above") from error


@dataclass(frozen=True, slots=True)
class Latency:
    """Latency from the stamp of a range (its due time) to its arrival at the subscriber, us."""

    p50: float
    p99: float
    max: float


@dataclass(slots=True)
class SubjectResult:
    """Results of one subject.

    Attributes:
        rates_hz: maximum rate without loss of each search.
        latency_us: median over the slices at each rate; `max` is the maximum of all.
        cpu_us_per_message: processor time of the subject at the highest rate for latency.
        chain_cpu_us_per_message: the same including the driver process.
        memory_mb: resident memory of the subject at the end.
    """

    rates_hz: list[float] = field(default_factory=list)
    latency_us: dict[int, Latency] = field(default_factory=dict)
    cpu_us_per_message: float = math.nan
    chain_cpu_us_per_message: float = math.nan
    memory_mb: float = math.nan

    @property
    def max_lossless_rate_hz(self) -> float:
        return median(self.rates_hz) if self.rates_hz else math.nan


@dataclass(frozen=True, slots=True)
class RateTrial:
    """Result of a trial at one rate.

    Attributes:
        received, lost: number of received ranges and of lost ranges between them.
        late_ns: latency of each received range.
        sustained: no range was lost, the requested rate was reached, and the last ranges were not late.
    """

    received: int
    lost: int
    late_ns: list[int]
    sustained: bool


class Subject:
    """Processes in a separate namespace, and their output."""

    def __init__(self, bench: Bench, name: str, kind: type, topic: str, *nodes: str) -> None:
        self.name = name
        self.figures = SubjectResult()
        self._bench = bench
        self._received: list[tuple[int, bytes]] = []
        self._num_kept = 0
        self._cpu_s = self._chain_cpu_s = 0.0
        self._counted = self._counted_hz = 0
        arrived, now_ns = self._received.append, time.time_ns
        bench.probe.subscribe(
            kind, f"/{name}/{topics.relative(topic)}", lambda data: arrived((now_ns(), data)), raw=True
        )
        # The measured node is the first process.
        self.processes = [bench.start(node, name) for node in nodes]
        self.play(50.0)
        wait(lambda: len(self._received) > 5, f"{name}: no ranges arrive", self.processes)
        self.pause()

    def play(self, rate_hz: float) -> None:
        self._set(rate=rate_hz / RECORDED_HZ, paused=False)

    def pause(self) -> None:
        """Stop, and wait until all queued ranges have arrived."""
        self._set(paused=True)
        before = -1
        while before != len(self._received):
            before = len(self._received)
            time.sleep(0.1)

    def reset_counts(self) -> None:
        """Reset the counters."""
        self._received.clear()
        self._num_kept = 0

    def count(self) -> tuple[int, int]:
        """Return the number of received ranges since the last call, and of lost ranges between them."""
        # Keep the last one to count losses between it and the next one.
        sequences = [read_stamp_and_sequence(data)[1] for _, data in self._received]
        fresh = len(sequences) - self._num_kept
        self._num_kept = min(len(sequences), 1)
        del self._received[:-1]
        return fresh, count_missing(sequences)

    def trial(self, rate_hz: float, seconds: float) -> RateTrial:
        self.play(rate_hz)
        time.sleep(_SETTLE_S)
        self._received.clear()
        began_ns = time.time_ns()
        time.sleep(seconds)
        passed_s = (time.time_ns() - began_ns) / 1e9
        arrivals = self._received.copy()
        self.pause()
        late_ns, sequences = [], []
        for arrived_ns, data in arrivals:
            stamp_ns, sequence = read_stamp_and_sequence(data)
            late_ns.append(arrived_ns - stamp_ns)
            sequences.append(sequence)
        lost = count_missing(sequences)
        sustained = (
            lost == 0 and len(arrivals) >= 0.97 * rate_hz * passed_s and max(late_ns[-20:]) < _MAX_LATENCY_NS
        )
        return RateTrial(len(arrivals), lost, late_ns, sustained)

    def warm_up(self) -> None:
        self.trial(RECORDED_HZ, _TRIAL_S)

    def measure_latency(self, rate_hz: int, seconds: float) -> Latency:
        before = [process_usage(process.pid).cpu_s for process in self.processes]
        trial = self.trial(rate_hz, seconds)
        after = [process_usage(process.pid).cpu_s for process in self.processes]
        if not trial.received:
            raise UwbMitigationError(f"{self.name}: no ranges arrive at {rate_hz} Hz")
        # Sum over slices, because the system counts in hundredths of a second. The sums include settling and
        # pause, which play at the same rate.
        weight = seconds / (seconds + _SETTLE_S)
        spent_s = [(b - a) * weight for a, b in zip(before, after, strict=True)]
        if rate_hz != self._counted_hz:
            self._counted_hz, self._counted, self._cpu_s, self._chain_cpu_s = rate_hz, 0, 0.0, 0.0
        self._cpu_s, self._chain_cpu_s = self._cpu_s + spent_s[0], self._chain_cpu_s + sum(spent_s)
        self._counted += trial.received
        self.figures.cpu_us_per_message = 1e6 * self._cpu_s / self._counted
        self.figures.chain_cpu_us_per_message = 1e6 * self._chain_cpu_s / self._counted
        p50, p99 = np.percentile(trial.late_ns, (50, 99)) / 1e3
        return Latency(float(p50), float(p99), max(trial.late_ns) / 1e3)

    def search_rate(self) -> None:
        """Find the maximum rate without loss to within a few per cent; 0 if even the lowest rate is too high."""

        def is_lossless(rate_hz: float) -> bool:
            # Try twice, because other load on the machine may have interfered.
            return self.trial(rate_hz, _TRIAL_S).sustained or self.trial(rate_hz, _TRIAL_S).sustained

        low, high = 0.0, _MIN_HZ
        # The next search begins below the previous results.
        below = self.figures.max_lossless_rate_hz / _STEP
        if below > 0 and is_lossless(below):
            low, high = below, below * _STEP
        while high < _MAX_HZ and is_lossless(high):
            low, high = high, high * _STEP
        for _ in range(_BISECTIONS if low else 0):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if is_lossless(middle) else (low, middle)
        self.figures.rates_hz.append(low)

    def _set(self, **values: object) -> None:
        self._bench.probe.set_parameters_of(f"/{self.name}/driver", self.processes, **values)


class Bench:
    """A subscriber in this process, and the subjects in separate processes."""

    def __init__(self, probe: Probe, bag: Path) -> None:
        self.probe = probe
        self.processes: list[subprocess.Popen[bytes]] = []
        self._bag = bag

    def start(self, node: str, namespace: str) -> subprocess.Popen[bytes]:
        """Start a node; a driver or a pipeline starts paused."""
        node, _, parameter = node.partition(" ")
        words = [parameter] if parameter else []
        if node in ("driver", "pipeline"):
            words = ["source:=mcap", f"path:={self._bag}", "loop:=true", "paused:=true"]
            words += ["wait_for_subscribers:=0", "start_delay:=0.0"]
        module = "benchmarks.equipment.relay" if node == "relay" else processes.ENTRY
        process = processes.start(node, *words, namespace=namespace, log_level="error", module=module)
        self.processes.append(process)
        return process


@contextmanager
def open_bench() -> Iterator[Bench]:
    """Open a bench with a separate ROS domain and a bag to play."""
    processes.isolate()
    with tempfile.TemporaryDirectory() as folder, spinning_node(Probe) as probe:
        bag = Path(folder, "ranges.mcap")
        write_bag(bag)
        bench = Bench(probe, bag)
        try:
            yield bench
        finally:
            processes.stop(*bench.processes)


def read_stamp_and_sequence(data: bytes) -> tuple[int, int]:
    """Return stamp, ns, and sequence of a serialised RangeCir or RangeCorrected, which begin with the same fields."""
    seconds, nanoseconds, length = _STAMP.unpack_from(data)
    (sequence,) = _SEQUENCE.unpack_from(data, first_field_offset(_STAMP.size + length))
    return seconds * NS_PER_S + nanoseconds, sequence


def count_missing(sequences: Sequence[int]) -> int:
    """Return the number of ranges of the bag that are missing between those that arrived."""
    return int(((np.diff(sequences) - 1) % RANGES).sum()) if len(sequences) > 1 else 0


def write_bag(path: Path) -> None:
    """Write a bag of `RANGES` simulated CIR windows, numbered from 0, at `RECORDED_HZ`."""
    records = [_cut_to_window(record) for record in islice(SimulatedSource(seed=1), _DISTINCT_RANGES)]
    with BagWriter(path, {"source": "simulated windows", "simulated": "true"}) as writer:
        for sequence in range(RANGES):
            measurement = records[sequence % _DISTINCT_RANGES].measurement
            stamp_ns = int(sequence * 1e9 / RECORDED_HZ)
            writer.write(Record(replace(measurement, stamp_ns=stamp_ns, sequence=sequence)))


def _cut_to_window(record: Record) -> Record:
    cir = record.measurement.cir
    start = int(cir.first_path_index) - WINDOW_LEAD
    samples = cir.samples[2 * start : 2 * (start + WINDOW)]
    return Record(replace(record.measurement, cir=replace(cir, samples=samples, start_index=start)))


ProgressCallback = Callable[[str, float], None]
"""Called with the next step and the finished share."""


def measure(repeats: int, slices: int, seconds: float, advance: ProgressCallback) -> dict[str, SubjectResult]:
    """Return all figures by subject.

    Percentiles are medians over slices of time in which the subjects take turns, so that short disturbances on the
    machine affect only one slice of one subject.

    Args:
        repeats: number of searches for each maximum rate.
        slices: number of slices for each latency.
        seconds: duration of a slice.
        advance: called with the progress.

    Raises:
        UwbMitigationError: a node did not start, or no ranges arrive.
    """
    with open_bench() as bench:
        subjects = [
            Subject(bench, "relay", RangeCir, RELAYED, "relay", "driver"),
            Subject(bench, "relay_serialised", RangeCir, RELAYED, "relay serialised:=true", "driver"),
            Subject(bench, "mitigator", RangeCorrected, topics.RANGE_CORRECTED, "mitigator", "driver"),
            Subject(bench, "pipeline", RangeCorrected, topics.RANGE_CORRECTED, "pipeline"),
        ]
        for subject in subjects:
            subject.warm_up()
        latencies: dict[tuple[str, int], list[Latency]] = {}

        def measure_slice(subject: Subject, rate_hz: int) -> None:
            latency = subject.measure_latency(rate_hz, seconds)
            latencies.setdefault((subject.name, rate_hz), []).append(latency)

        steps: list[Step] = [
            (f"latency of {subject.name} at {rate_hz} Hz", seconds, partial(measure_slice, subject, rate_hz))
            for rate_hz in RATES_HZ
            for _ in range(slices)
            for subject in subjects
        ]
        run_steps([*steps, *searches(subjects, repeats)], advance)
        for subject in subjects:
            for rate_hz in RATES_HZ:
                of_rate = latencies[subject.name, rate_hz]
                subject.figures.latency_us[rate_hz] = Latency(
                    median(latency.p50 for latency in of_rate),
                    median(latency.p99 for latency in of_rate),
                    max(latency.max for latency in of_rate),
                )
            subject.figures.memory_mb = process_usage(subject.processes[0].pid).memory_mb
        return {subject.name: subject.figures for subject in subjects}


Step = tuple[str, float, Callable[[], None]]
"""Name of the step, approximate duration, s, and the function that measures."""


def rate_ratio(rate_hz: float, baseline_hz: float) -> float | None:
    """Return the ratio of two rates, or None if the baseline is 0: the lowest rate was not sustained."""
    return rate_hz / baseline_hz if baseline_hz else None


def searches(subjects: Sequence[Subject], repeats: int) -> list[Step]:
    """Return the steps that search the maximum rates, in turns."""
    return [
        (f"highest rate of {subject.name}", _SEARCH_S, subject.search_rate)
        for _ in range(repeats)
        for subject in subjects
    ]


def run_steps(steps: Sequence[Step], advance: ProgressCallback) -> None:
    """Run the steps one after the other."""
    total_s, done_s = sum(duration_s for _, duration_s, _ in steps), 0.0
    for name, duration_s, measure_step in steps:
        advance(name, done_s / total_s)
        measure_step()
        done_s += duration_s


_STALL_TIMEOUT_S = 10.0
SOAK_SAMPLES = 10
"""Number of samples of the processes during a soak. Allocators fill their pools before the first."""


@dataclass(frozen=True, slots=True)
class Usage:
    """Sum over all processes after a number of ranges."""

    ranges: int
    memory_mb: float
    descriptors: int
    threads: int


@dataclass(frozen=True, slots=True)
class SoakResult:
    """Results of a soak.

    Attributes:
        received, lost: number of received corrected ranges and of lost ranges between them.
        seconds: wall time.
        course: usage after each tenth of the ranges, or once per second if that is longer.
    """

    received: int
    lost: int
    seconds: float
    course: tuple[Usage, ...]


def soak(messages: int, rate_hz: float, *, one_process: bool, advance: Callable[[int], None]) -> SoakResult:
    """Play `messages` ranges at `rate_hz`.

    Args:
        messages: number of ranges to play.
        rate_hz: rate of the replay, Hz.
        one_process: use the pipeline instead of two nodes.
        advance: called with the number of received ranges.

    Raises:
        UwbMitigationError: a node did not start or has exited, or no more ranges arrive.
    """
    nodes = ("pipeline",) if one_process else ("mitigator", "driver")
    with open_bench() as bench:
        subject = Subject(bench, "soak", RangeCorrected, topics.RANGE_CORRECTED, *nodes)
        pids = [process.pid for process in subject.processes]

        def sample_usage(ranges: int) -> Usage:
            usages = [process_usage(pid) for pid in pids]
            return Usage(
                ranges,
                sum(usage.memory_mb for usage in usages),
                sum(usage.descriptors for usage in usages),
                sum(usage.threads for usage in usages),
            )

        subject.reset_counts()
        subject.play(rate_hz)
        began_s = moved_s = time.monotonic()
        received = lost = 0
        course: list[Usage] = []
        while received < messages:
            time.sleep(1.0)
            arrived, missing = subject.count()
            received, lost = received + arrived, lost + missing
            if received * SOAK_SAMPLES >= messages * (len(course) + 1):
                course.append(sample_usage(received))
            if arrived:
                moved_s = time.monotonic()
            elif time.monotonic() - moved_s > _STALL_TIMEOUT_S:
                raise UwbMitigationError(f"no more ranges arrive after {received} ranges")
            advance(received)
        seconds = time.monotonic() - began_s
        subject.pause()
    return SoakResult(received, lost, seconds, tuple(course))
