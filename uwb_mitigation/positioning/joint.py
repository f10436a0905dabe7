"""Places, tracks, and what all ranges have in common, found together: robust least squares without a known position.

Of each stretch of motion the track is sought, at knots that a `Chain` ties together; of each place at rest one
position. They share the parameters: ranges that geometry tells more often than it has unknowns tell these too. Ranges of
a pair err alike for about a second (see `model`), so each weighs as one of as many as say something new.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.chain import Chain, Solution
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.rests import Stretches
from uwb_mitigation.positioning.scatter import scatter_of
from uwb_mitigation.positioning.smoother import Parameters
from uwb_mitigation.positioning.start import Height

KNOT_S = 0.15
LEAST_SCALE_M = 0.02
_FIRST_SCALE_M = 0.3
UNDERSTATED = 1.5
"""By how much deviations are multiplied: errors of one place come again with each lap, and a track bends to what persists,
which counting new ranges does not know. Of simulated drives, with it 9 of 10 offsets lie within two deviations."""

SLOW_SD_M, SLOW_S = 0.05, 20.0
"""Errors of a pair that stay the same for many seconds: reflections at one place, and the range bias of a DW1000, which
changes by 0.1 m with the received power (Decawave APS011). Averaging does not reduce them. Where the geometry is weak, as
outside of the anchors, they contribute most of the error of the common offset."""

AROUND_M = 5.0
"""Keeps a place of which too few anchors are left from running away, and no other."""

FAR_S = 0.5
"""A range that lies further from every knot has no place on a track."""

_SECOND_NS = 1_000_000_000
_ITERATIONS = 25
_HUBER_ITERATIONS = 4
_SETTLED_M = 1e-3
_NOWHERE = 1e-8
_STILL = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """What is fitted: ranges in motion one by one, those at rest as one median a pair and place.

    Attributes:
        knot, anchor: int (n,), where each belongs; knots of one stretch stand together.
        ahead_s: float64 (n,), its time after the knot's.
        range_m, share: float64 (n,), and how much of a new range each is.
        rise: float64 (n,), the height of the tag above the common one.
        rows: float64 (n, q), of the parameters.
        alike: int (n,), links that err about as much have the same number, from 0.
        of: int (n,), the link of each of the original ranges (r,).
        knot_stretch: int (K,). time_s: float64 (K,), of each knot in its stretch. at_rest: bool (s,).
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
        """The stretch of each link, int (n,)."""
        return self.knot_stretch[self.knot]

    def without(self, left_out: NDArray[np.bool_]) -> Links:
        """The same knots, without those links (n,); `of` says nothing any more."""
        kept = ~left_out
        columns = ("knot", "anchor", "ahead_s", "range_m", "share", "rise", "rows", "alike")
        return replace(self, **{name: getattr(self, name)[kept] for name in columns})


def links_of(stretches: Stretches, rows: NDArray[np.float64], alike: NDArray[np.intp], model: Model) -> Links:
    """Links of ranges whose parameters' rows are float64 (r, q), and which err as much as others `alike`, int (r,)."""
    ranges = stretches.ranges
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
    # Links at rest by place and anchor, all others by themselves.
    key = np.where(
        is_resting,
        stretches.of * 1024 + ranges.anchor,
        len(stretches) * 1024 + np.arange(len(ranges)),
    )
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    value, shared, kind = ranges.range_m[first].copy(), rows[first].copy(), alike[first].copy()
    rise = stretches.rise[first].copy()
    order = np.argsort(of, kind="stable")
    groups = np.split(order, np.searchsorted(of[order], np.arange(1, len(first))))
    for link, group in enumerate(groups):
        if len(group) > 1:
            value[link] = np.median(ranges.range_m[group])
            rise[link] = np.median(stretches.rise[group])
            shared[link] = np.median(rows[group], axis=0)
            kind[link] = int(np.median(alike[group]))
    return Links(
        knot[first],
        ranges.anchor[first],
        ahead[first],
        value,
        share[first],
        rise,
        shared,
        kind,
        of,
        np.concatenate(knot_stretch),
        np.concatenate(times),
        stretches.at_rest,
    )


def _share(anchor: NDArray[np.intp], seconds: float, persistence_s: float) -> NDArray[np.float64]:
    """How much of a new range each is: of a Gauss-Markov process there is one new every two time constants."""
    _, of, count = np.unique(anchor, return_inverse=True, return_counts=True)
    independent = np.maximum(seconds / (2.0 * persistence_s), 1.0)
    share: NDArray[np.float64] = np.minimum(1.0, independent / count)[of]
    return share


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """What was found.

    Attributes:
        position, velocity: float64 (K, 3), at the knots.
        parameters: float64 (q,), and their covariance (q, q).
        residual_m: float64 (n,), of each link. weight: float64 (n,), what robustness left of it.
        scale_m: float64 (g,), standard deviation of residuals that are no outliers, of links that err alike.
        stretch_loss: float64 (s,), robust loss of each stretch, in units of `scale_m`.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    parameters: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    weight: NDArray[np.float64]
    scale_m: NDArray[np.float64]
    stretch_loss: NDArray[np.float64]
    _solution: Solution
    _height: Height | None

    @property
    def loss(self) -> float:
        """Of all; to compare fits by, of the same scale."""
        return float(self.stretch_loss.sum())

    def covariances(self) -> NDArray[np.float64]:
        """Of the positions, float64 (K, 3, 3)."""
        d = 2 if self._height is not None else 3
        found = np.zeros((len(self.position), 3, 3))
        found[:, :d, :d] = self._solution.covariances(d)
        if self._height is not None:
            found[:, 2, 2] = self._height.sd**2
        return found


class JointSolver:
    """Fits places, tracks and parameters to links.

    Args:
        anchors: where they are.
        links: of which each knot has one or more.
        parameters: their means and deviations; the rows are the links'.
        height: of all tags, where it stays the same.
        scale_m: float64 (g,), of the residuals; None = estimated.
        around: float64 (K, 3), where the knots are known to be, to `AROUND_M`; None = nothing is known.

    Raises:
        DatasetError: from `fit`, where the ranges do not determine it.
    """

    def __init__(
        self,
        anchors: AnchorMap,
        links: Links,
        parameters: Parameters,
        model: Model,
        height: Height | None = None,
        scale_m: NDArray[np.float64] | None = None,
        around: NDArray[np.float64] | None = None,
    ) -> None:
        self._anchors, self._links, self._model, self._height = anchors, links, model, height
        self._around = (
            np.tile(anchors.position.mean(axis=0), (len(links.time_s), 1)) if around is None else around
        )
        self._nearness = _NOWHERE if around is None else 1.0 / AROUND_M**2
        self._d = 2 if height is not None else 3
        self._mean = parameters.mean
        self._certainty = 1.0 / np.maximum(parameters.sd, 1e-6) ** 2
        self._scale = scale_m
        self._order = np.argsort(links.knot, kind="stable")
        self._dt = np.diff(links.time_s)
        self._tied = np.diff(links.knot_stretch) == 0

    def fit(
        self,
        position: NDArray[np.float64],
        parameters: NDArray[np.float64] | None = None,
        *,
        near: bool = False,
    ) -> JointFit:
        """From positions float64 (K, 3) that are roughly right; `near` = they are a solution's, of much the same."""
        d, links = self._d, self._links
        x = np.zeros((len(links.time_s), 2 * d))
        x[:, :d] = position[:, :d]
        shared = self._mean.copy() if parameters is None else parameters
        scale = (
            np.full(int(links.alike.max(initial=0)) + 1, _FIRST_SCALE_M)
            if self._scale is None
            else self._scale
        )
        solution: Solution | None = None
        try:
            for iteration in range(_ITERATIONS):
                direction, _, error = self._errors(x, shared)
                if self._scale is None and (iteration or parameters is not None):
                    found = np.maximum(scatter_of(error, links.alike, len(scale)), LEAST_SCALE_M)
                    scale = found if near else np.maximum(found, 0.5 * scale)
                z = error / scale[links.alike]
                robust = self._model.weight(z)
                if iteration < _HUBER_ITERATIONS and not near:
                    robust = np.minimum(1.0, 1.0 / np.maximum(np.abs(z), 1e-9))
                weight = robust * links.share / scale[links.alike] ** 2
                solution = self._linearised(x, shared, direction, error, weight).solve()
                step = float(np.abs(solution.x[:, :d] - x[:, :d]).max())
                x, shared = solution.x, solution.shared
                if not np.isfinite(step) or step > 1e6:
                    raise np.linalg.LinAlgError
                if step < _SETTLED_M and (near or iteration > _HUBER_ITERATIONS + 2):
                    break
        except np.linalg.LinAlgError as error_:
            raise DatasetError(
                "the ranges do not determine where the tags were", valid="more ranges, or anchors"
            ) from error_
        assert solution is not None
        _, _, error = self._errors(x, shared)
        z = error / scale[links.alike]
        loss = np.bincount(links.stretch, self._model.loss(z) * links.share, minlength=len(links.at_rest))
        place, velocity = np.full((len(x), 3), self._level), np.zeros((len(x), 3))
        place[:, :d], velocity[:, :d] = x[:, :d], x[:, d:]
        return JointFit(
            place,
            velocity,
            shared,
            self._covariance(solution, x, shared, scale),
            error,
            self._model.weight(z),
            scale,
            loss.astype(np.float64),
            solution,
            self._height,
        )

    def _covariance(
        self,
        solution: Solution,
        x: NDArray[np.float64],
        shared: NDArray[np.float64],
        scale: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """The covariance of the parameters: of noise, and of errors that stay the same for `SLOW_S`."""
        links = self._links
        direction, _, error = self._errors(x, shared)
        weight = self._model.weight(error / scale[links.alike]) * links.share / scale[links.alike] ** 2
        rows = solution.reduced(links.knot, self._own(direction), links.rows)
        gain = weight[:, None] * rows @ solution.shared_covariance
        chunk = (links.time_s[links.knot] // SLOW_S).astype(np.intp)
        group = np.stack([links.stretch, chunk, links.anchor])
        _, of = np.unique(group, axis=1, return_inverse=True)
        summed = np.zeros((int(of.max(initial=0)) + 1, len(shared)))
        np.add.at(summed, of.reshape(-1), gain)
        found: NDArray[np.float64] = (
            UNDERSTATED**2 * solution.shared_covariance + SLOW_SD_M**2 * summed.T @ summed
        )
        return found

    @property
    def _level(self) -> float:
        return 0.0 if self._height is None else float(self._height.value)

    def _errors(
        self, x: NDArray[np.float64], shared: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Unit vectors (n, 3) from anchors to tags, distances (n,), and what is left of the ranges (n,)."""
        d, links = self._d, self._links
        at = x[links.knot]
        tag = np.full((len(at), 3), self._level)
        tag[:, :d] = at[:, :d] + links.ahead_s[:, None] * at[:, d:]
        tag[:, 2] += links.rise
        away = tag - self._anchors.position[links.anchor]
        distance = np.maximum(np.sqrt(np.einsum("ni,ni->n", away, away)), 0.05)
        return away / distance[:, None], distance, links.range_m - distance - links.rows @ shared

    def _own(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """The derivative of each range with respect to the position and velocity of its knot, float64 (n, 2 d)."""
        level = direction[:, : self._d]
        return np.concatenate([level, self._links.ahead_s[:, None] * level], axis=1)

    def _linearised(
        self,
        x: NDArray[np.float64],
        shared: NDArray[np.float64],
        direction: NDArray[np.float64],
        error: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> Chain:
        d, links = self._d, self._links
        own = self._own(direction)
        # The unknowns themselves are solved for, not their changes: motion and priors are linear in them.
        target = error + links.rows @ shared + np.einsum("nb,nb->n", own, x[links.knot])
        chain = Chain.empty(len(x), 2 * d, len(shared))
        order = self._order
        chain.add_rows(links.knot[order], own[order], links.rows[order], target[order], weight[order])
        self._add_motion(chain)
        chain.shared += np.diag(self._certainty)
        chain.right_shared += self._certainty * self._mean
        for axis in range(d):
            chain.diagonal[:, axis, axis] += self._nearness
            chain.right[:, axis] += self._nearness * self._around[:, axis]
        return chain

    def _add_motion(self, chain: Chain) -> None:
        d, links = self._d, self._links
        chain.add_motion(self._dt, d, self._model.acceleration, self._tied)
        first = np.concatenate([[True], ~self._tied])
        speed = np.where(links.at_rest[links.knot_stretch], _STILL, self._model.speed)[first]
        for axis in range(d, 2 * d):
            chain.diagonal[first, axis, axis] += 1.0 / speed**2
