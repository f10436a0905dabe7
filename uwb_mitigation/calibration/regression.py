"""What fits of a site share: the scatter of residuals, and unknown parameters on which ranges depend linearly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

MAD_TO_SD = 1.4826
MIN_ALIKE = 20
"""Minimum number of errors for an estimate of their standard deviation."""


def scatter_of(
    error_m: NDArray[np.float64], noise_group: NDArray[np.intp], kinds: int
) -> NDArray[np.float64]:
    """Return the standard deviation of each kind of errors (n,), float64 (kinds,), m: 1.48 times the median absolute error.

    Args:
        error_m: errors, float64 (n,), m.
        noise_group: int (n,), the kind of each. A kind with fewer than `MIN_ALIKE` errors gets the value of all errors.
        kinds: number of kinds.
    """
    scatter_m = np.full(kinds, MAD_TO_SD * float(np.median(np.abs(error_m))))
    for kind in range(kinds):
        errors_of_kind = error_m[noise_group == kind]
        if len(errors_of_kind) >= MIN_ALIKE:
            scatter_m[kind] = MAD_TO_SD * float(np.median(np.abs(errors_of_kind)))
    return scatter_m


NETWORK_SD = 0.03
"""Prior standard deviation of the factor of the universal network's predictions. It is small because errors of the
predictor reduce a free factor, and the remaining errors would appear in the offsets."""

SLOW_SD_M, CORRECTED_SLOW_SD_M = 0.10, 0.05
"""Standard deviation of the errors of a pair that stay the same for many seconds: reflections and obstacles at one position,
and the range bias of a DW1000, which changes by 0.1 m with the received power (Decawave APS011). The second value is for
ranges that the network corrects. Averaging does not reduce these errors, and residuals hardly show them, because the track
follows them. Simulated flats in which the first value was 0.05 got offsets of anchors with errors of 0.3 m."""

SLOPE_SD = 0.1
"""Prior standard deviation of the slope of a line in the received power, m/dB."""


@dataclass(frozen=True, slots=True, eq=False)
class Regressors:
    """Unknown parameters on which all ranges depend linearly: offsets, a factor of predictions, a line in received power.

    Attributes:
        names: of the q parameters.
        rows: float64 (n, q), derivative of each range with respect to each parameter; 0: unknown.
        mean, sd: float64 (q,), prior knowledge; an infinite sd: none.
        noise_group: int (n,), ranges whose errors have the same standard deviation have the same number, from 0.
        slow_sd_m: standard deviation of the errors that remain with these parameters and persist, see `SLOW_SD_M`.
    """

    names: tuple[str, ...]
    rows: NDArray[np.float64]
    mean: NDArray[np.float64]
    sd: NDArray[np.float64]
    noise_group: NDArray[np.intp]
    slow_sd_m: float = SLOW_SD_M

    @classmethod
    def single(cls, name: str, row: NDArray[np.float64], mean: float, sd: float) -> Regressors:
        """Return a single parameter with the derivatives float64 (n,); all ranges have errors of the same kind."""
        return cls((name,), row[:, None], np.array([mean]), np.array([sd]), np.zeros(len(row), np.intp))

    @classmethod
    def none(cls, ranges: int) -> Regressors:
        """Return no parameters, for that number of ranges."""
        return cls((), np.zeros((ranges, 0)), np.zeros(0), np.zeros(0), np.zeros(ranges, np.intp))

    @property
    def information(self) -> NDArray[np.float64]:
        """Inverse variances of the priors, float64 (q,)."""
        return 1.0 / np.maximum(self.sd, 1e-6) ** 2

    def select_rows(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Regressors:
        """Return the parameters for the ranges at `index`."""
        return replace(self, rows=self.rows[index], noise_group=self.noise_group[index])

    def concat(self, appended: Regressors) -> Regressors:
        """Return these parameters followed by the others; `noise_group` is unchanged."""
        return Regressors(
            self.names + appended.names,
            np.concatenate([self.rows, appended.rows], axis=1),
            np.concatenate([self.mean, appended.mean]),
            np.concatenate([self.sd, appended.sd]),
            self.noise_group,
            min(self.slow_sd_m, appended.slow_sd_m),
        )
