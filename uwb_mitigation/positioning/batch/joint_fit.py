"""Positions, tracks, and what all ranges have in common, estimated together without known positions of the tags.

Ranges are divided into segments of motion and positions at rest (`motion_segments`). Of each segment of motion the track is
estimated, at knots connected by a motion model; of each position at rest, one position. They share the parameters.
Ranges of a pair have similar errors for about a second (see `noise_model`), so that their weights correspond to the number of
independent ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.batch.least_squares import LeastSquares, Solution
from uwb_mitigation.positioning.batch.motion_segments import Segments
from uwb_mitigation.positioning.geometry import unit_vectors
from uwb_mitigation.positioning.noise_model import CORRECTED_SLOW_SD_M, NoiseModel, Regressors, scatter_of
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig
from uwb_mitigation.types.stamps import NS_PER_S

KNOT_S = 0.15
LEAST_SCALE_M = 0.02
_FIRST_SCALE_M = 0.3
SD_INFLATION = 1.5
"""Factor of standard deviations: errors of one position return with each lap, and a track follows persisting errors, which
the number of independent ranges does not contain. With it, 9 of 10 offsets of simulated drives are within two standard
deviations."""

SLOW_S = 20.0
"""Time for which the slow errors of a pair (see `Regressors`) stay the same. Where the geometry is weak, as outside of the
anchors, they contribute most of the error of the common offset."""

AROUND_M = 5.0
"""Standard deviation of the prior of a known position: it only affects positions with too few anchors."""

FAR_S = 0.5
"""A range further in time from every knot has no position on a track."""

_ITERATIONS = 25
_HUBER_ITERATIONS = 4
_CONVERGED_M = 1e-3
_NO_PRIOR = 1e-8
_STATIONARY = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Inputs of the fit: single ranges in motion, one median per pair and stationary position.

    Attributes:
        knot, anchor: int (n,), of each observation; knots of one segment are contiguous.
        ahead_s: float64 (n,), time of the observation after its knot.
        range_m, share: float64 (n,); the share is the number of independent ranges in an observation.
        relative_height: float64 (n,), the height of the tag above the common one.
        rows: float64 (n, q), of the parameters.
        noise_group: int (n,), observations whose errors have the same standard deviation have the same number, from 0.
        of: int (n,), the observation of each of the original ranges (r,).
        knot_segment: int (K,). time_s: float64 (K,), of each knot in its segment. is_stationary: bool (s,).
    """

    knot: NDArray[np.intp]
    anchor: NDArray[np.intp]
    ahead_s: NDArray[np.float64]
    range_m: NDArray[np.float64]
    share: NDArray[np.float64]
    relative_height: NDArray[np.float64]
    rows: NDArray[np.float64]
    noise_group: NDArray[np.intp]
    of: NDArray[np.intp]
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
        """Return the same knots without those observations (n,); `of` becomes invalid."""
        kept = ~left_out
        columns = ("knot", "anchor", "ahead_s", "range_m", "share", "relative_height", "rows", "noise_group")
        return replace(self, **{name: getattr(self, name)[kept] for name in columns})


def observations_of(segments: Segments, parameters: Regressors, model: NoiseModel) -> Observations:
    """Return the observations of ranges that depend on parameters."""
    ranges, rows, noise_group = segments.ranges, parameters.rows, parameters.noise_group
    knot, ahead, share = np.zeros(len(ranges), np.intp), np.zeros(len(ranges)), np.ones(len(ranges))
    knot_segment: list[NDArray[np.intp]] = []
    times: list[NDArray[np.float64]] = []
    edges = np.searchsorted(segments.of, np.arange(len(segments) + 1))
    known = 0
    for number in range(len(segments)):
        own = slice(edges[number], edges[number + 1])
        if segments.is_stationary[number]:
            time_s = np.zeros(1)
            knot[own] = known
        else:
            since = (ranges.stamp_ns[own] - ranges.stamp_ns[own][0]) / NS_PER_S
            index, of = np.unique(np.rint(since / KNOT_S).astype(np.int64), return_inverse=True)
            time_s = index * KNOT_S
            knot[own], ahead[own] = known + of, since - time_s[of]
            share[own] = _share(ranges.anchor[own], max(float(since[-1]), KNOT_S), model.persistence_s)
        knot_segment.append(np.full(len(time_s), number))
        times.append(time_s)
        known += len(time_s)
    in_stationary = segments.is_stationary[segments.of]
    # One observation for each pair of a position at rest, and one for each other range.
    of_pair = segments.of * 1024 + ranges.anchor
    key = np.where(in_stationary, of_pair, len(segments) * 1024 + np.arange(len(ranges)))
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    columns = np.column_stack([ranges.range_m, segments.relative_height, noise_group, rows])
    shared = columns[first]
    order = np.argsort(of, kind="stable")
    for observation, group in enumerate(
        np.split(order, np.searchsorted(of[order], np.arange(1, len(first))))
    ):
        if len(group) > 1:
            shared[observation] = np.median(columns[group], axis=0)
    return Observations(
        knot=knot[first],
        anchor=ranges.anchor[first],
        ahead_s=ahead[first],
        range_m=shared[:, 0],
        share=share[first],
        relative_height=shared[:, 1],
        rows=shared[:, 3:],
        noise_group=shared[:, 2].astype(np.intp),
        of=of,
        knot_segment=np.concatenate(knot_segment),
        time_s=np.concatenate(times),
        is_stationary=segments.is_stationary,
    )


def _share(anchor: NDArray[np.intp], seconds: float, persistence_s: float) -> NDArray[np.float64]:
    """Return the share of an independent range: a Gauss-Markov process has one per two time constants."""
    _, of, count = np.unique(anchor, return_inverse=True, return_counts=True)
    independent = np.maximum(seconds / (2.0 * persistence_s), 1.0)
    share: NDArray[np.float64] = np.minimum(1.0, independent / count)[of]
    return share


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

    def covariances(self) -> NDArray[np.float64]:
        """Return the covariances of the positions, float64 (K, 3, 3)."""
        d, height = self.config.dims, self.config.height
        found = np.zeros((len(self.position), 3, 3))
        found[:, :d, :d] = self._solution.covariances(d)
        if height is not None:
            found[:, 2, 2] = height.sd**2
        return found

    def antenna_position(self) -> NDArray[np.float64]:
        """Return the position of the tag's antenna at each observation, float64 (n, 3), m."""
        observations = self.observations
        position: NDArray[np.float64] = (
            self.position[observations.knot]
            + observations.ahead_s[:, None] * self.velocity[observations.knot]
        )
        position[:, 2] += observations.relative_height
        return position

    def without(self, left_out: NDArray[np.bool_]) -> JointFit:
        """Fit again without those observations, bool (n,), starting here."""
        observations, start = self.observations.without(left_out), self.position
        return fit_joint(
            self.config, observations, self.prior, start, self.parameters, around=start, near=True
        )

    def without_anchors(self, rows: NDArray[np.intp], correction_m: NDArray[np.float64]) -> JointFit:
        """Fit the positions only, to the other anchors' ranges minus a correction, float64 (n,)."""
        corrected = replace(
            self.observations,
            range_m=self.observations.range_m - correction_m,
            rows=np.zeros((len(self.observations), 0)),
        )
        observations = corrected.without(np.isin(self.observations.anchor, rows))
        return fit_joint(
            self.config,
            observations,
            Regressors.none(len(observations)),
            self.position,
            scale_m=self.scale_m,
            around=self.position,
            near=True,
        )


def fit_segments(
    config: EstimatorConfig,
    segments: Segments,
    prior: Regressors,
    position: NDArray[np.float64],
    parameters: NDArray[np.float64] | None = None,
    *,
    near: bool = False,
) -> JointFit:
    """Fit positions, tracks and parameters to the ranges of segments; as `fit_joint`."""
    observations = observations_of(segments, prior, config.model)
    return fit_joint(config, observations, prior, position, parameters, near=near)


def fit_joint(
    config: EstimatorConfig,
    observations: Observations,
    prior: Regressors,
    position: NDArray[np.float64],
    parameters: NDArray[np.float64] | None = None,
    *,
    scale_m: NDArray[np.float64] | None = None,
    around: NDArray[np.float64] | None = None,
    near: bool = False,
) -> JointFit:
    """Fit positions, tracks and parameters to observations.

    Args:
        config: anchors, noise model, height and area.
        observations: each knot has one or more.
        prior: mean and standard deviation of the parameters; its rows are those of the observations.
        position: float64 (K, 3), roughly right, to start from.
        parameters: to start from; None: the mean of the prior.
        scale_m: float64 (g,), of the residuals; None: estimated.
        around: float64 (K, 3), prior of the positions, with `AROUND_M`; None: no prior.
        near: the start is a solution of nearly the same problem.

    Raises:
        DatasetError: the ranges do not determine the solution.
    """
    d, model, problem = config.dims, config.model, _JointProblem(config, observations, prior, around)
    x = np.zeros((len(observations.time_s), 2 * d))
    x[:, :d] = position[:, :d]
    shared = prior.mean.copy() if parameters is None else parameters
    kinds = int(observations.noise_group.max(initial=0)) + 1
    scale = np.full(kinds, _FIRST_SCALE_M) if scale_m is None else scale_m
    solution: Solution | None = None
    try:
        for iteration in range(_ITERATIONS):
            unit, error = problem.residuals(x, shared)
            if scale_m is None and (iteration or parameters is not None):
                found = np.maximum(scatter_of(error, observations.noise_group, kinds), LEAST_SCALE_M)
                scale = found if near else np.maximum(found, 0.5 * scale)
            z = error / scale[observations.noise_group]
            robust = model.weight(z)
            if iteration < _HUBER_ITERATIONS and not near:
                robust = np.minimum(1.0, 1.0 / np.maximum(np.abs(z), 1e-9))
            weight = robust * observations.share / scale[observations.noise_group] ** 2
            solution = problem.linearised(x, shared, unit, error, weight).solve()
            step = float(np.abs(solution.x[:, :d] - x[:, :d]).max())
            x, shared = solution.x, solution.shared
            if not np.isfinite(step) or step > 1e6:
                raise np.linalg.LinAlgError
            if step < _CONVERGED_M and (near or iteration > _HUBER_ITERATIONS + 2):
                break
    except np.linalg.LinAlgError as error_:
        raise DatasetError(
            "the ranges do not determine where the tags were", valid="more ranges, or anchors"
        ) from error_
    assert solution is not None
    unit, error = problem.residuals(x, shared)
    z = error / scale[observations.noise_group]
    losses = np.bincount(
        observations.segment, model.loss(z) * observations.share, minlength=len(observations.is_stationary)
    )
    loss = losses.astype(np.float64)
    position, velocity = np.full((len(x), 3), problem.level), np.zeros((len(x), 3))
    position[:, :d], velocity[:, :d] = x[:, :d], x[:, d:]
    weight = model.weight(z) * observations.share / scale[observations.noise_group] ** 2
    covariance = problem.covariance(solution, unit, weight)
    return JointFit(
        config, observations, prior, position, velocity, shared, covariance, error, scale, loss, solution
    )


class _JointProblem:
    """The linearised problem of `fit_joint`."""

    def __init__(
        self,
        config: EstimatorConfig,
        observations: Observations,
        prior: Regressors,
        around: NDArray[np.float64] | None,
    ) -> None:
        self._config, self._links, self._prior = config, observations, prior
        centre = config.anchors.position.mean(axis=0)
        self._around = np.tile(centre, (len(observations.time_s), 1)) if around is None else around
        self._nearness = _NO_PRIOR if around is None else 1.0 / AROUND_M**2
        self.level = 0.0 if config.height is None else config.height.value

    def covariance(
        self, solution: Solution, unit: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance of the parameters: of noise, and of errors that stay the same for `SLOW_S`."""
        observations = self._links
        problem = LeastSquares(len(observations.time_s), 2 * self._config.dims, observations.rows.shape[1])
        rows = solution.reduced(problem.add(*self._rows(problem, unit), 0.0, 1.0))
        # The errors of stationary positions are independent, so that the residuals show most of them.
        is_stationary = observations.is_stationary[observations.segment]
        slow_sd_m = np.where(is_stationary, CORRECTED_SLOW_SD_M, self._prior.slow_sd_m)
        gain = (weight * slow_sd_m)[:, None] * rows @ solution.shared_covariance
        chunk = (observations.time_s[observations.knot] // SLOW_S).astype(np.intp)
        _, of = np.unique(
            np.stack([observations.segment, chunk, observations.anchor]), axis=1, return_inverse=True
        )
        summed = np.zeros((int(of.max(initial=0)) + 1, observations.rows.shape[1]))
        np.add.at(summed, of.reshape(-1), gain)
        found: NDArray[np.float64] = SD_INFLATION**2 * solution.shared_covariance + summed.T @ summed
        return found

    def residuals(
        self, x: NDArray[np.float64], shared: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return unit vectors (n, 3) from anchors to tags, and residuals (n,)."""
        d, observations = self._config.dims, self._links
        at = x[observations.knot]
        tag = np.full((len(at), 3), self.level)
        tag[:, :d] = at[:, :d] + observations.ahead_s[:, None] * at[:, d:]
        tag[:, 2] += observations.relative_height
        unit, distance = unit_vectors(tag, self._config.anchors.position[observations.anchor])
        return unit, observations.range_m - distance - observations.rows @ shared

    def _rows(
        self, problem: LeastSquares, unit: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return the columns and derivatives of each observation: of position and velocity, and of the parameters."""
        d, observations = self._config.dims, self._links
        n, q = observations.rows.shape
        shared = np.broadcast_to(problem.of_shared(range(q)), (n, q))
        columns = np.concatenate([problem.of_knot(observations.knot[:, None], range(2 * d)), shared], axis=1)
        level = unit[:, :d]
        return columns, np.concatenate(
            [level, observations.ahead_s[:, None] * level, observations.rows], axis=1
        )

    def linearised(
        self,
        x: NDArray[np.float64],
        shared: NDArray[np.float64],
        unit: NDArray[np.float64],
        error: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> LeastSquares:
        d, observations, model = self._config.dims, self._links, self._config.model
        problem = LeastSquares(len(x), 2 * d, len(shared))
        columns, rows = self._rows(problem, unit)
        # The unknowns are solved for, not their changes: motion and priors are linear in them.
        target = error + np.einsum("nc,nc->n", rows, np.append(x.reshape(-1), shared)[columns])
        problem.add(columns, rows, target, weight)
        connected = np.flatnonzero(np.diff(observations.knot_segment) == 0)
        problem.add_motion(connected, np.diff(observations.time_s)[connected], d, model.acceleration**2)
        if len(shared):
            problem.add_prior(
                problem.of_shared(range(len(shared))), self._prior.mean, self._prior.information
            )
        first = np.flatnonzero(np.diff(observations.knot_segment, prepend=-1))
        speed = np.where(
            observations.is_stationary[observations.knot_segment[first]], _STATIONARY, model.speed
        )
        every = np.arange(len(x))
        for axis in range(d):
            problem.add_prior(problem.of_knot(every, axis), self._around[:, axis], self._nearness)
            problem.add_prior(problem.of_knot(first, d + axis), 0.0, 1.0 / speed**2)
        return problem
