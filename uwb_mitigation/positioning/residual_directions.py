"""Recognises a displaced anchor by residuals that change with the direction to it. It also bends the track: the fit finds two thirds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

STEP_M, MIN_PLACES, MAX_PLACES = 1.0, 8, 60
"""Errors within a square of this side count once, because obstacles persist for metres; numbers of squares that are compared."""
MAX_AGE_S = 120.0
"""Older residuals are left out: the anchors file may have been corrected."""
DISPLACEMENT_SD_M, OFFSET_SD_M, NOISE_SD_M = 1.0, 0.3, 0.15
"""Prior standard deviations of the displacement and of the offset of an anchor, and that of the mean residual of a place."""
MIN_DISPLACEMENT_M, MIN_GAIN, STANDS_OUT = 0.5, 15.0, 2.0
"""Least displacement, gain in log likelihood, and its ratio to that of the next anchor: no right anchor is named in 32 drives of 150 s
(`benchmarks.sites`, seeds 1310, 1311, 1320, 1321), 13 of 32 that are 0.8 m off. In a hall, 3 of 54 alarms name a neighbour of one 1.2 to 3 m off."""

Key = TypeVar("Key")


class ResidualDirections:
    """Mean residuals of an anchor at the latest places of a tag."""

    def __init__(self) -> None:
        # {square: its time, s; number of ranges; sums of residual and horizontal direction from anchor to tag}, in the order of time.
        self._places: dict[tuple[float, float], list[float]] = {}
        self._latest_s = -math.inf
        self._fit: tuple[float, float] | None = None

    def add(self, time_s: float, range_m: float, tag: tuple[float, ...], anchor: tuple[float, ...]) -> None:
        """Add a range at a time on a steady clock, with the positions of antenna and anchor, x, y, z in m."""
        distance_m, self._latest_s = math.dist(tag, anchor), time_s
        if distance_m == 0.0 or not math.isfinite(range_m):
            return
        square = tag[0] // STEP_M, tag[1] // STEP_M
        place = self._places.get(square)
        if place is None:
            place = self._places[square] = [time_s, 0.0, 0.0, 0.0, 0.0]
            self._fit = None
            self._forget()
        place[1] += 1.0
        place[2] += range_m - distance_m
        place[3] += (tag[0] - anchor[0]) / distance_m
        place[4] += (tag[1] - anchor[1]) / distance_m

    def fit(self) -> tuple[float, float]:
        """Return the gain in log likelihood of a displacement compared with an offset alone, and the displacement, m."""
        self._forget()
        if self._fit is None:
            places = np.array(list(self._places.values()))
            is_enough = len(places) >= MIN_PLACES
            self._fit = _displacement(places[:, 2:] / places[:, 1:2]) if is_enough else (0.0, 0.0)
        return self._fit

    def _forget(self) -> None:
        num_old = sum(place[0] < self._latest_s - MAX_AGE_S for place in self._places.values())
        for square in list(self._places)[: max(num_old, len(self._places) - MAX_PLACES)]:
            del self._places[square]
            self._fit = None


def _displacement(means: NDArray[np.float64]) -> tuple[float, float]:
    residual_m, x, y = means.T
    columns = np.stack([-x, -y, np.ones_like(x)], axis=1) / NOISE_SD_M
    information = np.array([DISPLACEMENT_SD_M, DISPLACEMENT_SD_M, OFFSET_SD_M]) ** -2
    losses = []
    for first in (2, 0):
        rows, prior, weight = columns[:, first:], information[first:], np.ones_like(x)
        for _ in range(5):
            # Weights of Student's t-distribution with three degrees of freedom: some places are behind obstacles.
            normal = (rows.T * weight) @ rows + np.diag(prior)
            state = np.linalg.solve(normal, (rows.T * weight) @ residual_m / NOISE_SD_M)
            square = (residual_m / NOISE_SD_M - rows @ state) ** 2
            weight = 4.0 / (3.0 + square)
        losses.append(float(2.0 * np.log1p(square / 3.0).sum() + prior @ state**2 / 2.0))
    return losses[0] - losses[1], float(np.hypot(*state[:2]))


def displaced_anchor(anchors: Mapping[Key, ResidualDirections]) -> tuple[Key, float] | None:
    """Return the anchor that is probably displaced, and by how much at least, m; None: no anchor stands out."""
    if not anchors:
        return None
    fits = sorted(((*anchor.fit(), key) for key, anchor in anchors.items()), key=lambda fit: -fit[0])
    (gain, displacement_m, key), next_gain = fits[0], fits[1][0] if len(fits) > 1 else 0.0
    stands_out = displacement_m >= MIN_DISPLACEMENT_M and gain >= max(MIN_GAIN, STANDS_OUT * next_gain)
    return (key, displacement_m) if stands_out else None
