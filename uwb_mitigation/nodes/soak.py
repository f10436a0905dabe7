"""Runs many ranges through driver and mitigator, and watches what the processes take of the machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.nodes import topics, vitals
from uwb_mitigation.nodes.bench_nodes import Subject, open_bench

_STALLED_S = 10.0
_WARM = 0.1
"""Share of the ranges after which memory is taken as settled: allocators fill their pools first."""


@dataclass(frozen=True, slots=True)
class Vitals:
    """Of all processes together, after so many ranges."""

    ranges: int
    memory_mb: float
    descriptors: int
    threads: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of a soak.

    Attributes:
        received, lost: ranges that arrived corrected, and that are missing between them.
        seconds: wall time.
        settled, end: what was taken after a tenth of the ranges, and after all.
        highest_mb: memory at any time between the two.
    """

    received: int
    lost: int
    seconds: float
    settled: Vitals
    end: Vitals
    highest_mb: float


def soak(messages: int, rate_hz: float, *, one_process: bool, advance: Callable[[int], None]) -> Outcome:
    """Play `messages` ranges at `rate_hz`.

    Args:
        one_process: through the pipeline instead of two nodes.
        advance: told how many have arrived.

    Raises:
        UwbMitigationError: a node did not start, has ended, or nothing arrives any more.
    """
    nodes = ("pipeline",) if one_process else ("mitigator", "driver")
    with open_bench() as bench:
        subject = Subject(bench, "soak", RangeCorrected, topics.RANGE_CORRECTED, *nodes)
        pids = [process.pid for process in subject.processes]

        def look(ranges: int) -> Vitals:
            return Vitals(
                ranges,
                sum(vitals.memory_kb(pid) for pid in pids) / 1024,
                sum(vitals.descriptors(pid) for pid in pids),
                sum(vitals.threads(pid) for pid in pids),
            )

        subject.forget()
        subject.play(rate_hz)
        began_s = moved_s = time.monotonic()
        received = lost = 0
        settled: Vitals | None = None
        highest_mb = 0.0
        while received < messages:
            bench.spin_for(1.0)
            arrived, missing = subject.count()
            received, lost = received + arrived, lost + missing
            now = look(received)
            if settled is None and received >= _WARM * messages:
                settled = now
            if settled is not None:
                highest_mb = max(highest_mb, now.memory_mb)
            if arrived:
                moved_s = time.monotonic()
            elif time.monotonic() - moved_s > _STALLED_S:
                raise UwbMitigationError(f"nothing arrives any more after {received} ranges")
            advance(received)
        seconds = time.monotonic() - began_s
        subject.pause()
        end = look(received)
    assert settled is not None
    return Outcome(received, lost, seconds, settled, end, highest_mb)
