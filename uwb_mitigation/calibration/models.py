"""Models of the errors at a site that are used together with the offsets of its radios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.site_data import SiteData
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit import linear_fit

NO_MODEL, LINE, NETWORK = "", "line", "universal network"
"""Offsets only; a line in the received power and, if it is known, the power gap; the universal network."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteModel:
    """A linear bias model, or if it `has_network` the universal network."""

    linear_bias: LinearBiasModel
    has_network: bool = False

    @property
    def is_line(self) -> bool:
        """Whether it is a line in the received power."""
        return self.linear_bias.needs_power

    def correction_m(self, site: SiteData) -> NDArray[np.float64]:
        """Return the predicted errors of all ranges, float64 (r,), m; 0 where a power that the line needs is unknown."""
        if self.has_network:
            return site.universal_m
        line = self.linear_bias
        # Without a power gap, the first-path power is not needed.
        first_path_dbm = site.first_path_power_dbm if line.per_power_gap else site.rx_power_dbm
        predicted_m = line.predict_m(site.rx_power_dbm, first_path_dbm).astype(np.float64)
        return np.where(np.isfinite(predicted_m), predicted_m, 0.0)


def fit_line(data: Dataset) -> SiteModel:
    """Fit a line to ranges with the offsets subtracted.

    Raises:
        DatasetError: the fit fails.
    """
    has_gap = bool(np.isfinite(data.rx_power_dbm - data.first_path_power_dbm).mean() > 0.5)
    first_path_dbm = data.first_path_power_dbm if has_gap else None
    return SiteModel(
        linear_fit.fit_linear_bias(data.configurations, data.rx_power_dbm, first_path_dbm, data.error_m)
    )
