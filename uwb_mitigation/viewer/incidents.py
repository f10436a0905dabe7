"""What went wrong and when: anchors and tags that were lost and came back, positions and clocks that jumped."""

from __future__ import annotations

import math
from bisect import insort
from dataclasses import dataclass

import numpy as np

from uwb_mitigation.errors import format_id
from uwb_mitigation.positioning.health import NO_DATA_INTERVALS, NO_DATA_S
from uwb_mitigation.viewer.histories import BoundedDict, Pair, Pose

MAX_EVENTS, MAX_SOURCES = 500, 1000
CHECK_S = 0.5
"""Interval of the search for sources that have stopped."""
CLOCK_JUMP_S = 10.0
"""A larger change of the difference between stamps and the clock is a jump of a clock."""
JUMP_M, MAX_SPEED = 0.5, 10.0
"""A position jumps if it moves further than this, plus the time since the last one times this speed, m/s."""
SMOOTHING = 0.1
"""Weight of the latest interval in the mean interval of a source."""


@dataclass(slots=True)
class _Source:
    """Times of data: the latest one, the mean interval, its latest stamp or place, and whether it was reported as lost."""

    time_s: float
    interval_s: float = math.inf
    stamp_s: float = math.nan
    place: tuple[float, float] = (math.nan, math.nan)
    is_lost: bool = False


class Incidents:
    """Finds incidents in ranges and positions, which are added in the order of their times on one clock.

    Attributes:
        count: number of incidents.
        latest: time (s) and text of the latest `MAX_EVENTS`, in the order of time.
        largest_error: time (s) and text of the largest error of a recording, which is always shown.
        clock_jumps: {tag: time and size of the latest jump of the clock of its stamps, s}.
    """

    def __init__(self) -> None:
        self.count, self.latest = 0, list[tuple[float, str]]()
        self.largest_error: list[tuple[float, str]] = []
        self.clock_jumps: BoundedDict[int, tuple[float, float]] = BoundedDict(MAX_SOURCES)
        # A tag comes before its anchors.
        self._sources: BoundedDict[tuple[int | None, int | str], _Source] = BoundedDict(MAX_SOURCES)
        self._check_s = -math.inf

    def add(self, time_s: float, text: str) -> None:
        """Add an incident."""
        self.count += 1
        insort(self.latest, (time_s, text))
        del self.latest[:-MAX_EVENTS]

    def all(self) -> list[tuple[float, str]]:
        """Return what is kept, in the order of time."""
        return sorted([*self.latest, *self.largest_error])

    def add_range(self, pair: Pair, time_s: float, stamp_s: float) -> None:
        """Add a range at a time; `stamp_s` is on the clock of its tag."""
        source, passed_s = self._add((None, pair[1]), time_s)
        jump_s, source.stamp_s = stamp_s - source.stamp_s - passed_s, stamp_s
        # Ranges that are read late arrive at once.
        if abs(jump_s) > CLOCK_JUMP_S:
            self.clock_jumps.add(pair[1], (time_s, jump_s))
            self.add(time_s, f"clock of tag {format_id(pair[1])}: jump by {jump_s:+.0f} s")
        self._add(pair, time_s)

    def add_position(self, label: str, time_s: float, x: float, y: float) -> None:
        """Add a position of a tag."""
        source, passed_s = self._add((None, label), time_s)
        moved_m, source.place = math.dist(source.place, (x, y)), (x, y)
        if moved_m > JUMP_M + MAX_SPEED * passed_s:
            self.add(time_s, f"position of {label}: jump by {moved_m:.1f} m")

    def add_track(self, label: str, poses: Pose, end_s: float) -> None:
        """Add all positions of a tag until the end of a recording."""
        self._check_s = -math.inf
        for time_s, x, y in zip(*np.stack([poses.received_s, poses.x, poses.y]).tolist(), strict=True):
            self.add_position(label, time_s, x, y)
        self.check(end_s)

    def _add(self, key: tuple[int | None, int | str], time_s: float) -> tuple[_Source, float]:
        """Return a source and the time since its last data."""
        if time_s >= self._check_s:
            self.check(time_s)
        if (source := self._sources.get(key)) is None:
            source = self._sources.add(key, _Source(time_s))
            return source, math.nan
        passed_s, source.time_s = time_s - source.time_s, time_s
        if source.is_lost:
            source.is_lost = False
            self.add(time_s, f"{_name(key)}: back after {passed_s:.0f} s")
            if key[0] is None:
                # The tag was away, not its anchors.
                for (_, tag), source_of_tag in self._sources.items():
                    source_of_tag.time_s = time_s if tag == key[1] else source_of_tag.time_s
        else:
            mean_s = source.interval_s if math.isfinite(source.interval_s) else passed_s
            source.interval_s = mean_s + SMOOTHING * (passed_s - mean_s)
        return source, passed_s

    def check(self, now_s: float) -> None:
        """Report the sources without data at a time."""
        self._check_s = now_s + CHECK_S
        for key, source in self._sources.items():
            tag = self._sources.get((None, key[1]), source)
            is_late = now_s - source.time_s > max(NO_DATA_S, NO_DATA_INTERVALS * source.interval_s)
            if is_late and not tag.is_lost and not source.is_lost:
                source.is_lost = True
                self.add(source.time_s, f"{_name(key)}: lost")


def _name(key: tuple[int | None, int | str]) -> str:
    anchor_id, tag = key
    if isinstance(tag, str):
        return f"position of {tag}"
    name = f"tag {format_id(tag)}"
    return name if anchor_id is None else f"anchor {format_id(anchor_id)} of {name}"
