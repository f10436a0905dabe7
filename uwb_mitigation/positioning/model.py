"""How a tag moves and how its ranges err: the assumptions that filter, smoothers and survey share.

A range errs in three parts. White noise is small: two ranges in a row differ by a centimetre or two. What
is left persists while the tag moves about a metre, since multipath and obstacles do: a Gauss-Markov process of
each pair. And one offset stays, of the tag's own antenna delay. A published variance tells the first two
together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError


@dataclass(frozen=True, slots=True)
class Model:
    """How a tag moves and how its ranges err.

    Attributes:
        acceleration: root of the spectral density of white acceleration, m/s^1.5: 1 for robots, people and
            drones (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 6.2.2).
        speed: standard deviation of an unknown velocity, m/s in each axis.
        range_sd: of a range that comes without a variance, m: 0.10 is what the DW1000's data sheet promises.
        white: part of a range's variance that is new with each range.
        persistence_s: time constant of the other part: a metre at walking speed.
        offset_sd: of the offset that a tag's ranges share, m. 0.15: of a radio whose antenna delay nobody calibrated,
            ranges are off by 0.30 m at three sigma (Decawave APS014), and a pair has two.
        pair_sd: of what an anchor's own antenna delay adds to that, m; the smoother and what learns offsets have
            it, the live filter does not.
        long, short: thresholds of a normalised residual, beyond which a range that is too long or too short
            weighs less. Obstacles only lengthen: too long is doubted sooner.
    """

    acceleration: float = 1.0
    speed: float = 1.0
    range_sd: float = 0.10
    white: float = 0.1
    persistence_s: float = 1.0
    offset_sd: float = 0.15
    pair_sd: float = 0.10
    long: float = 1.0
    short: float = 1.5

    def __post_init__(self) -> None:
        limits = {
            "acceleration": (1e-3, 1e3),
            "speed": (1e-3, 1e3),
            "range_sd": (1e-3, 1e2),
            "white": (1e-3, 1.0),
            "persistence_s": (1e-3, 1e6),
            "offset_sd": (0.0, 1e2),
            "pair_sd": (0.0, 1e2),
            "long": (0.1, 100.0),
            "short": (0.1, 100.0),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ParameterError(
                    f"{name} = {value}", where="motion and range model", valid=f"{low} to {high}"
                )

    def inflation(self, z: float) -> float:
        """By how much the variance of a range grows whose normalised residual is `z` (measured - expected)."""
        limit = self.long if z > 0.0 else self.short
        return 1.0 if abs(z) <= limit else (z / limit) ** 2

    def weight(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """What is left of the weight of ranges with normalised residuals `z`: the inverse of `inflation`."""
        ratio = np.where(z > 0.0, self.long, self.short) / np.maximum(np.abs(z), 1e-12)
        weight: NDArray[np.float64] = np.minimum(1.0, ratio) ** 2
        return weight

    def loss(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minus the log likelihood of normalised residuals, whose derivative is z * weight(z).

        Huber's parabola within the thresholds; beyond, a logarithm, where Huber has a line: a reflection that is
        ten metres off pulls less than one that is one metre off, yet never nothing.
        """
        limit = np.where(z > 0.0, self.long, self.short)
        ratio = np.maximum(np.abs(z) / limit, 1e-12)
        loss: NDArray[np.float64] = np.where(
            ratio <= 1.0, 0.5 * z * z, limit**2 * (0.5 + np.log(np.maximum(ratio, 1.0)))
        )
        return loss

    def variance(self, published_m2: float) -> float:
        """The variance to use of a range: the published one, or the assumed one where none is known."""
        if math.isfinite(published_m2) and published_m2 > 0.0:
            return published_m2
        return self.range_sd**2
