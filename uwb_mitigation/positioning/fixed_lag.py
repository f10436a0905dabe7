"""Smoothing while it runs: where a tag was a second ago, with what came since."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.filter import RangeFilter
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.smoother import Parameters, Smoother
from uwb_mitigation.positioning.start import Area, Height
from uwb_mitigation.positioning.tracks import Estimate, Heights, Ranges, Track

LAG_S = 1.0
"""What a robot does next tells where it is now, for about so long."""

_BEFORE_S = 0.5
_EVERY_S = 0.1
_MOST_RANGES = 400
_ITERATIONS = 3
_SECOND_NS = 1_000_000_000

_Range = tuple[int, int, float, float]


class FixedLag:
    """Keeps the filter's states and the ranges of the last moments, and smooths over them when asked.

    Args:
        anchors, model, height, area: As of `TagLocator`.
    """

    def __init__(
        self, anchors: AnchorMap, model: Model, height: Height | None, area: Area | None = None
    ) -> None:
        self._anchors, self._model, self._height, self._area = anchors, model, height, area
        self._states: deque[tuple[int, RangeFilter]] = deque()
        self._ranges: deque[_Range] = deque()
        self._heights: deque[tuple[int, float, float]] = deque(maxlen=_MOST_RANGES)

    def add_height(self, height_m: float, variance_m2: float) -> None:
        """Take in the tag's height at the time of the latest range; the variance is positive."""
        if self._ranges:
            self._heights.append((self._ranges[-1][0], height_m, variance_m2))

    def add(self, known: RangeFilter, stamp_ns: int, anchor: int, range_m: float, variance_m2: float) -> None:
        """Take in a range, and the filter after it."""
        if self._ranges and stamp_ns < self._ranges[-1][0]:
            self.clear()
        self._ranges.append((stamp_ns, anchor, range_m, variance_m2))
        if not self._states or stamp_ns - self._states[-1][0] >= _EVERY_S * _SECOND_NS:
            self._states.append((stamp_ns, known.copy()))
        oldest = stamp_ns - round((LAG_S + _BEFORE_S + _EVERY_S) * _SECOND_NS)
        while self._states[0][0] < oldest:
            self._states.popleft()
        while self._ranges[0][0] < oldest:
            self._ranges.popleft()
        while self._heights and self._heights[0][0] < oldest:
            self._heights.popleft()

    def clear(self) -> None:
        """Forget all: the tag was lost."""
        self._states.clear()
        self._ranges.clear()
        self._heights.clear()

    def estimate(self) -> Estimate | None:
        """Where the tag was `LAG_S` before the latest range; None = not known for as long."""
        if not self._states or len(self._ranges) < 2:
            return None
        start_ns, known = self._states[0]
        wanted_ns = self._ranges[-1][0] - round(LAG_S * _SECOND_NS)
        if start_ns > wanted_ns:
            return None
        after = [row for row in self._ranges if row[0] > start_ns]
        # At a thousand ranges a second, every so-manieth tells as much: what persists does so for a second.
        after = after[:: math.ceil(len(after) / _MOST_RANGES)] if after else after
        if len(after) < 2:
            return None
        stamps = np.array([start_ns, *(row[0] for row in after)], np.int64)
        ranges = Ranges(
            stamps[1:],
            np.array([row[1] for row in after], np.intp),
            np.array([row[2] for row in after]),
            np.array([row[3] for row in after]),
            np.full(len(after), np.nan),
        )
        first = known.copy()
        first.predict(first.time_s + (int(stamps[1]) - start_ns) / _SECOND_NS)
        offset = Parameters(
            np.ones((len(after), 1)), np.zeros(1), np.array([max(self._model.offset_sd, 1e-3)])
        )
        guess = [*(state for stamp, state in self._states if stamp > start_ns)] or [first]
        times = [stamp for stamp, _ in self._states if stamp > start_ns] or [int(stamps[1])]
        initial = Track(
            np.array(times, np.int64),
            np.array([one.x[:3] for one in guess]),
            np.array([one.x[3:6] for one in guess]),
            np.zeros((len(guess), 6, 6)),
        )
        heights = None
        if self._heights:
            columns = [np.array(column) for column in zip(*self._heights, strict=True)]
            heights = Heights(columns[0], columns[1], columns[2])
        smoother = Smoother(
            self._anchors,
            self._model,
            ranges,
            height=self._height,
            parameters=offset,
            after=first,
            heights=heights,
        )
        try:
            track = smoother.fit(initial, _ITERATIONS).track
        except DatasetError:
            return None
        at = int(np.abs(track.stamp_ns - wanted_ns).argmin())
        ahead = (wanted_ns - int(track.stamp_ns[at])) / _SECOND_NS
        position = track.position[at] + ahead * track.velocity[at]
        if self._area is not None:
            position = self._area.clip(position)
        return Estimate(wanted_ns, position, track.velocity[at], track.covariance[at])
