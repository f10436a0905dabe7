"""The filter of one tag that has a place: constant velocity, a range at a time.

State: position (0-2), velocity (3-5), the offset that the tag's ranges share (6), and what persists of the error
of each anchor's ranges (7...); or, with `pair_offsets`, an offset of each anchor's ranges in place of the one. An
extended Kalman filter with a Schmidt (considered) part: offset and errors keep their uncertainty and correlations,
but a range moves them only where the data can tell (S. F. Schmidt 1966; partial updates as in Brink, "Partial-Update
Schmidt-Kalman Filter", 2017). Covariances by Joseph's form, which holds for any gain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.model import Model

OFFSET = 6
FIRST_ERROR = 7
_SHORTEST_M = 0.05
"""Closer to an anchor a range has no direction to speak of."""


class RangeFilter:
    """Args:
        anchors: rows of these are what `update` takes.
        model: motion and errors.
        time_s: of the first state.
        position: float64 (3,), m.
        covariance: float64 (3, 3) of `position`, m^2; a variance of 0 in z with `level`.
        level: the height is known and stays: no vertical motion.
        pair_offsets: of each anchor's ranges, float64 (m,) in m and (m, m) in m^2; None = one that all share, known
            to the model's deviation.

    Attributes:
        time_s: of the state, s.
        x, p: state float64 (n,) and its covariance (n, n).
        first_error: where the persisting errors begin in it.
        learns: whether ranges move offset and errors too, rather than only being judged by them.
    """

    __slots__ = (
        "_anchors",
        "_claimed",
        "_h",
        "_level",
        "_model",
        "first_error",
        "learns",
        "p",
        "time_s",
        "x",
    )

    def __init__(
        self,
        anchors: AnchorMap,
        model: Model,
        time_s: float,
        position: NDArray[np.float64],
        covariance: NDArray[np.float64],
        *,
        level: bool = False,
        pair_offsets: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    ) -> None:
        self.first_error = FIRST_ERROR if pair_offsets is None else OFFSET + len(anchors)
        n = self.first_error + len(anchors)
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
        if pair_offsets is None:
            self.p[OFFSET, OFFSET] = model.offset_sd**2
        else:
            offsets = slice(OFFSET, self.first_error)
            self.x[offsets], self.p[offsets, offsets] = pair_offsets
        diagonal = np.arange(self.first_error, n)
        self.p[diagonal, diagonal] = self._claimed

    def copy(self) -> RangeFilter:
        """The same filter, to go another way."""
        other = object.__new__(RangeFilter)
        for name in ("_anchors", "_level", "_model", "first_error", "learns", "time_s"):
            setattr(other, name, getattr(self, name))
        for name in ("_claimed", "_h", "p", "x"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def predict(self, time_s: float, pace: float = 1.0) -> None:
        """Go to a later time, in which errors fade `pace` times as fast; an earlier one changes nothing."""
        dt = time_s - self.time_s
        if dt <= 0.0:
            return
        self.time_s = time_s
        x, p, model = self.x, self.p, self._model
        x[:3] += dt * x[3:6]
        p[:3] += dt * p[3:6]
        p[:, :3] += dt * p[:, 3:6]
        first = self.first_error
        kept = math.exp(-dt * pace / model.persistence_s)
        x[first:] *= kept
        p[first:] *= kept
        p[:, first:] *= kept
        diagonal = p.reshape(-1)[:: len(x) + 1]
        diagonal[first:] += (1.0 - kept * kept) * self._claimed
        q = model.acceleration**2 * dt
        for axis in range(2 if self._level else 3):
            p[axis, axis] += q * dt * dt / 3.0
            cross = q * dt / 2.0
            p[axis, axis + 3] += cross
            p[axis + 3, axis] += cross
            p[axis + 3, axis + 3] += q

    def update(self, anchor: int, range_m: float, variance_m2: float) -> tuple[float, float]:
        """Take in a range at the state's own time.

        Args:
            anchor: a row of the anchors.
            range_m: finite, m.
            variance_m2: of its error, the persisting part included; NaN = unknown.

        Returns:
            The innovation divided by its standard deviation, and that deviation in m.
        """
        model = self._model
        variance = model.variance(variance_m2)
        claimed = self._claimed[anchor]
        # What a range claims beyond what the pair's persisting error stands for is new with this range.
        white = max(model.white * variance, variance - claimed)
        self._claimed[anchor] += 0.1 * ((1.0 - model.white) * variance - claimed)
        error, h, ph, expected = self._observe(anchor, range_m)
        s = expected + white
        sd = math.sqrt(s)
        z = error / sd
        s *= model.inflation(z)
        gain = ph / s
        if not self.learns:
            gain[OFFSET:] = 0.0
        self._apply(gain, h, ph, error, s - expected)
        return z, sd

    def innovation(self, anchor: int, range_m: float, variance_m2: float) -> float:
        """The normalised innovation that `update` would find, and nothing changed."""
        variance = self._model.variance(variance_m2)
        white = max(self._model.white * variance, variance - self._claimed[anchor])
        error, _, _, expected = self._observe(anchor, range_m)
        return error / math.sqrt(expected + white)

    def take_off(self, change_m: NDArray[np.float64]) -> None:
        """From here on, ranges come with so much more taken off, float64 (m,): what they share, and each one's."""
        shared = float(change_m.mean())
        self.x[OFFSET] -= shared
        self.x[FIRST_ERROR:] -= change_m - shared

    def _observe(
        self, anchor: int, range_m: float
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64], float]:
        """By how much a range is longer than expected; how it depends on the state, h; P h; and h' P h."""
        x, h, row = self.x, self._h, self.first_error + anchor
        offset = OFFSET if self.first_error == FIRST_ERROR else OFFSET + anchor
        h[OFFSET:] = 0.0
        away = x[:3] - self._anchors[anchor]
        distance = math.sqrt(away @ away)
        h[:3] = away / max(distance, _SHORTEST_M)
        h[offset] = 1.0
        h[row] = 1.0
        ph = self.p @ h
        return float(range_m - distance - x[offset] - x[row]), h, ph, float(h @ ph)

    def update_height(self, height_m: float, variance_m2: float) -> float:
        """Take in the height of the tag; returns the normalised innovation."""
        return self._direct(2, height_m, variance_m2)

    def confine(self, low: Sequence[float], high: Sequence[float]) -> bool:
        """Project the position onto a box; return whether it was outside.

        This is estimate projection (Simon, "Kalman filtering with state constraints", 2010): the covariance stays, so
        that repeated projections do not count as new information.
        """
        x = self.x
        # This runs after each update, where numbers of NumPy are slow.
        x0, x1, x2 = x[:3].tolist()
        if low[0] <= x0 <= high[0] and low[1] <= x1 <= high[1] and low[2] <= x2 <= high[2]:
            return False
        for axis in range(3):
            beyond = x[axis] - min(max(x[axis], low[axis]), high[axis])
            if beyond == 0.0:
                continue
            gain = self.p[:, axis] / max(self.p[axis, axis], 1e-12)
            # Where the correlation with another coordinate is steep, the linear model does not hold.
            gain[:3] = np.clip(gain[:3], -1.0, 1.0)
            if not self.learns:
                gain[OFFSET:] = 0.0
            x -= gain * beyond
        x[:3] = np.clip(x[:3], low, high)
        return True

    def update_speed(self, speed_m_per_s: float, variance_m2: float) -> float:
        """Take in the horizontal speed that wheels tell; returns the normalised innovation.

        Where the estimate itself hardly moves, a speed has no direction: then only standing still says something.
        """
        vx, vy = self.x[3], self.x[4]
        speed = math.hypot(vx, vy)
        if speed < 0.1 or speed_m_per_s < 0.05:
            if speed_m_per_s > 0.05:
                return 0.0
            return max(self._direct(axis, 0.0, variance_m2) for axis in (3, 4))
        h = np.zeros(len(self.x))
        h[3], h[4] = vx / speed, vy / speed
        return self._plain(h, speed_m_per_s - speed, variance_m2)

    def _direct(self, row: int, value: float, variance_m2: float) -> float:
        h = np.zeros(len(self.x))
        h[row] = 1.0
        return self._plain(h, value - float(self.x[row]), variance_m2)

    def _plain(self, h: NDArray[np.float64], innovation: float, variance_m2: float) -> float:
        ph = self.p @ h
        expected = float(h @ ph)
        s = expected + variance_m2
        z = innovation / math.sqrt(s)
        s *= self._model.inflation(z)
        gain = ph / s
        if not self.learns:
            gain[OFFSET:] = 0.0
        self._apply(gain, h, ph, innovation, s - expected)
        return z

    def _apply(
        self,
        gain: NDArray[np.float64],
        h: NDArray[np.float64],
        ph: NDArray[np.float64],
        innovation: float,
        noise: float,
    ) -> None:
        """Joseph's (I - K h) P (I - K h)' + K r K', written as updates of rank one."""
        self.x += gain * innovation
        a = self.p - np.multiply.outer(gain, ph)
        a -= np.multiply.outer(a @ h - noise * gain, gain)
        self.p = a

    @property
    def position(self) -> NDArray[np.float64]:
        """Float64 (3,), m."""
        return self.x[:3]

    @property
    def horizontal_sd(self) -> float:
        """Root of the larger of the two horizontal variances, m."""
        return math.sqrt(max(self.p[0, 0], self.p[1, 1]))
