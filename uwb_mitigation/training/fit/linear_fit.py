"""Fit the linear bias model by least absolute deviations to the mean of each configuration.

Least absolute deviations are used because a few configurations have errors of metres (wrong survey, no direct path), and
one mean per configuration because its measurements are not independent.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel

MIN_CONFIGURATIONS = 6
"""With fewer configurations, the linear bias model is their median, because three coefficients are not observable."""

MAX_LOS_INCREASE_M, MAX_LOS_STEPS, LOS_WEIGHT_STEP = 0.02, 8, 1.5
"""Largest increase of the error of LOS ranges by a line that is fitted to single ranges, and how it is enforced."""

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
        configurations: name of the configuration of each measurement.
        rx_power_dbm: received power, dBm.
        first_path_power_dbm: first-path power, dBm; None: fit a line in the received power only.
        error_m: measured - true range, m.

    Raises:
        DatasetError: there are no measurements.
    """
    if len(error_m) == 0:
        raise DatasetError("no measurements to fit a linear bias model to")
    powers = [rx_power_dbm]
    if first_path_power_dbm is not None:
        powers.append(rx_power_dbm - first_path_power_dbm)
    has_powers = np.isfinite(np.sum(powers, axis=0))
    names = configurations[has_powers]
    if len(np.unique(names)) < MIN_CONFIGURATIONS:
        return fit_constant(configurations, error_m)
    *columns, target = (configuration_means(names, values[has_powers]) for values in (*powers, error_m))
    design = np.column_stack([np.ones(len(target)), *columns])
    has_constant_power = len(powers) == 1 and float(np.ptp(columns[0])) < MIN_POWER_RANGE_DB
    if has_constant_power or np.linalg.matrix_rank(design, tol=1e-3) < design.shape[1]:
        return fit_constant(configurations, error_m)
    return _model(least_absolute_deviations(design, target))


def fit_linear_bias_to_rows(
    rx_power_dbm: NDArray[np.floating],
    first_path_power_dbm: NDArray[np.floating],
    error_m: NDArray[np.floating],
    is_los: NDArray[np.bool_],
) -> LinearBiasModel:
    """Fit the linear bias model to single ranges, for recordings without CIRs; all arrays have the shape (n,), n > 0.

    In such recordings, a configuration is often a whole environment with LOS and NLOS ranges, so that its mean shows no
    line. LOS ranges get more weight until their error does not grow; if it still does, or without levels, the model is
    a constant, that of the LOS ranges if the median of all is too large for them. Levels that no range has are not used.

    Args:
        rx_power_dbm: received power, dBm; NaN: unknown.
        first_path_power_dbm: first-path power, dBm; NaN: unknown.
        error_m: measured - true range, m.
        is_los: whether a range is in line of sight.
    """
    of_los, offset_m = error_m[is_los], float(np.median(error_m))
    limit_m = float(np.abs(of_los).mean()) + MAX_LOS_INCREASE_M if len(of_los) else np.inf
    if len(of_los) and np.abs(of_los - offset_m).mean() > limit_m:
        offset_m = float(np.median(of_los))
    constant = _model([offset_m])
    columns = [rx_power_dbm.astype(np.float64)]
    gap = columns[0] - first_path_power_dbm
    if np.isfinite(gap).any():
        columns.append(gap)
    has_levels = np.isfinite(np.sum(columns, axis=0))
    design = np.column_stack([np.ones(len(error_m)), *columns])[has_levels]
    target, los = error_m[has_levels], is_los[has_levels]
    has_line = len(design) and float(np.ptp(design[:, 1])) >= MIN_POWER_RANGE_DB
    if not has_line or np.linalg.matrix_rank(design, tol=1e-3) < design.shape[1]:
        return constant
    weight = np.ones(len(target))
    limit_m = float(np.abs(target[los]).mean()) + MAX_LOS_INCREASE_M if los.any() else np.inf
    for _ in range(MAX_LOS_STEPS):
        coefficients = least_absolute_deviations(design * weight[:, None], target * weight)
        if not los.any() or np.abs((target - design @ coefficients)[los]).mean() <= limit_m:
            break
        weight[los] *= LOS_WEIGHT_STEP
    else:
        return constant
    return _model(coefficients)


def least_absolute_deviations(
    design: NDArray[np.floating], target: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Return coefficients (p,) that minimise `sum(abs(target - design @ coefficients))`; design (n, p), target (n,).

    The coefficients are the multipliers of the dual linear programme, which has n bounded variables and p constraints
    (Barrodale and Roberts, "An improved algorithm for discrete l1 linear approximation", SIAM J. Numer. Anal. 1973).

    Raises:
        DatasetError: the solver fails.
    """
    # SciPy takes 0.3 s to import.
    from scipy.optimize import linprog

    # Powers are much larger than the ones of the intercept.
    column_scale = np.abs(design).max(axis=0)
    column_scale = np.where(column_scale > 0, column_scale, 1)
    solution = linprog(
        -target, A_eq=(design / column_scale).T, b_eq=np.zeros(design.shape[1]), bounds=(-1, 1)
    )
    if not solution.success:
        raise DatasetError(f"the linear bias model cannot be fitted: {solution.message}")
    return np.asarray(-solution.eqlin.marginals / column_scale, np.float64)


def fit_constant(configurations: NDArray[np.str_], error_m: NDArray[np.floating]) -> LinearBiasModel:
    """Return the median over configurations of their mean errors; arguments of shape (n,), n > 0."""
    return _model([float(np.median(configuration_means(configurations, error_m)))])


def _model(coefficients: Iterable[float]) -> LinearBiasModel:
    return LinearBiasModel(*(float(np.float32(value)) for value in coefficients))


def configuration_means(
    configurations: NDArray[np.str_], values: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the mean of each configuration, in the order of their names."""
    _, configuration_index = np.unique(configurations, return_inverse=True)
    return np.bincount(configuration_index, values.astype(np.float64)) / np.bincount(configuration_index)
