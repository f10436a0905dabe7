"""The filter of one tag with a known position: constant velocity, one range at a time.

State: position (0-2), velocity (3-5), the offset that the tag's ranges share (6), and the persisting error of each
anchor's ranges (7...). An extended Kalman filter with a Schmidt (considered) part: offset and errors keep their
uncertainty and correlations, but a range changes them only if they are observable (S. F. Schmidt 1966; partial updates
as in Brink, "Partial-Update Schmidt-Kalman Filter", 2017). Covariances in Joseph's form, which is valid for any gain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.tracks import Estimate

OFFSET = 6
FIRST_ERROR = 7
_SHORTEST_M = 0.05
"""Closer to an anchor, a range has no defined direction."""


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
        x, p: state float64 (n,) and its covariance (n, n).
        learns: whether ranges also change offset and errors, which are only considered otherwise.
    """

    __slots__ = ("_anchors", "_claimed", "_h", "_level", "_model", "learns", "p", "time_s", "x")

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
        self._h = np.zeros(n)
        # The unconditional variance of each pair's persisting error: what its last ranges' variances claim.
        self._claimed = (1.0 - model.white) * model.range_sd**2 + anchors.sd**2
        self.learns = False
        self.time_s = time_s
        self.x = np.zeros(n)
        self.x[:3] = position
        self.p = np.zeros((n, n))
        self.p[:3, :3] = covariance
        for axis in range(2 if level else 3):
            self.p[3 + axis, 3 + axis] = model.speed**2
        self.p[OFFSET, OFFSET] = model.offset_sd**2
        errors = np.arange(FIRST_ERROR, n)
        self.p[errors, errors] = self._claimed

    def copy(self) -> RangeFilter:
        """Return an independent copy."""
        other = object.__new__(RangeFilter)
        for name in ("_anchors", "_level", "_model", "learns", "time_s"):
            setattr(other, name, getattr(self, name))
        for name in ("_claimed", "_h", "p", "x"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def predict(self, time_s: float) -> None:
        """Predict the state at a later time; an earlier time has no effect."""
        dt = time_s - self.time_s
        if dt <= 0.0:
            return
        self.time_s = time_s
        x, p, model = self.x, self.p, self._model
        x[:3] += dt * x[3:6]
        p[:3] += dt * p[3:6]
        p[:, :3] += dt * p[:, 3:6]
        decay = math.exp(-dt / model.persistence_s)
        x[FIRST_ERROR:] *= decay
        p[FIRST_ERROR:] *= decay
        p[:, FIRST_ERROR:] *= decay
        diagonal = p.reshape(-1)[:: len(x) + 1]
        diagonal[FIRST_ERROR:] += (1.0 - decay * decay) * self._claimed
        q = model.acceleration**2 * dt
        for axis in range(2 if self._level else 3):
            p[axis, axis] += q * dt * dt / 3.0
            cross = q * dt / 2.0
            p[axis, axis + 3] += cross
            p[axis + 3, axis] += cross
            p[axis + 3, axis + 3] += q

    def update(self, anchor: int, range_m: float, variance_m2: float) -> tuple[float, float]:
        """Update with a range at the time of the state.

        Args:
            anchor: a row of the anchors.
            range_m: finite, m.
            variance_m2: of its error, including the persisting part; NaN: unknown.

        Returns:
            The innovation divided by its standard deviation, and this standard deviation in m.
        """
        model, x, h, row = self._model, self.x, self._h, FIRST_ERROR + anchor
        variance = model.variance(variance_m2)
        claimed = self._claimed[anchor]
        # The part of the variance that the pair's persisting error does not explain is white noise.
        white = max(model.white * variance, variance - claimed)
        self._claimed[anchor] += 0.1 * ((1.0 - model.white) * variance - claimed)
        h[FIRST_ERROR:] = 0.0
        away = x[:3] - self._anchors[anchor]
        distance = math.sqrt(away @ away)
        h[:3] = away / max(distance, _SHORTEST_M)
        h[OFFSET] = h[row] = 1.0
        return self._correct(h, float(range_m - distance - x[OFFSET] - x[row]), white)

    def update_height(self, height_m: float, variance_m2: float) -> float:
        """Update with the height of the tag; return the normalised innovation."""
        h = np.zeros(len(self.x))
        h[2] = 1.0
        return self._correct(h, height_m - float(self.x[2]), variance_m2)[0]

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
            gain = self.p[:, axis] / max(self.p[axis, axis], 1e-12)
            # If the correlation with another coordinate is steep, the linear model is not valid.
            gain[:3] = np.clip(gain[:3], -1.0, 1.0)
            if not self.learns:
                gain[OFFSET:] = 0.0
            x -= gain * beyond
        x[:3] = np.clip(x[:3], low, high)
        return True

    def _correct(self, h: NDArray[np.float64], innovation: float, noise: float) -> tuple[float, float]:
        """Robust update with a measurement with Jacobian h (n,) and noise variance; return as `update`."""
        ph = self.p @ h
        predicted = float(h @ ph)
        sd = math.sqrt(predicted + noise)
        z = innovation / sd
        s = (predicted + noise) * self._model.inflation(z)
        k = ph / s
        if not self.learns:
            k[OFFSET:] = 0.0
        self.x += k * innovation
        # Joseph's form (I - K H) P (I - K H)' + K R K', as updates of rank one.
        a = self.p - np.multiply.outer(k, ph)
        a -= np.multiply.outer(a @ h - (s - predicted) * k, k)
        self.p = a
        return z, sd

    def estimate(self, stamp_ns: int) -> Estimate:
        """Return position and velocity, at the stamp that the state is for."""
        return Estimate(stamp_ns, self.x[:3].copy(), self.x[3:6].copy(), self.p[:6, :6].copy())

    @property
    def position(self) -> NDArray[np.float64]:
        """Float64 (3,), m."""
        return self.x[:3]

    @property
    def horizontal_sd(self) -> float:
        """Root of the larger of the two horizontal variances, m."""
        return math.sqrt(max(self.p[0, 0], self.p[1, 1]))
