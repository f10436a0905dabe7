"""Conformal intervals by configuration, scaled by the predicted error.

The residual of a range is divided by a scale that grows with the predicted error. Quantiles of this ratio on held-out
configurations guarantee the coverage on new configurations (Vovk et al., "Algorithmic Learning in a Random World",
chapter 2; configurations, not ranges, are exchangeable).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError

GROWTH = 0.1
"""Factor of the squared predicted error in the squared scale: larger errors leave larger residuals."""

MIN_SCALE_M = 1e-3


@dataclass(frozen=True, slots=True)
class Intervals:
    """Variance = `variance_m2 + variance_per_m2 * predicted^2`; one standard deviation covers 68 %.

    Attributes:
        variance_m2, variance_per_m2: float32 values.
        sigmas95: number of standard deviations that cover 95 %.
    """

    variance_m2: float
    variance_per_m2: float
    sigmas95: float

    def variance_of(self, predicted_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variances of ranges with these predicted errors, (n,), m^2."""
        return self.variance_m2 + self.variance_per_m2 * predicted_m**2


def fit_intervals(
    residual_m: NDArray[np.floating], predicted_m: NDArray[np.floating], configurations: NDArray[np.str_]
) -> Intervals:
    """Compute intervals from residuals and predicted errors on held-out configurations, each of shape (n,).

    Rows that are not finite are ignored.

    Raises:
        DatasetError: no row is finite.
    """
    finite = np.isfinite(residual_m) & np.isfinite(predicted_m)
    if not finite.any():
        raise DatasetError("no errors to calibrate intervals with")
    residual, predicted, names = np.abs(residual_m[finite]), predicted_m[finite], configurations[finite]
    floor = max(float(np.median(residual)), MIN_SCALE_M) ** 2
    scale = np.sqrt(floor + GROWTH * np.square(predicted))
    quantile68, quantile95 = (_quantile(residual / scale, names, level) for level in (0.68, 0.95))
    quantile68 = max(quantile68, MIN_SCALE_M)
    return Intervals(
        float(np.float32(floor * quantile68**2)),
        float(np.float32(GROWTH * quantile68**2)),
        min(max(quantile95 / quantile68, 1.0), 1e3),
    )


def _quantile(ratio: NDArray[np.floating], configurations: NDArray[np.str_], level: float) -> float:
    """Return the conformal quantile for a new configuration: equal weights, with one additional weight for it."""
    _, configuration_index, count = np.unique(configurations, return_inverse=True, return_counts=True)
    order = np.argsort(ratio, kind="stable")
    cumulative_weight = np.cumsum(1 / count[configuration_index][order])
    target_weight = min(level * (len(count) + 1), math.nextafter(len(count), 0))
    index = int(np.searchsorted(cumulative_weight, target_weight - 1e-9))
    return float(ratio[order][min(index, len(ratio) - 1)])
