"""The track that fits all ranges of a recording best, looking ahead as well as back.

The same model as the filter's: white acceleration; of each range's error a white part, one that persists (a process
of each anchor, at every knot), an offset that all share, and one of each anchor. Knots lie a tenth of a second apart where there are
ranges; each range touches one. Iteratively reweighted Gauss-Newton on `chain`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.chain import Chain, Solution
from uwb_mitigation.positioning.filter import FIRST_ERROR, OFFSET, RangeFilter
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.start import Height
from uwb_mitigation.positioning.tracks import Heights, Ranges, Track

KNOT_S = 0.1
_ITERATIONS = 12
_SETTLED_M = 2e-3
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """What ranges have in common, beside the track, to be estimated with it.

    Attributes:
        rows: float64 (n, q), by how much each range grows with each parameter.
        mean, sd: float64 (q,), what is known before: an sd of inf = nothing.
    """

    rows: NDArray[np.float64]
    mean: NDArray[np.float64]
    sd: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """What the smoother found.

    Attributes:
        track: at the knots.
        parameters: float64 (q,), and their covariance (q, q); without any asked for, the offset that all share,
            then that of each anchor from which there are ranges, in the order of their rows.
        anchors: float64 (m, 3), where they were found to be, and `anchor_covariance` (m, 3, m, 3); as given
            where they were not asked for.
        residual_m: float64 (n,), what is left of each range, its anchor's persisting error not taken off.
        weight: float64 (n,), what robustness left of each range: 1 = all.
    """

    track: Track
    parameters: NDArray[np.float64]
    parameter_covariance: NDArray[np.float64]
    anchors: NDArray[np.float64]
    anchor_covariance: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    weight: NDArray[np.float64]


def knots_of(stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Multiples of the spacing next to which there are ranges, int64 (K,) ns since the first; and the knot of each."""
    spacing = round(KNOT_S * _SECOND_NS)
    number, of = np.unique((stamp_ns - stamp_ns[0] + spacing // 2) // spacing, return_inverse=True)
    return number * spacing, of


class Smoother:
    """Fits a track to ranges, and with it what else is unknown.

    Args:
        anchors, model: as of the filter.
        ranges: two or more, in order.
        height: of the tag, where it stays the same.
        parameters: beside the track; None = an offset of all ranges and one of each anchor, known to the
            model's deviations.
        find_anchors: the anchors' positions are unknown too.
        around: where anchors that are sought are known to be, and to which deviation in each axis, float64
            (m, 3) both; None = as `anchors` says.
        after: the filter at the first range's time, whose state and covariance are where the track begins.
        heights: measured heights of the tag; not together with `height`.

    Raises:
        DatasetError: fewer than two ranges.
    """

    def __init__(
        self,
        anchors: AnchorMap,
        model: Model,
        ranges: Ranges,
        *,
        height: Height | None = None,
        parameters: Parameters | None = None,
        find_anchors: bool = False,
        around: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
        after: RangeFilter | None = None,
        heights: Heights | None = None,
    ) -> None:
        if len(ranges) < 2:
            raise DatasetError(f"{len(ranges)} ranges", valid="two or more for a track")
        n = len(ranges)
        self._model, self._height, self._find, self._after = model, height, find_anchors, after
        self._d = 2 if height is not None else 3
        # Anchors that no range comes from have no errors to tell.
        self._used, self._slot = np.unique(ranges.anchor, return_inverse=True)
        self._known = anchors.position
        place, self._spread = around or (anchors.position, np.repeat(anchors.sd[:, None], 3, axis=1))
        self._expected = place - anchors.position
        self._where = anchors.position[self._used].copy()
        self._ranges = ranges
        self._origin_ns = int(ranges.stamp_ns[0])
        self._knots_ns, self._of = knots_of(ranges.stamp_ns)
        self._time_s = self._knots_ns / _SECOND_NS
        self._ahead_s = (ranges.stamp_ns - self._origin_ns - self._knots_ns[self._of]) / _SECOND_NS
        known = np.isfinite(ranges.variance_m2) & (ranges.variance_m2 > 0)
        self._variance = np.where(known, ranges.variance_m2, model.range_sd**2)
        usual = np.array([np.median(self._variance[self._slot == s]) for s in range(len(self._used))])
        self._persisting = (1.0 - model.white) * usual
        if not find_anchors:
            self._persisting = self._persisting + anchors.sd[self._used] ** 2
        self._white = np.maximum(model.white * self._variance, self._variance - self._persisting[self._slot])
        if parameters is None:
            own = np.eye(len(self._used))[self._slot]
            sd = np.array([model.offset_sd, *[model.pair_sd] * len(self._used)])
            parameters = Parameters(np.concatenate([np.ones((n, 1)), own], axis=1), np.zeros(len(sd)), sd)
        self._rows, self._mean = parameters.rows, parameters.mean
        self._certainty = 1.0 / np.maximum(parameters.sd, 1e-6) ** 2
        self._height_m = self._height_information = np.zeros(len(self._knots_ns))
        if heights is not None and height is None:
            value, variance = heights.at(self._origin_ns + self._knots_ns)
            self._height_m = np.nan_to_num(value)
            self._height_information = np.nan_to_num(1.0 / variance)

    def fit(self, initial: Track, iterations: int = _ITERATIONS) -> Smoothed:
        """The track, starting from one that is roughly right.

        Raises:
            DatasetError: the ranges do not determine it.
        """
        knots, d = len(self._time_s), self._d
        stamp = (initial.stamp_ns - self._origin_ns) / _SECOND_NS
        x = np.zeros((knots, 2 * d + len(self._used)))
        for axis in range(d):
            x[:, axis] = np.interp(self._time_s, stamp, initial.position[:, axis])
        shared = np.concatenate([self._mean, np.zeros(self._extra)])
        solution: Solution | None = None
        try:
            for _ in range(iterations):
                chain = self._linearise(x, shared)
                solution = chain.solve()
                moved = float(np.abs(solution.x[:, :d] - x[:, :d]).max())
                x, shared = solution.x, solution.shared
                if not np.isfinite(moved):
                    raise np.linalg.LinAlgError
                if moved < _SETTLED_M:
                    break
            assert solution is not None
            covariances = solution.covariances(2 * d)
        except np.linalg.LinAlgError as error:
            raise DatasetError(
                "the ranges do not determine a track", valid="more ranges, or anchors"
            ) from error
        return self._result(x, shared, solution, covariances)

    @property
    def _extra(self) -> int:
        """Shared unknowns beside the parameters: the height's error, and the anchors' places."""
        return (self._height is not None) + (3 * len(self._used) if self._find else 0)

    def _places(self, shared: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """The height, and the anchors' positions, that shared unknowns stand for."""
        at = len(self._mean)
        height = 0.0
        if self._height is not None:
            height = self._height.value + shared[at]
            at += 1
        where = self._where
        if self._find:
            where = where + shared[at:].reshape(-1, 3)
        return height, where

    def _geometry(
        self, x: NDArray[np.float64], shared: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unit vectors (n, 3) from anchor to tag, and distances (n,)."""
        d = self._d
        height, where = self._places(shared)
        at = x[self._of]
        tag = np.full((len(at), 3), height)
        tag[:, :d] = at[:, :d] + self._ahead_s[:, None] * at[:, d : 2 * d]
        away = tag - where[self._slot]
        distance = np.maximum(np.sqrt(np.einsum("ni,ni->n", away, away)), 0.05)
        return away / distance[:, None], distance

    def _linearise(self, x: NDArray[np.float64], shared: NDArray[np.float64]) -> Chain:
        d, m, q = self._d, len(self._used), len(shared)
        direction, distance = self._geometry(x, shared)
        p = len(self._mean)
        rows = np.zeros((len(distance), q))
        rows[:, :p] = self._rows
        at = p
        if self._height is not None:
            rows[:, at] = direction[:, 2]
            at += 1
        if self._find:
            for axis in range(3):
                rows[np.arange(len(rows)), at + 3 * self._slot + axis] = -direction[:, axis]
        own = np.zeros((len(distance), 2 * d + m))
        own[:, :d] = direction[:, :d]
        own[:, d : 2 * d] = self._ahead_s[:, None] * direction[:, :d]
        own[np.arange(len(own)), 2 * d + self._slot] = 1.0
        error = self._ranges.range_m - distance - self._rows @ shared[:p]
        # The unknowns themselves are solved for, not their changes: motion and priors are linear in them.
        target = error - x[self._of, 2 * d + self._slot] + rows @ shared
        target += np.einsum("nb,nb->n", own, x[self._of])
        weight = self._model.weight(error / np.sqrt(self._variance)) / self._white

        chain = Chain.empty(len(x), own.shape[1], q)
        order = np.argsort(self._of, kind="stable")
        chain.add_rows(self._of[order], own[order], rows[order], target[order], weight[order])
        self._add_motion(chain)
        self._add_priors(chain)
        return chain

    def _add_motion(self, chain: Chain) -> None:
        d, model = self._d, self._model
        dt = np.diff(self._time_s)
        chain.add_motion(dt, d, model.acceleration)
        kept = np.exp(-dt / model.persistence_s)
        for slot, variance in enumerate(self._persisting):
            i = 2 * d + slot
            noise = 1.0 / (variance * (1.0 - kept**2))
            chain.diagonal[1:, i, i] += noise
            chain.diagonal[:-1, i, i] += noise * kept**2
            chain.beside[:, i, i] -= noise * kept

    def _add_priors(self, chain: Chain) -> None:
        d, p = self._d, len(self._mean)
        for axis in range(p):
            chain.shared[axis, axis] += self._certainty[axis]
            chain.right_shared[axis] += self._certainty[axis] * self._mean[axis]
        at = p
        if self._height is not None and self._after is None:
            chain.shared[at, at] += 1.0 / self._height.sd**2
        at += self._height is not None
        if self._find:
            for slot, row in enumerate(self._used):
                for axis in range(3):
                    i = at + 3 * slot + axis
                    certainty = 1.0 / max(self._spread[row, axis], 1e-6) ** 2
                    chain.shared[i, i] += certainty
                    chain.right_shared[i] += certainty * self._expected[row, axis]
        if d == 3:
            chain.diagonal[:, 2, 2] += self._height_information
            chain.right[:, 2] += self._height_information * self._height_m
        if self._after is None:
            for axis in range(d):
                chain.diagonal[0, d + axis, d + axis] += 1.0 / self._model.speed**2
            for slot, variance in enumerate(self._persisting):
                chain.diagonal[0, 2 * d + slot, 2 * d + slot] += 1.0 / variance
            return
        self._add_filter(chain, self._after)

    def _add_filter(self, chain: Chain, after: RangeFilter) -> None:
        """What a filter knows of the first knot, of offset and height too, in their correlation."""
        d = self._d
        own = [*range(d), *range(3, 3 + d), *(FIRST_ERROR + int(row) for row in self._used)]
        index, shared = [*own, OFFSET], [0]
        if self._height is not None:
            index, shared = [*index, 2], [0, len(self._mean)]
        mean = after.x[index].copy()
        if self._height is not None:
            mean[-1] -= self._height.value
        information = np.linalg.inv(after.p[np.ix_(index, index)] + 1e-9 * np.eye(len(index)))
        told = information @ mean
        k = len(own)
        chain.diagonal[0] += information[:k, :k]
        chain.border[0][:, shared] += information[:k, k:]
        chain.shared[np.ix_(shared, shared)] += information[k:, k:]
        chain.right[0] += told[:k]
        chain.right_shared[shared] += told[k:]
        # The offset's own prior is in the filter already.
        chain.shared[0, 0] -= self._certainty[0]
        chain.right_shared[0] -= self._certainty[0] * self._mean[0]

    def _result(
        self,
        x: NDArray[np.float64],
        shared: NDArray[np.float64],
        solution: Solution,
        covariances: NDArray[np.float64],
    ) -> Smoothed:
        d, p, knots = self._d, len(self._mean), len(x)
        height, where = self._places(shared)
        position, velocity = np.full((knots, 3), height), np.zeros((knots, 3))
        position[:, :d], velocity[:, :d] = x[:, :d], x[:, d : 2 * d]
        full = np.zeros((knots, 6, 6))
        axes = [*range(d), *range(3, 3 + d)]
        full[np.ix_(range(knots), axes, axes)] = covariances
        if self._height is not None:
            full[:, 2, 2] = solution.shared_covariance[p, p]
        _, distance = self._geometry(x, shared)
        error = self._ranges.range_m - distance - self._rows @ shared[:p]
        anchors = self._known.copy()
        anchor_covariance = np.diag(self._spread.reshape(-1) ** 2)
        if self._find:
            anchors[self._used] = where
            at = p + (self._height is not None)
            own = (3 * self._used[:, None] + np.arange(3)).reshape(-1)
            anchor_covariance[np.ix_(own, own)] = solution.shared_covariance[at:, at:]
        return Smoothed(
            Track(self._origin_ns + self._knots_ns, position, velocity, full),
            shared[:p].copy(),
            solution.shared_covariance[:p, :p].copy(),
            anchors,
            anchor_covariance.reshape(len(anchors), 3, len(anchors), 3),
            error,
            self._model.weight(error / np.sqrt(self._variance)),
        )
