"""Offsets of radios and other common parameters of ranges, estimated without ground truth from known anchors.

Parameters that geometry cannot separate are not estimated: an anchor, a tag or a pair gets its own offset only if this is
significant; otherwise all share one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.batch.anchor_errors import (
    check_anchor_positions,
    check_motion,
    detect_anchor_errors,
    leave_one_out_residual,
    mirrored,
    position_scatter,
)
from uwb_mitigation.positioning.batch.joint_fit import KNOT_S, SLOW_S, JointFit, fit_segments
from uwb_mitigation.positioning.batch.motion_segments import Segments, find_segments
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel, Regressors
from uwb_mitigation.positioning.online.initialization import CandidatePosition, candidate_positions
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig, TagEstimator
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Ranges, Track

MAX_COMMON_SD_M = 0.2
"""A common offset with a larger standard deviation is unknown: uncalibrated antenna delays differ by as much."""

SEVERAL = 3.0
"""An offset is subtracted only if it is at least this number of standard deviations away from zero."""

MODEL = NoiseModel(long=1.5, short=1.5)
"""Once offsets and predictions are subtracted, errors are as often too long as too short. Different thresholds would bias
the offsets."""

COMMON_SD_M, OWN_SD_M = 1.0, 0.3
"""Prior standard deviations of the common offset, and of own offsets about it."""

MIN_CONFIDENCE = 0.99
OBSERVABLE = 0.6
"""An own offset is estimated if its standard deviation is a smaller part of the scatter of such offsets."""

MAX_OWN_SD_M = 0.1
"""Standard deviation of the own offsets of radios of one kind (0.3 m at three sigma, Decawave APS014): their prior is not
wider."""

MAX_OWN_SCATTER_M = 0.2
"""Own offsets that differ more are not those of radios: obstacles or wrong anchor positions cause them."""

MIN_SHARE = 0.5
"""If a smaller share of the own offsets is observable, none is estimated."""

MIN_OWN_SD_M = 0.02

OFFSETS_M = np.arange(-1.0, 2.01, 0.5)
START_SD_M = 0.2
WINDOW_S = 0.5
MAX_WINDOWS = 12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SelfCalibration:
    """The result.

    Attributes:
        segments, fit: as in `joint_fit`. Parameters: `offset`, `anchor ROW`, `tag NUMBER`, `pair NUMBER ROW`, and the
            regressors'.
        level: `pair`, `anchor` or `one`: what has a separate offset.
        notes: messages about parameters that are not observable, and about ranges that were left out.
        tag_ids: of the tags.
        unobserved_m: the estimate of a common offset that is not significant and therefore not subtracted; 0: it is.
        own_sd_m: standard deviation of own offsets about the common one, for pairs that get the common one.
        pseudo_m, pseudo_sd_m: float64 (r,), in the order of `segments.ranges`: the distance of each range's anchor from the
            track of the *other* anchors, and its standard deviation; NaN: unknown.
        position_scatter_m: `position_scatter` of raw ranges, and of calibrated ones on held-out parts; NaN: unknown.
    """

    segments: Segments
    fit: JointFit
    level: str
    notes: tuple[str, ...] = ()
    tag_ids: tuple[int, ...]
    common_offset_m: float = 0.0
    individual_sd_m: float
    pseudo_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    pseudo_sd_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    position_scatter_m: tuple[float, float] = (np.nan, np.nan)

    def raw_only(self, left_out: NDArray[np.bool_]) -> SelfCalibration:
        """Fit the same parameters and tracks without some of `segments.ranges`, bool (r,); the pseudo-truth is unchanged.

        Raises:
            DatasetError: the other ranges do not determine them.
        """
        left_out_observations = np.ones(len(self.fit.observations), np.bool_)
        left_out_observations[self.fit.observations.of[~left_out]] = False
        return replace(self, fit=self.fit.without(left_out_observations))

    def value(self, name: str) -> tuple[float, float]:
        """Return a parameter and its standard deviation; (0, 0): it was not estimated."""
        if name not in self.fit.prior.names:
            return 0.0, 0.0
        at = self.fit.prior.names.index(name)
        return float(self.fit.parameters[at]), float(np.sqrt(self.fit.covariance[at, at]))

    def pair(self, tag: int, row: int) -> tuple[float, float]:
        """Return the offset of a tag (its number) and an anchor (its row), m, and its standard deviation."""
        at, sd = self._columns(tag, row), self.fit.config.anchors.sd
        # The error of an anchor's position looks like an offset. Averaged over all directions from which the tag received it,
        # about half of its variance remains.
        placed = sd[row] ** 2 / 2.0 if len(at) > 1 else np.mean(sd**2) / len(sd) + self.individual_sd_m**2
        variance = self.fit.covariance[np.ix_(at, at)].sum() + placed + self.common_offset_m**2
        return float(self.fit.parameters[at].sum()), float(np.sqrt(variance))

    def applied(self, tag: int, row: int) -> tuple[float, float]:
        """Return the offset to subtract from the ranges of a tag and an anchor, m, and its standard deviation.

        If the mean of all offsets is significant, it is the estimate. Otherwise only an offset that is significant by
        itself is subtracted, and the others are 0.
        """
        value, sd = self.pair(tag, row)
        if self.mean_is_significant or abs(value) >= SEVERAL * sd:
            return value, sd
        return 0.0, float(np.hypot(value, sd))

    @property
    def mean_is_significant(self) -> bool:
        """Whether the mean offset of all pairs is `SEVERAL` standard deviations away from zero."""
        value, sd = self.mean()
        return abs(value) >= SEVERAL * sd

    def mean(self) -> tuple[float, float]:
        """The mean offset of all pairs, m, and its standard deviation."""
        pairs, sd = self.pairs(), self.fit.config.anchors.sd
        rows = np.zeros((len(pairs), len(self.fit.parameters)))
        for number, (tag, row) in enumerate(pairs):
            rows[number, self._columns(tag, row)] = 1.0
        of_mean = rows.mean(axis=0)
        placed = float(np.mean(sd**2)) / 2.0 / len(sd)
        variance = of_mean @ self.fit.covariance @ of_mean + placed + self.common_offset_m**2
        return float(of_mean @ self.fit.parameters), float(np.sqrt(variance))

    def _columns(self, tag: int, row: int) -> list[int]:
        """The parameters that are added to the ranges of a tag and an anchor."""
        wanted = {"offset", f"anchor {row}", f"tag {tag}", f"pair {tag} {row}"}
        return [i for i, name in enumerate(self.fit.prior.names) if name in wanted]

    def pairs(self) -> list[tuple[int, int]]:
        """Return (tag number, anchor row) of all pairs with ranges."""
        found = np.unique(np.stack([self.segments.tag, self.segments.ranges.anchor]), axis=1).T
        return [(int(tag), int(row)) for tag, row in found]


def self_calibrate(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    regressors: Regressors | None = None,
    *,
    height: Height | None = None,
    area: Area | None = None,
    heights_m: NDArray[np.float64] | None = None,
    height_sd_m: float = 0.1,
) -> SelfCalibration:
    """Estimate tracks, offsets and regressors.

    Args:
        anchors: their positions.
        tags: the ranges of each tag, in the order of time. A tag that is carried between several positions without ranging
            needs a pause of more than `GAP_S` there, or an id of its own for each position.
        regressors: as many rows as there are ranges.
        height: of all tags, if constant.
        area: of the tags.
        heights_m: measured height at each range, float64 (r,), m, instead of `height`.
        height_sd_m: standard deviation of `heights_m`, m.

    Raises:
        DatasetError: the geometry does not determine the solution; the message says what is missing.
    """
    if heights_m is not None:
        # Initial positions are found with the median height.
        height = Height(float(np.median(heights_m)), max(float(np.std(heights_m)), height_sd_m))
    config = EstimatorConfig(anchors, MODEL, height, area)
    known = regressors or Regressors.none(sum(map(len, tags)))
    detect_anchor_errors(anchors, np.unique(np.concatenate([one.anchor for one in tags])), height, area)
    notes: list[str] = []
    found = find_segments(tags)
    of_range = np.cumsum([0, *map(len, tags)])[found.tag] + found.row
    known = known.take(of_range)
    if heights_m is not None and height is not None:
        found = replace(found, relative_height=heights_m[of_range] - height.value)
    expected = known.rows @ known.mean
    offset = likely_offset(config, found, expected)
    position, placed = first_positions(config, found, expected + offset)
    if heights_m is not None and height is not None:
        # The spread of the heights was for the initial positions: each height has the accuracy of its measurement.
        config = replace(config, height=Height(height.value, height_sd_m))
    if not placed.all():
        notes.append(
            f"{int((~placed).sum())} of {len(placed)} segments left out: no position of the tag can be determined"
        )
    if not placed.any():
        raise DatasetError(
            "no position of a tag can be determined",
            valid="four anchors or more that receive a tag at once, --height or --area",
        )
    kept = placed[found.of]
    common = Regressors.one("offset", np.ones(len(kept)), offset, COMMON_SD_M)
    shared = replace(common.joined(known), noise_group=known.noise_group).take(kept)
    found = found.keep(placed)
    # The positions contain no knots of segments that were left out.
    fit = fit_segments(config, found, shared, position)
    ambiguous = mirrored(fit)
    if ambiguous.all():
        raise DatasetError(
            "the track has two mirror images, and either explains the ranges equally well",
            valid="--height or --area to choose one, or an anchor that is not on the others' line (above or below their plane)",
        )
    if ambiguous.any():
        notes.append(
            f"{int(ambiguous.sum())} of {len(ambiguous)} segments left out: their mirror images fit equally well"
        )
        position = fit.position[~ambiguous[fit.observations.knot_segment]]
        shared, found = shared.take(~ambiguous[found.of]), found.keep(~ambiguous)
        fit = fit_segments(config, found, shared, position)
    check_motion(fit)
    common_sd = float(np.sqrt(fit.covariance[0, 0]))
    level, own_sd = "one", 0.0
    # Without the common offset the true ranges are unknown: own offsets would contain its error.
    for group, members in candidates(found) if common_sd <= MAX_COMMON_SD_M else []:
        better, unobservable, sd_of_group = with_own_offsets(found, fit, members)
        if group == "anchor":
            own_sd = sd_of_group
        if better is None:
            notes.append(f"own offsets of {group}s are not significant, so that all share one")
            break
        before, after = _held_out_scatter(fit), _held_out_scatter(better)
        if after > before:
            notes.append(
                f"own offsets of {group}s: positions without one anchor scatter by {after:.3f} m with them, by "
                f"{before:.3f} m without them, so that all share one"
            )
            break
        fit, level = better, "pair" if group != "anchor" else "anchor"
        if unobservable:
            names = ", ".join(_with_ids(name, anchors, tags) for name in unobservable)
            notes.append(
                f"{names}: their own offsets are not significant, so that they get the common offset"
            )
    if level == "anchor" and len(np.unique(found.tag)) == 1:
        # With one tag, the offset of an anchor is that of the pair.
        level = "pair"
    fit = fit_segments(config, found, fit.prior, fit.position, fit.parameters)
    check_anchor_positions(found, fit, first_positions)
    ids = tuple(one.tag_id for one in tags)
    result = SelfCalibration(segments=found, fit=fit, level=level, tag_ids=ids, individual_sd_m=own_sd)
    if common_sd > MAX_COMMON_SD_M or not any(result.applied(*pair)[0] for pair in result.pairs()):
        value, sd = result.mean()
        notes.append(
            f"the offset is not significant, so that no offset is subtracted: {value:.2f} m with a standard deviation of "
            f"{sd:.2f} m. Drive between the anchors, not only past them"
        )
        zero = replace(shared, mean=np.append(0.0, shared.mean[1:]), sd=np.append(1e-4, shared.sd[1:]))
        start = np.append(0.0, fit.parameters[1 : len(zero.names)])
        fit = fit_segments(config, found, zero, fit.position, start)
        result = replace(result, fit=fit, level="one", common_offset_m=float(np.hypot(value, sd)))
    pseudo, pseudo_sd = leave_one_out_residual(fit)
    scatter = position_scatter(fit, np.zeros(len(fit.observations))), _held_out_scatter(fit)
    return replace(
        result, notes=tuple(notes), pseudo_m=pseudo, pseudo_sd_m=pseudo_sd, position_scatter_m=scatter
    )


def _held_out_scatter(fit: JointFit) -> float:
    """Return the scatter of positions, with parameters from the other half of the drive."""
    observations = fit.observations
    block = (observations.time_s[observations.knot] // SLOW_S).astype(int) + observations.segment
    correction = np.zeros(len(observations))
    for half in range(2):
        held_out, parameters = block % 2 == half, fit.parameters
        if held_out.any() and not held_out.all():
            parameters = fit.without(held_out).parameters
        correction[held_out] = observations.rows[held_out] @ parameters
    return position_scatter(fit, correction)


def candidates(found: Segments) -> list[tuple[str, dict[str, NDArray[np.bool_]]]]:
    """Return candidates for separate offsets in the order of their tests: {name: which ranges}."""
    row, tag = found.ranges.anchor, found.tag
    tried = [("anchor", {f"anchor {one}": row == one for one in np.unique(row).tolist()})]
    # The offset of a tag that stays at one position can hardly be separated from this position.
    num_segments = {one: len(np.unique(found.of[tag == one])) for one in np.unique(tag).tolist()}
    several = [
        one
        for one, count in num_segments.items()
        if count > 1 or not found.is_stationary[found.of[tag == one][0]]
    ]
    if len(several) > 1:
        tried.append(("tag", {f"tag {one}": tag == one for one in several}))
        pairs = {
            f"pair {one} {anchor}": (tag == one) & (row == anchor)
            for one in several
            for anchor in np.unique(row[tag == one]).tolist()
        }
        tried.append(("pair", pairs))
    return tried


def with_own_offsets(
    found: Segments, fit: JointFit, members: dict[str, NDArray[np.bool_]]
) -> tuple[JointFit | None, list[str], float]:
    """Add offsets of these groups of ranges to a fit, if they are significant.

    Empirical Bayes: the scatter of the offsets beyond their own uncertainty is their prior standard deviation.

    Returns:
        The fit with own offsets (None: not significant), the names of those that are not observable, and their scatter
        in m, which is also the error of the common offset as a replacement of an own one.
    """
    count = len(members)

    def with_groups(names: list[str], sd: float) -> JointFit:
        rows, zero = np.column_stack([members[name].astype(float) for name in names]), np.zeros(len(names))
        own = Regressors(tuple(names), rows, zero, np.full(len(names), sd), fit.prior.noise_group)
        start = np.append(fit.parameters, zero)
        return fit_segments(fit.config, found, fit.prior.joined(own), fit.position, start, near=True)

    trial = with_groups(list(members), OWN_SD_M)
    # Deviations from their mean: the mean is the common offset.
    centred = np.eye(count) - 1.0 / count
    own = centred @ trial.parameters[-count:]
    variance = np.diag(centred @ trial.covariance[-count:, -count:] @ centred)
    # The estimate without the prior.
    prior = OWN_SD_M**2 * (1.0 - 1.0 / count)
    alone = 1.0 / np.maximum(1.0 / variance - 1.0 / prior, 1e-9)
    free = own * alone / variance
    excess = float(np.sum(free**2 / alone))
    scatter = float(np.sum((free**2 - alone) / alone**2) / np.sum(1.0 / alone**2))
    sd = float(np.sqrt(max(scatter, 0.0)))
    is_significant = excess >= chi2.ppf(MIN_CONFIDENCE, max(count - 1, 1))
    if not is_significant or not MIN_OWN_SD_M**2 <= scatter <= MAX_OWN_SCATTER_M**2:
        return None, [], sd
    sd = min(sd, MAX_OWN_SD_M)
    observable = np.sqrt(1.0 / (1.0 / alone + 1.0 / sd**2)) < OBSERVABLE * sd
    if observable.mean() < MIN_SHARE:
        return None, [], sd
    names = [name for name, is_observable in zip(members, observable, strict=True) if is_observable]
    return with_groups(names, sd), [name for name in members if name not in names], sd


def likely_offset(config: EstimatorConfig, found: Segments, expected_m: NDArray[np.float64]) -> float:
    """Return the one of `OFFSETS_M` with which the ranges of a few moments agree best; 0 if no moment has enough ranges.

    Args:
        config: anchors, noise model, height and area.
        found: ranges, r in total.
        expected_m: float64 (r,), also subtracted from the ranges.
    """
    rng = np.random.default_rng(1)
    moments = []
    window = (found.ranges.stamp_ns - found.ranges.stamp_ns[0]) // round(WINDOW_S * NS_PER_S)
    key = np.where(found.is_stationary[found.of], -1 - found.of, window * len(found) + found.of)
    for one in rng.permutation(np.unique(key)).tolist():
        row, value = _medians(found.ranges, np.flatnonzero(key == one), expected_m)
        if len(row) > config.dims + 1:
            moments.append((row, value))
        if len(moments) == MAX_WINDOWS:
            break
    if not moments:
        return 0.0
    loss = np.zeros(len(OFFSETS_M))
    for row, value in moments:
        for k, offset in enumerate(OFFSETS_M.tolist()):
            possible = _candidate_positions(config, row, value - offset)
            loss[k] += possible[0].loss if possible else 50.0
    return float(OFFSETS_M[int(np.argmin(loss))])


def first_positions(
    config: EstimatorConfig, found: Segments, expected_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return initial positions float64 (K, 3) at the knots of the segments that have any; which these are, bool (s,)."""
    position: list[NDArray[np.float64]] = []
    placed = np.zeros(len(found), np.bool_)
    edges = np.searchsorted(found.of, np.arange(len(found) + 1))
    for number in range(len(found)):
        own = np.arange(edges[number], edges[number + 1])
        if found.is_stationary[number]:
            row, value = _medians(found.ranges, own, expected_m)
            possible = _candidate_positions(config, row, value) if len(row) > config.dims else []
            if possible:
                position.append(possible[0].position[None])
                placed[number] = True
            continue
        ranges = found.ranges.take(own)
        better = replace(ranges, range_m=np.maximum(ranges.range_m - expected_m[own], 0.0))
        track = TagEstimator(config).run(better)
        if len(track) >= 2:
            position.append(_at_knots(track, ranges))
            placed[number] = True
    return np.concatenate(position) if position else np.zeros((0, 3)), placed


def _candidate_positions(
    config: EstimatorConfig, row: NDArray[np.intp], range_m: NDArray[np.float64]
) -> list[CandidatePosition]:
    where, sd = config.anchors.position[row], np.full(len(row), START_SD_M)
    return candidate_positions(where, range_m, sd, config.model, height=config.height, area=config.area)


def _at_knots(track: Track, ranges: Ranges) -> NDArray[np.float64]:
    since = (ranges.stamp_ns - ranges.stamp_ns[0]) / NS_PER_S
    knots = np.unique(np.rint(since / KNOT_S).astype(np.int64)) * KNOT_S
    own = (track.stamp_ns - ranges.stamp_ns[0]) / NS_PER_S
    return np.stack([np.interp(knots, own, axis) for axis in track.position.T], axis=1)


def _medians(
    ranges: Ranges, rows: NDArray[np.intp], expected_m: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the anchors received in `rows`, and the median corrected range of each."""
    value = ranges.range_m[rows] - expected_m[rows]
    received = np.unique(ranges.anchor[rows])
    return received, np.array([np.median(value[ranges.anchor[rows] == one]) for one in received])


def _with_ids(name: str, anchors: AnchorMap, tags: Sequence[Ranges]) -> str:
    """Return the name of an own offset, with the ids of tag and anchor instead of their numbers."""
    kind, *numbers = name.split()
    if kind == "anchor":
        return f"anchor {anchors.anchors[int(numbers[0])]}"
    if kind == "tag":
        return f"tag {tags[int(numbers[0])].tag_id}"
    return f"tag {tags[int(numbers[0])].tag_id} and anchor {anchors.anchors[int(numbers[1])]}"
