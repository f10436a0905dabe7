"""Conformal intervals by configuration, scaled by the predicted error.

The error left of a range is compared with a scale that grows with the predicted error; quantiles of that ratio
on configurations that were held out then promise a coverage on configurations to come (Vovk et al.,
"Algorithmic Learning in a Random World", chapter 2; a configuration, not a range, is what is exchangeable).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError

GROWTH = 0.1
"""Of the squared scale, with the square of the predicted error: far walls leave larger errors than near ones."""

LEAST_SCALE_M = 1e-3


@dataclass(frozen=True, slots=True)
class Intervals:
    """Variance = `variance_m2 + variance_per_m2 * predicted^2`; one standard deviation covers 68 %.

    Attributes:
        variance_m2, variance_per_m2: float32 values.
        sigmas95: standard deviations that cover 95 %.
    """

    variance_m2: float
    variance_per_m2: float
    sigmas95: float


def calibrate(
    left_m: NDArray[np.floating], predicted_m: NDArray[np.floating], configurations: NDArray[np.str_]
) -> Intervals:
    """Intervals from the errors left and the errors predicted on held-out configurations, each of shape (n,).

    Rows that are not finite count for nothing.

    Raises:
        DatasetError: no row is finite.
    """
    known = np.isfinite(left_m) & np.isfinite(predicted_m)
    if not known.any():
        raise DatasetError("no errors to calibrate intervals with")
    left, predicted, names = np.abs(left_m[known]), predicted_m[known], configurations[known]
    floor = max(float(np.median(left)), LEAST_SCALE_M) ** 2
    scale = np.sqrt(floor + GROWTH * np.square(predicted))
    narrow, wide = (_quantile(left / scale, names, level) for level in (0.68, 0.95))
    narrow = max(narrow, LEAST_SCALE_M)
    return Intervals(
        float(np.float32(floor * narrow**2)),
        float(np.float32(GROWTH * narrow**2)),
        min(max(wide / narrow, 1.0), 1e3),
    )


def _quantile(ratio: NDArray[np.floating], configurations: NDArray[np.str_], level: float) -> float:
    """The quantile at which a configuration to come is covered: all weigh the same, and one more is yet to come."""
    _, of, count = np.unique(configurations, return_inverse=True, return_counts=True)
    order = np.argsort(ratio, kind="stable")
    reached = np.cumsum(1 / count[of][order])
    wanted = min(level * (len(count) + 1), math.nextafter(len(count), 0))
    at = int(np.searchsorted(reached, wanted - 1e-9))
    return float(ratio[order][min(at, len(ratio) - 1)])
