"""Runs many ranges through driver and mitigator, and watches what the processes take of the machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.benches import vitals
from uwb_mitigation.benches.nodes import Subject, open_bench
from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.nodes import topics

_STALLED_S = 10.0
LOOKS = 10
"""The processes are looked at after each such part of the ranges. Allocators fill their pools in the first."""


@dataclass(frozen=True, slots=True)
class Look:
    """Of all processes together, after so many ranges."""

    ranges: int
    memory_mb: float
    descriptors: int
    threads: int


@dataclass(frozen=True, slots=True)
class Soaked:
    """Of a soak.

    Attributes:
        received, lost: ranges that arrived corrected, and that are missing between them.
        seconds: wall time.
        course: what was taken after each tenth of the ranges, or once a second where that is longer.
    """

    received: int
    lost: int
    seconds: float
    course: tuple[Look, ...]


def soak(messages: int, rate_hz: float, *, one_process: bool, advance: Callable[[int], None]) -> Soaked:
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

        def look(ranges: int) -> Look:
            seen = [vitals.look(pid) for pid in pids]
            return Look(
                ranges,
                sum(of.memory_mb for of in seen),
                sum(of.descriptors for of in seen),
                sum(of.threads for of in seen),
            )

        subject.forget()
        subject.play(rate_hz)
        began_s = moved_s = time.monotonic()
        received = lost = 0
        course: list[Look] = []
        while received < messages:
            time.sleep(1.0)
            arrived, missing = subject.count()
            received, lost = received + arrived, lost + missing
            if received * LOOKS >= messages * (len(course) + 1):
                course.append(look(received))
            if arrived:
                moved_s = time.monotonic()
            elif time.monotonic() - moved_s > _STALLED_S:
                raise UwbMitigationError(f"nothing arrives any more after {received} ranges")
            advance(received)
        seconds = time.monotonic() - began_s
        subject.pause()
    return Soaked(received, lost, seconds, tuple(course))
