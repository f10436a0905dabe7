"""Simulated drives past anchors, with the range errors of the measurement model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import Anchor, AnchorMap
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.tracks import Ranges, TruePath

HALL = AnchorMap(
    [
        Anchor(number, place, 0.01)
        for number, place in enumerate(
            [(0.0, 0.0, 2.5), (12.0, 0.0, 0.5), (12.0, 9.0, 2.5), (0.0, 9.0, 0.5), (6.0, 0.0, 1.5)], 1
        )
    ]
)
NANOSECONDS = 1_000_000_000


def circuit(time_s: NDArray[np.float64], height_m: float = 1.0) -> NDArray[np.float64]:
    """Return positions (n, 3) on an ellipse through the hall, at about 0.8 m/s."""
    phase = 0.2 * time_s
    return np.stack([6 + 4 * np.cos(phase), 4.5 + 3 * np.sin(phase), np.full_like(phase, height_m)], axis=1)


def drive(
    anchors: AnchorMap = HALL,
    *,
    seconds: float = 60.0,
    rate_hz: float = 40.0,
    seed: int = 1,
    offset_m: float = 0.1,
    model: NoiseModel | None = None,
    path=circuit,
) -> tuple[Ranges, TruePath]:
    """Return ranges to the anchors in turn, with white noise, correlated errors and a common offset."""
    model = model or NoiseModel()
    rng = np.random.default_rng(seed)
    n = round(seconds * rate_hz)
    time_s = np.arange(n) / rate_hz
    anchor = np.arange(n) % len(anchors)
    position = path(time_s)
    kept = np.exp(-len(anchors) / rate_hz / model.persistence_s)
    error = np.empty(n)
    persisting = rng.normal(0, 1, len(anchors))
    for i in range(n):
        row = anchor[i]
        persisting[row] = kept * persisting[row] + np.sqrt(1 - kept**2) * rng.normal()
        error[i] = persisting[row]
    error *= model.range_sd * np.sqrt(1 - model.white)
    error += rng.normal(0, model.range_sd * np.sqrt(model.white), n) + offset_m
    distance = np.linalg.norm(position - anchors.position[anchor], axis=1)
    stamp_ns = np.rint(time_s * NANOSECONDS).astype(np.int64)
    nothing = np.full(n, np.nan)
    ranges = Ranges(stamp_ns, anchor, distance + error, np.full(n, model.range_sd**2), nothing, 7)
    return ranges, TruePath(stamp_ns, position)


WALL = AnchorMap(
    [
        Anchor(number, place, 0.03)
        for number, place in enumerate(
            [(1, -3, 0.2), (1, 3, 0.2), (1, -3, 2.5), (1, 3, 2.5), (1.1, 0, 1.3)], 1
        )
    ]
)
"""Anchors on one wall: beyond it is a mirror image of every position."""


def flight(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions (n, 3) of a drone that ascends from 0.08 m in front of `WALL` and lands."""
    height = 0.08 + 1.2 * np.sin(np.pi * np.clip(time_s / 60.0, 0.0, 1.0))
    return np.stack([-1.2 + 1.4 * np.sin(0.3 * time_s), 2.5 * np.sin(0.21 * time_s + 1.0), height], axis=1)


def block(ranges: Ranges, seed: int = 1, share: float = 0.25, mean_m: float = 0.5, anchors=None) -> Ranges:
    """Lengthen the ranges of each anchor (or of `anchors`) in a share of intervals of 2 s."""
    rng = np.random.default_rng(seed)
    interval = (ranges.stamp_ns - ranges.stamp_ns[0]) // (2 * NANOSECONDS)
    for row in np.unique(ranges.anchor) if anchors is None else anchors:
        size = int(interval.max()) + 1
        longer = (rng.random(size) < share) * rng.exponential(mean_m, size)
        own = ranges.anchor == row
        ranges.range_m[own] += longer[interval[own]]
    return ranges
