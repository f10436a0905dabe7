"""The filter of one tag with a known position: constant velocity, one range at a time (an extended Kalman filter).

State: position (0-2), velocity (3-5), and the errors of the ranges as in `robust_update`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import daxpy, dscal

from uwb_mitigation.positioning.geometry import Symmetry
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.robust_update import COVARIANCE_SCALE, SHORTEST_M, RobustUpdate
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Estimate

KinematicState = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""Position, velocity and covariance of both, float64 (3,), (3,) and (6, 6)."""

OFFSET = 6
FIRST_ERROR = 7

CONTRADICTED_FACTOR = 12.0
"""Factor of published covariances while ranges contradict the position. With it, the 95 % ellipses of raw ranges past four anchors, two
of them swapped or one 3 m off, contain 35 to 91 % of the true positions instead of 16 to 52 % (simulated, six of ten drives)."""


class RangeFilter:
    """Filter of the position and velocity of a tag.

    Args:
        anchors: `update` takes rows of these.
        model: motion and errors.
        time_s: of the first state.
        position: float64 (3,), m.
        covariance: float64 (3, 3) of `position`, m^2; a variance of 0 in z with `level`.
        level: the height is known and constant: no vertical motion.

    Attributes:
        is_level: as given.
        time_s: of the state, s.
        state: mean, covariance and updates.
        factor: of published covariances, see `CONTRADICTED_FACTOR`.
        unseen: float64 (6, 6), covariance of the position (m^2; 0 for the velocity) for what the state does not contain: constant errors, other solutions.
    """

    __slots__ = ("_anchors", "_model", "factor", "is_level", "state", "time_s", "unseen")

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
        # Python numbers are faster than NumPy for the vector to an anchor.
        self._anchors: list[list[float]] = anchors.position.tolist()
        self._model, self.is_level, self.time_s, self.factor = model, level, time_s, 1.0
        self.state = RobustUpdate(anchors, model, np.concatenate([position, np.zeros(3)]))
        self.state.P[:3, :3], self.unseen = covariance, np.zeros((6, 6))
        for axis in range(2 if level else 3):
            self.state.P[3 + axis, 3 + axis] = model.speed**2

    @property
    def x(self) -> NDArray[np.float64]:
        """State, float64 (n,)."""
        self.state.normalise()
        return self.state.x

    @property
    def P(self) -> NDArray[np.float64]:
        """Covariance of the state, float64 (n, n)."""
        self.state.normalise()
        return self.state.P

    def copy(self) -> RangeFilter:
        """Return an independent copy."""
        twin = copy.copy(self)
        twin.state = self.state.copy()
        return twin

    def predict(self, time_s: float) -> None:
        """Predict the state at a later time; an earlier time has no effect."""
        dt = time_s - self.time_s
        if dt <= 0.0:
            return
        self.time_s = time_s
        state, model = self.state, self._model
        state.predict_velocity(dt, 2 if self.is_level else 3, model.acceleration**2)
        state.predict_errors(dt / model.persistence_s)

    def update(
        self, anchor: int, range_m: float, variance_m2: float, is_corrected: bool
    ) -> tuple[float, float]:
        """Update with a finite range at the time of the state; see `RobustUpdate.update_range`."""
        # Python numbers are faster here than NumPy.
        state, (u, v, w) = self.state, self._anchors[anchor]
        x, y, z = state.x_items[:3]
        x, y, z = x - u, y - v, z - w
        distance = math.sqrt(x * x + y * y + z * z)
        divisor, H = distance if distance > SHORTEST_M else SHORTEST_M, state.H_items
        H[0], H[1], H[2] = x / divisor, y / divisor, z / divisor
        return state.update_range(anchor, range_m, distance, variance_m2, is_corrected)

    def update_height(self, height_m: float, variance_m2: float) -> tuple[float, float]:
        """Update with the height of the tag; return as `RobustUpdate.update_range`."""
        H = np.zeros(len(self.state.x))
        H[2] = 1.0
        return self.state.update(H, height_m - self.state.x.item(2), variance_m2, robust=False)

    def confine(self, low: Sequence[float], high: Sequence[float]) -> None:
        """Project the position onto a box."""
        # This runs after each update. Python numbers are faster here than NumPy scalars.
        x = self.state.x
        x0, x1, x2 = self.state.x_items[:3]
        if low[0] <= x0 <= high[0] and low[1] <= x1 <= high[1] and low[2] <= x2 <= high[2]:
            return
        for axis in range(3):
            nearest = min(max(x.item(axis), low[axis]), high[axis])
            if nearest != x[axis]:
                self.state.project(axis, nearest)
        x[:3] = np.clip(x[:3], low, high)

    def reflect(self, mirror: Symmetry) -> None:
        """Replace position and velocity by their mirror images."""
        reflection = np.eye(3) - 2.0 * np.multiply.outer(mirror.axis, mirror.axis)
        x, P = self.state.x, self.state.P
        x[:3] = mirror.images(x[:3])[0]
        x[3:6] = reflection @ x[3:6]
        for rows in (slice(3), slice(3, 6)):
            P[rows] = reflection @ P[rows]
            P[:, rows] = P[:, rows] @ reflection

    def estimate(self, stamp_ns: int) -> Estimate:
        """Return position and velocity, at the stamp that the state is for."""
        return Estimate(stamp_ns, *self.solution())

    def solution(self) -> KinematicState:
        """Return position, velocity and covariance of an estimate."""
        state = self.state
        # In place and contiguous, which takes a third of the time: factor * scale * P + unseen. P is symmetric except for rounding errors.
        x, covariance = state.x, state.motion_P + state.motion_P.T
        flat = covariance.ravel()
        dscal(0.5 * self.factor * COVARIANCE_SCALE, flat)
        daxpy(self.unseen.ravel(), flat)
        return x[:3].copy(), x[3:6].copy(), covariance

    @property
    def position(self) -> NDArray[np.float64]:
        """Float64 (3,), m."""
        return self.state.x[:3]
