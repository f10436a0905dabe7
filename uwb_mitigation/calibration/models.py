"""Models of the errors at a site that are used together with the offsets of its radios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.site_data import SiteData
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit import linear_fit

NO_MODEL, LINE, NETWORK, NETWORK_LINE = "", "line", "universal network", "universal network + line"
"""Offsets only; a line in the received power and, if it is known, the power gap; the universal network, also with a line. In order
of complexity."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteModel:
    """A linear bias model, and if it `has_network` the universal one."""

    linear_bias: LinearBiasModel
    has_network: bool = False

    @property
    def is_line(self) -> bool:
        """Whether it corrects ranges without a network."""
        return self.linear_bias.needs_power and not self.has_network

    def correction_m(self, site: SiteData) -> NDArray[np.float64]:
        """Return the predicted errors of all ranges, float64 (r,), m; 0 where a power that the line needs is unknown."""
        line = self.linear_bias
        # Without a power gap, the first-path power is not needed.
        first_path_dbm = site.first_path_power_dbm if line.per_power_gap else site.rx_power_dbm
        predicted_m = line.predict_m(site.rx_power_dbm, first_path_dbm).astype(np.float64)
        if self.has_network:
            predicted_m = predicted_m + site.universal_m
        return np.where(np.isfinite(predicted_m), predicted_m, 0.0)


def fit_model(kind: str, data: Dataset, universal_m: NDArray[np.float64]) -> SiteModel:
    """Fit a model.

    Args:
        kind: one of the names above.
        data: ranges with the offsets subtracted.
        universal_m: predictions of the universal network for them, float64 (n,), m.

    Raises:
        DatasetError: the fit fails.
    """
    has_network = kind in (NETWORK, NETWORK_LINE)
    has_gap = bool(np.isfinite(data.rx_power_dbm - data.first_path_power_dbm).mean() > 0.5)
    # A bundle with a network passes a range through if its first-path power is unknown.
    if kind in (NO_MODEL, NETWORK) or (has_network and not has_gap):
        return SiteModel(LinearBiasModel(0.0), has_network)
    residual_m = data.error_m - universal_m if has_network else data.error_m
    first_path_dbm = data.first_path_power_dbm if has_gap else None
    line = linear_fit.fit_linear_bias(data.configurations, data.rx_power_dbm, first_path_dbm, residual_m)
    return SiteModel(line, has_network)
