"""Motion and range error models of filter, smoothers and survey.

The error of a range has three parts. White noise is small: two ranges in a row differ by a centimetre or two. Multipath and
obstacles persist while the tag moves by about a metre: a Gauss-Markov process of each pair. The antenna delay of the tag is
a constant offset. A published variance is the sum of the first two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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
        return published_m2 if 0.0 < published_m2 < math.inf else self.range_sd**2

    def variances(self, published_m2: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `variance` of each range, float64 (n,)."""
        is_known = np.isfinite(published_m2) & (published_m2 > 0.0)
        return np.where(is_known, published_m2, self.range_sd**2)


# Once: this takes as long as 20 checks.
_HINTS = get_type_hints(NoiseModel, include_extras=True)
