"""Smoothing of a track with all ranges of a recording, before and after each position.

`Smoother` uses the error model of the filter: white acceleration; each range error is the sum of white noise, a persisting
error (one process per anchor), a common offset, and an offset of each anchor. Knots are 0.1 s apart where there are ranges;
each range belongs to one knot. It is solved by iteratively reweighted Gauss-Newton.

`smooth` fuses its track with those of the live filter forwards and backwards. The batch smoother is best if offsets and smooth
motion replace geometry: far away from a small group of anchors. With NLOS errors and weakly observable heights it relies
too much on its model, and its errors exceed those of the live filter. So its covariance is enlarged, and the three
tracks are fused by covariance intersection, which is consistent for any correlation of their errors (Julier, Uhlmann 1997;
weights of Niehsen 2002).
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.batch.least_squares import LeastSquares, Solution, gauss_newton
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import unit_vectors
from uwb_mitigation.positioning.online.filter import FIRST_ERROR, OFFSET, RangeFilter
from uwb_mitigation.positioning.online.robot_estimator import make_estimator
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Ranges, Track

KNOT_S = 0.1
BATCH_BIAS_M = 0.2
"""Standard deviation of the batch smoother's bias that its covariance does not contain: a typical NLOS error."""

_ITERATIONS = 12
_CONVERGED_M = 2e-3
_OLDEST_NS = NS_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """The result of the smoother.

    Attributes:
        track: at the knots.
        anchors: float64 (m, 3), estimated positions, and `anchor_covariance` (m, 3, m, 3); as given if they are not
            estimated.
        residual_m: float64 (n,), of each range, including the persisting error of its anchor.
    """

    track: Track
    anchors: NDArray[np.float64]
    anchor_covariance: NDArray[np.float64]
    residual_m: NDArray[np.float64]


def knots_of(stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Return the knots, int64 (K,) ns since the first stamp, and the knot of each stamp, int (n,)."""
    spacing = round(KNOT_S * NS_PER_S)
    number, knot = np.unique((stamp_ns - stamp_ns[0] + spacing // 2) // spacing, return_inverse=True)
    return number * spacing, knot


class Smoother:
    """Fits a track to ranges, together with other unknowns.

    Args:
        config: anchors, error model, and prior knowledge of the height.
        ranges: two or more, in the order of time.
        find_anchors: also estimate the positions of the anchors.
        around: prior positions of estimated anchors and their standard deviations, float64 (m, 3) both; None: those of
            `anchors`.
        after: the filter at the time of the first range, whose state and covariance are the prior of the track.

    Raises:
        DatasetError: fewer than two ranges.
    """

    def __init__(
        self,
        config: EstimatorConfig,
        ranges: Ranges,
        *,
        find_anchors: bool = False,
        around: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
        after: RangeFilter | None = None,
    ) -> None:
        if len(ranges) < 2:
            raise DatasetError(f"{len(ranges)} ranges", valid="two or more for a track")
        anchors, model = config.anchors, config.model
        self._model, self._height, self._find, self._after = model, config.height, find_anchors, after
        self._d = config.dims
        # Anchors without ranges have no persisting errors to estimate.
        self._used, self._slot = np.unique(ranges.anchor, return_inverse=True)
        self._anchor_position = anchors.position
        self._around, self._spread = around or (anchors.position, np.repeat(anchors.sd[:, None], 3, axis=1))
        self._ranges = ranges
        self._origin_ns = int(ranges.stamp_ns[0])
        self._knots_ns, self._knot = knots_of(ranges.stamp_ns)
        self._time_s = self._knots_ns / NS_PER_S
        self._ahead_s = (ranges.stamp_ns - self._origin_ns - self._knots_ns[self._knot]) / NS_PER_S
        self._variance = model.variances(ranges.variance_m2)
        median = np.array([np.median(self._variance[self._slot == s]) for s in range(len(self._used))])
        self._persisting = (1.0 - model.smoother_white) * median
        if not find_anchors:
            self._persisting = self._persisting + anchors.sd[self._used] ** 2
        self._white = np.maximum(
            model.smoother_white * self._variance, self._variance - self._persisting[self._slot]
        )
        # A common offset, and one of each anchor.
        self._offset_sd = np.array([model.offset_sd, *[model.pair_sd] * len(self._used)])
        self._heights = config.heights if config.height is None else None
        extra = (self._height is not None) + (3 * len(self._used) if find_anchors else 0)
        self._without_ranges = self._motion_and_priors(len(self._offset_sd) + extra)
        self._columns = self._columns_of_ranges()
        self._x, self._shared = np.zeros((0, 0)), np.zeros(0)
        self._solution: Solution

    def fit(self, initial: Track, iterations: int = _ITERATIONS) -> Smoothed:
        """Return the track, starting from one that is roughly right.

        Raises:
            DatasetError: the ranges do not determine it.
        """
        stamp_s = (initial.stamp_ns - self._origin_ns) / NS_PER_S
        self._x = np.zeros((len(self._time_s), 2 * self._d + len(self._used)))
        for axis in range(self._d):
            self._x[:, axis] = np.interp(self._time_s, stamp_s, initial.position[:, axis])
        self._shared = np.zeros(self._without_ranges.shared)
        gauss_newton(self._improve, iterations=iterations, converged=_CONVERGED_M)
        return self._result()

    def _improve(self, iteration: int) -> float:
        """Linearise and solve; return the largest change of a position, m."""
        self._solution, d, before = self._linearised().solve(), self._d, self._x
        self._x, self._shared = self._solution.x, self._solution.shared
        return float(np.abs(self._x[:, :d] - before[:, :d]).max())

    def _result(self) -> Smoothed:
        x, knots, d, p = self._x, len(self._x), self._d, len(self._offset_sd)
        height, anchors = self._split()
        position, velocity = np.full((knots, 3), height), np.zeros((knots, 3))
        position[:, :d], velocity[:, :d] = x[:, :d], x[:, d : 2 * d]
        covariance = np.zeros((knots, 6, 6))
        axes = [*range(d), *range(3, 3 + d)]
        covariance[np.ix_(range(knots), axes, axes)] = self._solution.covariances(2 * d)
        if self._height is not None:
            covariance[:, 2, 2] = self._solution.shared_covariance[p, p]
        anchor_covariance = np.diag(self._spread.reshape(-1) ** 2)
        if self._find:
            axes_of_used = (3 * self._used[:, None] + np.arange(3)).reshape(-1)
            of_anchors = self._solution.shared_covariance[-len(axes_of_used) :, -len(axes_of_used) :]
            anchor_covariance[np.ix_(axes_of_used, axes_of_used)] = of_anchors
        return Smoothed(
            Track(self._origin_ns + self._knots_ns, position, velocity, covariance),
            anchors,
            anchor_covariance.reshape(len(anchors), 3, len(anchors), 3),
            self._residuals()[1],
        )

    def _split(self) -> tuple[float, NDArray[np.float64]]:
        """Return the height (0 if it is not shared) and the positions of all anchors (m, 3)."""
        shared, height, anchors = self._shared, 0.0, self._anchor_position.copy()
        if self._height is not None:
            height = self._height.value + shared[len(self._offset_sd)]
        if self._find:
            anchors[self._used] += shared[-3 * len(self._used) :].reshape(-1, 3)
        return height, anchors

    def _residuals(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return unit vectors (n, 3) from anchor to tag, and residuals (n,) that include persisting errors."""
        d, shared, x = self._d, self._shared, self._x[self._knot]
        height, anchors = self._split()
        tag = np.full((len(x), 3), height)
        tag[:, :d] = x[:, :d] + self._ahead_s[:, None] * x[:, d : 2 * d]
        unit, distance = unit_vectors(tag, anchors[self._ranges.anchor])
        return unit, self._ranges.range_m - distance - shared[0] - shared[1 + self._slot]

    def _linearised(self) -> LeastSquares:
        unit, residual = self._residuals()
        values = [
            unit[:, : self._d],
            self._ahead_s[:, None] * unit[:, : self._d],
            np.ones((len(unit), 3)),
            unit[:, 2:][:, : int(self._height is not None)],
        ]
        if self._find:
            values.append(-unit)
        row, problem = np.concatenate(values, axis=1), self._without_ranges.copy()
        # The unknowns are solved for, not their changes: motion and priors are linear in them.
        target = residual - self._x[self._knot, 2 * self._d + self._slot]
        target += np.einsum("nc,nc->n", row, np.append(self._x, self._shared)[self._columns])
        weight = self._model.weight(residual / np.sqrt(self._variance)) / self._white
        problem.add(self._columns, row, target, weight)
        return problem

    def _columns_of_ranges(self) -> NDArray[np.intp]:
        """Return the columns (n, c) of the unknowns on which each range depends."""
        problem, knot, slot = self._without_ranges, self._knot[:, None], self._slot[:, None]
        columns = [
            problem.of_knot(knot, range(2 * self._d)),
            problem.of_knot(knot, 2 * self._d + slot),
            problem.of_shared(slot * (0, 1) + (0, 1)),
        ]
        if self._height is not None:
            columns.append(np.full(knot.shape, problem.of_shared(len(self._offset_sd))))
        if self._find:
            columns.append(problem.of_shared(problem.shared - 3 * len(self._used) + 3 * slot + np.arange(3)))
        return np.concatenate(columns, axis=1)

    def _motion_and_priors(self, shared: int) -> LeastSquares:
        """Return the part of the problem that is linear and has constant weights."""
        d, model, knots = self._d, self._model, len(self._time_s)
        problem = LeastSquares(knots, 2 * d + len(self._used), shared)
        dt, every = np.diff(self._time_s), np.arange(knots - 1)
        problem.add_motion(every, dt, d, model.acceleration**2)
        decay = np.exp(-dt / model.persistence_s)
        for i, variance in enumerate(self._persisting, 2 * d):
            pair = problem.of_knot(np.stack([every + 1, every], axis=1), i)
            row = np.stack([np.ones(len(dt)), -decay], axis=1)
            problem.add(pair, row, 0.0, 1.0 / (variance * (1.0 - decay**2)))
        self._add_priors(problem)
        return problem

    def _add_priors(self, problem: LeastSquares) -> None:
        d, p, m = self._d, len(self._offset_sd), len(self._used)
        # The prior of a filter contains the common offset, and the height.
        first = 0 if self._after is None else 1
        problem.add_prior(
            problem.of_shared(range(first, p)), 0.0, 1.0 / np.maximum(self._offset_sd[first:], 1e-6) ** 2
        )
        if self._find:
            shift = (self._around - self._anchor_position)[self._used].reshape(-1)
            sd = np.maximum(self._spread[self._used].reshape(-1), 1e-6)
            columns = problem.of_shared(range(problem.shared - 3 * m, problem.shared))
            problem.add_prior(columns, shift, 1.0 / sd**2)
        if self._heights is not None:
            value, variance = self._heights.height_at(self._origin_ns + self._knots_ns)
            is_finite = np.isfinite(value)
            if is_finite.any():
                columns = problem.of_knot(np.flatnonzero(is_finite), 2)
                problem.add_prior(columns, value[is_finite], 1.0 / variance[is_finite])
        if self._after is None:
            if self._height is not None:
                problem.add_prior(problem.of_shared(p), 0.0, 1.0 / self._height.sd**2)
            problem.add_prior(problem.of_knot(0, range(d, 2 * d)), 0.0, 1.0 / self._model.speed**2)
            problem.add_prior(problem.of_knot(0, range(2 * d, 2 * d + m)), 0.0, 1.0 / self._persisting)
            return
        index = [*range(d), *range(3, 3 + d), *(FIRST_ERROR + self._used), OFFSET]
        column = [*problem.of_knot(0, range(2 * d + m)), problem.of_shared(0)]
        state = self._after.x.copy()
        if self._height is not None:
            index, column = [*index, 2], [*column, problem.of_shared(p)]
            state[2] -= self._height.value
        information = np.linalg.inv(self._after.P[np.ix_(index, index)] + 1e-9 * np.eye(len(index)))
        root = np.linalg.cholesky((information + information.T) / 2.0).T
        problem.add(np.tile(column, (len(index), 1)), root, root @ state[index], 1.0)


def smooth(config: EstimatorConfig, ranges: Ranges, live: Track) -> Track:
    """Return positions at ten stamps a second, each from all ranges before and after it.

    Args:
        config: anchors, error model, and prior knowledge of the tag.
        ranges: two or more.
        live: the track of a `TagEstimator` from the same ranges; not empty.
    """
    stamp_ns = int(ranges.stamp_ns[0]) + knots_of(ranges.stamp_ns)[0]
    end_ns, backwards = int(ranges.stamp_ns[-1]), slice(None, None, -1)
    heights = config.heights and config.heights.reversed(end_ns)
    robot = config.robot and replace(
        config.robot,
        odometry=config.robot.odometry and config.robot.odometry.reversed(end_ns),
        imu=config.robot.imu and config.robot.imu.reversed(end_ns),
    )
    # Constant errors of ranges, and mirrored heights, are the same in both directions: they are no reason to prefer one.
    alone = replace(config, widens=False)
    earlier = _states_at(make_estimator(alone).run(ranges), stamp_ns)
    # The part of the position's covariance beyond that of the filter, which can be larger at times.
    unseen = np.zeros_like(earlier[1])
    beyond = np.nan_to_num(_states_at(live, stamp_ns)[1] - earlier[1])[:, :3, :3]
    values, vectors = np.linalg.eigh(beyond)
    unseen[:, :3, :3] = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    track = make_estimator(replace(alone, heights=heights, robot=robot)).run(ranges.reversed(end_ns))
    later = _states_at(track, (end_ns - stamp_ns)[backwards])
    flip = np.diag([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    later = later[0][backwards] @ flip, flip @ later[1][backwards] @ flip
    state, covariance, spread = _fused(earlier, later)
    # Without a position of either filter the batch smoother's choice among several optima is arbitrary.
    is_known = np.asarray(np.isfinite(state).all(axis=1), np.bool_)
    yaw = _fused_yaw(_yaw_at(live, stamp_ns), _yaw_at(track, end_ns - stamp_ns))
    batch = None
    # The batch smoother has no odometry.
    if not np.isfinite(yaw[:, 0]).any():
        with contextlib.suppress(DatasetError):
            batch = Smoother(config, ranges).fit(live).track
    if batch is not None:
        state, covariance, more = fused_with_batch(state, covariance, batch)
        spread += more
    position = state[:, :3] if config.area is None else config.area.clip(state[:, :3])
    return Track(stamp_ns, position, state[:, 3:], covariance + spread + unseen, yaw).take(is_known)


def fused_with_batch(
    state: NDArray[np.float64], covariance: NDArray[np.float64], batch: Track
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fuse states (k, 6) of the filter, with covariances (k, 6, 6), with the batch smoother's at the same times.

    Returns:
        As `_fused`.
    """
    batch_state = np.concatenate([batch.position, batch.velocity], axis=1)
    batch_covariance = batch.covariance + np.diag([BATCH_BIAS_M**2] * 3 + [0.0] * 3)
    difference = (batch_state - state)[:, :3]
    expected = _regular((covariance + batch_covariance)[:, :3, :3])
    squared = np.einsum("ni,ni->n", difference, np.linalg.solve(expected, difference[..., None])[..., 0])
    # If it contradicts the filters, it is in another optimum.
    batch_covariance *= np.fmax(squared / 3.0, 1.0)[:, None, None]
    return _fused((state, covariance), (batch_state, batch_covariance))


def _states_at(track: Track, stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """States float64 (k, 6) and covariances (k, 6, 6) predicted from the latest estimates; NaN without a recent one."""
    if len(track) == 0:
        return np.full((len(stamp_ns), 6), np.nan), np.full((len(stamp_ns), 6, 6), np.nan)
    latest = np.searchsorted(track.stamp_ns, stamp_ns, side="right") - 1
    age_ns = stamp_ns - track.stamp_ns[latest]
    age_s = age_ns[:, None] / NS_PER_S
    state = np.concatenate(
        [track.position[latest] + age_s * track.velocity[latest], track.velocity[latest]], axis=1
    )
    covariance = track.covariance[latest].copy()
    absent = (latest < 0) | (age_ns > _OLDEST_NS)
    state[absent], covariance[absent] = np.nan, np.nan
    return state, covariance


def _yaw_at(track: Track, stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return yaws and their variances (k, 2) between the estimates around each stamp; NaN where one is unknown."""
    yaws = np.full((len(stamp_ns), 2), np.nan)
    if len(track) > 1:
        after = np.searchsorted(track.stamp_ns, stamp_ns).clip(1, len(track) - 1)
        span_ns = track.stamp_ns[after] - track.stamp_ns[after - 1]
        fraction = ((stamp_ns - track.stamp_ns[after - 1]) / np.maximum(span_ns, 1)).clip(0.0, 1.0)
        first, second = track.yaw[after - 1], track.yaw[after]
        yaws[:, 0] = first[:, 0] + fraction * _wrapped(second[:, 0] - first[:, 0])
        yaws[:, 1] = np.maximum(first[:, 4], second[:, 4])
        yaws[span_ns > _OLDEST_NS] = np.nan
    return yaws


def _fused_yaw(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fuse yaws and variances (k, 2) by covariance intersection, as `_fused`; return the columns of `Track.yaw`."""
    (a, p), (b, q) = first.T, second.T
    difference, weight = _wrapped(b - a), q / (p + q)
    has_both = np.isfinite(difference)
    yaw = np.where(has_both, a + (1.0 - weight) * difference, np.where(np.isfinite(a), a, b))
    variance = 1.0 / (weight / p + (1.0 - weight) / q) + weight * (1.0 - weight) * difference**2
    variance = np.where(has_both, variance, np.where(np.isfinite(a), p, q))
    zero = np.where(np.isfinite(yaw), 0.0, np.nan)
    return np.stack([_wrapped(yaw), zero, zero, zero, variance], axis=1)


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi, np.float64)


def _fused(
    first: tuple[NDArray[np.float64], NDArray[np.float64]],
    second: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fuse states (k, 6) with covariances (k, 6, 6) by covariance intersection; where one is NaN, take the other.

    Returns:
        States, covariances, and the spread of the two means (k, 6, 6), as in a mixture: where they differ, one is wrong.
    """
    (a, p), (b, q) = first, second
    state, covariance = np.where(np.isfinite(a), a, b), np.where(np.isfinite(p), p, q)
    spread = np.zeros_like(covariance)
    has_both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    p, q = _regular(p[has_both]), _regular(q[has_both])
    trace = [np.einsum("nii->n", c[:, :3, :3]) for c in (p, q)]
    weight = (trace[1] / (trace[0] + trace[1]))[:, None, None]
    information_p, information_q = weight * np.linalg.inv(p), (1.0 - weight) * np.linalg.inv(q)
    fused = np.linalg.inv(information_p + information_q)
    covariance[has_both] = fused
    difference = a[has_both] - b[has_both]
    spread[has_both] = weight * (1.0 - weight) * np.einsum("ni,nj->nij", difference, difference)
    weighted = information_p @ a[has_both][..., None] + information_q @ b[has_both][..., None]
    state[has_both] = (fused @ weighted)[..., 0]
    return state, covariance, spread


def _regular(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariances without the zero variances of a level tag."""
    return covariance + 1e-9 * np.eye(covariance.shape[-1])
