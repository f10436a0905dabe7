"""Positions, tracks, and what all ranges have in common, estimated together without known positions of the tags.

Ranges are divided into segments of motion and positions at rest (`motion_segments`). Of each segment of motion the track is
estimated, at knots connected by a motion model; of each position at rest, one position. They share the parameters.
Ranges of a pair have similar errors for about a second (see `noise_model`), so that their weights correspond to the number of
independent ones.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.motion_segments import Segments
from uwb_mitigation.calibration.regression import CORRECTED_SLOW_SD_M, Regressors, scatter_of
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.batch.least_squares import LeastSquares, Solution, gauss_newton
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import unit_vectors
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.stamps import NS_PER_S

KNOT_S = 0.15
"""Between knots the velocity is constant: at 1 m/s^2 the position differs by less than 3 mm."""

LEAST_SCALE_M, _FIRST_SCALE_M = 0.02, 0.3
"""Minimum standard deviation of the residuals, the noise of a DW1000, and that of the first iteration, with offsets and NLOS errors."""

SD_INFLATION = 1.5
"""Factor of standard deviations: errors of one position return with each lap, and a track follows persisting errors, which
the number of independent ranges does not contain. With it, 9 of 10 offsets of simulated drives are within two standard
deviations."""

SLOW_S = 20.0
"""Time for which the slow errors of a pair (see `Regressors`) stay the same. Where the geometry is weak, as outside of the
anchors, they contribute most of the error of the common offset."""

SLOW_SHARE = 1.2
"""Minimum standard deviation of the slow errors relative to that of the residuals: obstacles increase both. With it, the mean
squared normalised error of offsets of anchors is 1.0 in 29 simulated drives (sites, flats and layouts of real deployments, seeds
0 to 5), and the largest one decreases from 5.8 to 4.3."""

AROUND_M = 5.0
"""Standard deviation of the prior of a known position: it only affects positions with too few anchors."""

FAR_S = 0.5
"""A range further in time from every knot has no position on a track."""

MAX_REFITS = 5
"""With more anchors, several are left out together."""

_ITERATIONS, _HUBER_ITERATIONS, _CONVERGED_M = 25, 4, 1e-3
"""Maximum number of iterations; those with a convex loss, for starts that are far away; and the change of positions that ends them."""

PARAMETER_PRECISION = 0.2
"""The parameters are the result: they must change by less than this share of the limit for positions."""
_NO_PRIOR, _STATIONARY = 1e-8, 1e-6
"""Information of a position without a prior, m^-2, which keeps the matrix regular; standard deviation of the velocity at rest, m/s."""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Inputs of the fit: single ranges in motion, one median per pair and stationary position.

    Attributes:
        knot, anchor: int (n,), of each observation; knots of one segment are contiguous.
        ahead_s: float64 (n,), time of the observation after its knot.
        range_m, independent: float64 (n,); the latter is the number of independent ranges in an observation.
        relative_height: float64 (n,), the height of the tag above the common one.
        rows: float64 (n, q), of the parameters.
        noise_group: int (n,), observations whose errors have the same standard deviation have the same number, from 0.
        observation_index: int (r,), the observation of each of the original ranges.
        knot_segment: int (K,). time_s: float64 (K,), of each knot in its segment. is_stationary: bool (s,).
    """

    knot: NDArray[np.intp]
    anchor: NDArray[np.intp]
    ahead_s: NDArray[np.float64]
    range_m: NDArray[np.float64]
    independent: NDArray[np.float64]
    relative_height: NDArray[np.float64]
    rows: NDArray[np.float64]
    noise_group: NDArray[np.intp]
    observation_index: NDArray[np.intp]
    knot_segment: NDArray[np.intp]
    time_s: NDArray[np.float64]
    is_stationary: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.range_m)

    @property
    def segment(self) -> NDArray[np.intp]:
        """The segment of each observation, int (n,)."""
        return self.knot_segment[self.knot]

    def without(self, left_out: NDArray[np.bool_]) -> Observations:
        """Return the same knots without those observations (n,); `observation_index` becomes invalid."""
        is_used = ~left_out
        of_knots = ("observation_index", "knot_segment", "time_s", "is_stationary")
        columns = [field.name for field in fields(self) if field.name not in of_knots]
        return replace(self, **{name: getattr(self, name)[is_used] for name in columns})


def observations_of(segments: Segments, parameters: Regressors, model: NoiseModel) -> Observations:
    """Return the observations of ranges that depend on parameters."""
    ranges, rows, noise_group = segments.ranges, parameters.rows, parameters.noise_group
    knot, ahead_s, independent = np.zeros(len(ranges), np.intp), np.zeros(len(ranges)), np.ones(len(ranges))
    knot_segment: list[NDArray[np.intp]] = []
    times: list[NDArray[np.float64]] = []
    edges = np.searchsorted(segments.segment, np.arange(len(segments) + 1))
    num_knots = 0
    for number in range(len(segments)):
        rows_of_segment = slice(edges[number], edges[number + 1])
        if segments.is_stationary[number]:
            time_s = np.zeros(1)
            knot[rows_of_segment] = num_knots
        else:
            since = (ranges.stamp_ns[rows_of_segment] - ranges.stamp_ns[rows_of_segment][0]) / NS_PER_S
            index, slot = np.unique(np.rint(since / KNOT_S).astype(np.int64), return_inverse=True)
            time_s = index * KNOT_S
            knot[rows_of_segment], ahead_s[rows_of_segment] = num_knots + slot, since - time_s[slot]
            independent[rows_of_segment] = _independent_share(
                ranges.anchor[rows_of_segment], max(float(since[-1]), KNOT_S), model.persistence_s
            )
        knot_segment.append(np.full(len(time_s), number))
        times.append(time_s)
        num_knots += len(time_s)
    in_stationary = segments.is_stationary[segments.segment]
    # One observation for each pair of a position at rest, and one for each other range.
    of_pair = segments.segment * 1024 + ranges.anchor
    key = np.where(in_stationary, of_pair, len(segments) * 1024 + np.arange(len(ranges)))
    _, first, observation_index = np.unique(key, return_index=True, return_inverse=True)
    shared = medians(
        np.column_stack([ranges.range_m, segments.relative_height, noise_group, rows]), observation_index
    )
    return Observations(
        knot=knot[first],
        anchor=ranges.anchor[first],
        ahead_s=ahead_s[first],
        range_m=shared[:, 0],
        independent=independent[first],
        relative_height=shared[:, 1],
        rows=shared[:, 3:],
        noise_group=shared[:, 2].astype(np.intp),
        observation_index=observation_index,
        knot_segment=np.concatenate(knot_segment),
        time_s=np.concatenate(times),
        is_stationary=segments.is_stationary,
    )


def medians(values: NDArray[np.float64], index: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the medians float64 (n, ...) of rows float64 (r, ...) with the same index, int (r,) from 0 to n - 1."""
    # Its import takes 0.4 s, and other commands only use other parts of this module.
    import pandas as pd

    median: NDArray[np.float64] = pd.DataFrame(values).groupby(index).median().to_numpy(np.float64)
    return median.reshape(-1, *values.shape[1:])


def _independent_share(anchor: NDArray[np.intp], seconds: float, persistence_s: float) -> NDArray[np.float64]:
    """Return the share of an independent range: a Gauss-Markov process has one per two time constants."""
    _, slot, count = np.unique(anchor, return_inverse=True, return_counts=True)
    independent = np.maximum(seconds / (2.0 * persistence_s), 1.0)
    return np.asarray(np.minimum(1.0, independent / count)[slot], np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a fit starts.

    Attributes:
        position: float64 (K, 3), of the knots. parameters: float64 (q,); None: the mean of the prior.
        is_close: this is a solution of nearly the same problem.
        is_prior: the positions are also a prior, with `AROUND_M`.
    """

    position: NDArray[np.float64]
    parameters: NDArray[np.float64] | None = None
    is_close: bool = False
    is_prior: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """The result of `fit_joint`.

    Attributes:
        config, observations, prior: the problem.
        position, velocity: float64 (K, 3), at the knots.
        parameters: float64 (q,), and their covariance (q, q).
        residual_m: float64 (n,), of each observation.
        scale_m: float64 (g,), standard deviation of residuals that are no outliers, for each kind of observations.
        segment_loss: float64 (s,), robust loss of each segment, in units of `scale_m`.
    """

    config: EstimatorConfig
    observations: Observations
    prior: Regressors
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    parameters: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    scale_m: NDArray[np.float64]
    segment_loss: NDArray[np.float64]
    _solution: Solution

    @property
    def loss(self) -> float:
        """Loss of all segments, to compare fits with the same scale."""
        return float(self.segment_loss.sum())

    def antenna_position(self) -> NDArray[np.float64]:
        """Return the position of the tag's antenna at each observation, float64 (n, 3), m."""
        observations = self.observations
        position: NDArray[np.float64] = (
            self.position[observations.knot]
            + observations.ahead_s[:, None] * self.velocity[observations.knot]
        )
        position[:, 2] += observations.relative_height
        return position

    def start(self) -> Start:
        """Return this solution as the start and the prior of nearly the same problem."""
        return Start(self.position, self.parameters, is_close=True, is_prior=True)

    def positions_only(self, range_m: NDArray[np.float64], start: Start) -> JointFit:
        """Fit the positions only, to other ranges of the observations, float64 (n,), m."""
        fixed = replace(self.observations, range_m=range_m, rows=np.zeros((len(range_m), 0)))
        return fit_joint(self.config, fixed, Regressors.none(len(range_m)), start, self.scale_m)

    def leave_anchors_out(
        self, range_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where the tag was according to the other anchors, (n, 3), and the standard deviation of the distance, (n,).

        Args:
            range_m: corrected ranges of the observations, float64 (n,), m.

        Returns:
            Positions of the antenna at each observation, estimated without its anchor, m, and the standard deviation of their
            distance from this anchor, m; NaN: unknown.
        """
        observations, used = self.observations, np.unique(self.observations.anchor)
        antenna, sd_m = np.full((len(observations), 3), np.nan), np.full(len(observations), np.nan)
        for rows in (used[k::MAX_REFITS] for k in range(min(MAX_REFITS, len(used)))):
            left_out = np.isin(observations.anchor, rows)
            remaining = replace(self, observations=observations.without(left_out))
            try:
                refit = remaining.positions_only(range_m[~left_out], replace(self.start(), parameters=None))
                covariance = refit._solution.covariances(self.config.dims)
            except DatasetError:
                continue
            received = np.zeros(len(observations.time_s), np.bool_)
            received[observations.knot[~left_out]] = True
            is_near = left_out & (_gap_s(observations, received)[observations.knot] <= FAR_S)
            tag = replace(refit, observations=observations).antenna_position()[is_near]
            antenna[is_near] = tag
            unit, _ = unit_vectors(tag, self.config.anchors.position[observations.anchor[is_near]])
            level, covariance = unit[:, : self.config.dims], covariance[observations.knot[is_near]]
            variance = np.einsum("ni,nij,nj->n", level, covariance, level)
            if self.config.height is not None:
                variance += (unit[:, 2] * self.config.height.sd) ** 2
            sd_m[is_near] = np.sqrt(variance)
        return antenna, sd_m


def _gap_s(observations: Observations, received: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the time from each knot to the nearest one of its segment that still has ranges; inf without one."""
    # Segments are moved so far apart that none is near another.
    apart_s = float(observations.time_s.max(initial=0.0)) + 1e6
    time_s = observations.time_s + observations.knot_segment * apart_s
    received_s = np.concatenate([[-np.inf], time_s[received], [np.inf]])
    after = np.searchsorted(received_s, time_s)
    return np.asarray(np.minimum(time_s - received_s[after - 1], received_s[after] - time_s), np.float64)


def fit_segments(config: EstimatorConfig, segments: Segments, prior: Regressors, start: Start) -> JointFit:
    """Fit positions, tracks and parameters to the ranges of segments; as `fit_joint`."""
    return fit_joint(config, observations_of(segments, prior, config.model), prior, start)


def fit_joint(
    config: EstimatorConfig,
    observations: Observations,
    prior: Regressors,
    start: Start,
    scale_m: NDArray[np.float64] | None = None,
) -> JointFit:
    """Fit positions, tracks and parameters to observations.

    Args:
        config: anchors, noise model, height and area.
        observations: each knot has one or more.
        prior: mean and standard deviation of the parameters; its rows are those of the observations.
        start: roughly right.
        scale_m: float64 (g,), of the residuals; None: estimated.

    Raises:
        DatasetError: the ranges do not determine the solution.
    """
    problem = _JointProblem(config, observations, prior, start, scale_m)
    min_iterations = 1 if start.is_close else _HUBER_ITERATIONS + 4
    gauss_newton(
        problem.improve, iterations=_ITERATIONS, converged=_CONVERGED_M, min_iterations=min_iterations
    )
    return problem.result()


class _JointProblem:
    """The linearised problem of `fit_joint`, and its solution so far."""

    def __init__(
        self,
        config: EstimatorConfig,
        observations: Observations,
        prior: Regressors,
        start: Start,
        scale_m: NDArray[np.float64] | None,
    ) -> None:
        self._config, self._observations, self._prior, self._start = config, observations, prior, start
        self._has_scale = scale_m is not None
        num_groups = int(observations.noise_group.max(initial=0)) + 1
        self._scale_m = np.full(num_groups, _FIRST_SCALE_M) if scale_m is None else scale_m
        self._level_m = 0.0 if config.height is None else config.height.value
        knots, d = len(observations.time_s), config.dims
        self._x = np.zeros((knots, 2 * d))
        self._x[:, :d] = start.position[:, :d]
        self._parameters = prior.mean.copy() if start.parameters is None else start.parameters
        self._solution: Solution
        self._without_ranges = self._motion_and_priors()
        self._columns = self._columns_of_ranges()

    def improve(self, iteration: int) -> float:
        """Linearise and solve; return the change, m: root mean square of positions, or the largest one of parameters."""
        noise_group, start = self._observations.noise_group, self._start
        unit, error_m = self._residuals()
        if not self._has_scale and (iteration or start.parameters is not None):
            scale_m = np.maximum(scatter_of(error_m, noise_group, len(self._scale_m)), LEAST_SCALE_M)
            self._scale_m = scale_m if start.is_close else np.maximum(scale_m, 0.5 * self._scale_m)
        z = error_m / self._scale_m[noise_group]
        robust = self._config.model.weight(z)
        if iteration < _HUBER_ITERATIONS and not start.is_close:
            robust = np.minimum(1.0, 1.0 / np.maximum(np.abs(z), 1e-9))
        self._solution = self._linearised(unit, error_m, self._weight(robust)).solve()
        positions = np.s_[:, : self._config.dims]
        change = float(np.sqrt(np.mean((self._solution.x[positions] - self._x[positions]) ** 2)))
        changes = np.abs(self._solution.shared - self._parameters) / PARAMETER_PRECISION
        self._x, self._parameters = self._solution.x, self._solution.shared
        return float(np.max(changes, initial=change))

    def result(self) -> JointFit:
        """Return the solution."""
        d, model, observations = self._config.dims, self._config.model, self._observations
        unit, error_m = self._residuals()
        z = error_m / self._scale_m[observations.noise_group]
        loss = np.bincount(
            observations.segment,
            model.loss(z) * observations.independent,
            minlength=len(observations.is_stationary),
        )
        position, velocity = np.full((len(self._x), 3), self._level_m), np.zeros((len(self._x), 3))
        position[:, :d], velocity[:, :d] = self._x[:, :d], self._x[:, d:]
        return JointFit(
            config=self._config,
            observations=observations,
            prior=self._prior,
            position=position,
            velocity=velocity,
            parameters=self._parameters,
            covariance=self._covariance(self._solution, unit, self._weight(model.weight(z))),
            residual_m=error_m,
            scale_m=self._scale_m,
            segment_loss=loss.astype(np.float64),
            _solution=self._solution,
        )

    def _weight(self, robust: NDArray[np.float64]) -> NDArray[np.float64]:
        observations = self._observations
        return robust * observations.independent / self._scale_m[observations.noise_group] ** 2

    def _covariance(
        self, solution: Solution, unit: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance of the parameters: of noise, and of errors that stay the same for `SLOW_S`."""
        observations = self._observations
        rows = solution.reduced(self._columns, self._derivatives(unit))
        # The errors of stationary positions are independent, so that the residuals show most of them.
        is_stationary = observations.is_stationary[observations.segment]
        slow_sd_m = np.where(is_stationary, CORRECTED_SLOW_SD_M, self._prior.slow_sd_m)
        slow_sd_m = np.maximum(slow_sd_m, SLOW_SHARE * self._scale_m[observations.noise_group])
        gain = (weight * slow_sd_m)[:, None] * rows @ solution.shared_covariance
        interval = (observations.time_s[observations.knot] // SLOW_S).astype(np.intp)
        _, slot = np.unique(
            np.stack([observations.segment, interval, observations.anchor]), axis=1, return_inverse=True
        )
        summed = np.zeros((int(slot.max(initial=0)) + 1, observations.rows.shape[1]))
        np.add.at(summed, slot.reshape(-1), gain)
        return np.asarray(SD_INFLATION**2 * solution.shared_covariance + summed.T @ summed, np.float64)

    def _residuals(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return unit vectors (n, 3) from anchors to tags, and residuals (n,)."""
        d, observations = self._config.dims, self._observations
        x = self._x[observations.knot]
        tag = np.full((len(x), 3), self._level_m)
        tag[:, :d] = x[:, :d] + observations.ahead_s[:, None] * x[:, d:]
        tag[:, 2] += observations.relative_height
        unit, distance = unit_vectors(tag, self._config.anchors.position[observations.anchor])
        return unit, observations.range_m - distance - observations.rows @ self._parameters

    def _derivatives(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives (n, 2 d + q) of each observation: by position and velocity, and by the parameters."""
        level, observations = unit[:, : self._config.dims], self._observations
        return np.concatenate([level, observations.ahead_s[:, None] * level, observations.rows], axis=1)

    def _columns_of_ranges(self) -> NDArray[np.intp]:
        """Return the columns (n, 2 d + q) of the derivatives."""
        observations, problem = self._observations, self._without_ranges
        n, q = observations.rows.shape
        shared = np.broadcast_to(problem.of_shared(range(q)), (n, q))
        return np.concatenate(
            [problem.of_knot(observations.knot[:, None], range(problem.unknowns)), shared], axis=1
        )

    def _linearised(
        self, unit: NDArray[np.float64], error_m: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> LeastSquares:
        problem, knot, shared = self._without_ranges.copy(), self._observations.knot, self._observations.rows
        values = self._derivatives(unit)[:, : problem.unknowns]
        # The unknowns are solved for, not their changes: motion and priors are linear in them.
        of_knot = np.einsum("nc,nc->n", values, self._x[knot])
        problem.add_at_knots(knot, values, shared, error_m + of_knot + shared @ self._parameters, weight)
        return problem

    def _motion_and_priors(self) -> LeastSquares:
        """Return the part of the problem that is linear and has constant weights."""
        d, observations, model = self._config.dims, self._observations, self._config.model
        problem = LeastSquares(len(observations.time_s), 2 * d, len(self._prior.mean))
        connected = np.flatnonzero(np.diff(observations.knot_segment) == 0)
        problem.add_motion(connected, np.diff(observations.time_s)[connected], d, model.acceleration**2)
        problem.add_prior(problem.of_shared(range(problem.shared)), self._prior.mean, self._prior.information)
        first = np.flatnonzero(np.diff(observations.knot_segment, prepend=-1))
        is_stationary = observations.is_stationary[observations.knot_segment[first]]
        speed = np.where(is_stationary, _STATIONARY, model.speed)
        knots, centre = np.arange(problem.knots), self._config.anchors.position.mean(axis=0)
        prior_position = self._start.position if self._start.is_prior else np.tile(centre, (len(knots), 1))
        information = 1.0 / AROUND_M**2 if self._start.is_prior else _NO_PRIOR
        for axis in range(d):
            problem.add_prior(problem.of_knot(knots, axis), prior_position[:, axis], information)
            problem.add_prior(problem.of_knot(first, d + axis), 0.0, 1.0 / speed**2)
        return problem
