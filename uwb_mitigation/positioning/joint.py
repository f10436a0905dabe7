"""Positions, tracks, and what all ranges have in common, estimated together without known positions of the tags.

Ranges are divided into segments of motion and positions at rest (`stretches`). Of each segment of motion the track is
estimated, at knots connected by a motion model; of each position at rest, one position. They share the parameters.
Ranges of a pair have similar errors for about a second (see `model`), so that their weights correspond to the number of
independent ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.geometry import directions
from uwb_mitigation.positioning.least_squares import LeastSquares, Solution
from uwb_mitigation.positioning.locator import Setting
from uwb_mitigation.positioning.model import MAD_TO_SD, Model, Regressors, scatter_of
from uwb_mitigation.positioning.tracks import Ranges

STILL_M = 0.06
"""Ranges of one pair that scatter less (1.48 x median absolute deviation) are from a tag at rest: the noise of a DW1000 is
2 to 5 cm."""

FEW = 3
"""If the median number of ranges per anchor is smaller, a tag is taken as at one position."""

BIN_S = 1.0
LEAST_S = 4.0
"""Shorter stationary parts belong to the motion around them."""

GAP_S = 10.0
"""After a longer pause a tag may be anywhere."""

KNOT_S = 0.15
LEAST_SCALE_M = 0.02
_FIRST_SCALE_M = 0.3
UNDERSTATED = 1.5
"""Factor of standard deviations: errors of one position return with each lap, and a track follows persisting errors, which
the number of independent ranges does not contain. With it, 9 of 10 offsets of simulated drives are within two standard
deviations."""

SLOW_SD_M, SLOW_S = 0.05, 20.0
"""Errors of a pair that stay the same for many seconds: reflections at one position, and the range bias of a DW1000, which
changes by 0.1 m with the received power (Decawave APS011). Averaging does not reduce them. Where the geometry is weak, as
outside of the anchors, they contribute most of the error of the common offset."""

AROUND_M = 5.0
"""Standard deviation of the prior of a known position: it only affects positions with too few anchors."""

FAR_S = 0.5
"""A range further in time from every knot has no position on a track."""

_SECOND_NS = 1_000_000_000
_ITERATIONS = 25
_HUBER_ITERATIONS = 4
_CONVERGED_M = 1e-3
_NO_PRIOR = 1e-8
_STATIONARY = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Ranges of all tags, ordered by segment.

    Attributes:
        ranges: in the order of the segments, each in the order of time; `tag_id` is meaningless.
        tag: int (n,), index of the tag of each range.
        row: int (n,), row in the ranges of that tag.
        of: int (n,), segment of each range, from 0.
        at_rest: bool (s,), whether each segment is stationary.
        rise: float64 (n,), the height of the tag above the common one at each range.
    """

    ranges: Ranges
    tag: NDArray[np.intp]
    row: NDArray[np.intp]
    of: NDArray[np.intp]
    at_rest: NDArray[np.bool_]
    rise: NDArray[np.float64]

    def __len__(self) -> int:
        """The number of segments."""
        return len(self.at_rest)

    def keep(self, wanted: NDArray[np.bool_]) -> Stretches:
        """Return only these segments, bool (s,)."""
        return self.only(wanted[self.of])

    def only(self, kept: NDArray[np.bool_]) -> Stretches:
        """Return only these ranges, bool (n,), and the segments that contain them."""
        numbers, of = np.unique(self.of[kept], return_inverse=True)
        columns = (self.tag[kept], self.row[kept], of, self.at_rest[numbers], self.rise[kept])
        return Stretches(self.ranges.take(kept), *columns)


def stretches(tags: Sequence[Ranges]) -> Stretches:
    """Divide the ranges of tags into positions at rest and segments of motion.

    A tag may be moved between positions at rest only without ranging, during a pause of more than `GAP_S`.
    """
    tag, row, of, at_rest = [], [], [], list[bool]()
    for number, ranges in enumerate(tags):
        for piece, is_still in _segments(ranges):
            tag.append(np.full(len(piece), number))
            row.append(piece)
            of.append(np.full(len(piece), len(at_rest)))
            at_rest.append(is_still)
    tag_of, row_of = np.concatenate(tag), np.concatenate(row)
    taken = [one.take(row_of[tag_of == number]) for number, one in enumerate(tags)]
    columns = Ranges.joined(taken)
    return Stretches(columns, tag_of, row_of, np.concatenate(of), np.array(at_rest), np.zeros(len(columns)))


def _segments(ranges: Ranges) -> list[tuple[NDArray[np.intp], bool]]:
    """Return the rows of each segment of one tag, and whether it is at rest."""
    rows = np.arange(len(ranges))
    # Ignore pauses: pairs may have been recorded one after the other.
    if _is_sparse(ranges, rows) or _is_still(ranges, rows):
        return [(rows, True)]
    parts = np.split(rows, np.flatnonzero(np.diff(ranges.stamp_ns) > GAP_S * _SECOND_NS) + 1)
    return [segment for part in parts for segment in _parts(ranges, part)]


def _parts(ranges: Ranges, rows: NDArray[np.intp]) -> list[tuple[NDArray[np.intp], bool]]:
    """Divide a segment without gaps at the start and end of stationary parts."""
    if _is_sparse(ranges, rows) or _is_still(ranges, rows):
        return [(rows, True)]
    number = (ranges.stamp_ns[rows] - ranges.stamp_ns[rows[0]]) // round(BIN_S * _SECOND_NS)
    # Whether the tag has one position in a bin and the next one: the ranges of each anchor are similar.
    bins = int(number[-1]) + 1
    starts = np.searchsorted(number, np.arange(bins + 1))
    alike = np.zeros(bins, np.bool_)
    for k in range(bins - 1):
        alike[k] = _is_still(ranges, rows[starts[k] : starts[k + 2]], least=2)
    still = alike | np.concatenate([[False], alike[:-1]])
    edges = np.flatnonzero(np.diff(still)) + 1
    found: list[tuple[NDArray[np.intp], bool]] = []
    moving: list[NDArray[np.intp]] = []
    for run in np.split(np.arange(bins), edges):
        piece = rows[starts[run[0]] : starts[run[-1] + 1]]
        if still[run[0]] and len(run) * BIN_S >= LEAST_S and _is_still(ranges, piece):
            if moving:
                found.append((np.concatenate(moving), False))
                moving = []
            found.append((piece, True))
        elif len(piece):
            moving.append(piece)
    if moving:
        found.append((np.concatenate(moving), False))
    return found


def _is_sparse(ranges: Ranges, rows: NDArray[np.intp]) -> bool:
    """Return whether there are too few ranges per anchor to track motion."""
    return float(np.median(np.unique(ranges.anchor[rows], return_counts=True)[1])) < FEW


def _is_still(ranges: Ranges, rows: NDArray[np.intp], least: int = FEW) -> bool:
    """Return whether the ranges of most anchors scatter only by noise."""
    anchor, value = ranges.anchor[rows], ranges.range_m[rows]
    spread = []
    for one in np.unique(anchor):
        own = value[anchor == one]
        if len(own) >= least:
            spread.append(MAD_TO_SD * float(np.median(np.abs(own - np.median(own)))))
    # While a tag moves, its ranges to two anchors may be constant, but not to three.
    return len(spread) >= 3 and float(np.quantile(spread, 0.8)) < STILL_M


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Inputs of the fit: single ranges in motion, one median per pair and stationary position.

    Attributes:
        knot, anchor: int (n,), of each link; knots of one segment are contiguous.
        ahead_s: float64 (n,), time of the link after its knot.
        range_m, share: float64 (n,); the share is the number of independent ranges in a link.
        rise: float64 (n,), the height of the tag above the common one.
        rows: float64 (n, q), of the parameters.
        alike: int (n,), links whose errors have the same standard deviation have the same number, from 0.
        of: int (n,), the link of each of the original ranges (r,).
        knot_stretch: int (K,). time_s: float64 (K,), of each knot in its segment. at_rest: bool (s,).
    """

    knot: NDArray[np.intp]
    anchor: NDArray[np.intp]
    ahead_s: NDArray[np.float64]
    range_m: NDArray[np.float64]
    share: NDArray[np.float64]
    rise: NDArray[np.float64]
    rows: NDArray[np.float64]
    alike: NDArray[np.intp]
    of: NDArray[np.intp]
    knot_stretch: NDArray[np.intp]
    time_s: NDArray[np.float64]
    at_rest: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.range_m)

    @property
    def stretch(self) -> NDArray[np.intp]:
        """The segment of each link, int (n,)."""
        return self.knot_stretch[self.knot]

    def without(self, left_out: NDArray[np.bool_]) -> Links:
        """Return the same knots without those links (n,); `of` becomes invalid."""
        kept = ~left_out
        columns = ("knot", "anchor", "ahead_s", "range_m", "share", "rise", "rows", "alike")
        return replace(self, **{name: getattr(self, name)[kept] for name in columns})


def links_of(stretches: Stretches, parameters: Regressors, model: Model) -> Links:
    """Return the links of ranges that depend on parameters."""
    ranges, rows, alike = stretches.ranges, parameters.rows, parameters.alike
    knot, ahead, share = np.zeros(len(ranges), np.intp), np.zeros(len(ranges)), np.ones(len(ranges))
    knot_stretch: list[NDArray[np.intp]] = []
    times: list[NDArray[np.float64]] = []
    edges = np.searchsorted(stretches.of, np.arange(len(stretches) + 1))
    known = 0
    for number in range(len(stretches)):
        own = slice(edges[number], edges[number + 1])
        if stretches.at_rest[number]:
            time_s = np.zeros(1)
            knot[own] = known
        else:
            since = (ranges.stamp_ns[own] - ranges.stamp_ns[own][0]) / _SECOND_NS
            index, of = np.unique(np.rint(since / KNOT_S).astype(np.int64), return_inverse=True)
            time_s = index * KNOT_S
            knot[own], ahead[own] = known + of, since - time_s[of]
            share[own] = _share(ranges.anchor[own], max(float(since[-1]), KNOT_S), model.persistence_s)
        knot_stretch.append(np.full(len(time_s), number))
        times.append(time_s)
        known += len(time_s)
    is_resting = stretches.at_rest[stretches.of]
    # One link for each pair of a position at rest, and one for each other range.
    of_pair = stretches.of * 1024 + ranges.anchor
    key = np.where(is_resting, of_pair, len(stretches) * 1024 + np.arange(len(ranges)))
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    columns = np.column_stack([ranges.range_m, stretches.rise, alike, rows])
    shared = columns[first]
    order = np.argsort(of, kind="stable")
    for link, group in enumerate(np.split(order, np.searchsorted(of[order], np.arange(1, len(first))))):
        if len(group) > 1:
            shared[link] = np.median(columns[group], axis=0)
    return Links(
        knot=knot[first],
        anchor=ranges.anchor[first],
        ahead_s=ahead[first],
        range_m=shared[:, 0],
        share=share[first],
        rise=shared[:, 1],
        rows=shared[:, 3:],
        alike=shared[:, 2].astype(np.intp),
        of=of,
        knot_stretch=np.concatenate(knot_stretch),
        time_s=np.concatenate(times),
        at_rest=stretches.at_rest,
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
        setting, links, prior: the problem.
        position, velocity: float64 (K, 3), at the knots.
        parameters: float64 (q,), and their covariance (q, q).
        residual_m: float64 (n,), of each link.
        scale_m: float64 (g,), standard deviation of residuals that are no outliers, for each kind of links.
        stretch_loss: float64 (s,), robust loss of each segment, in units of `scale_m`.
    """

    setting: Setting
    links: Links
    prior: Regressors
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    parameters: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    scale_m: NDArray[np.float64]
    stretch_loss: NDArray[np.float64]
    _solution: Solution

    @property
    def loss(self) -> float:
        """Loss of all segments, to compare fits with the same scale."""
        return float(self.stretch_loss.sum())

    def covariances(self) -> NDArray[np.float64]:
        """Return the covariances of the positions, float64 (K, 3, 3)."""
        d, height = self.setting.dims, self.setting.height
        found = np.zeros((len(self.position), 3, 3))
        found[:, :d, :d] = self._solution.covariances(d)
        if height is not None:
            found[:, 2, 2] = height.sd**2
        return found

    def without(self, left_out: NDArray[np.bool_]) -> JointFit:
        """Fit again without those links, bool (n,), starting here."""
        links, start = self.links.without(left_out), self.position
        return fit_joint(self.setting, links, self.prior, start, self.parameters, around=start, near=True)

    def without_anchors(self, rows: NDArray[np.intp], correction_m: NDArray[np.float64]) -> JointFit:
        """Fit the positions only, to the other anchors' ranges minus a correction, float64 (n,)."""
        corrected = replace(
            self.links, range_m=self.links.range_m - correction_m, rows=np.zeros((len(self.links), 0))
        )
        links = corrected.without(np.isin(self.links.anchor, rows))
        return fit_joint(
            self.setting,
            links,
            Regressors.none(len(links)),
            self.position,
            scale_m=self.scale_m,
            around=self.position,
            near=True,
        )


def fit_stretches(
    setting: Setting,
    stretches: Stretches,
    prior: Regressors,
    position: NDArray[np.float64],
    parameters: NDArray[np.float64] | None = None,
    *,
    near: bool = False,
) -> JointFit:
    """Fit positions, tracks and parameters to the ranges of segments; as `fit_joint`."""
    links = links_of(stretches, prior, setting.model)
    return fit_joint(setting, links, prior, position, parameters, near=near)


def fit_joint(
    setting: Setting,
    links: Links,
    prior: Regressors,
    position: NDArray[np.float64],
    parameters: NDArray[np.float64] | None = None,
    *,
    scale_m: NDArray[np.float64] | None = None,
    around: NDArray[np.float64] | None = None,
    near: bool = False,
) -> JointFit:
    """Fit positions, tracks and parameters to links.

    Args:
        links: each knot has one or more.
        prior: mean and standard deviation of the parameters; its rows are those of the links.
        position: float64 (K, 3), roughly right, to start from.
        parameters: to start from; None: the mean of the prior.
        scale_m: float64 (g,), of the residuals; None: estimated.
        around: float64 (K, 3), prior of the positions, with `AROUND_M`; None: no prior.
        near: the start is a solution of nearly the same problem.

    Raises:
        DatasetError: the ranges do not determine the solution.
    """
    d, model, problem = setting.dims, setting.model, _Problem(setting, links, prior, around)
    x = np.zeros((len(links.time_s), 2 * d))
    x[:, :d] = position[:, :d]
    shared = prior.mean.copy() if parameters is None else parameters
    kinds = int(links.alike.max(initial=0)) + 1
    scale = np.full(kinds, _FIRST_SCALE_M) if scale_m is None else scale_m
    solution: Solution | None = None
    try:
        for iteration in range(_ITERATIONS):
            unit, error = problem.residuals(x, shared)
            if scale_m is None and (iteration or parameters is not None):
                found = np.maximum(scatter_of(error, links.alike, kinds), LEAST_SCALE_M)
                scale = found if near else np.maximum(found, 0.5 * scale)
            z = error / scale[links.alike]
            robust = model.weight(z)
            if iteration < _HUBER_ITERATIONS and not near:
                robust = np.minimum(1.0, 1.0 / np.maximum(np.abs(z), 1e-9))
            weight = robust * links.share / scale[links.alike] ** 2
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
    z = error / scale[links.alike]
    losses = np.bincount(links.stretch, model.loss(z) * links.share, minlength=len(links.at_rest))
    loss = losses.astype(np.float64)
    place, velocity = np.full((len(x), 3), problem.level), np.zeros((len(x), 3))
    place[:, :d], velocity[:, :d] = x[:, :d], x[:, d:]
    weight = model.weight(z) * links.share / scale[links.alike] ** 2
    covariance = problem.covariance(solution, unit, weight)
    return JointFit(setting, links, prior, place, velocity, shared, covariance, error, scale, loss, solution)


class _Problem:
    """The linearised problem of `fit_joint`."""

    def __init__(
        self, setting: Setting, links: Links, prior: Regressors, around: NDArray[np.float64] | None
    ) -> None:
        self._setting, self._links, self._prior = setting, links, prior
        centre = setting.anchors.position.mean(axis=0)
        self._around = np.tile(centre, (len(links.time_s), 1)) if around is None else around
        self._nearness = _NO_PRIOR if around is None else 1.0 / AROUND_M**2
        self.level = 0.0 if setting.height is None else setting.height.value

    def covariance(
        self, solution: Solution, unit: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance of the parameters: of noise, and of errors that stay the same for `SLOW_S`."""
        links = self._links
        problem = LeastSquares(len(links.time_s), 2 * self._setting.dims, links.rows.shape[1])
        rows = solution.reduced(problem.add(*self._rows(problem, unit), 0.0, 1.0))
        gain = weight[:, None] * rows @ solution.shared_covariance
        chunk = (links.time_s[links.knot] // SLOW_S).astype(np.intp)
        _, of = np.unique(np.stack([links.stretch, chunk, links.anchor]), axis=1, return_inverse=True)
        summed = np.zeros((int(of.max(initial=0)) + 1, links.rows.shape[1]))
        np.add.at(summed, of.reshape(-1), gain)
        found: NDArray[np.float64] = (
            UNDERSTATED**2 * solution.shared_covariance + SLOW_SD_M**2 * summed.T @ summed
        )
        return found

    def residuals(
        self, x: NDArray[np.float64], shared: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return unit vectors (n, 3) from anchors to tags, and residuals (n,)."""
        d, links = self._setting.dims, self._links
        at = x[links.knot]
        tag = np.full((len(at), 3), self.level)
        tag[:, :d] = at[:, :d] + links.ahead_s[:, None] * at[:, d:]
        tag[:, 2] += links.rise
        unit, distance = directions(tag, self._setting.anchors.position[links.anchor])
        return unit, links.range_m - distance - links.rows @ shared

    def _rows(
        self, problem: LeastSquares, unit: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return the columns and derivatives of each link: of position and velocity, and of the parameters."""
        d, links = self._setting.dims, self._links
        n, q = links.rows.shape
        shared = np.broadcast_to(problem.of_shared(range(q)), (n, q))
        columns = np.concatenate([problem.of_knot(links.knot[:, None], range(2 * d)), shared], axis=1)
        level = unit[:, :d]
        return columns, np.concatenate([level, links.ahead_s[:, None] * level, links.rows], axis=1)

    def linearised(
        self,
        x: NDArray[np.float64],
        shared: NDArray[np.float64],
        unit: NDArray[np.float64],
        error: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> LeastSquares:
        d, links, model = self._setting.dims, self._links, self._setting.model
        problem = LeastSquares(len(x), 2 * d, len(shared))
        columns, rows = self._rows(problem, unit)
        # The unknowns are solved for, not their changes: motion and priors are linear in them.
        target = error + np.einsum("nc,nc->n", rows, np.append(x.reshape(-1), shared)[columns])
        problem.add(columns, rows, target, weight)
        connected = np.flatnonzero(np.diff(links.knot_stretch) == 0)
        problem.add_motion(connected, np.diff(links.time_s)[connected], d, model.acceleration**2)
        if len(shared):
            problem.add_prior(
                problem.of_shared(range(len(shared))), self._prior.mean, self._prior.information
            )
        first = np.flatnonzero(np.diff(links.knot_stretch, prepend=-1))
        speed = np.where(links.at_rest[links.knot_stretch[first]], _STATIONARY, model.speed)
        every = np.arange(len(x))
        for axis in range(d):
            problem.add_prior(problem.of_knot(every, axis), self._around[:, axis], self._nearness)
            problem.add_prior(problem.of_knot(first, d + axis), 0.0, 1.0 / speed**2)
        return problem
