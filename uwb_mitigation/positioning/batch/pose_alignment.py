"""Ranges together with a robot's own localisation: time offset, lever arms, and the true ranges.

A pose is that of the robot's frame, and the antenna has a lever arm in this frame. Radio and localisation have their own
clocks and delays. Both, and the offset of each pair, are estimated from the ranges by robust least squares (Gauss-Newton).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.geometry import unit_vectors
from uwb_mitigation.positioning.noise_model import NoiseModel, Regressors, scatter_of
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import PosePath, Ranges

MAX_TIME_OFFSET_S = 2.0
COARSE_OFFSETS_S = np.arange(-MAX_TIME_OFFSET_S, MAX_TIME_OFFSET_S + 0.01, 0.1)
FINE_OFFSETS_S = np.arange(-0.1, 0.101, 0.02)
TIME_OFFSET_SD_S, LEVER_SD_M, OFFSET_SD_M = 2.0, 1.0, 2.0
MIN_RANGES = 40
MAX_RANGES, SEARCHED = 20_000, 4000
"""The fit, and the search for the time offset, use at most this number of ranges."""


SLOPE_S = 0.1
"""The velocity of a pose is the difference over this time before and after it."""

SEPARATED_M = 0.1
"""A lever arm with a larger standard deviation cannot be separated from the offsets."""

BLOCK_S, SD_INFLATION = 10.0, 1.5
"""Errors of blocks of this duration count as independent. The factor accounts for errors that
recur with each lap, which are not in their scatter."""

LEVER_STEPS = 5
MIN_SD_M = 0.01
"""Minimum standard deviation of white noise and of persisting errors."""

_ITERATIONS = 40
_FIXED_SD = 1e-9
_SMALL_M = 0.02
_MODEL = NoiseModel(long=1.5, short=1.5)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PoseAlignment:
    """The result.

    Attributes:
        time_offset_s, time_offset_sd_s: added to the stamp of a range to get that of the localisation; sd 0 = given.
        lever_arm_m, lever_arm_sd_m: (T, 3), of each tag's antenna in the robot's frame; sd 0 = given, NaN = not observable,
            so that the start value is kept.
        pairs: (tag number, anchor row), and `offset_m`, `offset_sd_m` of each.
        position: float64 (r, 3), of the antenna at each range; NaN = unknown. distance_m: (r,), to the anchor.
    """

    time_offset_s: float
    time_offset_sd_s: float
    lever_arm_m: NDArray[np.float64]
    lever_arm_sd_m: NDArray[np.float64]
    pairs: tuple[tuple[int, int], ...]
    offset_m: NDArray[np.float64]
    offset_sd_m: NDArray[np.float64]
    position: NDArray[np.float64]
    distance_m: NDArray[np.float64]

    def pair(self, tag: int, row: int, anchor_sd_m: float) -> tuple[float, float]:
        """Return the offset of a pair, m, and its standard deviation, which includes the anchor's position error."""
        at = self.pairs.index((tag, row))
        return float(self.offset_m[at]), math.hypot(float(self.offset_sd_m[at]), anchor_sd_m / math.sqrt(2.0))

    def as_json(self) -> dict[str, object]:
        """Return values for JSON; null = not observable. Lever arm of the first tag, and of all tags by their ids."""
        arms = self.lever_arm_m.tolist()
        sds = [[None if math.isnan(sd) else sd for sd in own] for own in self.lever_arm_sd_m.tolist()]
        return {
            "time_offset_s": self.time_offset_s,
            "time_offset_sd_s": self.time_offset_sd_s,
            "lever_arm_m": arms[0],
            "lever_arm_sd_m": sds[0],
            "lever_arms_m": arms,
            "lever_arms_sd_m": sds,
        }


def align_poses(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    paths: Sequence[PosePath],
    known: Regressors,
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
        known: as many rows as there are ranges, one tag after the other.
        time_offset_s: if known.
        lever_arms_m: float64 (T, 3), of each tag; None: zero.
        estimate_lever_arm: start from these arms and estimate them.

    Raises:
        DatasetError: too few ranges are within the localisation's times, or arms and offsets cannot be separated.
    """
    ranges = Ranges.joined(tags)
    tag = np.repeat(np.arange(len(tags)), list(map(len, tags)))
    if (fewest := min(map(len, paths))) < 2:
        raise DatasetError(f"{fewest} poses of the localisation", valid="two or more")
    pairs, of_pair = np.unique(np.stack([tag, ranges.anchor]), axis=1, return_inverse=True)
    chosen = np.arange(len(ranges))
    if len(chosen) > MAX_RANGES:
        chosen = np.sort(np.random.default_rng(1).choice(chosen, MAX_RANGES, replace=False))
    smoothed = [path.smoothed() for path in paths]
    anchor = anchors.position[ranges.anchor]
    problem = _AlignmentProblem(
        ranges, tag, of_pair.reshape(-1), anchor, known, smoothed, pairs.shape[1]
    ).take(chosen)
    levers = np.zeros((len(tags), 3)) if lever_arms_m is None else lever_arms_m
    start, free = levers, np.full(levers.shape, estimate_lever_arm)
    time_offset, free_time_offset = time_offset_s, time_offset_s is None
    if time_offset is None:
        time_offset, start = problem.likely(levers, estimate_lever_arm)
    time_offset, lever, offset, sd = problem.solve(time_offset, start, levers, free_time_offset, free)
    if estimate_lever_arm:
        lever_sd = sd[1 : 1 + levers.size].reshape(levers.shape)
        free = lever_sd < SEPARATED_M
        if not free[:, :2].all():
            raise DatasetError(
                "lever arm and offsets cannot be separated: the standard deviation of the arm is "
                f"{lever_sd[:, :2].max():.2f} m",
                valid="--lever-arm or a transform in the bag instead of --estimate-lever-arm, or a drive with more turns",
            )
        if not free.all():
            # A level drive does not observe the height of the arm: it would trade off against the offsets.
            start = np.where(free, lever, levers)
            time_offset, lever, offset, sd = problem.solve(time_offset, start, levers, free_time_offset, free)
    position, rotation = _poses_at(paths, tag, ranges.stamp_ns, time_offset)
    antenna = position + np.einsum("nij,nj->ni", rotation, lever[tag])
    distance = np.linalg.norm(antenna - anchor, axis=1)
    _check_enough(int(np.isfinite(distance).sum()), free_time_offset or estimate_lever_arm)
    lever_sd = np.where(free, sd[1 : 1 + levers.size].reshape(levers.shape), np.nan)
    return PoseAlignment(
        time_offset_s=time_offset,
        time_offset_sd_s=float(sd[0]) if free_time_offset else 0.0,
        lever_arm_m=lever,
        lever_arm_sd_m=lever_sd if estimate_lever_arm else np.zeros(levers.shape),
        pairs=tuple((int(a), int(b)) for a, b in pairs.T),
        offset_m=offset,
        offset_sd_m=sd[1 + levers.size :][: pairs.shape[1]],
        position=antenna,
        distance_m=distance,
    )


def _poses_at(
    paths: Sequence[PosePath], tag: NDArray[np.intp], stamp_ns: NDArray[np.int64], later_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `PosePath.poses_at` for the path of each tag (n,)."""
    position, rotation = np.zeros((len(tag), 3)), np.zeros((len(tag), 3, 3))
    for number, path in enumerate(paths):
        own = tag == number
        position[own], rotation[own] = path.poses_at(stamp_ns[own], later_s)
    return position, rotation


def _check_enough(count: int, alignment_unknown: bool) -> None:
    """Offsets alone can be estimated from any number of ranges, because their priors are known."""
    least = MIN_RANGES if alignment_unknown else 1
    if count < least:
        raise DatasetError(
            f"{count} ranges lie within the localisation's times",
            valid=f"{least} or more: do their clocks agree to {MAX_TIME_OFFSET_S:g} s?",
        )


@dataclass(frozen=True, slots=True, eq=False)
class _AlignmentProblem:
    """n ranges of tags (n,) and pairs (n,) to anchors at (n, 3), and the paths of the T tags. Lever arms are (T, 3)."""

    ranges: Ranges
    tag: NDArray[np.intp]
    pair: NDArray[np.intp]
    anchor: NDArray[np.float64]
    known: Regressors
    paths: Sequence[PosePath]
    pairs: int

    def take(self, index: NDArray[np.intp]) -> _AlignmentProblem:
        columns = {name: getattr(self, name)[index] for name in ("tag", "pair", "anchor")}
        return replace(self, ranges=self.ranges.take(index), known=self.known.select_rows(index), **columns)

    def likely(self, lever: NDArray[np.float64], free_lever: bool) -> tuple[float, NDArray[np.float64]]:
        """Return the time offset with which the ranges agree best, and its lever arms.

        The lever arms are estimated for each time offset again, because with a wrong one turns look like outliers.

        Raises:
            DatasetError: too few ranges are within the localisation's times.
        """
        count = min(len(self.ranges), SEARCHED)
        few = self.take(np.linspace(0, len(self.ranges) - 1, count).astype(int))
        best = (math.inf, 0.0, lever)
        for time_offsets in (COARSE_OFFSETS_S, FINE_OFFSETS_S):
            for time_offset in (best[1] + time_offsets).tolist():
                arm = few._lever_arm(time_offset, lever) if free_lever else lever
                left = np.abs(few._centred(time_offset, arm)[0])
                if np.isfinite(left).sum() >= MIN_RANGES:
                    best = min(best, (float(np.nanmedian(left)), time_offset, arm), key=lambda one: one[0])
        if not math.isfinite(best[0]):
            raise DatasetError(
                "too few ranges are within the time span of the localisation",
                valid=f"clocks that agree to {MAX_TIME_OFFSET_S:g} s, or --time-offset",
            )
        return best[1], best[2]

    def _lever_arm(self, time_offset: float, lever: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the lever arms for a time offset: least absolute deviations, by reweighting."""
        for _ in range(LEVER_STEPS):
            left, rows = self._centred(time_offset, lever)
            known = np.isfinite(left) & np.isfinite(rows).all(axis=1)
            if int(known.sum()) < MIN_RANGES:
                return lever
            lever = lever.copy()
            for tag in np.unique(self.tag[known]):
                own = known & (self.tag == tag)
                weight = 1.0 / np.maximum(np.abs(left[own]), _SMALL_M)
                information = float(weight.sum()) * _SMALL_M**2 / LEVER_SD_M**2
                normal = rows[own].T @ (weight[:, None] * rows[own]) + information * np.eye(3)
                right = rows[own].T @ (weight * left[own]) - information * lever[tag]
                lever[tag] += np.linalg.solve(normal, right)
        return lever

    def _medians(self, error: NDArray[np.float64]) -> NDArray[np.float64]:
        found = np.zeros(self.pairs)
        for pair in np.unique(self.pair[np.isfinite(error)]):
            found[pair] = np.nanmedian(error[self.pair == pair])
        return found

    def _errors(
        self, time_offset: float, lever: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return range minus distance and known corrections (n,), and derivatives of the distance by the lever arm (n, 3)."""
        position, rotation = _poses_at(self.paths, self.tag, self.ranges.stamp_ns, time_offset)
        unit, distance = unit_vectors(
            position + np.einsum("nij,nj->ni", rotation, lever[self.tag]), self.anchor
        )
        error = self.ranges.range_m - self.known.rows @ self.known.mean - distance
        return error, np.einsum("ni,nij->nj", unit, rotation)

    def _centred(
        self, time_offset: float, lever: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return `_errors` minus the median error of each pair."""
        error, rows = self._errors(time_offset, lever)
        return error - self._medians(error)[self.pair], rows

    def solve(
        self,
        time_offset: float,
        lever: NDArray[np.float64],
        expected: NDArray[np.float64],
        free_time_offset: bool,
        free_lever: NDArray[np.bool_],
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Fit by Gauss-Newton, from a time offset and lever arms.

        Args:
            time_offset: start value, s.
            lever: start values of the lever arms, float64 (T, 3), m.
            expected: prior of the lever arms.
            free_time_offset: whether the time offset is estimated.
            free_lever: whether each coordinate of the arms is estimated, bool (T, 3).

        Returns:
            Time offset, lever arms, offsets of the pairs, and the standard deviations of all in this order.
        """
        arms = slice(1, 1 + lever.size)
        pairs = slice(arms.stop, arms.stop + self.pairs)
        size = pairs.stop + len(self.known.mean)
        prior_sd = np.concatenate(
            [
                [TIME_OFFSET_SD_S if free_time_offset else _FIXED_SD],
                np.where(free_lever.reshape(-1), LEVER_SD_M, _FIXED_SD),
                np.full(self.pairs, OFFSET_SD_M),
                self.known.sd,
            ]
        )
        information = 1.0 / prior_sd**2
        # The means of the regressors are subtracted already.
        mean = np.array(
            [0.0 if free_time_offset else time_offset, *expected.reshape(-1), *np.zeros(size - arms.stop)]
        )
        offsets = self._medians(self._errors(time_offset, lever)[0])
        x = np.array([time_offset, *lever.reshape(-1), *offsets, *np.zeros(size - pairs.stop)])
        # The errors of a pair persist for about this time (see `noise_model`).
        # Stamps are not relative to the first range, so that groups are the same without the ranges that are held out.
        group = self.ranges.stamp_ns // round(2.0 * _MODEL.persistence_s * NS_PER_S) * self.pairs + self.pair
        every = np.arange(len(self.pair))
        for iteration in range(_ITERATIONS):
            arm = x[arms].reshape(lever.shape)
            error, of_arm = self._errors(x[0], arm)
            after, before = (self._errors(x[0] + by, arm)[0] for by in (SLOPE_S, -SLOPE_S))
            rows = np.zeros((len(error), size))
            rows[:, 0] = (before - after) / (2.0 * SLOPE_S)
            rows[every[:, None], 1 + 3 * self.tag[:, None] + np.arange(3)] = of_arm
            rows[every, pairs.start + self.pair] = 1.0
            rows[:, pairs.stop :] = self.known.rows
            left = error - x[pairs][self.pair] - self.known.rows @ x[pairs.stop :]
            known = np.isfinite(left) & np.isfinite(rows).all(axis=1)
            _check_enough(int(known.sum()), free_time_offset or bool(free_lever.any()))
            normal, right = _normal_equations(
                rows[known], left[known], group[known], self.known.noise_group[known]
            )
            covariance = np.linalg.inv(normal + np.diag(information))
            step = covariance @ (right + information * (mean - x))
            step[0] = np.clip(step[0], -0.3, 0.3)
            x = x + step
            if float(np.abs(step).max()) < 1e-5 and iteration > 3:
                break
        # Errors persist for longer than a group, and those of the localisation are in all pairs: the sandwich estimator
        # with the scores of long blocks includes both (Liang and Zeger, Biometrika 1986).
        block = self.ranges.stamp_ns // round(BLOCK_S * NS_PER_S)
        parts = [known & (block == number) for number in np.unique(block[known])]
        scores = np.array(
            [_normal_equations(rows[p], left[p], group[p], self.known.noise_group[p])[1] for p in parts]
        )
        blocks = max(len(scores), 2)
        robust = covariance @ (scores.T @ scores) @ covariance * (blocks / (blocks - 1))
        sd = SD_INFLATION * np.sqrt(np.diag(covariance) + np.diag(robust))
        arm = np.where(free_lever, x[arms].reshape(lever.shape), expected)
        return float(x[0]), arm, x[pairs].copy(), sd


def _normal_equations(
    rows: NDArray[np.float64],
    left_m: NDArray[np.float64],
    group: NDArray[np.intp],
    noise_group: NDArray[np.intp],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the normal matrix (q, q) and right side (q,) of n ranges, robust against outliers among ranges and groups.

    Random effects: the ranges of a group share an error of unknown variance. It does not affect what changes within the
    group, and reduces the weight of the group's mean to that of one range (Searle, Casella, McCulloch, Variance Components,
    1992, section 3.3). Both variances are estimated from the residuals, by medians.

    Args:
        rows: float64 (n, q), derivative of each range by each unknown.
        left_m: float64 (n,), residuals.
        group: int (n,), ranges whose errors persist together have the same number.
        noise_group: int (n,), ranges whose errors have the same standard deviation have the same number, from 0.
    """
    order = np.argsort(group, kind="stable")
    rows, left_m, group, noise_group = rows[order], left_m[order], group[order], noise_group[order]
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    count = np.diff(np.append(starts, len(group)))
    of = np.repeat(np.arange(len(starts)), count)
    kinds = int(noise_group.max(initial=0)) + 1

    middle = np.array([np.median(part) for part in np.split(left_m, starts[1:])])
    within = left_m - middle[of]
    # Of n values around their own median: n - 1 are left.
    several = count[of] > 1
    larger = np.sqrt(count / np.maximum(count - 1.0, 1.0))[of]
    white = np.full(kinds, MIN_SD_M)
    if several.any():
        white = np.maximum(scatter_of((within * larger)[several], noise_group[several], kinds), MIN_SD_M)
    weight = _MODEL.weight(within / white[noise_group]) / white[noise_group] ** 2
    total = np.add.reduceat(weight, starts)
    both = np.concatenate([rows, left_m[:, None]], axis=1)
    shared = np.add.reduceat(both * weight[:, None], starts) / total[:, None]
    apart = both - shared[of]
    scaled = apart * weight[:, None]
    kind = np.array([int(np.median(part)) for part in np.split(noise_group, starts[1:])])
    spread = scatter_of(shared[:, -1], kind, kinds)[kind]
    persists = np.sqrt(np.maximum(spread**2 - 1.0 / total, MIN_SD_M**2))
    variance = persists**2 + 1.0 / total
    of_group = _MODEL.weight(shared[:, -1] / np.sqrt(variance)) / variance
    outer = scaled.T @ apart + (shared * of_group[:, None]).T @ shared
    return outer[:-1, :-1], outer[:-1, -1]
