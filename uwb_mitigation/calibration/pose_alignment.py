"""Ranges together with a robot's own localisation: time offset, lever arms, and the true ranges.

A pose is that of the robot's frame, and the antenna has a lever arm in this frame. Radio and localisation have their own
clocks and delays. Both, and the offset of each pair, are estimated from the ranges by robust least squares (Gauss-Newton).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.joint_fit import medians
from uwb_mitigation.calibration.regression import Regressors, scatter_of
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.batch.least_squares import gauss_newton
from uwb_mitigation.positioning.geometry import unit_vectors
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import PosePath, Ranges

MAX_TIME_OFFSET_S = 2.0
"""Clocks that differ more are not synchronised, which is refused. The steps below: at 1 m/s, 0.1 s are 0.1 m, the noise of a range."""

COARSE_OFFSETS_S = np.arange(-MAX_TIME_OFFSET_S, MAX_TIME_OFFSET_S + 0.01, 0.1)
FINE_OFFSETS_S = np.arange(-0.1, 0.101, 0.02)
TIME_OFFSET_SD_S, LEVER_SD_M, OFFSET_SD_M = 2.0, 1.0, 2.0
"""Prior standard deviations: as large as these values can be on robots, so that the ranges decide."""

MIN_RANGES = 40
"""Fewer do not determine time offset, lever arm and offsets."""

MAX_RANGES, SEARCHED = 20_000, 4000
"""The fit, and the search for the time offset, use at most this number of ranges."""

SLOPE_S = 0.1
"""The velocity of a pose is the difference over this time before and after it."""

SEPARATED_M = 0.1
"""A lever arm with a larger standard deviation cannot be separated from the offsets."""

BLOCK_S, SD_INFLATION = 10.0, 1.5
"""Errors of blocks of this duration count as independent. The factor accounts for errors that
recur with each lap, which are not in their scatter."""

MIN_SD_M = 0.01
"""Minimum standard deviation of white noise and of persisting errors."""

_ITERATIONS, _CONVERGED, _FIXED_SD = 40, 1e-5, 1e-9
"""Maximum number of iterations and the change that ends them, m or s; standard deviation of given values."""

_MODEL = NoiseModel(long=1.5, short=1.5)


@dataclass(frozen=True, slots=True, eq=False)
class PoseAlignment:
    """The result, or where its fit starts.

    Attributes:
        time_offset_s, time_offset_sd_s: added to the stamp of a range to get that of the localisation; sd 0 = given.
        lever_arm_m, lever_arm_sd_m: (T, 3), of each tag's antenna in the robot's frame; sd 0 = given, NaN = not observable,
            so that the start value is kept.
        is_free_time: whether the time offset is estimated. is_free_arm: bool (T, 3), whether each coordinate is.
        pairs: (tag number, anchor row), and `offset_m`, `offset_sd_m` of each.
        sd: of time offset, lever arms, offsets and regressors, in this order.
        position: float64 (r, 3), of the antenna at each range; NaN = unknown. distance_m: (r,), to the anchor.
    """

    time_offset_s: float
    lever_arm_m: NDArray[np.float64]
    is_free_time: bool
    is_free_arm: NDArray[np.bool_]
    pairs: tuple[tuple[int, int], ...]
    offset_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    sd: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    distance_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def time_offset_sd_s(self) -> float:
        """Standard deviation of the time offset."""
        return float(self.sd[0]) if self.is_free_time else 0.0

    @property
    def lever_arm_sd_m(self) -> NDArray[np.float64]:
        """Standard deviations of the lever arms, (T, 3)."""
        sd_m = self.sd[1 : 1 + self.lever_arm_m.size].reshape(self.lever_arm_m.shape)
        return np.where(self.is_free_arm, sd_m, np.nan if self.is_free_arm.any() else 0.0)

    @property
    def offset_sd_m(self) -> NDArray[np.float64]:
        """Standard deviations of the offsets of the pairs."""
        return self.sd[1 + self.lever_arm_m.size :][: len(self.pairs)]

    def check_enough(self, count: int) -> None:
        """Refuse too few ranges with a pose; offsets alone can be estimated from any number, because their priors are known."""
        least = MIN_RANGES if self.is_free_time or self.is_free_arm.any() else 1
        if count < least:
            raise DatasetError(
                f"{count} ranges lie within the localisation's times",
                valid=f"{least} or more: do their clocks agree to {MAX_TIME_OFFSET_S:g} s?",
            )

    def as_json(self) -> dict[str, object]:
        """Return values for JSON; NaN = not observable. Lever arm of the first tag, and of all tags by their ids."""
        return {
            "time_offset_s": self.time_offset_s,
            "time_offset_sd_s": self.time_offset_sd_s,
            "lever_arm_m": self.lever_arm_m[0],
            "lever_arm_sd_m": self.lever_arm_sd_m[0],
            "lever_arms_m": self.lever_arm_m,
            "lever_arms_sd_m": self.lever_arm_sd_m,
        }


def align_poses(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    paths: Sequence[PosePath],
    regressors: Regressors,
    *,
    time_offset_s: float | None = None,
    lever_arms_m: NDArray[np.float64] | None = None,
    estimate_lever_arm: bool = False,
) -> PoseAlignment:
    """Estimate time offset and offsets, and on request the lever arms.

    Args:
        anchors: positions of the anchors.
        tags: ranges of each tag.
        paths: for each tag, the path of the robot that carries it.
        regressors: as many rows as there are ranges, one tag after the other.
        time_offset_s: if known.
        lever_arms_m: float64 (T, 3), of each tag; None: zero.
        estimate_lever_arm: start from these arms and estimate them.

    Raises:
        DatasetError: too few ranges are within the localisation's times, or arms and offsets cannot be separated.
    """
    if (fewest := min(map(len, paths))) < 2:
        raise DatasetError(f"{fewest} poses of the localisation", valid="two or more")
    arms_m = np.zeros((len(tags), 3)) if lever_arms_m is None else lever_arms_m
    is_free_arm, ranges = np.full(arms_m.shape, estimate_lever_arm), Ranges.of_tags(tags)
    tag, anchor = np.repeat(np.arange(len(tags)), list(map(len, tags))), anchors.position[ranges.anchor]
    columns, pair = np.unique(np.stack([tag, ranges.anchor]), axis=1, return_inverse=True)
    pairs, smoothed = tuple(zip(*columns.tolist(), strict=True)), [path.smoothed() for path in paths]
    problem = _AlignmentProblem(ranges, tag, pair.reshape(-1), anchor, regressors, smoothed, pairs, arms_m)
    start = PoseAlignment(time_offset_s or 0.0, arms_m, time_offset_s is None, is_free_arm, pairs)
    alignment = problem.fit(start)
    position, rotation = _poses_at(paths, tag, ranges.stamp_ns, alignment.time_offset_s)
    antenna = position + np.einsum("nij,nj->ni", rotation, alignment.lever_arm_m[tag])
    distance = np.linalg.norm(antenna - anchor, axis=1)
    start.check_enough(int(np.isfinite(distance).sum()))
    return replace(alignment, position=antenna, distance_m=distance)


def _poses_at(
    paths: Sequence[PosePath], tag: NDArray[np.intp], stamp_ns: NDArray[np.int64], later_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `PosePath.poses_at` for the path of each tag (n,)."""
    position, rotation = np.zeros((len(tag), 3)), np.zeros((len(tag), 3, 3))
    for number, path in enumerate(paths):
        is_of_tag = tag == number
        position[is_of_tag], rotation[is_of_tag] = path.poses_at(stamp_ns[is_of_tag], later_s)
    return position, rotation


@dataclass(frozen=True, slots=True, eq=False)
class _AlignmentProblem:
    """n ranges of tags (n,) and pairs (n,) to anchors at (n, 3), and of the T tags paths and given lever arms (T, 3)."""

    ranges: Ranges
    tag: NDArray[np.intp]
    pair: NDArray[np.intp]
    anchor: NDArray[np.float64]
    regressors: Regressors
    paths: Sequence[PosePath]
    pairs: tuple[tuple[int, int], ...]
    given_arms: NDArray[np.float64]

    def take(self, index: NDArray[np.intp]) -> _AlignmentProblem:
        columns = {name: getattr(self, name)[index] for name in ("tag", "pair", "anchor")}
        return replace(
            self, ranges=self.ranges.take(index), regressors=self.regressors.select_rows(index), **columns
        )

    def fit(self, start: PoseAlignment) -> PoseAlignment:
        """Search the time offset if it is unknown, and fit; coordinates of the arms that are not observable are as given.

        Raises:
            DatasetError: see `align_poses`.
        """
        problem, estimates_arm = self, bool(start.is_free_arm.any())
        if len(self.ranges) > MAX_RANGES:
            chosen = np.random.default_rng(1).choice(len(self.ranges), MAX_RANGES, replace=False)
            problem = self.take(np.sort(chosen))
        if start.is_free_time:
            start = replace(start, time_offset_s=problem.likely_time_offset())
        alignment = problem.solve(start)
        if not estimates_arm:
            return alignment
        is_observable = alignment.lever_arm_sd_m < SEPARATED_M
        if not is_observable[:, :2].all():
            raise DatasetError(
                "lever arm and offsets cannot be separated: the standard deviation of the arm is "
                f"{alignment.lever_arm_sd_m[:, :2].max():.2f} m",
                valid="--lever-arm or a transform in the bag instead of --estimate-lever-arm, or a drive with more turns",
            )
        if is_observable.all():
            return alignment
        # A level drive does not observe the height of the arm: it would trade off against the offsets.
        arms = np.where(is_observable, alignment.lever_arm_m, self.given_arms)
        return problem.solve(replace(alignment, lever_arm_m=arms, is_free_arm=is_observable))

    def likely_time_offset(self) -> float:
        """Return the time offset with which the ranges agree best, for the given lever arms.

        Raises:
            DatasetError: too few ranges are within the localisation's times.
        """
        count = min(len(self.ranges), SEARCHED)
        subset = self.take(np.linspace(0, len(self.ranges) - 1, count).astype(int))
        best = (math.inf, 0.0)
        for time_offsets in (COARSE_OFFSETS_S, FINE_OFFSETS_S):
            for time_offset in (best[1] + time_offsets).tolist():
                error, _ = subset.errors(time_offset, self.given_arms)
                residual = np.abs(error - subset.medians(error)[subset.pair])
                if np.isfinite(residual).sum() >= MIN_RANGES:
                    best = min(best, (float(np.nanmedian(residual)), time_offset))
        if not math.isfinite(best[0]):
            raise DatasetError(
                "too few ranges are within the time span of the localisation",
                valid=f"clocks that agree to {MAX_TIME_OFFSET_S:g} s, or --time-offset",
            )
        return best[1]

    def medians(self, error: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the median of each pair, of errors (n,), NaN: unknown; 0: the pair has none."""
        # Its import takes 0.4 s.
        import pandas as pd

        median = pd.Series(error).groupby(self.pair).median().reindex(range(len(self.pairs)))
        return np.asarray(median.fillna(0.0), np.float64)

    def errors(
        self, time_offset: float, lever: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return range minus distance and known corrections (n,), and derivatives of the distance by the lever arm (n, 3)."""
        position, rotation = _poses_at(self.paths, self.tag, self.ranges.stamp_ns, time_offset)
        unit, distance = unit_vectors(
            position + np.einsum("nij,nj->ni", rotation, lever[self.tag]), self.anchor
        )
        error = self.ranges.range_m - self.regressors.rows @ self.regressors.mean - distance
        return error, np.einsum("ni,nij->nj", unit, rotation)

    def solve(self, start: PoseAlignment) -> PoseAlignment:
        """Fit by Gauss-Newton; the given lever arms are the prior."""
        fit = _AlignmentFit(self, start)
        gauss_newton(fit.improve, iterations=_ITERATIONS, converged=_CONVERGED, min_iterations=5)
        return fit.result()


class _AlignmentFit:
    """The unknowns x of an alignment so far: time offset, lever arms, offsets of the pairs, and regressors."""

    def __init__(self, problem: _AlignmentProblem, start: PoseAlignment) -> None:
        self._problem, self._start, self._given_arms = problem, start, problem.given_arms
        given_arms, num_pairs, prior = problem.given_arms, len(problem.pairs), problem.regressors
        size = given_arms.size
        self._arms, self._pairs = slice(1, 1 + size), slice(1 + size, 1 + size + num_pairs)
        time_sd = TIME_OFFSET_SD_S if start.is_free_time else _FIXED_SD
        arm_sd = np.where(start.is_free_arm.reshape(-1), LEVER_SD_M, _FIXED_SD)
        sd = np.concatenate([[time_sd], arm_sd, np.full(num_pairs, OFFSET_SD_M), prior.sd])
        self._information = 1.0 / sd**2
        # The means of the regressors are subtracted already.
        no_offsets, no_change = np.zeros(num_pairs), np.zeros(len(prior.mean))
        mean_s = 0.0 if start.is_free_time else start.time_offset_s
        self._mean = np.concatenate([[mean_s], given_arms.reshape(-1), no_offsets, no_change])
        offsets = problem.medians(problem.errors(start.time_offset_s, start.lever_arm_m)[0])
        self._x = np.concatenate([[start.time_offset_s], start.lever_arm_m.reshape(-1), offsets, no_change])
        # The errors of a pair persist for about this time (see `noise_model`). Stamps are not relative to the first range, so
        # that groups are the same without the ranges that are held out.
        interval = problem.ranges.stamp_ns // round(2.0 * _MODEL.persistence_s * NS_PER_S)
        self._group = interval * num_pairs + problem.pair

    def improve(self, iteration: int) -> float:
        """Linearise and solve; return the largest change."""
        rows, residual_m, is_used = self._linearised()
        normal, right = self._normal_equations(rows, residual_m, is_used)
        self._covariance = np.linalg.inv(normal + np.diag(self._information))
        step = self._covariance @ (right + self._information * (self._mean - self._x))
        step[0] = np.clip(step[0], -0.3, 0.3)
        self._x = self._x + step
        return float(np.abs(step).max())

    def result(self) -> PoseAlignment:
        """Return the unknowns and their standard deviations.

        Errors persist for longer than a group, and those of the localisation are in all pairs: the sandwich estimator with the
        scores of long blocks includes both (Liang and Zeger, Biometrika 1986).
        """
        rows, residual_m, is_used = self._linearised()
        block = self._problem.ranges.stamp_ns // round(BLOCK_S * NS_PER_S)
        scores = np.array(
            [
                self._normal_equations(rows, residual_m, is_used & (block == number))[1]
                for number in np.unique(block[is_used])
            ]
        )
        num_blocks = max(len(scores), 2)
        robust = self._covariance @ (scores.T @ scores) @ self._covariance * (num_blocks / (num_blocks - 1))
        return replace(
            self._start,
            time_offset_s=float(self._x[0]),
            lever_arm_m=np.where(self._start.is_free_arm, self._arm, self._given_arms),
            offset_m=self._x[self._pairs].copy(),
            sd=SD_INFLATION * np.sqrt(np.diag(self._covariance) + np.diag(robust)),
        )

    @property
    def _arm(self) -> NDArray[np.float64]:
        return self._x[self._arms].reshape(self._given_arms.shape)

    def _linearised(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return derivatives (n, q), residuals (n,), and which ranges have a pose.

        Raises:
            DatasetError: too few.
        """
        problem, x = self._problem, self._x
        error_m, arm_rows = problem.errors(x[0], self._arm)
        after, before = (problem.errors(x[0] + shift_s, self._arm)[0] for shift_s in (SLOPE_S, -SLOPE_S))
        rows, index = np.zeros((len(error_m), len(x))), np.arange(len(error_m))
        rows[:, 0] = (before - after) / (2.0 * SLOPE_S)
        rows[index[:, None], 1 + 3 * problem.tag[:, None] + np.arange(3)] = arm_rows
        rows[index, self._pairs.start + problem.pair] = 1.0
        rows[:, self._pairs.stop :] = problem.regressors.rows
        residual_m = error_m - x[self._pairs][problem.pair] - problem.regressors.rows @ x[self._pairs.stop :]
        is_used = np.isfinite(residual_m) & np.isfinite(rows).all(axis=1)
        self._start.check_enough(int(is_used.sum()))
        return rows, residual_m, is_used

    def _normal_equations(
        self, rows: NDArray[np.float64], residual_m: NDArray[np.float64], is_used: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return normal matrix (q, q) and right side (q,) of the ranges `is_used`, robust against outliers among ranges and groups.

        Random effects: the ranges of a group share an error of unknown variance. It does not affect what changes within the
        group, and reduces the weight of the group's mean to that of one range (Searle, Casella, McCulloch, Variance Components,
        1992, section 3.3). Both variances are estimated from the residuals, by medians.

        Args:
            rows: float64 (n, q), derivative of each range by each unknown.
            residual_m: float64 (n,), residuals.
            is_used: bool (n,).
        """
        index = np.flatnonzero(is_used)
        index = index[np.argsort(self._group[index], kind="stable")]
        rows, residual_m, group = rows[index], residual_m[index], self._group[index]
        noise_group = self._problem.regressors.noise_group[index]
        starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
        count = np.diff(np.append(starts, len(group)))
        slot = np.repeat(np.arange(len(starts)), count)
        kinds = int(noise_group.max(initial=0)) + 1

        middle, kind = medians(np.column_stack([residual_m, noise_group]), slot).T
        within = residual_m - middle[slot]
        # Of n values around their own median: n - 1 are left.
        several = count[slot] > 1
        larger = np.sqrt(count / np.maximum(count - 1.0, 1.0))[slot]
        white = np.full(kinds, MIN_SD_M)
        if several.any():
            white = np.maximum(scatter_of((within * larger)[several], noise_group[several], kinds), MIN_SD_M)
        weight = _MODEL.weight(within / white[noise_group]) / white[noise_group] ** 2
        total = np.add.reduceat(weight, starts)
        augmented = np.concatenate([rows, residual_m[:, None]], axis=1)
        shared = np.add.reduceat(augmented * weight[:, None], starts) / total[:, None]
        within_group = augmented - shared[slot]
        weighted = within_group * weight[:, None]
        kind = kind.astype(np.intp)
        spread = scatter_of(shared[:, -1], kind, kinds)[kind]
        persists = np.sqrt(np.maximum(spread**2 - 1.0 / total, MIN_SD_M**2))
        variance = persists**2 + 1.0 / total
        of_group = _MODEL.weight(shared[:, -1] / np.sqrt(variance)) / variance
        outer = weighted.T @ within_group + (shared * of_group[:, None]).T @ shared
        return outer[:-1, :-1], outer[:-1, -1]
