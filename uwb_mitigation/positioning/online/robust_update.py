"""State of a tag or robot with the errors of its ranges, and the robust Kalman update that all filters share.

State: motion (0 to k - 1), the offset that the tag's ranges have in common (k), the persisting error of each anchor's ranges
(k + 1, ...), and behind them the constant errors of up to `MAX_CONSTANT` anchors. While the position is searched, offset and
errors are only considered (S. F. Schmidt, 1966): they keep their uncertainty and their correlations, so that no candidate
position explains its ranges by wrong offsets. Afterwards they are estimated. Only ranges that a model corrected have constant
errors as states: those of raw ranges would follow obstacles, also if their variance is known. The mean square of the
residuals widens the published covariance, see `persisting_variance`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import daxpy, ddot, dger

from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.anchors import AnchorMap

SHORTEST_M = 0.05
"""Closer to an anchor, a range has no defined direction."""

MIN_VARIANCE_M2 = 1e-6
"""Of white noise: measurements with less would make the covariance singular."""

CORRECTED_WHITE = 0.6
"""As `NoiseModel.white`, for ranges whose constant error is a state."""

CONSTANT_SD = 0.07
"""Standard deviation of the constant error of an anchor, m: antenna delay, position, reflections. A state for corrected ranges; for
raw ones a part of the published covariance."""

UNCERTAIN_SD = 0.15
"""Corrected ranges with a larger published standard deviation (m) may be too short: behind thin walls the model corrects obstacles that
delay nothing, by about this standard deviation. Half of it or more is added again if residuals show it, see `RobustUpdate.overcorrection`."""

MIN_UNCERTAIN, MAX_UNCERTAIN = 15, 400
"""The running mean `overcorrection` starts with this number of ranges without an error, and includes at most about the second number of
ranges, so that it follows a robot into rooms with other walls. Chosen on simulated sites 0 to 7 and drives in flats with seeds 101 to 108
and 700 to 703, where 400 to 4,000 are equal."""

MAX_CONSTANT = 16
"""With more anchors, the one whose constant error has been estimated for longest is forgotten: the state remains small."""

MAX_RATIO = 9.0
"""Limit of the contribution of a range to `consistency`: a single anchor with a large error must not dominate it."""

LARGE_RATIO = 2.0
"""Raw ranges whose persisting errors have a larger mean second moment relative to the model get a larger variance, until it is this
one. Otherwise the robust loss follows the anchors that agree by chance, if anchors have constant errors of 0.3 m. Chosen on
development seeds of the layout `box`; the RMSE of 26 drives in other layouts, sites and halls is the same to 1 mm."""

RATIO_RATE = 0.001
"""Share of a new range in the running mean `raw_ratio`: it includes about a thousand ranges."""

COVARIANCE_SCALE = 1.4
"""Factor of P in published covariances."""

CONSISTENCY_RATE = 0.01
"""Share of a new range in the running mean `consistency`: it includes about a hundred ranges."""

SCALE, POWER, MIN_SCALE, MAX_SCALE = 2.2, 4.0, 0.2, 12.0
"""See `RobustUpdate.covariance_scale`."""

RESIDUAL_SCALE = 1.75
"""Least variance of persisting errors relative to the mean square of residuals: a fit of a position and an offset to seven anchors hides
three sevenths of it. With fewer anchors it hides more."""

RESIDUAL_RATE, SHORTEST_RESIDUAL_M, LONGEST_RESIDUAL_M = 0.012, -1.5, 0.5
"""Share of a new range in `residual_square`, and limits of the residuals: longer ones are obstacles, whose weight is small."""

MIN_UNIT, MAX_ELAPSED = 1e-3, 100.0
"""Limits of `RobustUpdate.error_unit`, and of the time constants of one prediction."""

_ONES = np.ones(3)


def items_of(array: NDArray[np.float64]) -> memoryview[float]:
    """Return the elements of an array for reading and writing as Python numbers: faster than with the array."""
    return cast("memoryview[float]", array.data)


class RobustUpdate:
    """Mean, covariance and measurement updates.

    Args:
        anchors: rows of the persisting errors.
        model: range errors.
        motion: initial values of the k motion states; their covariance is zero.

    Attributes:
        x, P: state float64 (n,) and its covariance (n, n). Persisting errors are in units of `error_unit`, and their variances lack the
            noise since the anchor's latest range: so a prediction does not change their rows and columns. See `normalise`.
        error_unit: decays with the persisting errors, m.
        moments: float64 (n + 1, n), P and below it x, which are views of it: many operations are the same for both.
        H: float64 (n,), derivatives of the next range with respect to the motion states, which the owner sets.
        x_items, P_items, H_items: the same as memory views, whose elements are Python numbers: faster than those of arrays.
        estimates_errors: whether measurements change offset and errors, which are only considered otherwise.
        consistency: running mean of the second moments of the persisting errors, relative to the model; 1: they are as modelled.
        raw_factor: of the variance of raw ranges; the owner sets it.
        raw_ratio: `consistency` of raw ranges over a thousand ranges, relative to the model without the factor of `LARGE_RATIO`.
        overcorrection: mean error of uncertain corrected ranges in their standard deviations; if negative, it is subtracted.
        residual_square: running mean of the products of two residuals of an anchor in a row, m^2: of their errors without noise.
    """

    def __init__(self, anchors: AnchorMap, model: NoiseModel, motion: NDArray[np.float64]) -> None:
        self._model, self._offset = model, len(motion)
        n = len(motion) + 1 + len(anchors)
        # The unconditional variance of each anchor's persisting error: what its last ranges' variances claim.
        self._error_variance: list[float] = ((1.0 - model.white) * model.range_sd**2 + anchors.sd**2).tolist()
        # The inverse square of the unit at each anchor's latest range.
        self.error_unit, self._noise_until = 1.0, [1.0] * len(anchors)
        self.estimates_errors, self.consistency, self.raw_ratio = False, 1.0, 1.0
        self.raw_factor = 1.0
        self.residual_square, self._last_residual = 0.0, [0.0] * len(anchors)
        self.overcorrection, self._num_uncertain = 0.0, MIN_UNCERTAIN
        self._constant_rows: dict[int, int] = {}
        # Whether the latest range of an anchor was raw.
        self._is_raw: dict[int, bool] = {}
        self._set_moments(np.zeros((n + 1, n)))
        self.x[: len(motion)] = motion
        self.P[self._offset, self._offset] = model.offset_sd**2
        errors = np.arange(self._offset + 1, n)
        self.P[errors, errors] = self._error_variance

    def _set_moments(self, moments: NDArray[np.float64]) -> None:
        self.moments = moments = np.ascontiguousarray(moments)
        self._flat, self._size = moments.reshape(-1), moments.shape[1]
        self.P: NDArray[np.float64] = moments[:-1]
        self.x: NDArray[np.float64] = moments[-1]
        self.H = np.zeros(self._size)
        self.H[self._offset] = 1.0
        self.x_items, self.P_items, self.H_items = map(items_of, (self.x, self.P, self.H))
        # Views, and memory for products, are made once.
        self._rows, self._columns = self.P[: self._offset], self.P[:, : self._offset]
        self.motion_P, self._product = self._rows[:, : self._offset], np.zeros(self._size + 1)
        self._PH, self._transposed = self._product[:-1], moments.T
        # States of errors whose derivatives are not 0.
        self._used: tuple[int, ...] = ()

    def copy(self) -> RobustUpdate:
        """Return an independent copy."""
        twin = copy.copy(self)
        twin._set_moments(self.moments.copy())
        for name in ("_constant_rows", "_is_raw", "_error_variance", "_last_residual", "_noise_until"):
            setattr(twin, name, getattr(self, name).copy())
        return twin

    def replace_motion(self, motion: NDArray[np.float64]) -> RobustUpdate:
        """Return a state with other motion states (k,), the same errors, and the covariance of position and errors."""
        self.normalise()
        twin, k, old = self.copy(), len(motion), self._offset
        twin._offset = k
        before = np.r_[0:3, old : len(self.x)]
        n = k + len(self.x) - old
        twin._set_moments(np.zeros((n + 1, n)))
        retained = np.r_[0:3, k:n]
        twin.P[np.ix_(retained, retained)] = self.P[np.ix_(before, before)]
        twin.x[:k], twin.x[k:] = motion, self.x[old:]
        twin._constant_rows = {anchor: row + k - old for anchor, row in self._constant_rows.items()}
        return twin

    def _constant_row(self, anchor: int) -> int:
        """Return the state of an anchor's constant error; it replaces the oldest one if there are too many."""
        rows = self._constant_rows
        if anchor in rows:
            return rows[anchor]
        if not rows:
            size = min(MAX_CONSTANT, len(self._error_variance))
            H, columns = self.H, np.pad(self.moments, ((0, 0), (0, size)))
            self._set_moments(np.insert(columns, [len(H)] * size, 0.0, axis=0))
            self.H[: self._offset] = H[: self._offset]
        x, P = self.x, self.P
        free = self._offset + 1 + len(self._error_variance) + len(rows)
        row = free if free < len(x) else rows.pop(next(iter(rows)))
        x[row] = P[row] = P[:, row] = 0.0
        P[row, row] = CONSTANT_SD**2
        rows[anchor] = row
        return row

    def predict_errors(self, elapsed: float) -> None:
        """Predict the persisting errors after `elapsed` time constants."""
        self.error_unit *= math.exp(-elapsed if elapsed < MAX_ELAPSED else -MAX_ELAPSED)
        if self.error_unit < MIN_UNIT:
            self.normalise()

    def predict_motion(self, F: NDArray[np.float64]) -> None:
        """Replace the covariance by F P F.T, with the transition matrix F (k, k) of the motion states."""
        self._rows[:] = F.dot(self._rows)
        self._columns[:] = self._columns.dot(F.T)

    def predict_velocity(self, dt: float, axes: int, q: float) -> None:
        """Predict position (0-2) and velocity (3-5) in the first `axes`, with white acceleration of spectral density q."""
        flat, n = self._flat, self._size
        # Rows and columns of the position plus dt times those of the velocity: products of small matrices take several times as long.
        daxpy(flat, flat, axes * n, dt, 3 * n, 1, 0, 1)
        for axis in range(axes):
            daxpy(flat, flat, n + 1, dt, axis + 3, n, axis, n)
        # Q along the diagonals of the blocks.
        q *= dt
        daxpy(_ONES, flat, axes, q * dt * dt / 3.0, 0, 1, 0, n + 1)
        daxpy(_ONES, flat, axes, q * dt / 2.0, 0, 1, 3, n + 1)
        daxpy(_ONES, flat, axes, q * dt / 2.0, 0, 1, 3 * n, n + 1)
        daxpy(_ONES, flat, axes, q, 0, 1, 3 * n + 3, n + 1)

    def normalise(self) -> None:
        """Convert the persisting errors in `x` and `P` to metres, with their noise."""
        unit, first = self.error_unit, self._offset + 1
        if unit == 1.0:
            return
        errors = slice(first, first + len(self._error_variance))
        noise = np.array(self._error_variance) * (unit**-2 - np.array(self._noise_until))
        self.x[errors] *= unit
        np.einsum("ii->i", self.P[errors, errors])[:] += noise
        self.P[errors] *= unit
        self.P[:, errors] *= unit
        self.error_unit, self._noise_until = 1.0, [1.0] * len(self._error_variance)

    def update_range(
        self, anchor: int, range_m: float, distance_m: float, variance_m2: float, is_corrected: bool
    ) -> tuple[float, float]:
        """Update with a range; `H` is set.

        Args:
            anchor: a row of the anchors.
            range_m: measured range, m.
            distance_m: predicted distance, m.
            variance_m2: of its error, including the persisting part; NaN: unknown.
            is_corrected: whether a model corrected it: its anchor has a constant error.

        Returns:
            The innovation divided by its standard deviation, and this standard deviation in m.
        """
        constant = self._constant_row(anchor) if is_corrected else 0
        self._is_raw[anchor] = not is_corrected
        model, x, H, P, k = self._model, self.x_items, self.H_items, self.P_items, self._offset
        row, factor = k + 1 + anchor, 1.0
        # Conditions are faster here than `min` and `max`.
        if not is_corrected:
            factor = self.raw_factor
            if self.raw_ratio > LARGE_RATIO * factor:
                factor = min(self.raw_ratio / LARGE_RATIO, MAX_RATIO)
        variance, error_variance = factor * model.variance(variance_m2), self._error_variance[anchor]
        unit = self.error_unit
        noise_until = 1.0 / (unit * unit)
        P[row, row] += error_variance * (noise_until - self._noise_until[anchor])
        self._noise_until[anchor] = noise_until
        # The part of the variance that the persisting error does not explain is white noise.
        white_share = CORRECTED_WHITE if is_corrected else model.white
        white, unexplained = white_share * variance, variance - error_variance
        if white < unexplained:
            white = unexplained
        self._error_variance[anchor] = error_variance + 0.1 * (
            (1.0 - white_share) * variance - error_variance
        )
        for used in self._used:
            H[used] = 0.0
        self._used = (row, constant) if is_corrected else (row,)
        H[row] = unit
        residual = range_m - distance_m - x[k]
        if is_corrected and variance > UNCERTAIN_SD**2:
            range_sd, error_m = math.sqrt(variance), residual - x[constant]
            residual -= min(self.overcorrection, 0.0) * range_sd
            if self.estimates_errors:
                # This mean is not robust: weights that prefer short ranges would find overcorrection behind thick walls, too.
                self._num_uncertain = min(self._num_uncertain + 1, MAX_UNCERTAIN)
                error = min(max(error_m / range_sd, -1.0), 3.0)
                self.overcorrection += (error - self.overcorrection) / self._num_uncertain
        if is_corrected:
            H[constant] = 1.0
            residual -= x[constant]
            # Near an anchor the distance is not linear in the position: variance of its second-order term (Bar-Shalom, Li,
            # Kirubarajan, 10.3.2). Otherwise the filter may continue on the other side of an anchor that it passes.
            curvature = (P[0, 0] + P[1, 1]) / (distance_m if distance_m > SHORTEST_M else SHORTEST_M)
            white += 0.5 * curvature * curvature
        z, sd = self.update(self.H, residual - unit * x[row], white)
        residual = min(max(residual, SHORTEST_RESIDUAL_M), LONGEST_RESIDUAL_M)
        # White noise does not contribute to the mean of this product.
        square = residual * self._last_residual[anchor]
        self._last_residual[anchor] = residual
        self.residual_square += RESIDUAL_RATE * (square - self.residual_square)
        ratio = (x[row] ** 2 + P[row, row]) / (noise_until * error_variance)
        if ratio > MAX_RATIO:
            ratio = MAX_RATIO
        self.consistency += CONSISTENCY_RATE * (ratio - self.consistency)
        if not is_corrected:
            self.raw_ratio += RATIO_RATE * (factor * ratio - self.raw_ratio)
        return z, sd

    def update(
        self, H: NDArray[np.float64], innovation: float, R: float, *, robust: bool = True
    ) -> tuple[float, float]:
        """Update with a measurement with Jacobian H (n,) and noise variance R; return as `update_range`."""
        # The method `dot` and BLAS are faster here than operators.
        product, PH = self._product, self._PH
        self.moments.dot(H, product)
        S = ddot(H, PH) + (R if R > MIN_VARIANCE_M2 else MIN_VARIANCE_M2)
        sd = math.sqrt(S)
        z, product[-1] = innovation / sd, -innovation
        gain = PH
        if not self.estimates_errors:
            gain = PH.copy()
            gain[self._offset :] = 0.0
        # This is Joseph's form for these gains: moments -= product gain.T / S, in place.
        factor = -1.0 / (S * self._model.inflation(z) if robust else S)
        dger(factor, gain, product, 1, 1, self._transposed, 1, 1, 1)
        if not self.estimates_errors:
            # The covariance of errors that are only considered stays.
            self.P[:, self._offset :] = self.P[self._offset :].T
        return z, sd

    def project(self, axis: int, value: float) -> None:
        """Move a coordinate to a value, and the other states by their correlation with it.

        This is estimate projection (Simon, "Kalman filtering with state constraints", 2010): the covariance stays, so
        that repeated projections do not count as new information.
        """
        K = self.P[:, axis] / max(self.P[axis, axis], 1e-12)
        # If the correlation with another coordinate is steep, the linear model is not valid.
        K[:3] = np.clip(K[:3], -1.0, 1.0)
        if not self.estimates_errors:
            K[self._offset :] = 0.0
        self.x -= K * (self.x[axis] - value)

    @property
    def modelled_variance(self) -> float:
        """Mean variance of the persisting errors in the model, m^2."""
        return sum(self._error_variance) / len(self._error_variance)

    def constant_variance(self, rows: Sequence[int]) -> float:
        """Return the variance of constant errors that are not states, m^2: those of the received `rows` whose latest range was raw."""
        is_raw = [self._is_raw[row] for row in rows if row in self._is_raw] or [True]
        return CONSTANT_SD**2 * (sum(is_raw) / len(is_raw))

    def persisting_variance(self, num_anchors: int, dims: int) -> float:
        """Return the variance of the errors that do not average out, m^2, for the number of received anchors and unknown coordinates."""
        hidden = num_anchors / max(num_anchors - dims - 1, 1)
        return max(hidden, RESIDUAL_SCALE) * max(self.residual_square, 0.0)

    def covariance_scale(self) -> float:
        """Return the factor with which solutions of filters are compared: a larger one if the estimated errors are large now.

        The filter sees only a part of the persisting errors, so that their true variance differs from the model by more than
        `consistency`. The power and the limits were chosen on simulated drives, the Hanyang runs and the labyrinth.
        """
        scale = SCALE * math.pow(self.consistency, POWER)
        return scale if MIN_SCALE < scale < MAX_SCALE else min(max(scale, MIN_SCALE), MAX_SCALE)
