"""Recognises a displaced anchor while a tag moves: its residuals change with the direction to it, unlike an offset.

It also bends the track with which it is compared, so the fit finds about two thirds of the displacement.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

STEP_M, MIN_PLACES, MAX_PLACES = 1.0, 8, 60
"""Errors within a step count once, because obstacles persist for metres. The latest places of an anchor are compared."""
DISPLACEMENT_SD_M, OFFSET_SD_M, NOISE_SD_M = 1.0, 0.3, 0.15
"""Prior standard deviations of the displacement and of the offset of an anchor, and that of the mean residual of a place."""
MIN_DISPLACEMENT_M, MIN_GAIN, STANDS_OUT = 0.4, 20.0, 2.0
"""Least displacement, gain in log likelihood, and its ratio to that of the next anchor. In 32 simulated drives with right anchors no anchor exceeds
all three; half of the anchors do that are 0.8 m off. A height that is wrong by 1 m looks like a displacement in one of 16."""

Key = TypeVar("Key")
Vector = NDArray[np.float64]


class ResidualDirections:
    """Mean residuals of an anchor at the latest places of a tag."""

    def __init__(self) -> None:
        # Horizontal position, m; number of ranges; sums of residual and horizontal direction from anchor to tag.
        self._places: deque[list[float]] = deque(maxlen=MAX_PLACES)
        self._fit: tuple[float, float] | None = None

    def add(self, range_m: float, position: tuple[float, ...], anchor: tuple[float, ...]) -> None:
        """Add a range, with the position of the antenna and the anchor's, x, y, z in m."""
        distance_m = math.dist(position, anchor)
        if distance_m == 0.0 or not math.isfinite(range_m):
            return
        if not self._places or math.dist(position[:2], self._places[-1][:2]) > STEP_M:
            self._places.append([*position[:2], 0.0, 0.0, 0.0, 0.0])
            self._fit = None
        place = self._places[-1]
        place[2] += 1.0
        place[3] += range_m - distance_m
        place[4] += (position[0] - anchor[0]) / distance_m
        place[5] += (position[1] - anchor[1]) / distance_m

    def fit(self) -> tuple[float, float]:
        """Return the gain in log likelihood of a displacement compared with an offset alone, and the displacement, m."""
        if self._fit is None:
            # The last place is not complete.
            places = np.array(self._places)[:-1]
            is_enough = len(places) >= MIN_PLACES
            self._fit = _displacement(*(places[:, 3:] / places[:, 2:3]).T) if is_enough else (0.0, 0.0)
        return self._fit


def _displacement(residual_m: Vector, x: Vector, y: Vector) -> tuple[float, float]:
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
