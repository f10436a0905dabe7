"""Ranges beside a robot's own localisation: how far clocks and antenna are from it, and how long ranges truly were.

A pose tells where the robot's frame is, not the antenna: that sits off it by a lever arm, in the robot's frame. And
radio and localisation stamp by clocks and delays of their own. Both, and the offset of each pair, by robust least squares
(Gauss-Newton) on the ranges themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.persisting import normal_equations
from uwb_mitigation.positioning.regressors import Regressors
from uwb_mitigation.positioning.tracks import Ranges

GAP_S = 0.5
"""In longer gaps of the localisation nothing is known of the pose."""

MOST_LAG_S = 2.0
LAGS_S = np.arange(-MOST_LAG_S, MOST_LAG_S + 0.01, 0.1)
LAG_SD_S, LEVER_SD_M, OFFSET_SD_M = 2.0, 1.0, 2.0
LEAST_RANGES = 40
MOST_RANGES = 20_000
"""Of more, so many are fitted to, spread evenly: none of these unknowns needs more."""

SMOOTHED_S = 0.2
"""Where poses jitter, times halfway between two of them would look best, since there the jitter is less."""

SLOPE_S = 0.1
"""The velocity of a pose is from so long before and after it."""

FINE_LAG_S = 0.02
LEVER_STEPS = 5
SEARCHED = 4000
"""Of more ranges, so many tell about which lag it is."""

_STEPS = 40
_PERSISTENCE_S = 1.0
_SMALL_M = 0.02
_MOST_NEIGHBOURS = 20
_WORST_CONDITION = 1e6
_SECOND_NS = 1_000_000_000
_MODEL = Model(long=1.5, short=1.5)


@dataclass(frozen=True, slots=True, eq=False)
class PosePath:
    """Where a robot's frame was: int64 (n,) stamps in order, float64 (n, 3) positions in m, and (n, 4) unit quaternions
    x, y, z, w that turn the robot's axes into the map's."""

    stamp_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def shifted(self, by_ns: int) -> PosePath:
        """At stamps that much later."""
        return PosePath(self.stamp_ns + by_ns, self.position, self.orientation)

    def smoothed(self) -> PosePath:
        """Positions from a parabola through those of `SMOOTHED_S` before and after each (Savitzky and Golay, 1964)."""
        time_s = (self.stamp_ns - self.stamp_ns[0]) / _SECOND_NS
        # Sums over neighbours of 1, t, t^2, t^3, t^4, and of the positions times the first three.
        moments, right = np.zeros((len(self), 5)), np.zeros((len(self), 3, 3))
        reach = (
            int(np.max(np.searchsorted(time_s, time_s + SMOOTHED_S, side="right") - np.arange(len(self)))) - 1
        )
        stride = max(1, reach // _MOST_NEIGHBOURS)
        for step in range(-(reach // stride) * stride, reach + 1, stride):
            here = np.arange(max(-step, 0), len(self) - max(step, 0))
            since = (time_s[here + step] - time_s[here]) / SMOOTHED_S
            powers = np.where(np.abs(since)[:, None] <= 1.0, since[:, None] ** np.arange(5), 0.0)
            moments[here] += powers
            right[here] += powers[:, :3, None] * self.position[here + step][:, None]
        normal = moments[:, np.add.outer(np.arange(3), np.arange(3))]
        # Poses that bags tell twice are at too few times for a parabola.
        told = (moments[:, 0] >= 5.0) & (np.linalg.cond(normal) < _WORST_CONDITION)
        position = self.position.copy()
        position[told] = np.linalg.solve(normal[told], right[told])[:, 0]
        return PosePath(self.stamp_ns, position, self.orientation)

    @classmethod
    def joined(cls, paths: Sequence[PosePath]) -> PosePath:
        """All in the order of time."""
        stamp_ns = np.concatenate([path.stamp_ns for path in paths])
        order = np.argsort(stamp_ns, kind="stable")
        return cls(
            stamp_ns[order],
            np.concatenate([path.position for path in paths])[order],
            np.concatenate([path.orientation for path in paths])[order],
        )

    def at(
        self, stamp_ns: NDArray[np.int64], later_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (k, 3) and rotation matrices (k, 3, 3) at stamps + `later_s`; NaN outside, and in gaps over `GAP_S`.

        Between two poses the quaternion is interpolated linearly and scaled to length 1: turns are small there.
        """
        own = (self.stamp_ns - self.stamp_ns[0]) / _SECOND_NS
        wanted = (stamp_ns - self.stamp_ns[0]) / _SECOND_NS + later_s
        after = np.clip(np.searchsorted(own, wanted), 1, len(own) - 1)
        before = after - 1
        span = own[after] - own[before]
        part = (wanted - own[before]) / np.maximum(span, 1e-9)
        outside = (part < -1e-9) | (part > 1.0 + 1e-9) | (span > GAP_S)
        part = np.where(outside, np.nan, part)[:, None]
        position = (1.0 - part) * self.position[before] + part * self.position[after]
        first, second = self.orientation[before], self.orientation[after]
        second = np.where(np.einsum("ni,ni->n", first, second)[:, None] < 0.0, -second, second)
        turn = (1.0 - part) * first + part * second
        return position, _matrices(turn / np.linalg.norm(turn, axis=1, keepdims=True))


def _matrices(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices (k, 3, 3) of unit quaternions (k, 4), x, y, z, w."""
    x, y, z, w = q.T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Localised:
    """What was found.

    Attributes:
        time_offset_s, time_offset_sd_s: what to add to a range's stamp to have the localisation's; an sd of 0 = given.
        lever_arm_m, lever_arm_sd_m: (3,), of the antenna in the robot's frame; sd 0 = given, NaN = not told.
        pairs: (tag number, anchor row), and `offset_m`, `offset_sd_m` of each.
        position: float64 (r, 3), of the antenna at each of all ranges; NaN = not known. distance_m: (r,), to the anchor.
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
        """The offset of a pair, m, and its deviation, which an anchor that is misplaced adds to."""
        at = self.pairs.index((tag, row))
        return float(self.offset_m[at]), math.hypot(float(self.offset_sd_m[at]), anchor_sd_m / math.sqrt(2.0))

    @property
    def lever_arm(self) -> tuple[float, float, float]:
        """The same as numbers."""
        x, y, z = self.lever_arm_m.tolist()
        return x, y, z

    def as_json(self) -> dict[str, object]:
        """Numbers; null = not told."""
        sds = [None if math.isnan(sd) else sd for sd in self.lever_arm_sd_m.tolist()]
        return {
            "time_offset_s": self.time_offset_s,
            "time_offset_sd_s": self.time_offset_sd_s,
            "lever_arm_m": self.lever_arm_m.tolist(),
            "lever_arm_sd_m": sds,
        }


def solve_localised(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    path: PosePath,
    known: Regressors,
    *,
    time_offset_s: float | None = None,
    lever_arm_m: tuple[float, float, float] | None = None,
) -> Localised:
    """Time offset, lever arm and offsets.

    Args:
        path: of the robot that carries all the tags.
        known: as many rows as there are ranges, one tag after the other.
        time_offset_s, lever_arm_m: where known.

    Raises:
        DatasetError: too few ranges lie within the localisation's times, or it does not move.
    """
    stamp = np.concatenate([one.stamp_ns for one in tags])
    row = np.concatenate([one.anchor for one in tags])
    value = np.concatenate([one.range_m for one in tags])
    tag = np.repeat(np.arange(len(tags)), list(map(len, tags)))
    if len(path) < 2:
        raise DatasetError(f"{len(path)} poses of the localisation", valid="two or more")
    pairs, of_pair = np.unique(np.stack([tag, row]), axis=1, return_inverse=True)
    of_pair = of_pair.reshape(-1)
    chosen = np.arange(len(stamp))
    if len(chosen) > MOST_RANGES:
        chosen = np.sort(np.random.default_rng(1).choice(chosen, MOST_RANGES, replace=False))
    fitted = _Fit(
        anchors.position[row[chosen]],
        stamp[chosen],
        value[chosen],
        of_pair[chosen],
        pairs.shape[1],
        known.take(chosen),
        path.smoothed(),
    )
    lever = np.zeros(3) if lever_arm_m is None else np.array(lever_arm_m, float)
    lag = time_offset_s
    if lag is None:
        lag, lever = fitted.likely(lever, lever_arm_m is None)
    unknown = fitted.solve(lag, lever, time_offset_s is None, lever_arm_m is None)
    position, turn = path.at(stamp, unknown.lag)
    antenna = position + turn @ unknown.lever
    distance = np.linalg.norm(antenna - anchors.position[row], axis=1)
    _check_enough(int(np.isfinite(distance).sum()), time_offset_s is None or lever_arm_m is None)
    sd = np.sqrt(np.diag(unknown.covariance))[: 4 + pairs.shape[1]]
    return Localised(
        unknown.lag,
        float(sd[0]) if time_offset_s is None else 0.0,
        unknown.lever,
        np.where(unknown.told, sd[1:4], np.nan) if lever_arm_m is None else np.zeros(3),
        tuple((int(a), int(b)) for a, b in pairs.T),
        unknown.offset,
        sd[4:],
        antenna,
        distance,
    )


def _check_enough(count: int, alignment_unknown: bool) -> None:
    """Of the offsets alone, whose deviations are known beforehand, any range tells."""
    least = LEAST_RANGES if alignment_unknown else 1
    if count < least:
        raise DatasetError(
            f"{count} ranges lie within the localisation's times",
            valid=f"{least} or more: do their clocks agree to {MOST_LAG_S:g} s?",
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Unknowns:
    lag: float
    lever: NDArray[np.float64]
    offset: NDArray[np.float64]
    covariance: NDArray[np.floating[Any]]
    told: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """n ranges (n,) to anchors (n, 3), of `count` pairs; `known` of them."""

    anchor: NDArray[np.float64]
    stamp_ns: NDArray[np.int64]
    range_m: NDArray[np.float64]
    pair: NDArray[np.intp]
    count: int
    known: Regressors
    path: PosePath

    def likely(self, lever: NDArray[np.float64], free_lever: bool) -> tuple[float, NDArray[np.float64]]:
        """The lag with which ranges agree best, and the lever arm beside it: from each lag anew, since a wrong one has
        turns look like outliers.

        Raises:
            DatasetError: hardly any range lies within the localisation's times.
        """
        few = self if len(self.range_m) <= SEARCHED else self._some(SEARCHED)
        best = (math.inf, 0.0, lever)
        for around, lags in ((0.0, LAGS_S), (None, np.arange(-0.1, 0.101, FINE_LAG_S))):
            middle = best[1] if around is None else around
            for lag in (middle + lags).tolist():
                arm = few._lever(lag, lever) if free_lever else lever
                best = min(best, (few._spread(lag, arm), lag, arm), key=lambda one: one[0])
        if not math.isfinite(best[0]):
            raise DatasetError(
                "hardly any range lies within the localisation's times",
                valid=f"clocks that agree to {MOST_LAG_S:g} s, or --time-offset",
            )
        return best[1], best[2]

    def _some(self, count: int) -> _Fit:
        part = np.linspace(0, len(self.range_m) - 1, count).astype(int)
        columns = ("anchor", "stamp_ns", "range_m", "pair")
        some = {name: getattr(self, name)[part] for name in columns}
        return replace(self, known=self.known.take(part), **some)

    def _left(self, lag: float, lever: NDArray[np.float64]) -> NDArray[np.float64]:
        error = self._errors(lag, lever)[0]
        left: NDArray[np.float64] = error - self._medians(error)[self.pair]
        return left

    def _spread(self, lag: float, lever: NDArray[np.float64]) -> float:
        left = np.abs(self._left(lag, lever))
        return float(np.nanmedian(left)) if np.isfinite(left).sum() >= LEAST_RANGES else math.inf

    def _lever(self, lag: float, lever: NDArray[np.float64]) -> NDArray[np.float64]:
        """The lever arm that goes best with a lag: least absolute deviations, by reweighting."""
        for _ in range(LEVER_STEPS):
            left = self._left(lag, lever)
            _, unit, turn = self._errors(lag, lever)
            rows = np.einsum("ni,nij->nj", unit, turn)
            known = np.isfinite(left) & np.isfinite(rows).all(axis=1)
            if int(known.sum()) < LEAST_RANGES:
                return lever
            rows, left = rows[known], left[known]
            weight = 1.0 / np.maximum(np.abs(left), _SMALL_M)
            certainty = float(weight.sum()) * _SMALL_M**2 / LEVER_SD_M**2
            normal = rows.T @ (weight[:, None] * rows) + certainty * np.eye(3)
            lever = lever + np.linalg.solve(normal, rows.T @ (weight * left) - certainty * lever)
        return lever

    def _medians(self, error: NDArray[np.float64]) -> NDArray[np.float64]:
        found = np.zeros(self.count)
        for pair in range(self.count):
            own = error[self.pair == pair]
            found[pair] = np.nanmedian(own) if np.isfinite(own).any() else 0.0
        return found

    def _errors(
        self, lag: float, lever: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Range less distance and what is expected beside it (n,), unit vectors (n, 3) from anchor to antenna, rotations (n, 3, 3)."""
        position, turn = self.path.at(self.stamp_ns, lag)
        away = position + turn @ lever - self.anchor
        distance = np.maximum(np.linalg.norm(away, axis=1), 0.05)
        return self.range_m - self.known.rows @ self.known.mean - distance, away / distance[:, None], turn

    def solve(self, lag: float, lever: NDArray[np.float64], free_lag: bool, free_lever: bool) -> _Unknowns:
        first = 4 + self.count
        size = first + len(self.known.mean)
        certainty = 1.0 / np.array(
            [
                LAG_SD_S**2 if free_lag else 1e-18,
                *[LEVER_SD_M**2 if free_lever else 1e-18] * 3,
                *[OFFSET_SD_M**2] * self.count,
                *(self.known.sd**2).tolist(),
            ]
        )
        # What is known of regressors' factors is taken off with their means.
        mean = np.array([lag, *lever, *np.zeros(size - 4)])
        if free_lag:
            mean[0] = 0.0
        x = np.array([lag, *lever, *self._medians(self._errors(lag, lever)[0]), *np.zeros(size - first)])
        # Ranges of a pair err alike for about so long (see `model`).
        chunk = (self.stamp_ns - self.stamp_ns.min()) // round(2.0 * _PERSISTENCE_S * _SECOND_NS)
        group = chunk * self.count + self.pair
        covariance: NDArray[np.floating[Any]] = np.eye(size)
        for step_number in range(_STEPS):
            error, unit, turn = self._errors(x[0], x[1:4])
            beside, before = (self._errors(x[0] + by, x[1:4])[0] for by in (SLOPE_S, -SLOPE_S))
            rows = np.zeros((len(error), size))
            rows[:, 0] = (before - beside) / (2.0 * SLOPE_S)
            rows[:, 1:4] = np.einsum("ni,nij->nj", unit, turn)
            rows[np.arange(len(error)), 4 + self.pair] = 1.0
            rows[:, first:] = self.known.rows
            left = error - x[4:first][self.pair] - self.known.rows @ x[first:]
            known = np.isfinite(left) & np.isfinite(rows).all(axis=1)
            _check_enough(int(known.sum()), free_lag or free_lever)
            normal, right = normal_equations(
                rows[known], left[known], group[known], self.known.alike[known], _MODEL
            )
            covariance = np.linalg.inv(normal + np.diag(certainty))
            move = covariance @ (right + certainty * (mean - x))
            move[0] = np.clip(move[0], -0.3, 0.3)
            x = x + move
            if float(np.abs(move).max()) < 1e-5 and step_number > 3:
                break
        told = np.sqrt(np.diag(covariance)[1:4]) < 0.3 * LEVER_SD_M
        return _Unknowns(float(x[0]), x[1:4].copy(), x[4:first].copy(), covariance, told)
