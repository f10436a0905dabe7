"""A model of robot_localization's EKF in `two_d_mode`, which is configured by the same YAML file.

State, Jacobian, default covariances and the order of prediction and correction are those of robot_localization 3.8
(`ekf.cpp`, `filter_base.cpp`), without control, delayed messages and outlier rejection.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

PLANAR = [0, 1, 5, 6, 7, 11, 12, 13]
"""Rows of x, y, yaw, vx, vy, vyaw, ax, ay in the vectors of 15 values."""

X, Y, YAW, VX, VY, VYAW, AX, AY = range(8)

KNOWN = {
    *("frequency", "two_d_mode", "map_frame", "odom_frame", "base_link_frame", "world_frame"),
    *("odom0", "odom0_config", "imu0", "imu0_config", "pose0", "pose0_config"),
    *("pose0_differential", "pose0_relative", "initial_estimate_covariance", "process_noise_covariance"),
}
DEFAULT_NOISE = [0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015]


class Ekf:
    """The filter.

    Attributes:
        x, P: state and covariance.
        time_s: time of the latest measurement.
    """

    def __init__(self, parameters: dict[str, Any]) -> None:
        assert set(parameters) <= KNOWN, "the model does not know all parameters"
        assert parameters["two_d_mode"]
        assert not parameters.get("pose0_differential", False)
        assert not parameters.get("pose0_relative", False)
        self._parameters = parameters
        self._noise = np.diag(self._diagonal("process_noise_covariance", DEFAULT_NOISE))
        self.x, self.P = np.zeros(8), np.diag(self._diagonal("initial_estimate_covariance", [1e-9] * 15))
        self.time_s: float | None = None

    def fuse(self, sensor: str, time_s: float, values: dict[int, float], R: NDArray[np.float64]) -> None:
        """Fuse the values that the configuration of the sensor selects.

        Args:
            sensor: such as odom0.
            time_s: stamp.
            values: {row of the state: value}.
            R: covariance of the values.
        """
        if sensor not in self._parameters:
            return
        rows, columns, square = self._selection(sensor, tuple(values))
        self.predict(time_s)
        z = np.array(list(values.values()))[columns]
        # H selects rows of the state.
        covariance = self.P[rows]
        K = np.linalg.solve(covariance[:, rows] + R[square], covariance).T
        self.x = self.x + K @ (z - self.x[rows])
        self.P = self.P - K @ covariance

    def predict(self, time_s: float) -> None:
        """Predict the state at a time; an earlier one has no effect."""
        if self.time_s is not None and time_s > self.time_s:
            self._predict(time_s - self.time_s)
        self.time_s = time_s if self.time_s is None else max(time_s, self.time_s)

    @cache  # noqa: B019
    def _selection(
        self, sensor: str, measured: tuple[int, ...]
    ) -> tuple[list[int], list[int], tuple[Any, ...]]:
        """Return the rows of the state that the configuration selects, their places in the values, and in a covariance."""
        config = self._parameters[f"{sensor}_config"]
        assert len(config) == 15
        rows = [row for row, selected in enumerate(np.take(config, PLANAR)) if selected]
        assert sum(config) == len(rows), "values that are not in the plane"
        assert set(rows) <= set(measured), f"{sensor} does not measure all selected values"
        columns = [column for column, row in enumerate(measured) if row in rows]
        return [measured[column] for column in columns], columns, np.ix_(columns, columns)

    def _predict(self, dt: float) -> None:
        cosine, sine = math.cos(self.x[YAW]) * dt, math.sin(self.x[YAW]) * dt
        F, turned = np.eye(8), np.array(((cosine, -sine), (sine, cosine)))
        F[:2, VX : VY + 1], F[:2, AX : AY + 1] = turned, 0.5 * dt * turned
        F[YAW, VYAW] = F[VX, AX] = F[VY, AY] = dt
        before, self.x = self.x, F @ self.x
        # The Jacobian: the step turns with the yaw.
        F[X, YAW], F[Y, YAW] = before[Y] - self.x[Y], self.x[X] - before[X]
        self.P = F @ self.P @ F.T + dt * self._noise

    def _diagonal(self, name: str, default: list[float]) -> NDArray[np.float64]:
        values = np.array(self._parameters.get(name, np.diag(default)), np.float64)
        # Some versions of robot_localization read 225 values without a check of their number.
        assert values.size == 225
        return np.take(np.diag(values.reshape(15, 15)), PLANAR)
