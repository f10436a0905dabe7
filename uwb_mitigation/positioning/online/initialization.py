"""Candidate positions from a few ranges without an initial position, and least squares as a baseline."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Ranges, Track

IMPLAUSIBLE = 9.0
"""Positions that are less likely than the best one by a factor of e^9 (eight thousand) are not plausible."""

_STEPS, _CONVERGED_M = 40, 1e-6
_STUCK = 0.01
_WALL_SD_M = 0.02
"""Standard deviation of the pseudo-measurement that keeps a position at the boundary of the area."""

_NEAR_WALL_M = 0.5
_AROUND = 24
_SPHERE = 96
_LEAST_SQUARES = NoiseModel(long=100.0, short=100.0)
_FRESH_S = 0.5
_EVERY_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class CandidatePosition:
    """A candidate position.

    Attributes:
        position: float64 (3,), m.
        covariance: float64 (3, 3), m^2, of a tag whose ranges err independently.
        loss: minus the log likelihood, up to a constant.
    """

    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    loss: float


def candidate_positions(
    anchors: NDArray[np.float64],
    range_m: NDArray[np.float64],
    sd_m: NDArray[np.float64],
    model: NoiseModel,
    *,
    height: Height | None = None,
    area: Area | None = None,
) -> list[CandidatePosition]:
    """Return all plausible local optima, the best first.

    Levenberg-Marquardt starts on the circles (spheres, if the height is unknown) of the two shortest ranges around their
    anchors, and at the centre of the anchors.

    Args:
        anchors: float64 (k, 3), m, of each range.
        range_m: measured ranges, float64 (k,), m.
        sd_m: standard deviations of the ranges, float64 (k,), m.
        model: how robust.
        height: known height of the tag.
        area: area of the tag.
    """
    if len(range_m) < (2 if height is not None else 3):
        return []
    (x,), (cost,), (hessian,) = local_optima(anchors, range_m[None], sd_m, model, height, area)
    result: list[CandidatePosition] = []
    remaining = np.flatnonzero(np.isfinite(cost))
    remaining = remaining[np.argsort(cost[remaining])]
    while len(remaining):
        best = remaining[0]
        information = hessian[best] + 1e-6 * np.eye(3)
        result.append(CandidatePosition(x[best].copy(), np.linalg.inv(information), float(cost[best])))
        offset = x[remaining] - x[best]
        same = (np.sum(offset * offset, axis=1) < 0.25) | (
            np.sum(offset @ information * offset, axis=1) < 4.0
        )
        remaining = remaining[~same]
    return result


def local_optima(
    anchors: NDArray[np.float64],
    range_m: NDArray[np.float64],
    sd_m: NDArray[np.float64],
    model: NoiseModel,
    height: Height | None,
    area: Area | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return n local optima for each of m sets of ranges, of which some are equal; see `candidate_positions`.

    Args:
        anchors: float64 (k, 3), m, of each range.
        range_m: measured ranges, float64 (m, k), m.
        sd_m: standard deviations of the ranges, float64 (k,), m.
        model: how robust.
        height: known height of the tag.
        area: area of the tag.

    Returns:
        positions float64 (m, n, 3), losses (m, n), infinite where implausible, and Hessians (m, n, 3, 3).
    """
    x = np.concatenate([_starts(anchors, set_m, height) for set_m in range_m])
    sets = len(range_m), len(x) // len(range_m)
    of_starts = np.repeat(range_m, sets[1], axis=0)
    problem = _Trilateration(anchors, of_starts, sd_m, model, *_height_prior(len(x), height))
    x, loss, gradient, hessian = problem.descend(x)
    cost = loss.reshape(sets)
    # Discard starts that have not converged, unless no start has converged.
    step = np.linalg.solve(hessian + 1e-9 * np.eye(3), gradient[..., None])[..., 0]
    arrived = (np.einsum("ni,ni->n", step, gradient) < _STUCK).reshape(sets)
    cost[~arrived & arrived.any(axis=1, keepdims=True)] = np.inf
    if area is not None:
        excess = x - area.clip(x)
        squared = np.einsum("ni,ni->n", excess, np.einsum("nij,nj->ni", hessian, excess))
        is_near = (np.linalg.norm(excess, axis=1) < _NEAR_WALL_M) | (squared < IMPLAUSIBLE)
        cost[~is_near.reshape(sets)] = np.inf
        outside = np.flatnonzero(np.isfinite(cost.ravel()) & (excess != 0.0).any(axis=1))
        if len(outside):
            # Optima just outside, because of range errors: find the best positions on the boundary.
            wall = area.clip(x[outside])
            walls = problem.with_walls(outside, wall, excess[outside] != 0.0)
            x[outside], cost.flat[outside], _, hessian[outside] = walls.descend(wall)
            x = area.clip(x)
    cost[cost > cost.min(axis=1, keepdims=True) + IMPLAUSIBLE] = np.inf
    return x.reshape(*sets, 3), cost, hessian.reshape(*sets, 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class _Trilateration:
    """k ranges, or n sets of k ranges (n, k), and independent priors of n positions.

    Attributes:
        anchors: float64 (k, 3). range_m, sd_m: float64 (k,) or (n, k).
        mean, information: float64 (n, 3), priors and their inverse variances; 0: no prior.
    """

    anchors: NDArray[np.float64]
    range_m: NDArray[np.float64]
    sd_m: NDArray[np.float64]
    model: NoiseModel
    mean: NDArray[np.float64]
    information: NDArray[np.float64]

    def with_walls(
        self, rows: NDArray[np.intp], wall: NDArray[np.float64], is_held: NDArray[np.bool_]
    ) -> _Trilateration:
        """Return the problem of those positions, with the coordinates `is_held` bool (n, 3) at the boundary."""
        information = np.where(is_held, 1.0 / _WALL_SD_M**2, self.information[rows])
        mean = np.where(is_held, wall, self.mean[rows])
        return replace(self, range_m=self.range_m[rows], mean=mean, information=information)

    def descend(
        self, x: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Run Levenberg-Marquardt from n starts; return positions, loss, gradient and Hessian."""
        damping = np.full(len(x), 1e-2)
        cost, gradient, hessian, _ = self.linearised(x)
        for _ in range(_STEPS):
            diagonal = np.einsum("nii->ni", hessian)
            damped = hessian + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(3)
            step = np.linalg.solve(damped, gradient[..., None])[..., 0]
            if float(np.abs(step).max(initial=0.0)) < _CONVERGED_M:
                break
            trial = x - step
            trial_values = self.linearised(trial)
            better = trial_values[0] <= cost
            x = np.where(better[:, None], trial, x)
            cost = np.where(better, trial_values[0], cost)
            gradient = np.where(better[:, None], trial_values[1], gradient)
            hessian = np.where(better[:, None, None], trial_values[2], hessian)
            damping = np.clip(np.where(better, damping / 4.0, damping * 8.0), 1e-8, 1e8)
        return x, cost, gradient, hessian

    def linearised(
        self, x: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return loss (n,), its gradient (n, 3), a Gauss-Newton Hessian (n, 3, 3), and weighted rows (n, k, 3) at x."""
        vector = x[:, None] - self.anchors
        distance = np.sqrt(np.einsum("nki,nki->nk", vector, vector))
        z = (self.range_m - distance) / self.sd_m
        slope = vector / np.maximum(distance, 1e-6)[..., None] / self.sd_m[..., None]
        rows = slope * self.model.weight(z)[..., None]
        offset = x - self.mean
        pull = self.information * offset
        cost = self.model.loss(z).sum(axis=1) + 0.5 * np.einsum("ni,ni->n", pull, offset)
        gradient = pull - np.einsum("nki,nk->ni", rows, z)
        hessian = np.einsum("nki,nkj->nij", rows, slope)
        hessian[:, [0, 1, 2], [0, 1, 2]] += self.information
        return cost, gradient, hessian, rows


def _height_prior(count: int, height: Height | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `mean` and `information` of that number of positions."""
    mean, information = np.zeros((2, count, 3))
    if height is not None:
        mean[:, 2], information[:, 2] = height.value, 1.0 / height.sd**2
    return mean, information


def _starts(
    anchors: NDArray[np.float64], range_m: NDArray[np.float64], height: Height | None
) -> NDArray[np.float64]:
    order = np.argsort(range_m)[:2]
    start_groups = [anchors.mean(axis=0, keepdims=True) + 0.1]
    for i in order:
        if height is not None:
            # Not along the axes: anchors are often aligned with one, where two mirror images meet in a saddle point.
            angle = 0.1 + np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
            up = np.zeros_like(angle)
        else:
            # Points spread evenly over a sphere by the golden angle.
            k = np.arange(_SPHERE) + 0.5
            angle, up = np.pi * (1.0 + 5.0**0.5) * k, 1.0 - 2.0 * k / _SPHERE
        level = np.sqrt(1.0 - up * up)
        direction = np.stack([level * np.cos(angle), level * np.sin(angle), up], axis=1)
        start_groups.append(anchors[i] + max(float(range_m[i]), 0.1) * direction)
    starts = np.concatenate(start_groups)
    if height is not None:
        starts[:, 2] = height.value
    return starts


def snapshot(anchors: AnchorMap, ranges: Ranges, height: Height | None = None) -> Track:
    """Return the baseline: least squares on the latest range of each anchor, without motion model or robust loss.

    A position ten times a second, if enough anchors (two, or three without a height) were received within half a second;
    velocities and covariances are NaN. The solution with the smallest sum of squares is used; the descent starts at
    the centre of the anchors, and on all sides of it.
    """
    stamps, latest = _latest(len(anchors), ranges)
    enough = np.isfinite(latest).sum(axis=1) >= (2 if height is not None else 3)
    stamps, latest = stamps[enough], latest[enough]
    present = np.isfinite(latest)
    range_m, sd_m = np.where(present, latest, 0.0), np.where(present, 1.0, np.inf)
    reach = np.nanmedian(latest, axis=1, keepdims=True) if len(latest) else np.zeros((0, 1))
    exact = None if height is None else Height(height.value, 1e-4)
    prior = _height_prior(len(latest), exact)
    problem = _Trilateration(anchors.position, range_m, sd_m, _LEAST_SQUARES, *prior)
    best, least = np.zeros((len(latest), 3)), np.full(len(latest), np.inf)
    sides = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -0.5]]) + 0.01
    for side in sides:
        x = anchors.position.mean(axis=0) + reach * side
        if height is not None:
            x[:, 2] = height.value
        x, cost, *_ = problem.descend(x)
        # Mirror images have equal costs: rounding must not choose between them.
        better = cost < least - 1e-6
        best, least = np.where(better[:, None], x, best), np.where(better, cost, least)
    unknown = np.full((len(stamps), 6, 6), np.nan)
    return Track(stamps, best, unknown[:, 0, :3], unknown)


def _latest(count: int, ranges: Ranges) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps int64 (t,) and the latest range of each anchor within `_FRESH_S`, float64 (t, count); NaN: none."""
    every = round(_EVERY_S * NS_PER_S)
    number = (ranges.stamp_ns - ranges.stamp_ns[:1]) // every
    # The last range of each interval.
    ends = np.flatnonzero(np.diff(number, append=number[-1:] + 1)) if len(number) else np.zeros(0, np.intp)
    range_at_end = np.full((len(ends), count), np.nan)
    for row in range(count):
        selected = np.flatnonzero(ranges.anchor == row)
        before = np.searchsorted(selected, ends, side="right") - 1
        has_range = before >= 0
        last = selected[before[has_range]]
        age = ranges.stamp_ns[ends[has_range]] - ranges.stamp_ns[last]
        range_at_end[has_range, row] = np.where(age <= _FRESH_S * NS_PER_S, ranges.range_m[last], np.nan)
    return ranges.stamp_ns[ends], range_at_end
