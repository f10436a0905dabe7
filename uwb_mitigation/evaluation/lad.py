"""The line prior fitted by least absolute deviations on one mean per configuration.

Least absolute deviations, because a few configurations are surveyed badly or have no path at all and
err by metres; one mean per configuration, because measurements of one are not independent.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.model.prior import LinePrior

MIN_CONFIGURATIONS = 6
"""Fewer do not bear a line of three coefficients: the prior is then their median."""


def fit_prior(
    configurations: NDArray[np.str_],
    rx_power_dbm: NDArray[np.floating],
    first_path_power_dbm: NDArray[np.floating],
    error_m: NDArray[np.floating],
) -> LinePrior:
    """The prior of measurements with these values, each of shape (n,).

    Powers may be NaN where unknown: those rows count for nothing, and where too few configurations
    remain, or their powers are all alike, the prior is the median over configurations.

    Raises:
        DatasetError: there are no measurements.
    """
    if len(error_m) == 0:
        raise DatasetError("no measurements to fit a prior to")
    gap = rx_power_dbm - first_path_power_dbm
    known = np.isfinite(gap)
    names = np.unique(configurations[known])
    if len(names) < MIN_CONFIGURATIONS:
        return constant(configurations, error_m)
    design = np.column_stack(
        [
            np.ones(len(names)),
            means(configurations[known], rx_power_dbm[known]),
            means(configurations[known], gap[known]),
        ]
    )
    if np.linalg.matrix_rank(design, tol=1e-3) < design.shape[1]:
        return constant(configurations, error_m)
    target = means(configurations[known], error_m[known])
    offset, per_rx_power, per_power_gap = (
        float(np.float32(value)) for value in least_absolute_deviations(design, target)
    )
    return LinePrior(offset, per_rx_power, per_power_gap)


def fit_level(
    configurations: NDArray[np.str_], rx_power_dbm: NDArray[np.floating], error_m: NDArray[np.floating]
) -> LinePrior:
    """A line in the received power alone, as `fit_prior`: for radios that tell no other. Arguments of shape (n,)."""
    known = np.isfinite(rx_power_dbm)
    names = np.unique(configurations[known])
    if len(names) < MIN_CONFIGURATIONS:
        return constant(configurations, error_m)
    level, target = (means(configurations[known], values[known]) for values in (rx_power_dbm, error_m))
    if float(np.ptp(level)) < 1.0:
        return constant(configurations, error_m)
    design = np.column_stack([np.ones(len(names)), level])
    offset, slope = least_absolute_deviations(design, target)
    return LinePrior(float(np.float32(offset)), float(np.float32(slope)))


def least_absolute_deviations(
    design: NDArray[np.floating], target: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Coefficients (p,) that minimise `sum(abs(target - design @ coefficients))`; design (n, p), target (n,).

    Iteratively reweighted least squares, its floor on the residuals lowered step by step (Schlossmacher,
    "An iterative technique for absolute deviations curve fitting", JASA 1973), then a step onto the
    vertex: an optimum passes through p of the points.
    """
    points, unknowns = design.shape
    # Columns of one size: the powers are large numbers beside the intercept's ones.
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


def constant(configurations: NDArray[np.str_], error_m: NDArray[np.floating]) -> LinePrior:
    """The median over configurations of their mean errors; arguments of shape (n,), n > 0."""
    return LinePrior(float(np.float32(np.median(means(configurations, error_m)))))


def means(configurations: NDArray[np.str_], values: NDArray[np.floating]) -> NDArray[np.float64]:
    """The mean of each configuration, in the order of their names."""
    _, of = np.unique(configurations, return_inverse=True)
    means: NDArray[np.float64] = np.bincount(of, values.astype(np.float64)) / np.bincount(of)
    return means
