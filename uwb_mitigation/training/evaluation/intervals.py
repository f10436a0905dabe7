"""Uncertainty of corrected ranges: conformal intervals of models of one site, and the scale of models for unknown sites.

Conformal: the residual of a range is divided by a scale that grows with the predicted error. Quantiles of this ratio on held-out
configurations guarantee the coverage on new configurations (Vovk et al., "Algorithmic Learning in a Random World",
chapter 2; configurations, not ranges, are exchangeable).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from uwb_mitigation.errors import DatasetError

GROWTH = 0.1
"""Factor of the squared predicted error in the squared scale: larger errors leave larger residuals."""

MIN_SCALE_M = 1e-3

SIZES_M = (0.0, *(2.0**exponent for exponent in range(-6, 5)))
"""Sizes of the predicted error at which scales are stored."""

_PER_M = 1024
"""Stored deviations are multiples of about a millimetre, which float32 represents exactly."""

MIN_DEVIATION_M = 0.08
"""Minimum standard deviation at an unknown site: reflections that the training data does not contain. Constant errors of anchors are
states of the filter. With 0.06, 0.08, 0.10, 0.12 and 0.15 m, live errors on simulated drives (sites 20 to 27, ten in flats, six as in
the tutorial) decrease with the minimum or stay, but the 68 % intervals on the EVK1000 logs become too short below 0.08 m."""

Scale = tuple[tuple[float, float], ...]
"""See `ModelCard.scale`."""


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

    @property
    def scale(self) -> Scale:
        """The standard deviation at `SIZES_M`."""
        return _scale_of(np.sqrt(self.variance_of(np.array(SIZES_M))))


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


def fit_scale(
    residual_m: NDArray[np.floating], predicted_m: NDArray[np.floating], weight: NDArray[np.floating]
) -> Scale:
    """Return the most likely standard deviations of Laplace distributed residuals, which increase with the predicted error.

    Args:
        residual_m: errors after correction on held-out data, m, (n,).
        predicted_m: predicted errors, m, (n,).
        weight: of each range in the likelihood, (n,).
    """
    ramps = np.clip((np.abs(predicted_m)[:, None] - SIZES_M[:-1]) / np.diff(SIZES_M), 0.0, 1.0)
    # The scale parameter of a Laplace distribution is its standard deviation divided by the square root of 2.
    magnitude, weight = math.sqrt(2.0) * np.abs(residual_m), weight / weight.sum()

    def objective(steps: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        deviation = steps[0] + ramps @ steps[1:]
        slope = weight * (1.0 - magnitude / deviation) / deviation
        loss = weight @ (np.log(deviation) + magnitude / deviation)
        return float(loss), np.append(slope.sum(), slope @ ramps)

    bounds = [(MIN_DEVIATION_M, None)] + [(0.0, None)] * ramps.shape[1]
    start = np.full(len(SIZES_M), MIN_DEVIATION_M)
    return _scale_of(np.cumsum(minimize(objective, start, jac=True, bounds=bounds).x))


def sigmas95_of(
    residual_m: NDArray[np.floating], deviation_m: NDArray[np.floating], configurations: NDArray[np.str_]
) -> float:
    """Return the number of standard deviations that cover 95 % of the residuals of a new configuration."""
    return min(max(_quantile(np.abs(residual_m) / deviation_m, configurations, 0.95), 1.0), 1e3)


def _scale_of(deviations_m: NDArray[np.floating]) -> Scale:
    return tuple(zip(SIZES_M, (np.ceil(_PER_M * deviations_m) / _PER_M).tolist(), strict=True))


def _quantile(ratio: NDArray[np.floating], configurations: NDArray[np.str_], level: float) -> float:
    """Return the conformal quantile for a new configuration: equal weights, with one additional weight for it."""
    _, configuration_index, count = np.unique(configurations, return_inverse=True, return_counts=True)
    order = np.argsort(ratio, kind="stable")
    cumulative_weight = np.cumsum(1 / count[configuration_index][order])
    target_weight = min(level * (len(count) + 1), math.nextafter(len(count), 0))
    index = int(np.searchsorted(cumulative_weight, target_weight - 1e-9))
    return float(ratio[order][min(index, len(ratio) - 1)])
