"""Errors of a track against true positions: RMSE, coverage, consistency and protection levels."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import CHI2_95, PROTECTION, protection_levels
from uwb_mitigation.types.tracks import Track, TruePath

NORMAL95 = 1.96
"""Deviations that a normal error exceeds in 5 % of all cases (two-sided)."""


@dataclass(frozen=True, slots=True)
class TrackErrors:
    """Horizontal errors of a track, in m unless stated otherwise.

    Attributes:
        epochs: number of estimates with a known true position.
        rmse, median, p95: of the horizontal distance to the truth.
        coverage95: share of truths inside the 95 % ellipses; NaN without covariances.
        nees_per_dof: mean normalised estimation error squared, over its two degrees of freedom: 1 is consistent,
            more is overconfident (Bar-Shalom et al., section 5.4); NaN without covariances.
        exceeded: share of epochs with an error in x or y above its protection level; NaN without covariances.
        height_rmse: RMSE of z.
        heading_rmse_deg: RMSE of the yaw where it is known, degrees; NaN: never, or without a true yaw.
        heading_found_after_s: time from the first estimate to the first one with a yaw; NaN as above.
        heading_exceeded: share of known headings with an error above 3.29 standard deviations; NaN as above.
        height_coverage95: share of true heights within 1.96 standard deviations; NaN without covariances.
        height_exceeded: share of epochs with an error in z above its protection level; NaN without covariances.
    """

    epochs: int
    rmse: float = math.nan
    median: float = math.nan
    p95: float = math.nan
    coverage95: float = math.nan
    nees_per_dof: float = math.nan
    exceeded: float = math.nan
    height_rmse: float = math.nan
    heading_rmse_deg: float = math.nan
    heading_found_after_s: float = math.nan
    heading_exceeded: float = math.nan
    height_coverage95: float = math.nan
    height_exceeded: float = math.nan

    def as_json(self) -> dict[str, float | int | None]:
        """Return the keys of `track --json`; unknown values are null."""
        values = {_JSON_KEYS.get(key, key): value for key, value in asdict(self).items()}
        return {name: value if math.isfinite(value) else None for name, value in values.items()}


_JSON_KEYS = {
    "rmse": "horizontal_rmse_m",
    "median": "median_m",
    "p95": "p95_m",
    "exceeded": "protection_exceeded",
    "height_rmse": "height_rmse_m",
}

NO_ERRORS = TrackErrors(0)


def track_errors(track: Track, truth: TruePath) -> TrackErrors:
    """Return the errors of a track at its own times.

    Args:
        track: estimates; NaN covariances are not evaluated.
        truth: true positions.
    """
    true = truth.position_at(track.stamp_ns)
    known = np.isfinite(true).all(axis=1)
    if not known.any():
        return NO_ERRORS
    errors = errors_of(track.position[known], track.covariance[known], true[known])
    of_yaw = np.angle(np.exp(1j * (track.yaw[:, 0] - truth.yaw_at(track.stamp_ns))))
    is_known = np.isfinite(of_yaw)
    of_yaw, yaw_sd = of_yaw[is_known], np.sqrt(track.yaw[is_known, 4])
    if not len(of_yaw):
        return errors
    first = int(np.isfinite(track.yaw[:, 0]).argmax())
    return replace(
        errors,
        heading_rmse_deg=math.degrees(np.sqrt(np.mean(of_yaw**2))),
        heading_found_after_s=float(track.stamp_ns[first] - track.stamp_ns[0]) / 1e9,
        heading_exceeded=float((np.abs(of_yaw) > PROTECTION * yaw_sd).mean()),
    )


def errors_of(
    position: NDArray[np.float64], covariance: NDArray[np.float64], true: NDArray[np.float64]
) -> TrackErrors:
    """Return the errors of n positions (n, 3) with covariances (n, d, d) from true positions (n, 3)."""
    error = position[:, :2] - true[:, :2]
    distance, height_error = np.hypot(*error.T), np.abs(position[:, 2] - true[:, 2])
    errors = TrackErrors(
        len(error),
        rmse=float(np.sqrt(np.mean(distance**2))),
        median=float(np.median(distance)),
        p95=float(np.percentile(distance, 95)),
        height_rmse=float(np.sqrt(np.mean(height_error**2))),
    )
    plane = covariance[:, :2, :2]
    if not len(error) or not np.isfinite(plane).all():
        return errors
    height_sd = np.sqrt(covariance[:, 2, 2])
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(plane, error[..., None])[..., 0])
    return replace(
        errors,
        coverage95=float((squared <= CHI2_95).mean()),
        nees_per_dof=float(squared.mean() / 2.0),
        exceeded=float((np.abs(error) > protection_levels(plane)).any(axis=1).mean()),
        height_coverage95=float((height_error <= NORMAL95 * height_sd).mean()),
        height_exceeded=float((height_error > PROTECTION * height_sd).mean()),
    )
