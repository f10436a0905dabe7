"""The constant offset of each pair of one tag, learnt while it drives.

A filter of its own beside the one that tells where the tag is: the same model, with an offset of each pair in place
of the one that all share. Where the tag was is found anew from the same ranges, so that it is known how much of an
offset may be an error of the place. It takes a few ranges a second: those between say the same again.

It learns from a range only while
- neither filter doubts it, in either direction: what leaves out the long alone would learn too short;
- the tag moves: at rest the same reflections come again and again, and look like an offset;
- geometry is good: more anchors are heard than a place needs, and around the tag.
What was learnt fades over hours: boards are swapped, and antenna delays go with the temperature.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.filter import OFFSET, RangeFilter
from uwb_mitigation.positioning.geometry import gdop
from uwb_mitigation.positioning.locator import TagLocator
from uwb_mitigation.positioning.model import Model

POOR_GDOP = 3.0
"""Beyond that a common offset and the place can hardly be told apart. Among anchors all around it is 1 to 2 in a plane;
in space, from anchors all at about one height, 4 and more, and what was learnt there was overconfident by two."""

SPARE_ANCHORS = 2
"""More anchors than a place needs: one for what all offsets share, one to contradict."""

SPACING_S = 0.2
"""Of two ranges of a pair that are taken."""

SLOWEST_M_PER_S = 0.15
"""A tag that moves less stands."""

PACE_M_PER_S = 1.0
"""At this pace errors fade as fast as the model says; when slower, the slower."""

FADING_S = 4.0 * 3600.0
"""Time constant of forgetting."""

_CHECK_S = 0.25
_STEADY_S = 2.0
_RESTART_S = 3.0
_START_SD_M = 1.0


class OffsetLearner:
    """Args:
        anchors, model: as of the tag's filter.
        level: the tag's height is known and stays.

    Attributes:
        offset_m: float64 (m,), by how much ranges are too long; 0 before anything was learnt.
        learnt: int (m,), how many ranges of each anchor it was learnt from, since the start.
    """

    def __init__(self, anchors: AnchorMap, model: Model, *, level: bool = False) -> None:
        m = len(anchors)
        self._anchors, self._model, self._level = anchors, model, level
        self._prior = np.full((m, m), model.offset_sd**2) + np.eye(m) * model.pair_sd**2
        self.offset_m = np.zeros(m)
        self._covariance = self._prior.copy()
        self.learnt = np.zeros(m, np.intp)
        self._filter: RangeFilter | None = None
        self._followed: RangeFilter | None = None
        self._velocity = np.zeros(3)
        self._last_s = self._taken_s = self._checked_s = -math.inf
        self._taken_of_s = np.full(m, -math.inf)
        self._known_s = math.inf
        self._good = False

    def know(self, mean_m: NDArray[np.float64], sd_m: NDArray[np.float64]) -> None:
        """Begin with what was learnt before: float64 (m,) both; a mean that is NaN = nothing of that pair.

        Pairs of which nothing is known get what the others share.
        """
        known = np.flatnonzero(np.isfinite(mean_m))
        if not len(known):
            return
        prior, variance = self._prior[np.ix_(known, known)], sd_m[known] ** 2
        shared = np.linalg.solve(prior, self._prior[known]).T
        self.offset_m = shared @ mean_m[known]
        told = np.diag(np.minimum(variance, np.diag(prior)))
        self._covariance = self._prior - shared @ (prior - told) @ shared.T

    @property
    def sd_m(self) -> NDArray[np.float64]:
        """Deviations of the offsets, float64 (m,), m; about a fifth too small, since only ranges that agree teach."""
        deviations: NDArray[np.float64] = np.sqrt(np.diag(self._covariance))
        return deviations

    def add(self, locator: TagLocator, anchor: int, range_m: float, variance_m2: float) -> bool:
        """Take in a range, as it came, after the tag's locator has taken it.

        Args:
            locator: of the tag.
            anchor, range_m, variance_m2: of the range, nothing learnt taken off.

        Returns:
            Whether the offsets are others now.
        """
        followed = locator.filter
        if followed is None:
            return False
        time_s = followed.time_s
        if followed is not self._followed:
            # The tag was found anew, its clock perhaps too.
            self._followed, self._filter = followed, None
            self._velocity[:] = 0.0
            self._last_s = self._taken_s = self._checked_s = -math.inf
            self._taken_of_s[:] = -math.inf
        if time_s - self._checked_s >= _CHECK_S:
            self._checked_s = time_s
            rows = locator.heard()
            enough = len(rows) >= (2 if self._level else 3) + SPARE_ANCHORS
            dilution = gdop(self._anchors.position[rows], followed.position, level=self._level)
            self._good = enough and dilution <= POOR_GDOP
        dt = min(time_s - self._last_s, _STEADY_S)
        self._last_s = time_s
        self._velocity += dt / _STEADY_S * (followed.x[3:6] - self._velocity)
        speed = math.sqrt(self._velocity @ self._velocity)
        limit = min(self._model.long, self._model.short)
        if not self._good or speed < SLOWEST_M_PER_S or abs(locator.states[anchor].z) > limit:
            return False
        if time_s - self._taken_of_s[anchor] < SPACING_S:
            return False
        return self._learn(followed, min(speed / PACE_M_PER_S, 1.0), limit, anchor, range_m, variance_m2)

    def _learn(
        self,
        followed: RangeFilter,
        pace: float,
        limit: float,
        anchor: int,
        range_m: float,
        variance_m2: float,
    ) -> bool:
        time_s = followed.time_s
        # The offsets stay; how sure they are goes back to what is known of any board.
        kept = math.exp(-max(time_s - self._known_s, 0.0) / FADING_S)
        self._known_s = time_s
        self._covariance = kept * self._covariance + (1.0 - kept) * self._prior
        if self._filter is None or time_s - self._taken_s > _RESTART_S:
            self._filter = self._start(followed)
            self._taken_s = time_s
        one = self._filter
        offsets = slice(OFFSET, one.first_error)
        one.p[offsets] *= math.sqrt(kept)
        one.p[:, offsets] *= math.sqrt(kept)
        one.p[offsets, offsets] = self._covariance
        one.predict(time_s, pace)
        if abs(one.innovation(anchor, range_m, variance_m2)) > limit:
            return False
        one.update(anchor, range_m, variance_m2)
        self._taken_s = self._taken_of_s[anchor] = time_s
        self.learnt[anchor] += 1
        self.offset_m = one.x[offsets].copy()
        self._covariance = one.p[offsets, offsets].copy()
        return True

    def _start(self, followed: RangeFilter) -> RangeFilter:
        """Where the tag is, roughly: what the ranges told of it is not told twice."""
        spread = np.eye(3) * _START_SD_M**2
        if self._level:
            spread[2, 2] = max(followed.p[2, 2], 1e-6)
        one = RangeFilter(
            self._anchors,
            self._model,
            followed.time_s,
            followed.position.copy(),
            spread,
            level=self._level,
            pair_offsets=(self.offset_m, self._covariance),
        )
        one.x[3:6] = followed.x[3:6]
        one.learns = True
        return one


def faded_sd(sd_m: float, elapsed_s: float, model: Model) -> float:
    """The deviation of an offset so long after it was learnt, m."""
    kept = math.exp(-max(elapsed_s, 0.0) / FADING_S)
    return math.sqrt(kept * sd_m**2 + (1.0 - kept) * (model.offset_sd**2 + model.pair_sd**2))
