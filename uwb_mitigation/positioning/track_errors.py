"""How good a track is, where the truth is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import protection_levels
from uwb_mitigation.positioning.tracks import Track, TruePath

ELLIPSE95 = 5.991
"""95th percentile of chi-squared with two degrees of freedom."""


@dataclass(frozen=True, slots=True)
class TrackErrors:
    """Horizontal errors of a track, m unless said.

    Attributes:
        epochs: estimates with a truth beside them.
        rmse, median, p95: of the horizontal distance to the truth.
        coverage95: share of truths inside the 95 % ellipses; NaN without covariances.
        nees_per_dof: mean normalised estimation error squared, over its two degrees of freedom: 1 is honest,
            more is overconfident (Bar-Shalom et al., section 5.4); NaN without covariances.
        exceeded: share of epochs where the error in x or y was beyond its protection level; NaN likewise.
        height_rmse: RMSE of z.
    """

    epochs: int
    rmse: float
    median: float
    p95: float
    coverage95: float
    nees_per_dof: float
    exceeded: float
    height_rmse: float

    def as_json(self) -> dict[str, float | int | None]:
        """The keys of `track --json`; what is not known is null."""
        values = {
            "horizontal_rmse_m": self.rmse,
            "median_m": self.median,
            "p95_m": self.p95,
            "coverage95": self.coverage95,
            "nees_per_dof": self.nees_per_dof,
            "protection_exceeded": self.exceeded,
            "height_rmse_m": self.height_rmse,
        }
        return {"epochs": self.epochs} | {
            name: value if math.isfinite(value) else None for name, value in values.items()
        }


NO_ERRORS = TrackErrors(0, *(math.nan,) * 7)


def track_errors(track: Track, truth: TruePath, offset_ns: int = 0) -> TrackErrors:
    """The errors of a track at its own times.

    Args:
        track: estimates; covariances that are NaN are not judged.
        truth: true positions.
        offset_ns: what to add to the track's stamps to get times of the truth.
    """
    true = truth.at(track.stamp_ns + offset_ns)
    known = np.isfinite(true).all(axis=1)
    if not known.any():
        return NO_ERRORS
    return errors_of(track.position[known], track.covariance[known], true[known])


def errors_of(
    position: NDArray[np.float64], covariance: NDArray[np.float64], true: NDArray[np.float64]
) -> TrackErrors:
    """The errors of n positions (n, 3) with covariances (n, d, d) beside true ones (n, 3)."""
    error = position[:, :2] - true[:, :2]
    distance = np.hypot(*error.T)
    plane = covariance[:, :2, :2]
    coverage = nees = exceeded = math.nan
    if len(error) and np.isfinite(plane).all():
        squared = np.einsum("ni,ni->n", error, np.linalg.solve(plane, error[..., None])[..., 0])
        coverage = float((squared <= ELLIPSE95).mean())
        nees = float(squared.mean() / 2.0)
        exceeded = float((np.abs(error) > protection_levels(plane)).any(axis=1).mean())
    return TrackErrors(
        len(error),
        float(np.sqrt(np.mean(distance**2))),
        float(np.median(distance)),
        float(np.percentile(distance, 95)),
        coverage,
        nees,
        exceeded,
        float(np.sqrt(np.mean((position[:, 2] - true[:, 2]) ** 2))),
    )
