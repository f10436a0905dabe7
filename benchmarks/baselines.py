"""Simple position filters, to which the product is compared: an extended Kalman filter with Huber's loss, with or without offset.

The model is the one of a textbook: constant velocity, white range errors with a fixed standard deviation, and one offset
that all ranges have in common, if it is estimated. No constant was tuned on a data set.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Estimate, Heights, Ranges, Track

RANGE_SD_M = 0.10
ACCELERATION = 1.0
"""Root of the spectral density of white acceleration, m/s^1.5."""

HUBER = 1.345
"""Normalised innovation from which a range is down-weighted (95 % efficiency with normal errors)."""

START_SD_M, SPEED_SD = 1.0, 1.0
MAX_GAP_S = 3.0
_OFFSET = 6


def run_ekf(
    anchors: AnchorMap,
    ranges: Ranges,
    start: Track,
    *,
    height: Height | None = None,
    heights: Heights | None = None,
    offset_sd_m: float = 0.0,
) -> Track:
    """Return the estimate after each range.

    Args:
        anchors: rows of `ranges`.
        ranges: in the order of time; variances are used where they are known.
        start: positions from least squares: the filter starts at the first one, and again after a gap.
        height: constant height of the tag; its velocity is horizontal.
        heights: measured heights of the tag.
        offset_sd_m: standard deviation of the common offset; 0: no offset.
    """
    estimates: list[Estimate] = []
    state: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    used_heights, last_ns = 0, 0
    variances = np.where(ranges.variance_m2 > 0.0, ranges.variance_m2, RANGE_SD_M**2)
    for stamp_ns, row, range_m, R in zip(
        ranges.stamp_ns.tolist(), ranges.anchor, ranges.range_m, variances, strict=True
    ):
        dt = (stamp_ns - last_ns) / 1e9
        last_ns = stamp_ns
        if state is None or dt > MAX_GAP_S:
            index = int(np.searchsorted(start.stamp_ns, stamp_ns))
            if index == len(start) or start.stamp_ns[index] != stamp_ns:
                state = None
                continue
            state = _initial(start.position[index], height, offset_sd_m)
            dt = 0.0
        x, P = _predict(*state, dt, level=height is not None)
        vector = x[:3] - anchors.position[row]
        distance = max(math.sqrt(vector @ vector), 0.05)
        H = np.zeros(7)
        H[:3], H[_OFFSET] = vector / distance, float(offset_sd_m > 0.0)
        x, P = _update(x, P, H, range_m - distance - H[_OFFSET] * x[_OFFSET], float(R))
        if heights is not None:
            while used_heights < len(heights) and heights.stamp_ns[used_heights] <= stamp_ns:
                H = np.eye(7)[2]
                z, variance = heights.height_m[used_heights], heights.variance_m2[used_heights]
                x, P = _update(x, P, H, z - x[2], float(variance))
                used_heights += 1
        state = x, P
        estimates.append(Estimate(stamp_ns, x[:3].copy(), x[3:6].copy(), P[:6, :6].copy()))
    return Track.from_estimates(estimates)


def _initial(
    position: NDArray[np.float64], height: Height | None, offset_sd_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, sd = np.zeros(7), np.array([START_SD_M] * 3 + [SPEED_SD] * 3 + [offset_sd_m])
    x[:3] = position
    if height is not None:
        x[2], sd[2], sd[5] = height.value, height.sd, 0.0
    return x, np.diag(sd**2)


def _predict(
    x: NDArray[np.float64], P: NDArray[np.float64], dt: float, *, level: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    F, Q, axes = np.eye(7), np.zeros((7, 7)), 2 if level else 3
    for axis in range(axes):
        F[axis, axis + 3] = dt
        Q[axis, axis], Q[axis + 3, axis + 3] = ACCELERATION**2 * dt**3 / 3.0, ACCELERATION**2 * dt
        Q[axis, axis + 3] = Q[axis + 3, axis] = ACCELERATION**2 * dt**2 / 2.0
    return F @ x, F @ P @ F.T + Q


def _update(
    x: NDArray[np.float64], P: NDArray[np.float64], H: NDArray[np.float64], innovation: float, R: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    S = float(H @ P @ H) + R
    z = abs(innovation) / math.sqrt(S)
    S *= max(1.0, z / HUBER)
    K = P @ H / S
    P = P - np.outer(K, K) * S
    return x + K * innovation, (P + P.T) / 2.0
