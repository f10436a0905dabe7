"""Ranges beside a robot's own localisation: how far clocks and antenna are from it, and how long ranges truly were.

A pose tells where the robot's frame is, not the antenna: that sits off it by a lever arm, in the robot's frame. And
radio and localisation stamp by clocks and delays of their own. Both, and the offset of each pair, by robust least squares
(Gauss-Newton) on the ranges themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import directions
from uwb_mitigation.positioning.model import Model, Regressors, scatter_of
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

SEPARATED_M = 0.1
"""A lever arm that is known less well cannot be separated from the offsets."""

BLOCK_S, UNDERSTATED = 10.0, 1.5
"""Errors of blocks of that duration count as independent. Errors that come again with each lap are not in their scatter:
hence the factor."""

FINE_LAG_S = 0.02
LEVER_STEPS = 5
SEARCHED = 4000
"""Of more ranges, so many tell about which lag it is."""

MIN_SD_M = 0.01
"""Of white noise and of persisting errors."""

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

    def interpolated(self, stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], Rotation]:
        """Return positions (k, 3) and rotations (k,) at stamps; before the first pose and after the last as there.

        Between two poses the quaternion is interpolated linearly and normalised: rotations are small there.
        """
        after = np.searchsorted(self.stamp_ns, stamp_ns).clip(0, len(self) - 1)
        before = np.maximum(after - 1, 0)
        span_ns = np.maximum(self.stamp_ns[after] - self.stamp_ns[before], 1)
        part = ((stamp_ns - self.stamp_ns[before]) / span_ns).clip(0.0, 1.0)[:, None]
        position = (1.0 - part) * self.position[before] + part * self.position[after]
        first, second = self.orientation[before], self.orientation[after]
        second = np.where(np.einsum("ni,ni->n", first, second)[:, None] < 0.0, -second, second)
        return position, Rotation.from_quat((1.0 - part) * first + part * second)

    def at(
        self, stamp_ns: NDArray[np.int64], later_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (k, 3) and rotation matrices (k, 3, 3) at stamps + `later_s`; NaN outside, and in gaps over `GAP_S`."""
        wanted = stamp_ns + round(later_s * _SECOND_NS)
        after = np.searchsorted(self.stamp_ns, wanted).clip(1, len(self) - 1)
        gap = self.stamp_ns[after] - self.stamp_ns[after - 1] > GAP_S * _SECOND_NS
        unknown = (wanted < self.stamp_ns[0]) | (wanted > self.stamp_ns[-1]) | gap
        position, turn = self.interpolated(wanted)
        matrices = turn.as_matrix()
        position[unknown], matrices[unknown] = np.nan, np.nan
        return position, matrices


@dataclass(frozen=True, slots=True, eq=False)
class Localised:
    """What was found.

    Attributes:
        time_offset_s, time_offset_sd_s: what to add to a range's stamp to have the localisation's; an sd of 0 = given.
        lever_arm_m, lever_arm_sd_m: (T, 3), of each tag's antenna in the robot's frame; sd 0 = given, NaN = not observable,
            so that the start value holds.
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

    def as_json(self) -> dict[str, object]:
        """Numbers; null = not observable. The arm of the first tag, and of all in the order of their ids."""
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


def solve_localised(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    paths: Sequence[PosePath],
    known: Regressors,
    *,
    time_offset_s: float | None = None,
    lever_arms_m: NDArray[np.float64] | None = None,
    estimate_lever_arm: bool = False,
) -> Localised:
    """Estimate time offset and offsets, and on request the lever arms.

    Args:
        paths: of the robot that carries the tag, for each tag.
        known: as many rows as there are ranges, one tag after the other.
        time_offset_s: if known.
        lever_arms_m: float64 (T, 3), of each tag; None: zero.
        estimate_lever_arm: start from these arms and estimate them.

    Raises:
        DatasetError: too few ranges lie within the localisation's times, or arms and offsets cannot be separated.
    """
    every = Ranges.joined(tags)
    stamp, row, value = every.stamp_ns, every.anchor, every.range_m
    tag = np.repeat(np.arange(len(tags)), list(map(len, tags)))
    if (fewest := min(map(len, paths))) < 2:
        raise DatasetError(f"{fewest} poses of the localisation", valid="two or more")
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
        tag[chosen],
        pairs.shape[1],
        known.take(chosen),
        [path.smoothed() for path in paths],
    )
    levers = np.zeros((len(tags), 3)) if lever_arms_m is None else lever_arms_m
    start, free = levers, np.full(levers.shape, estimate_lever_arm)
    lag = time_offset_s
    if lag is None:
        lag, start = fitted.likely(levers, estimate_lever_arm)
    unknown = fitted.solve(lag, start, levers, time_offset_s is None, free)
    if estimate_lever_arm:
        free = unknown.lever_sd < SEPARATED_M
        if not free[:, :2].all():
            raise DatasetError(
                "lever arm and offsets cannot be separated: the standard deviation of the arm is "
                f"{unknown.lever_sd[:, :2].max():.2f} m",
                valid="--lever-arm or a transform in the bag instead of --estimate-lever-arm, or a drive with more turns",
            )
        if not free.all():
            # A level drive does not observe the height of the arm: it would trade off against the offsets.
            unknown = fitted.solve(
                unknown.lag, np.where(free, unknown.lever, levers), levers, time_offset_s is None, free
            )
    position, turn = _at(paths, tag, stamp, unknown.lag)
    antenna = position + np.einsum("nij,nj->ni", turn, unknown.lever[tag])
    distance = np.linalg.norm(antenna - anchors.position[row], axis=1)
    _check_enough(int(np.isfinite(distance).sum()), time_offset_s is None or estimate_lever_arm)
    arm_sd = np.where(free, unknown.lever_sd, np.nan) if estimate_lever_arm else np.zeros(levers.shape)
    return Localised(
        unknown.lag,
        float(unknown.sd[0]) if time_offset_s is None else 0.0,
        unknown.lever,
        arm_sd,
        tuple((int(a), int(b)) for a, b in pairs.T),
        unknown.offset,
        unknown.sd[1 + levers.size :][: pairs.shape[1]],
        antenna,
        distance,
    )


def _at(
    paths: Sequence[PosePath], tag: NDArray[np.intp], stamp_ns: NDArray[np.int64], later_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """As `PosePath.at`, of the path of each tag (n,)."""
    position, turn = np.zeros((len(tag), 3)), np.zeros((len(tag), 3, 3))
    for number, path in enumerate(paths):
        own = tag == number
        position[own], turn[own] = path.at(stamp_ns[own], later_s)
    return position, turn


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
    """Of T tags and their pairs; sd: float64 (1 + 3 T + pairs + regressors,), in this order."""

    lag: float
    lever: NDArray[np.float64]
    offset: NDArray[np.float64]
    sd: NDArray[np.float64]

    @property
    def lever_sd(self) -> NDArray[np.float64]:
        return self.sd[1 : 1 + self.lever.size].reshape(self.lever.shape)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """n ranges (n,) of tags (n,) to anchors (n, 3), of `count` pairs; `known` of them. Lever arms are float64 (T, 3)."""

    anchor: NDArray[np.float64]
    stamp_ns: NDArray[np.int64]
    range_m: NDArray[np.float64]
    pair: NDArray[np.intp]
    tag: NDArray[np.intp]
    count: int
    known: Regressors
    paths: Sequence[PosePath]

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
        columns = ("anchor", "stamp_ns", "range_m", "pair", "tag")
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
            lever = lever.copy()
            for tag in range(len(lever)):
                own = known & (self.tag == tag)
                if not own.any():
                    continue
                weight = 1.0 / np.maximum(np.abs(left[own]), _SMALL_M)
                certainty = float(weight.sum()) * _SMALL_M**2 / LEVER_SD_M**2
                normal = rows[own].T @ (weight[:, None] * rows[own]) + certainty * np.eye(3)
                right = rows[own].T @ (weight * left[own]) - certainty * lever[tag]
                lever[tag] += np.linalg.solve(normal, right)
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
        position, turn = _at(self.paths, self.tag, self.stamp_ns, lag)
        unit, distance = directions(position + np.einsum("nij,nj->ni", turn, lever[self.tag]), self.anchor)
        return self.range_m - self.known.rows @ self.known.mean - distance, unit, turn

    def solve(
        self,
        lag: float,
        lever: NDArray[np.float64],
        expected: NDArray[np.float64],
        free_lag: bool,
        free_lever: NDArray[np.bool_],
    ) -> _Unknowns:
        """From a lag and lever arms; `expected`: the arms as known before, bool (T, 3): which coordinates are estimated."""
        arms = slice(1, 1 + lever.size)
        pairs = slice(arms.stop, arms.stop + self.count)
        size = pairs.stop + len(self.known.mean)
        certainty = 1.0 / np.array(
            [
                LAG_SD_S**2 if free_lag else 1e-18,
                *np.where(free_lever.reshape(-1), LEVER_SD_M**2, 1e-18).tolist(),
                *[OFFSET_SD_M**2] * self.count,
                *(self.known.sd**2).tolist(),
            ]
        )
        # What is known of regressors' factors is taken off with their means.
        mean = np.array([0.0 if free_lag else lag, *expected.reshape(-1), *np.zeros(size - arms.stop)])
        offsets = self._medians(self._errors(lag, lever)[0])
        x = np.array([lag, *lever.reshape(-1), *offsets, *np.zeros(size - pairs.stop)])
        # Ranges of a pair err alike for about so long (see `model`).
        since = self.stamp_ns - self.stamp_ns.min()
        chunk = since // round(2.0 * _PERSISTENCE_S * _SECOND_NS)
        group = chunk * self.count + self.pair
        every = np.arange(len(self.pair))
        for step_number in range(_STEPS):
            arm = x[arms].reshape(lever.shape)
            error, unit, turn = self._errors(x[0], arm)
            beside, before = (self._errors(x[0] + by, arm)[0] for by in (SLOPE_S, -SLOPE_S))
            rows = np.zeros((len(error), size))
            rows[:, 0] = (before - beside) / (2.0 * SLOPE_S)
            for axis in range(3):
                rows[every, 1 + 3 * self.tag + axis] = np.einsum("ni,ni->n", unit, turn[:, :, axis])
            rows[every, pairs.start + self.pair] = 1.0
            rows[:, pairs.stop :] = self.known.rows
            left = error - x[pairs][self.pair] - self.known.rows @ x[pairs.stop :]
            known = np.isfinite(left) & np.isfinite(rows).all(axis=1)
            _check_enough(int(known.sum()), free_lag or bool(free_lever.any()))
            normal, right = _normal_equations(rows[known], left[known], group[known], self.known.alike[known])
            covariance = np.linalg.inv(normal + np.diag(certainty))
            move = covariance @ (right + certainty * (mean - x))
            move[0] = np.clip(move[0], -0.3, 0.3)
            x = x + move
            if float(np.abs(move).max()) < 1e-5 and step_number > 3:
                break
        # Errors persist for longer than a group, and those of the localisation are in all pairs: the scatter of the
        # scores of long blocks shows it (Liang and Zeger, Biometrika 1986).
        block = since // round(BLOCK_S * _SECOND_NS)
        scores = np.array(
            [
                _normal_equations(rows[one], left[one], group[one], self.known.alike[one])[1]
                for number in np.unique(block[known])
                for one in [known & (block == number)]
            ]
        )
        blocks = max(len(scores), 2)
        robust = covariance @ (scores.T @ scores) @ covariance * (blocks / (blocks - 1))
        sd = UNDERSTATED * np.sqrt(np.diag(covariance) + np.diag(robust))
        arm = np.where(free_lever, x[arms].reshape(lever.shape), expected)
        return _Unknowns(float(x[0]), arm, x[pairs].copy(), sd)


def _normal_equations(
    rows: NDArray[np.float64],
    left_m: NDArray[np.float64],
    group: NDArray[np.intp],
    alike: NDArray[np.intp],
    model: Model = _MODEL,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the normal matrix (q, q) and right side (q,) of n ranges, robust against outliers among ranges and groups.

    Random effects: the ranges of a group share an error of unknown variance. It does not affect what changes within the
    group, and reduces the weight of the group's mean to that of one range (Searle, Casella, McCulloch, Variance Components,
    1992, section 3.3). Both variances are estimated from the residuals, by medians.

    Args:
        rows: float64 (n, q), what each range grows by with each unknown.
        left_m: float64 (n,), what is not explained yet.
        group: int (n,), whose errors persist together.
        alike: int (n,), ranges that should err about as much have the same number, from 0.
    """
    order = np.argsort(group, kind="stable")
    rows, left_m, group, alike = rows[order], left_m[order], group[order], alike[order]
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    count = np.diff(np.append(starts, len(group)))
    of = np.repeat(np.arange(len(starts)), count)
    kinds = int(alike.max(initial=0)) + 1

    def mean(
        values: NDArray[np.float64], weight: NDArray[np.float64], total: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        found: NDArray[np.float64] = np.add.reduceat((values.T * weight).T, starts) / total[:, None]
        return found

    middle = np.array([np.median(part) for part in np.split(left_m, starts[1:])])
    within = left_m - middle[of]
    # Of n values around their own median: n - 1 are left.
    several = count[of] > 1
    larger = np.sqrt(count / np.maximum(count - 1.0, 1.0))[of]
    if several.any():
        white = scatter_of((within * larger)[several], alike[several], kinds)
    else:
        white = np.full(kinds, MIN_SD_M)
    white = np.maximum(white, MIN_SD_M)
    weight = model.weight(within / white[alike]) / white[alike] ** 2
    total = np.add.reduceat(weight, starts)
    both = np.concatenate([rows, left_m[:, None]], axis=1)
    shared = mean(both, weight, total)
    apart = both - shared[of]
    scaled = apart * weight[:, None]
    kind = np.array([int(np.median(part)) for part in np.split(alike, starts[1:])])
    spread = scatter_of(shared[:, -1], kind, kinds)[kind]
    persists = np.sqrt(np.maximum(spread**2 - 1.0 / total, MIN_SD_M**2))
    variance = persists**2 + 1.0 / total
    of_group = model.weight(shared[:, -1] / np.sqrt(variance)) / variance
    outer = scaled.T @ apart + (shared * of_group[:, None]).T @ shared
    return outer[:-1, :-1], outer[:-1, -1]
