"""The filter of one tag with a known position: constant velocity, one range at a time.

State: position (0-2), velocity (3-5), the offset that the tag's ranges share (6), and the persisting error of each
anchor's ranges (7...). An extended Kalman filter with a Schmidt (considered) part: offset and errors keep their
uncertainty and correlations, but a range changes them only if they are observable (S. F. Schmidt 1966; partial updates
as in Brink, "Partial-Update Schmidt-Kalman Filter", 2017). Covariances in Joseph's form, which is valid for any gain.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Estimate

OFFSET = 6
FIRST_ERROR = 7
MIN_VARIANCE_M2 = 1e-6
"""Of white noise: measurements with less would make the covariance singular."""

SHORTEST_M = 0.05
"""Closer to an anchor, a range has no defined direction."""

_Filter = TypeVar("_Filter", bound="RangeFilter")


class RangeFilter:
    """Extended Kalman filter of the position and velocity of a tag.

    Args:
        anchors: `update` takes rows of these.
        model: motion and errors.
        time_s: of the first state.
        position: float64 (3,), m.
        covariance: float64 (3, 3) of `position`, m^2; a variance of 0 in z with `level`.
        level: the height is known and constant: no vertical motion.

    Attributes:
        time_s: of the state, s.
        x, P: state float64 (n,) and its covariance (n, n).
        updates_consider_states: whether ranges also change offset and errors, which are only considered otherwise.
    """

    __slots__ = (
        "P",
        "_H",
        "_anchors",
        "_error_variance",
        "_level",
        "_model",
        "time_s",
        "updates_consider_states",
        "x",
    )

    def __init__(
        self,
        anchors: AnchorMap,
        model: NoiseModel,
        time_s: float,
        position: NDArray[np.float64],
        covariance: NDArray[np.float64],
        *,
        level: bool = False,
    ) -> None:
        n = FIRST_ERROR + len(anchors)
        self._anchors = anchors.position
        self._model = model
        self._level = level
        self._H = np.zeros(n)
        # The unconditional variance of each pair's persisting error: what its last ranges' variances claim.
        self._error_variance = (1.0 - model.white) * model.range_sd**2 + anchors.sd**2
        self.updates_consider_states = False
        self.time_s = time_s
        self.x = np.zeros(n)
        self.x[:3] = position
        self.P = np.zeros((n, n))
        self.P[:3, :3] = covariance
        for axis in range(2 if level else 3):
            self.P[3 + axis, 3 + axis] = model.speed**2
        self.P[OFFSET, OFFSET] = model.offset_sd**2
        errors = np.arange(FIRST_ERROR, n)
        self.P[errors, errors] = self._error_variance

    def copy(self: _Filter) -> _Filter:
        """Return an independent copy."""
        other = copy.copy(self)
        for name in ("P", "_H", "_error_variance", "x"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def predict(self, time_s: float) -> None:
        """Predict the state at a later time; an earlier time has no effect."""
        dt = time_s - self.time_s
        if dt <= 0.0:
            return
        self.time_s = time_s
        x, P, model = self.x, self.P, self._model
        x[:3] += dt * x[3:6]
        P[:3] += dt * P[3:6]
        P[:, :3] += dt * P[:, 3:6]
        self._predict_errors(dt / model.persistence_s)
        q = model.acceleration**2 * dt
        for axis in range(2 if self._level else 3):
            P[axis, axis] += q * dt * dt / 3.0
            cross = q * dt / 2.0
            P[axis, axis + 3] += cross
            P[axis + 3, axis] += cross
            P[axis + 3, axis + 3] += q

    def _predict_errors(self, elapsed: float) -> None:
        """Predict the persisting errors after `elapsed` time constants."""
        decay = math.exp(-elapsed)
        self.x[FIRST_ERROR:] *= decay
        P = self.P
        P[FIRST_ERROR:] *= decay
        P[:, FIRST_ERROR:] *= decay
        diagonal = P.reshape(-1)[:: len(P) + 1]
        diagonal[FIRST_ERROR:] += (1.0 - decay * decay) * self._error_variance

    def update(self, anchor: int, range_m: float, variance_m2: float) -> tuple[float, float]:
        """Update with a range at the time of the state.

        Args:
            anchor: a row of the anchors.
            range_m: finite, m.
            variance_m2: of its error, including the persisting part; NaN: unknown.

        Returns:
            The innovation divided by its standard deviation, and this standard deviation in m.
        """
        model, x, H, row = self._model, self.x, self._H, FIRST_ERROR + anchor
        variance = model.variance(variance_m2)
        error_variance = self._error_variance[anchor]
        # The part of the variance that the pair's persisting error does not explain is white noise.
        white = max(model.white * variance, variance - error_variance)
        self._error_variance[anchor] += 0.1 * ((1.0 - model.white) * variance - error_variance)
        H[FIRST_ERROR:] = 0.0
        H[OFFSET] = H[row] = 1.0
        distance = self._linearize(self._anchors[anchor])
        return self._correct(H, float(range_m - distance - x[OFFSET] - x[row]), white)

    def _linearize(self, anchor: NDArray[np.float64]) -> float:
        """Set the derivatives of the distance in H; return the distance."""
        away = self.x[:3] - anchor
        distance = math.sqrt(away @ away)
        self._H[:3] = away / max(distance, SHORTEST_M)
        return distance

    def update_height(self, height_m: float, variance_m2: float) -> float:
        """Update with the height of the tag; return the normalised innovation."""
        H = np.zeros(len(self.x))
        H[2] = 1.0
        return self._correct(H, height_m - float(self.x[2]), variance_m2)[0]

    def confine(self, low: Sequence[float], high: Sequence[float]) -> bool:
        """Project the position onto a box; return whether it was outside.

        This is estimate projection (Simon, "Kalman filtering with state constraints", 2010): the covariance stays, so
        that repeated projections do not count as new information.
        """
        x = self.x
        # This runs after each update. Python numbers are faster here than NumPy scalars.
        x0, x1, x2 = x[:3].tolist()
        if low[0] <= x0 <= high[0] and low[1] <= x1 <= high[1] and low[2] <= x2 <= high[2]:
            return False
        for axis in range(3):
            beyond = x[axis] - min(max(x[axis], low[axis]), high[axis])
            if beyond == 0.0:
                continue
            gain = self.P[:, axis] / max(self.P[axis, axis], 1e-12)
            # If the correlation with another coordinate is steep, the linear model is not valid.
            gain[:3] = np.clip(gain[:3], -1.0, 1.0)
            if not self.updates_consider_states:
                gain[OFFSET:] = 0.0
            x -= gain * beyond
        x[:3] = np.clip(x[:3], low, high)
        return True

    def _correct(self, H: NDArray[np.float64], innovation: float, R: float) -> tuple[float, float]:
        """Robust update with a measurement with Jacobian H (n,) and noise variance R; return as `update`."""
        R = max(R, MIN_VARIANCE_M2)
        PH = self.P @ H
        HPH = float(H @ PH)
        sd = math.sqrt(HPH + R)
        z = innovation / sd
        S = (HPH + R) * self._model.inflation(z)
        K = PH / S
        if not self.updates_consider_states:
            K[OFFSET:] = 0.0
        self.x += K * innovation
        # Joseph's form (I - K H) P (I - K H)' + K R K', as updates of rank one.
        P = self.P - np.multiply.outer(K, PH)
        P -= np.multiply.outer(P @ H - (S - HPH) * K, K)
        self.P = P
        return z, sd

    def estimate(self, stamp_ns: int) -> Estimate:
        """Return position and velocity, at the stamp that the state is for."""
        return Estimate(stamp_ns, self.x[:3].copy(), self.x[3:6].copy(), self.P[:6, :6].copy())

    @property
    def position(self) -> NDArray[np.float64]:
        """Float64 (3,), m."""
        return self.x[:3]

    @property
    def horizontal_sd(self) -> float:
        """Root of the larger of the two horizontal variances, m."""
        return math.sqrt(max(self.P[0, 0], self.P[1, 1]))
