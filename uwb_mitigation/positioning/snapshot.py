"""The baseline: least squares on the latest range of each anchor, as if nothing were known of motion or outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.start import Height
from uwb_mitigation.positioning.tracks import Ranges, Track

FRESH_S = 0.5
EVERY_S = 0.1
_STEPS = 20
_SECOND_NS = 1_000_000_000


def snapshot(anchors: AnchorMap, ranges: Ranges, height: Height | None = None) -> Track:
    """A position ten times a second, wherever enough anchors (two, or three without a height) spoke within half a
    second; without velocities and covariances (NaN).

    Of several solutions that of the least squares wins: the descent starts from the anchors' centre and
    from beside it on all sides.
    """
    dims = 2 if height is not None else 3
    stamps, latest = _latest(len(anchors), ranges)
    enough = np.isfinite(latest).sum(axis=1) >= dims
    stamps, latest = stamps[enough], latest[enough]
    position = _solve(anchors.position, latest, height)
    nothing = np.full((len(stamps), 6, 6), np.nan)
    return Track(stamps, position, nothing[:, 0, :3], nothing)


def _latest(count: int, ranges: Ranges) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Times int64 (t,), and the fresh range of each anchor then, float64 (t, count); NaN = none."""
    every = round(EVERY_S * _SECOND_NS)
    number = (ranges.stamp_ns - ranges.stamp_ns[:1]) // every
    # The last range of each interval.
    ends = np.flatnonzero(np.diff(number, append=number[-1:] + 1)) if len(number) else np.zeros(0, np.intp)
    found = np.full((len(ends), count), np.nan)
    for row in range(count):
        own = np.flatnonzero(ranges.anchor == row)
        before = np.searchsorted(own, ends, side="right") - 1
        some = before >= 0
        last = own[before[some]]
        age = ranges.stamp_ns[ends[some]] - ranges.stamp_ns[last]
        found[some, row] = np.where(age <= FRESH_S * _SECOND_NS, ranges.range_m[last], np.nan)
    return ranges.stamp_ns[ends], found


def _solve(
    anchors: NDArray[np.float64], range_m: NDArray[np.float64], height: Height | None
) -> NDArray[np.float64]:
    """Least squares for every row of ranges (t, m) at once, by Levenberg and Marquardt; float64 (t, 3)."""
    present = np.isfinite(range_m)
    wanted = np.where(present, range_m, 0.0)
    reach = np.nanmedian(range_m, axis=1, keepdims=True) if len(range_m) else np.zeros((0, 1))
    best, least = np.zeros((len(wanted), 3)), np.full(len(wanted), np.inf)
    sides = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -0.5]]) + 0.01
    for side in sides:
        x = anchors.mean(axis=0) + reach * side
        if height is not None:
            x[:, 2] = height.value
        damping = np.full(len(x), 1e-3)
        cost, gradient, normal = _normal(x, anchors, wanted, present, height)
        for _ in range(_STEPS):
            scaled = normal + (damping[:, None] * np.einsum("tii->ti", normal) + 1e-9)[..., None] * np.eye(3)
            trial = x - np.linalg.solve(scaled, gradient[..., None])[..., 0]
            new = _normal(trial, anchors, wanted, present, height)
            better = new[0] <= cost
            x = np.where(better[:, None], trial, x)
            cost = np.where(better, new[0], cost)
            gradient = np.where(better[:, None], new[1], gradient)
            normal = np.where(better[:, None, None], new[2], normal)
            damping = np.clip(np.where(better, damping / 5.0, damping * 5.0), 1e-9, 1e9)
        nearer = cost < least
        best, least = np.where(nearer[:, None], x, best), np.where(nearer, cost, least)
    return best


def _normal(
    x: NDArray[np.float64],
    anchors: NDArray[np.float64],
    wanted: NDArray[np.float64],
    present: NDArray[np.bool_],
    height: Height | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    away = x[:, None] - anchors
    distance = np.maximum(np.linalg.norm(away, axis=2), 1e-6)
    slope = away / distance[..., None] * present[..., None]
    residual = (distance - wanted) * present
    if height is not None:
        slope[..., 2] = 0.0
    normal = np.einsum("tmi,tmj->tij", slope, slope)
    if height is not None:
        normal[:, 2, 2] = 1.0
    return (residual**2).sum(axis=1), np.einsum("tmi,tm->ti", slope, residual), normal
