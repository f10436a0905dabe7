"""Models of the errors at a site that are used together with the offsets of its radios."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.site_data import SiteData
from uwb_mitigation.mitigation.model.floating import predict_m
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.weights import FloatWeights
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit import linear_fit

NO_MODEL, LINE, NETWORK, NETWORK_LINE = "", "line", "universal network", "universal network + line"
FINE_TUNED = "fine-tuned network"
"""Offsets only; a line in the received power and, if it is known, the power gap; the universal network multiplied by a factor,
also with a line, or trained further. In order of complexity."""

FineTune = Callable[[Dataset, NDArray[np.float64]], tuple[LinearBiasModel, FloatWeights]]
"""Returns a constant and a network for ranges and the predictions of the universal network for them, (n,), m."""

FACTOR_BOUNDS, MIN_SPREAD_M = (0.0, 1.5), 0.05
"""Bounds of the factor of the universal network's predictions, and the minimum spread that makes it observable."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteModel:
    """A linear bias model, and the factor of the universal network's predictions (0: none) or a network that replaces it."""

    linear_bias: LinearBiasModel
    factor: float = 0.0
    network: FloatWeights | None = None

    @property
    def has_network(self) -> bool:
        """Whether it needs CIRs."""
        return self.factor != 0.0 or self.network is not None

    def correction_m(self, site: SiteData) -> NDArray[np.float64]:
        """Return the predicted errors of all ranges, float64 (r,), m; 0 where a power that the line needs is unknown."""
        line = self.linear_bias
        # Without a power gap, the first-path power is not needed.
        first_path_dbm = site.first_path_power_dbm if line.per_power_gap else site.rx_power_dbm
        network_m = self.factor * site.universal_m
        if self.network is not None:
            network_m = predict_m(self.network, site.inputs).astype(np.float64)
        predicted_m = line.predict_m(site.rx_power_dbm, first_path_dbm) + network_m
        return np.where(np.isfinite(predicted_m), predicted_m, 0.0)


def fit_model(
    kind: str, data: Dataset, universal_m: NDArray[np.float64], fine_tune: FineTune | None = None
) -> SiteModel:
    """Fit a model.

    Args:
        kind: one of the names above.
        data: ranges with the offsets subtracted.
        universal_m: predictions of the universal network for them, float64 (n,), m.
        fine_tune: trains the network of `FINE_TUNED`.

    Raises:
        DatasetError: the fit fails.
    """
    if kind == NO_MODEL:
        return SiteModel(LinearBiasModel(0.0))
    if kind == FINE_TUNED and fine_tune is not None:
        constant, network = fine_tune(data, universal_m)
        return SiteModel(constant, network=network)
    factor = _factor(data, universal_m) if kind in (NETWORK, NETWORK_LINE) else 0.0
    residual_m = data.error_m - factor * universal_m
    has_gap = bool(np.isfinite(data.rx_power_dbm - data.first_path_power_dbm).mean() > 0.5)
    # A bundle with a network passes a range through if its first-path power is unknown.
    if kind == NETWORK or (kind == NETWORK_LINE and not has_gap):
        return SiteModel(linear_fit.fit_constant(data.configurations, residual_m), factor)
    first_path_dbm = data.first_path_power_dbm if has_gap else None
    line = linear_fit.fit_linear_bias(data.configurations, data.rx_power_dbm, first_path_dbm, residual_m)
    return SiteModel(line, factor)


def _factor(data: Dataset, universal_m: NDArray[np.float64]) -> float:
    """Fit the factor of the universal network's predictions to the errors.

    Noise of the predictions would bias the factor towards 0, and with it the estimated offsets.
    """
    predicted_m, error_m = (
        linear_fit.configuration_means(data.configurations, values) for values in (universal_m, data.error_m)
    )
    if len(predicted_m) < linear_fit.MIN_CONFIGURATIONS or float(np.ptp(predicted_m)) < MIN_SPREAD_M:
        return 1.0
    design = np.column_stack([np.ones(len(predicted_m)), predicted_m])
    factor = float(linear_fit.least_absolute_deviations(design, error_m)[1])
    return float(np.float32(np.clip(factor, *FACTOR_BOUNDS)))
