"""The part of the predicted error without a network: a linear model of the powers that the radio reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_POWER_DBM = 1000.0
"""Levels with a larger absolute value are invalid; this also prevents float32 overflow."""


@dataclass(frozen=True, slots=True)
class LinearBiasModel:
    """`offset_m + per_rx_power * rx_power + per_power_gap * (rx_power - first_path_power)`.

    Coefficients are float32 values and the line is evaluated in float32. Each product and sum is rounded once and in
    this order, so that host and microcontroller give identical bits. If both slopes are zero, the line is a constant
    and needs no powers.

    Attributes:
        offset_m: constant term, m.
        per_rx_power: m per dBm.
        per_power_gap: m per dB.
    """

    offset_m: float
    per_rx_power: float = 0.0
    per_power_gap: float = 0.0

    @property
    def needs_power(self) -> bool:
        """Whether the model uses power levels."""
        return self.per_rx_power != 0.0 or self.per_power_gap != 0.0

    def predict_m(
        self, rx_power_dbm: NDArray[Any], first_path_power_dbm: NDArray[Any]
    ) -> NDArray[np.float32]:
        """Return the predicted errors, m, float32 (n,), of arrays of floats (n,).

        NaN if a power that the line needs is not finite or its absolute value exceeds `MAX_POWER_DBM`.
        """
        if not self.needs_power:
            return np.full(len(rx_power_dbm), self.offset_m, np.float32)
        is_valid = np.abs(rx_power_dbm) <= MAX_POWER_DBM
        is_valid &= np.abs(first_path_power_dbm) <= MAX_POWER_DBM
        rx, first_path = (
            np.where(is_valid, power, np.nan).astype(np.float32)
            for power in (rx_power_dbm, first_path_power_dbm)
        )
        gap = rx - first_path
        level = np.float32(self.offset_m) + np.float32(self.per_rx_power) * rx
        return np.asarray(level + np.float32(self.per_power_gap) * gap, np.float32)
