"""Checks of a calibration without ground truth: observability, errors in the anchors file, and agreement of the anchors.

The ranges of an anchor that is not where the anchors file says look like ranges with an offset. The difference is that
the error depends on the direction to the tag. So the hypothesis of another position competes with that of an offset, by
their likelihoods.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from uwb_mitigation.calibration.first_positions import first_positions
from uwb_mitigation.calibration.joint_fit import (
    FAR_S,
    JointFit,
    Observations,
    Start,
    fit_joint,
    observations_of,
)
from uwb_mitigation.calibration.motion_segments import GAP_S, Segments
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.geometry import AnchorRank, Area, Height, anchor_rank, unit_vectors
from uwb_mitigation.positioning.noise_model import MAD_TO_SD, Regressors
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Ranges, Track, TruePath

MISPLACED_M = 0.4
"""A smaller displacement looks like reflections."""

MIN_LOSS_GAIN = 12.0
"""The log likelihood by which another position must explain the ranges better than an offset."""

LARGER = 0.35
"""The share of the misfit that two swapped anchors must also explain."""

STANDS_OUT = 1.5
"""The gain of a displaced anchor relative to the next one: obstacles make several anchors look displaced."""

HEIGHTS_M = np.array([-2.0, -1.5, -1.0, 1.0, 1.5, 2.0])
"""Changes of the height that are tried. Ranges that obstacles lengthen often fit a height better that is wrong by 0.5 m."""

HEIGHT_GAIN = 0.12
"""The share of the misfit that another height must explain, in addition to `MIN_LOSS_GAIN`: ranges to anchors above the tag
that obstacles lengthen also fit a lower tag better. Simulated: at most 0.09 with the right height, 0.18 or more if it is wrong
by 1.5 m."""

MISFIT_M, MISFIT_SHARE = 0.5, 0.08
"""Swaps are examined if this share of the ranges has larger residuals."""

MAX_MISFIT_SHARE = 0.5
"""If a larger share has such residuals, the track is wrong. Simulated: at most 0.11 of the ranges of drives and placements, 0.67 or
more of those of placements that are recorded as one drive."""

MAX_SUSPECTS = 6
"""Only the anchors with the largest residuals are examined for swaps: all pairs of 24 anchors would take minutes."""

MOVES_M = 1.0
MIN_INDEPENDENT = 20
"""Independent ranges in addition to those that the positions at rest need."""

MIRRORED = 4.5
"""Mirror images cannot be distinguished if their likelihoods differ by a factor of less than e^4.5."""

MAX_REFITS = 8
MAX_GROUPS = 5

INDEPENDENT_S = 2.0
"""Range errors of an anchor within this time count as one independent error."""

MIN_GROUPS = 8
"""An anchor with fewer independent errors is not examined."""

MIN_SD_M = 0.1
MAX_ANCHOR_RANGES = 2000

MIN_MEAN_GAIN = 0.1
"""Reduction of the mean loss of a range by two swapped anchors, in addition to `LARGER`."""

_FIX = "their true positions in the anchors file (`uwb-mitigation survey` finds them)"
_NO_POSITION_LOSS = 6.0
_DISPLACEMENT_SD_M = 2.0
_STEPS = 6
_MAX_RANGES = 1000


def detect_anchor_errors(
    anchors: AnchorMap, used: NDArray[np.intp], height: Height | None, area: Area | None = None
) -> None:
    """Refuse anchors that do not determine positions and offsets.

    Args:
        anchors: anchors of the file.
        used: rows of the received anchors.
        height: height of the tags, if constant.
        area: of the tags; it can exclude the mirror image of a track at a plane of anchors.

    Raises:
        DatasetError: too few, or all on a line (without a height: in a plane).
    """
    needed = 4 if height is not None else 5
    if len(used) < needed:
        raise DatasetError(
            f"{len(used)} anchors were received",
            valid=f"{needed} or more" + (", or four and --height" if height is None else ""),
        )
    position = anchors.position[used]
    if height is not None:
        position = position * (1.0, 1.0, 0.0)
    kind = anchor_rank(position)
    if kind in (AnchorRank.POINT, AnchorRank.LINE):
        raise DatasetError("the anchors are all on a line", valid="one or more that are not on this line")
    if height is None and area is None and kind is AnchorRank.PLANE:
        raise DatasetError(
            "the anchors are all in a plane: the mirror image of the track explains the ranges equally well",
            valid="--height of the tag, --area on one side of the plane, or an anchor above or below that plane",
        )


def check_motion(fit: JointFit) -> None:
    """Refuse recordings in which positions and offsets cannot be separated.

    Raises:
        DatasetError: the tags do not move enough, or there are too few independent ranges.
    """
    spread = float(np.linalg.norm(np.ptp(fit.position, axis=0)))
    if spread < MOVES_M:
        raise DatasetError(
            f"the tag moves by {spread:.1f} m only: its position and the offset cannot be separated",
            valid=f"a drive of {MOVES_M:g} m or more, or tags at several positions",
        )
    independent = float(fit.observations.independent.sum())
    needed = MIN_INDEPENDENT + 1.5 * fit.config.dims * int(fit.observations.is_stationary.sum())
    if independent < needed:
        raise DatasetError(
            f"{len(fit.observations.observation_index)} ranges, {independent:.0f} of them independent: too few",
            valid=f"{needed:.0f} or more: a longer drive, or more anchors at each position",
        )


def mirrored(fit: JointFit) -> NDArray[np.bool_]:
    """Return which segments have a mirror image beyond the anchors that explains the ranges equally well, bool (s,)."""
    config, observations = fit.config, fit.observations
    used = config.anchors.position[np.unique(observations.anchor)]
    axes = slice(0, config.dims)
    centre = used.mean(axis=0)
    normal = np.zeros(3)
    normal[axes] = np.linalg.svd(used[:, axes] - centre[axes])[2][-1]
    image = fit.position - 2.0 * ((fit.position - centre) @ normal)[:, None] * normal
    corrected = observations.range_m - observations.rows @ fit.parameters
    try:
        refit = fit.positions_only(corrected, Start(image))
    except DatasetError:
        return np.zeros(len(fit.segment_loss), np.bool_)
    is_distinct = np.linalg.norm(refit.position - fit.position, axis=1) > MOVES_M
    if config.area is not None:
        is_distinct &= config.area.holds(refit.position)
    distinct_share = np.bincount(observations.knot_segment, is_distinct) / np.bincount(
        observations.knot_segment
    )
    return (refit.segment_loss - fit.segment_loss < MIRRORED) & (distinct_share > 0.5)


def check_height(fit: JointFit) -> None:
    """Refuse a height with which the ranges fit much worse than with another one.

    Raises:
        DatasetError: gives the better height.
    """
    config, height = fit.config, fit.config.height
    if height is None:
        return
    best_gain, best_m = max(MIN_LOSS_GAIN, HEIGHT_GAIN * fit.loss), height.value
    for change_m in HEIGHTS_M[np.abs(HEIGHTS_M) > 3.0 * height.sd].tolist():
        changed = replace(config, height=replace(height, value=height.value + change_m))
        try:
            refit = fit_joint(changed, fit.observations, fit.prior, fit.start(), fit.scale_m)
        except DatasetError:
            continue
        if fit.loss - refit.loss > best_gain:
            best_gain, best_m = fit.loss - refit.loss, height.value + change_m
    if best_m != height.value:
        raise DatasetError(
            f"the height of {height.value:g} m contradicts the ranges: they fit a height of about {best_m:g} m much better",
            valid="the height of the tag's antenna in the coordinates of the anchors",
        )


def check_anchor_positions(segments: Segments, fit: JointFit) -> None:
    """Refuse ranges that other anchor positions explain much better.

    Args:
        segments: ranges of the solution.
        fit: solution with the positions of the file.

    Raises:
        DatasetError: names the anchors; or most ranges contradict the track.
    """
    observations = fit.observations
    misfit = float(
        (observations.independent * (np.abs(fit.residual_m) > MISFIT_M)).sum()
        / observations.independent.sum()
    )
    if misfit > MISFIT_SHARE:
        loss = fit.config.model.loss(fit.residual_m / fit.scale_m[observations.noise_group])
        by_anchor = np.bincount(observations.anchor, loss * observations.independent)
        check_swapped(segments, fit.config, fit.prior, fit.scale_m, np.argsort(by_anchor)[::-1])
    if misfit > MAX_MISFIT_SHARE:
        raise DatasetError(
            f"{misfit:.0%} of the ranges contradict the estimated track by more than {MISFIT_M:g} m",
            valid=f"a drive, or pauses of more than {GAP_S:g} s between the positions of a carried tag; the anchors file of this "
            "site",
        )
    displaced = {
        row: (gain, moved_m)
        for row in np.unique(observations.anchor).tolist()
        for moved_m, gain in [_displaced(row, segments, fit)]
        if moved_m > MISPLACED_M and gain > MIN_LOSS_GAIN
    }
    gains = sorted(gain for gain, _ in displaced.values())
    if not gains or (len(gains) > 1 and gains[-1] < STANDS_OUT * gains[-2]):
        return
    row = max(displaced, key=displaced.__getitem__)
    raise DatasetError(
        f"anchor {fit.config.anchors.anchors[row]} contradicts the others: {displaced[row][1]:.1f} m from its position in the "
        "anchors file, it explains the ranges",
        valid=_FIX,
    )


def check_swapped(
    segments: Segments,
    config: EstimatorConfig,
    prior: Regressors,
    scale_m: NDArray[np.float64],
    suspects: NDArray[np.intp],
) -> None:
    """Refuse two anchors whose exchange explains the ranges much better.

    Args:
        segments: ranges.
        config: anchors, noise model, height and area.
        prior: parameters of the ranges.
        scale_m: float64 (g,), of the residuals.
        suspects: rows of anchors; the first `MAX_SUSPECTS` are examined, if they were received.

    Raises:
        DatasetError: names them.
    """
    order = np.arange(len(config.anchors))
    trial = _SwapTrial(segments, config, prior, scale_m)
    limit = (1.0 - LARGER) * trial.loss(order) - MIN_MEAN_GAIN
    best: tuple[int, int] | None = None
    examined = np.intersect1d(suspects[:MAX_SUSPECTS], segments.ranges.anchor)
    for a, b in itertools.combinations(examined.tolist(), 2):
        swapped = order.copy()
        swapped[[a, b]] = b, a
        if (value := trial.loss(swapped)) < limit:
            best, limit = (a, b), value
    if best is not None:
        first, second = (config.anchors.anchors[row] for row in best)
        raise DatasetError(
            f"anchors {first} and {second} contradict the others: swapped, they explain the ranges",
            valid=_FIX,
        )


class _SwapTrial:
    """The first ranges, to which the anchors are fitted in another order."""

    def __init__(
        self, segments: Segments, config: EstimatorConfig, prior: Regressors, scale_m: NDArray[np.float64]
    ) -> None:
        is_trial = np.arange(len(segments.ranges)) < _MAX_RANGES
        self._segments, self._prior = segments.select_ranges(is_trial), prior.select_rows(is_trial)
        self._config, self._scale_m = config, np.maximum(scale_m, 0.1)

    def loss(self, order: NDArray[np.intp]) -> float:
        """Return the mean loss of a range; a range without a position counts as an outlier."""
        anchors, segments, prior = self._config.anchors, self._segments, self._prior
        config = replace(self._config, anchors=anchors.moved(anchors.position[order], anchors.sd))
        position, has_position = first_positions(config, segments, prior.rows @ prior.mean)
        if not has_position.any():
            return _NO_POSITION_LOSS
        ranges_with_position = has_position[segments.segment]
        prior = prior.select_rows(ranges_with_position)
        observations = observations_of(segments.select(has_position), prior, config.model)
        try:
            refit = fit_joint(config, observations, prior, Start(position), self._scale_m)
        except DatasetError:
            return _NO_POSITION_LOSS
        used = float(ranges_with_position.mean())
        return used * refit.loss / float(observations.independent.sum()) + (1.0 - used) * _NO_POSITION_LOSS


def _displaced(row: int, segments: Segments, fit: JointFit) -> tuple[float, float]:
    """Return the displacement of the anchor that explains the ranges best, m, and the gain in log likelihood."""
    config, has_column = fit.config, np.array([name != f"anchor {row}" for name in fit.prior.names])
    base, anchors = fit.prior.select_columns(has_column), fit.config.anchors
    observations = observations_of(segments, base, config.model)
    is_of_anchor = (observations.anchor == row)[:, None]
    position, parameters, displaced = fit.position, fit.parameters[has_column], anchors
    gain, axes = 0.0, slice(0, 2)
    try:
        for iteration in range(_STEPS):
            tag = position[observations.knot] + observations.relative_height[:, None] * (0.0, 0.0, 1.0)
            unit, _ = unit_vectors(tag, displaced.position[observations.anchor])
            rows = np.concatenate([observations.rows, -unit[:, axes] * is_of_anchor], axis=1)
            shift = displaced.position[row, axes] - anchors.position[row, axes]
            prior = replace(
                base,
                mean=np.concatenate([base.mean, -shift]),
                sd=np.concatenate([base.sd, np.full(2, _DISPLACEMENT_SD_M)]),
            )
            refit = fit_joint(
                replace(config, anchors=displaced),
                replace(observations, rows=rows),
                prior,
                Start(position, np.concatenate([parameters, np.zeros(2)]), is_close=True, is_prior=True),
                fit.scale_m,
            )
            position, parameters, step = refit.position, refit.parameters[:-2], refit.parameters[-2:]
            anchor_position = displaced.position.copy()
            anchor_position[row, axes] += step
            displaced = displaced.moved(anchor_position, displaced.sd)
            gain = fit.loss - refit.loss
            if float(np.abs(step).max()) < 0.02 or (iteration == 0 and gain < 0.5 * MIN_LOSS_GAIN):
                break
    except DatasetError:
        return 0.0, 0.0
    return float(np.linalg.norm(displaced.position[row] - anchors.position[row])), gain


def position_scatter(fit: JointFit, correction_m: NDArray[np.float64]) -> float:
    """Return the error of the horizontal positions without ground truth, RMSE in m: the jackknife over the anchors.

    Errors of ranges that contradict each other move the track when an anchor is left out. An error that all anchors have in
    common is not detected.

    Args:
        fit: solution of n ranges.
        correction_m: float64 (n,), subtracted from each range.

    Returns:
        NaN if too few anchors remain.
    """
    used = np.unique(fit.observations.anchor)
    groups = min(MAX_GROUPS, len(used))
    anchor_groups = [used[k::groups] for k in range(groups)]
    if len(used) - max(map(len, anchor_groups)) < fit.config.dims + 1:
        return float("nan")
    tracks = np.array([fit.without_anchors(rows, correction_m).position[:, :2] for rows in anchor_groups])
    squared = np.sum((tracks - tracks.mean(axis=0)) ** 2, axis=(0, 2))
    return float(np.sqrt(squared.mean() * (groups - 1) / groups))


def leave_one_out_residual(fit: JointFit) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return for each range the distance of its anchor from the other anchors' track, and its standard deviation."""
    observations, used = fit.observations, np.unique(fit.observations.anchor)
    distance, sd = np.full(len(observations), np.nan), np.full(len(observations), np.nan)
    # With many anchors, leave out several together: enough remain.
    for anchor_group in (used[k::MAX_REFITS] for k in range(min(MAX_REFITS, len(used)))):
        try:
            refit = fit.without_anchors(anchor_group, observations.rows @ fit.parameters)
            covariance = refit.covariances()
        except DatasetError:
            continue
        mask = np.isin(observations.anchor, anchor_group)
        received = np.zeros(len(observations.time_s), np.bool_)
        received[observations.knot[~mask]] = True
        knot = observations.knot[mask]
        tag = refit.position[knot] + observations.ahead_s[mask][:, None] * refit.velocity[knot]
        tag[:, 2] += observations.relative_height[mask]
        unit, distance[mask] = unit_vectors(tag, fit.config.anchors.position[observations.anchor[mask]])
        sd_of_group = np.sqrt(np.einsum("ni,nij,nj->n", unit, covariance[knot], unit))
        sd_of_group[~(_gap_s(observations, received)[knot] <= FAR_S)] = np.nan
        sd[mask] = sd_of_group
    return distance[observations.observation_index], sd[observations.observation_index]


def _gap_s(observations: Observations, received: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the time from each knot to the nearest one of its segment that still has ranges; inf without one."""
    # Segments are moved so far apart that none is near another.
    time = observations.time_s + observations.knot_segment * (
        float(observations.time_s.max(initial=0.0)) + 1e6
    )
    received_time = time[received]
    if not len(received_time):
        return np.full(len(time), np.inf)
    last = len(received_time) - 1
    after = np.searchsorted(received_time, time).clip(min(1, last), last)
    nearest: NDArray[np.float64] = np.minimum(
        np.abs(time - received_time[after]), np.abs(time - received_time[np.maximum(after - 1, 0)])
    )
    return nearest


@dataclass(frozen=True, slots=True, eq=False)
class AnchorRanges:
    """The ranges of one anchor.

    Attributes:
        antenna: (n, 3), position of the tag, m. range_m: (n,). tag: int (n,).
        weight: the number of independent errors, divided by n.
    """

    antenna: NDArray[np.float64]
    range_m: NDArray[np.float64]
    tag: NDArray[np.intp]
    weight: float

    def residual_m(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the error of each range to an anchor at `position` minus the median of its tag."""
        error: NDArray[np.float64] = self.range_m - np.linalg.norm(self.antenna - position, axis=1)
        for tag in np.unique(self.tag):
            error[self.tag == tag] -= np.median(error[self.tag == tag])
        return error

    def sd_m(self, position: NDArray[np.float64]) -> float:
        """Return the robust standard deviation of the errors for an anchor at `position`, m."""
        return max(MIN_SD_M, MAD_TO_SD * float(np.median(np.abs(self.residual_m(position)))))

    def loss(self, position: NDArray[np.float64], sd_m: float) -> float:
        """Return the negative log likelihood (Cauchy) for an anchor at `position`, with per-tag offsets."""
        return float(self.weight * np.log1p((self.residual_m(position) / sd_m) ** 2).sum())

    def best_displacement(self, position: NDArray[np.float64], sd_m: float) -> NDArray[np.float64]:
        """Return the horizontal displacement from `position` that fits the ranges best, m, shape (3,)."""
        solution = least_squares(
            lambda shift: self.residual_m(position + np.append(shift, 0.0)),
            np.zeros(2),
            loss="cauchy",
            f_scale=sd_m,
        )
        return np.append(solution.x, 0.0)


def is_displaced(
    anchors: AnchorMap, ranges: Ranges, row: int, track: Track, min_gain: float = MIN_LOSS_GAIN
) -> bool:
    """Return whether another position of an anchor explains its ranges to the track of the other anchors much better.

    An offset, or obstacles that lengthen some ranges, do not depend on the direction to the tag as a wrong position does.

    Args:
        anchors: anchors of the file.
        ranges: ranges of one tag.
        row: row of the anchor.
        track: track of the tag, estimated without this anchor.
        min_gain: of the log likelihood.
    """
    path = TruePath(track.stamp_ns, track.position)
    antenna = path.position_at(ranges.stamp_ns)
    is_used = np.isfinite(antenna).all(axis=1) & (ranges.anchor == row)
    by_anchor = _by_anchor(ranges, np.zeros(len(ranges), np.intp), antenna, is_used)
    if row not in by_anchor:
        return False
    anchor_ranges, position = by_anchor[row], anchors.position[row]
    shift = anchor_ranges.best_displacement(position, anchor_ranges.sd_m(position))
    # The noise at the better position: at the wrong one, the displacement itself would count as noise.
    sd_m = anchor_ranges.sd_m(position + shift)
    loss = anchor_ranges.loss(position, sd_m)
    gain = loss - anchor_ranges.loss(position + shift, sd_m)
    return float(np.linalg.norm(shift)) > MISPLACED_M and gain > max(min_gain, LARGER * loss)


def validate_anchor_map(
    anchors: AnchorMap,
    all_ranges: Ranges,
    tag: NDArray[np.intp],
    antenna: NDArray[np.float64],
    is_used: NDArray[np.bool_],
) -> None:
    """Raise an error if other anchor positions fit the ranges much better.

    Args:
        anchors: anchors of the file.
        all_ranges: r ranges.
        tag: int (r,), tag of each range.
        antenna: (r, 3), position of the tag's antenna at each range, m.
        is_used: bool (r,), whether the position is known and the range is not an outlier.

    Raises:
        DatasetError: names the anchors.
    """
    ranges = _by_anchor(all_ranges, tag, antenna, is_used)
    if not ranges:
        return
    position = {row: anchors.position[row] for row in ranges}
    residuals = [anchor_ranges.residual_m(position[row]) for row, anchor_ranges in ranges.items()]
    sd_m = max(MIN_SD_M, MAD_TO_SD * float(np.median(np.abs(np.concatenate(residuals)))))
    loss, shift_m, gain = dict[int, float](), dict[int, float](), dict[int, float]()
    for row, anchor_ranges in ranges.items():
        shift = anchor_ranges.best_displacement(position[row], sd_m)
        loss[row], shift_m[row] = anchor_ranges.loss(position[row], sd_m), float(np.linalg.norm(shift))
        gain[row] = loss[row] - anchor_ranges.loss(position[row] + shift, sd_m)
    suspects = [
        row
        for row in ranges
        if shift_m[row] > MISPLACED_M and gain[row] > max(MIN_LOSS_GAIN, LARGER * loss[row])
    ]
    swaps = []
    for a, b in itertools.combinations(suspects, 2):
        swapped_loss = ranges[a].loss(position[b], sd_m) + ranges[b].loss(position[a], sd_m)
        swap_gain = loss[a] + loss[b] - swapped_loss
        # Two free displacements always fit better than a swap, but only slightly better if the anchors are swapped.
        if swap_gain > (1.0 - LARGER) * (gain[a] + gain[b]):
            swaps.append((swap_gain, a, b))
    if swaps:
        first, second = (anchors.anchors[row] for row in max(swaps)[1:])
        raise DatasetError(
            f"anchors {first} and {second} contradict the localisation: the ranges fit if these anchors are swapped",
            valid=_FIX,
        )
    if suspects:
        row = max(suspects, key=gain.__getitem__)
        raise DatasetError(
            f"anchor {anchors.anchors[row]} contradicts the localisation: the ranges fit a position {shift_m[row]:.1f} m "
            "from that in the anchors file",
            valid=_FIX,
        )


def _by_anchor(
    ranges: Ranges, tag: NDArray[np.intp], antenna: NDArray[np.float64], is_used: NDArray[np.bool_]
) -> dict[int, AnchorRanges]:
    by_anchor = {}
    for row in np.unique(ranges.anchor).tolist():
        rows = np.flatnonzero(is_used & (ranges.anchor == row))
        group = ranges.stamp_ns[rows] // round(INDEPENDENT_S * 1e9)
        independent = len(np.unique(np.stack([group, tag[rows]]), axis=1).T) if len(rows) else 0
        if independent < MIN_GROUPS:
            continue
        rows = rows[:: math.ceil(len(rows) / MAX_ANCHOR_RANGES)]
        weight = min(1.0, independent / len(rows))
        by_anchor[row] = AnchorRanges(antenna[rows], ranges.range_m[rows], tag[rows], weight)
    return by_anchor
