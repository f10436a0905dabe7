"""Fit the linear bias model by least absolute deviations to the mean of each configuration.

Least absolute deviations are used because a few configurations have errors of metres (wrong survey, no direct path), and
one mean per configuration because its measurements are not independent.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.model.linear_bias import LinearBiasModel

MIN_CONFIGURATIONS = 6
"""With fewer configurations, the linear bias model is their median, because three coefficients are not observable."""

MIN_POWER_RANGE_DB = 1.0
"""Minimum span of the received powers for fitting a line in the received power."""


def fit_linear_bias(
    configurations: NDArray[np.str_],
    rx_power_dbm: NDArray[np.floating],
    first_path_power_dbm: NDArray[np.floating] | None,
    error_m: NDArray[np.floating],
) -> LinearBiasModel:
    """Fit the linear bias model to measurements; all arrays have the shape (n,).

    Rows with an unknown power (NaN) are ignored. If too few configurations remain, or if their powers are almost equal, the
    linear_bias is the median over configurations.

    Args:
        first_path_power_dbm: None: fit a line in the received power only.

    Raises:
        DatasetError: there are no measurements.
    """
    if len(error_m) == 0:
        raise DatasetError("no measurements to fit a linear bias model to")
    powers = [rx_power_dbm]
    if first_path_power_dbm is not None:
        powers.append(rx_power_dbm - first_path_power_dbm)
    known = np.isfinite(np.sum(powers, axis=0))
    names = configurations[known]
    columns = [means(names, values[known]) for values in powers] if known.any() else []
    if not columns or len(columns[0]) < MIN_CONFIGURATIONS:
        return constant(configurations, error_m)
    design = np.column_stack([np.ones(len(columns[0])), *columns])
    is_flat = len(powers) == 1 and float(np.ptp(columns[0])) < MIN_POWER_RANGE_DB
    if is_flat or np.linalg.matrix_rank(design, tol=1e-3) < design.shape[1]:
        return constant(configurations, error_m)
    found = least_absolute_deviations(design, means(names, error_m[known]))
    return LinearBiasModel(*(float(np.float32(value)) for value in found))


def least_absolute_deviations(
    design: NDArray[np.floating], target: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Return coefficients (p,) that minimise `sum(abs(target - design @ coefficients))`; design (n, p), target (n,).

    Iteratively reweighted least squares with a decreasing floor on the residuals (Schlossmacher,
    "An iterative technique for absolute deviations curve fitting", JASA 1973), then a step to the
    vertex, because an optimum passes through p of the points.
    """
    points, unknowns = design.shape
    # Scale the columns: powers are much larger than the ones of the intercept.
    size = np.abs(design).max(axis=0)
    scaled = design / np.where(size > 0, size, 1)
    weight = np.ones(points)
    floor = max(float(np.abs(target).max()), 1e-9)
    coefficients = np.zeros(unknowns)
    for _ in range(200):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(scaled * root[:, None], target * root, rcond=None)[0]
        residual = np.abs(target - scaled @ coefficients)
        floor = max(0.9 * floor, 1e-9)
        weight = 1 / np.maximum(residual, floor)
    nearest = np.argsort(np.abs(target - scaled @ coefficients), kind="stable")[:unknowns]
    vertex = np.linalg.lstsq(scaled[nearest], target[nearest], rcond=None)[0]
    if np.abs(target - scaled @ vertex).sum() < np.abs(target - scaled @ coefficients).sum():
        coefficients = vertex
    return coefficients / np.where(size > 0, size, 1)


def constant(configurations: NDArray[np.str_], error_m: NDArray[np.floating]) -> LinearBiasModel:
    """Return the median over configurations of their mean errors; arguments of shape (n,), n > 0."""
    return LinearBiasModel(float(np.float32(np.median(means(configurations, error_m)))))


def means(configurations: NDArray[np.str_], values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean of each configuration, in the order of their names."""
    _, of = np.unique(configurations, return_inverse=True)
    means: NDArray[np.float64] = np.bincount(of, values.astype(np.float64)) / np.bincount(of)
    return means
