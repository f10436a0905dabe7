"""Baselines: constants, and regressions on features of the CIR and of the header. Needs scikit-learn.

The nine features of the CIR are those used in the literature to classify NLOS propagation (Marano et al.,
"NLOS identification and mitigation for localization based on UWB experimental data", JSAC 2010).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.training.data.dataset import Dataset

LOS = "LOS"
RIDGE_PENALTY = 10.0
TREES, LEAVES = 100, 8

_FIRST_PATH = slice(5, 9)
_LATE = 60
_TINY = 1e-12

Predict = Callable[[Dataset], NDArray[np.floating]]


def los_median(train: Dataset) -> float:
    """Return the median error in LOS, or of all measurements if none has the label LOS, m."""
    los_errors = train.error_m[train.labels == LOS]
    return float(np.median(los_errors if len(los_errors) else train.error_m))


def overall_median(train: Dataset) -> float:
    """Return the median error, m."""
    return float(np.median(train.error_m))


def ridge(train: Dataset, *, header: bool) -> Predict:
    """Fit a ridge regression on standardised features of the CIR and, with `header`, of the header."""
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    model = make_pipeline(StandardScaler(), Ridge(RIDGE_PENALTY))
    model.fit(baseline_features(train, header=header), train.error_m, ridge__sample_weight=_weights(train))
    return lambda data: np.asarray(model.predict(baseline_features(data, header=header)), np.float64)


def gradient_boosting(train: Dataset, seed: int) -> Predict:
    """Fit gradient-boosted trees with absolute error on all features."""
    from sklearn.ensemble import HistGradientBoostingRegressor
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    model = HistGradientBoostingRegressor(
        loss="absolute_error", max_iter=TREES, max_leaf_nodes=LEAVES, random_state=seed
    )
    # On data this small, threads only add overhead.
    with threadpool_limits(1):
        model.fit(baseline_features(train, header=True), train.error_m, sample_weight=_weights(train))
    return lambda data: np.asarray(model.predict(baseline_features(data, header=True)), np.float64)


def baseline_features(dataset: Dataset, *, header: bool) -> NDArray[np.float64]:
    """Return nine features of each CIR window and, with `header`, six of its header: float64 (n, 9 or 15).

    Unknown values of the header are 0.
    """
    amplitude = dataset.inputs.astype(np.float64) ** 2
    power = amplitude**2
    energy = power.sum(axis=1) + _TINY
    taps = np.arange(power.shape[1])
    delay = power @ taps / energy
    spread = np.sqrt((power * (taps - delay[:, None]) ** 2).sum(axis=1) / energy)
    centred = amplitude - amplitude.mean(axis=1, keepdims=True)
    kurtosis = (centred**4).mean(axis=1) / (centred**2).mean(axis=1).clip(_TINY) ** 2
    peak = amplitude.max(axis=1)
    first = amplitude[:, _FIRST_PATH].max(axis=1)
    columns = [
        10 * np.log10(energy),
        20 * np.log10(peak + _TINY),
        20 * np.log10(first + _TINY),
        20 * np.log10((first + _TINY) / (peak + _TINY)),
        amplitude.argmax(axis=1),
        delay,
        spread,
        kurtosis,
        power[:, _LATE:].sum(axis=1) / energy,
    ]
    if header:
        rx_power = dataset.rx_power_dbm.astype(np.float64)
        columns += [rx_power, rx_power - dataset.first_path_power_dbm]
        headers = np.zeros((len(dataset), 2)) if dataset.headers is None else dataset.headers
        columns += [*headers.T.astype(np.float64), *np.log1p(headers.T.astype(np.float64))]
    return np.asarray(np.nan_to_num(np.column_stack(columns), nan=0.0, posinf=0.0, neginf=0.0), np.float64)


def _weights(train: Dataset) -> NDArray[np.float64]:
    """Return weights of the rows that give every configuration the same total weight."""
    _, group_index, count = np.unique(train.configurations, return_inverse=True, return_counts=True)
    return np.asarray(len(train) / (len(count) * count[group_index]), np.float64)
