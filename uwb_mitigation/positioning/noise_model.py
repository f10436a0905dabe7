"""Motion and range error models of filter, smoothers and survey.

The error of a range has three parts. White noise is small: two ranges in a row differ by a centimetre or two. Multipath and
obstacles persist while the tag moves by about a metre: a Gauss-Markov process of each pair. The antenna delay of the tag is
a constant offset. A published variance is the sum of the first two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, get_type_hints

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import check_range

STUDENT_DOF = 4.0
"""Degrees of freedom of the likelihood that compares hypotheses: heavy tails."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Motion and range error model; the annotations contain the limits.

    Attributes:
        acceleration: root of the spectral density of white acceleration, m/s^1.5: 1 for robots, people and
            drones (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 6.2.2).
        speed: standard deviation of an unknown velocity, m/s in each axis.
        range_sd: of a range without a variance, m: 0.10 is the value of the DW1000's data sheet.
        white: share of white noise in the variance of a range.
        persistence_s: time constant of the other part: a metre at walking speed.
        offset_sd: of the common offset of a tag's ranges, m. 0.15: without calibration of its antenna delay, a radio changes
            ranges by 0.30 m at three sigma (Decawave APS014), and a pair has two radios.
        pair_sd: of the additional offset of each anchor, m; the live filter does not use it.
        smoother_white: as `white`, for the batch smoother. On simulated drives its errors are 3 to 14 % smaller than with
            `white`, which suits the filter.
        long, short: thresholds of the normalised residual of a range that is too long or too short, from which its weight
            decreases. Obstacles lengthen ranges only, so `long` is the smaller one.
    """

    acceleration: Annotated[float, (1e-3, 1e3)] = 0.8
    speed: Annotated[float, (1e-3, 1e3)] = 1.0
    range_sd: Annotated[float, (1e-3, 1e2)] = 0.10
    white: Annotated[float, (1e-3, 1.0)] = 0.4
    persistence_s: Annotated[float, (1e-3, 1e6)] = 1.0
    offset_sd: Annotated[float, (0.0, 1e2)] = 0.15
    pair_sd: Annotated[float, (0.0, 1e2)] = 0.10
    smoother_white: Annotated[float, (1e-3, 1.0)] = 0.8
    long: Annotated[float, (0.1, 100.0)] = 0.8
    short: Annotated[float, (0.1, 100.0)] = 1.5

    def __post_init__(self) -> None:
        for name, hint in _HINTS.items():
            check_range("motion and range model", name, getattr(self, name), *hint.__metadata__[0])

    def inflation(self, z: float) -> float:
        """Return the factor of the variance of a range with the normalised residual `z` (measured - expected)."""
        limit = self.long if z > 0.0 else self.short
        return 1.0 if abs(z) <= limit else (z / limit) ** 2

    def weight(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the factor of the weights of ranges with normalised residuals `z`: the inverse of `inflation`."""
        ratio = np.where(z > 0.0, self.long, self.short) / np.maximum(np.abs(z), 1e-12)
        return np.minimum(1.0, ratio) ** 2

    def loss(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return minus the log likelihood of normalised residuals; its derivative is z * weight(z).

        Within the thresholds it is a parabola, beyond them a logarithm (Huber's loss: a line), so that a large outlier has less
        influence than a small one.
        """
        limit = np.where(z > 0.0, self.long, self.short)
        ratio = np.maximum(np.abs(z) / limit, 1e-12)
        return np.where(ratio <= 1.0, 0.5 * z * z, limit**2 * (0.5 + np.log(np.maximum(ratio, 1.0))))

    def student_loss(self, z: float) -> float:
        """Return minus the log likelihood of a normalised innovation for Student's t-distribution, without its constant.

        It compares hypotheses: unlike `loss`, it is normalised, so that a filter does not win by a larger variance.
        """
        return 0.5 * (STUDENT_DOF + 1.0) * math.log1p(z * z / STUDENT_DOF)

    def variance(self, published_m2: float) -> float:
        """Return the variance of a range: the published one, or the default if that is unknown."""
        if math.isfinite(published_m2) and published_m2 > 0.0:
            return published_m2
        return self.range_sd**2

    def variances(self, published_m2: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `variance` of each range, float64 (n,)."""
        is_known = np.isfinite(published_m2) & (published_m2 > 0.0)
        return np.where(is_known, published_m2, self.range_sd**2)


# Once: this takes as long as 20 checks.
_HINTS = get_type_hints(NoiseModel, include_extras=True)

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
