"""Offsets of radios and other common parameters of ranges, estimated without ground truth from known anchors.

Parameters that geometry cannot separate are not estimated: an anchor, a tag or a pair gets its own offset only if this is
significant; otherwise all share one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from uwb_mitigation.calibration.anchor_errors import (
    check_anchor_positions,
    check_height,
    check_motion,
    check_swapped,
    detect_anchor_errors,
    leave_one_out_residual,
    mirrored,
    position_scatter,
)
from uwb_mitigation.calibration.first_positions import (
    START_SD_M,
    first_positions,
    likely_offset,
    suspects,
)
from uwb_mitigation.calibration.joint_fit import SLOW_S, JointFit, Start, fit_segments
from uwb_mitigation.calibration.motion_segments import Segments, find_segments
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel, Regressors
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Ranges

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

MIN_POSITION_SHARE = 0.5
"""If fewer ranges have a position, swapped anchors are examined."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SelfCalibration:
    """The result.

    Attributes:
        segments, fit: as in `joint_fit`. Parameters: `offset`, `anchor ROW`, `tag NUMBER`, `pair NUMBER ROW`, and the
            regressors'.
        level: `pair`, `anchor` or `one`: what has a separate offset.
        notes: messages about parameters that are not observable, and about ranges that were left out.
        tag_ids: of the tags.
        common_offset_m: size of a common offset that is not significant and therefore not subtracted; 0: it is.
        individual_sd_m: standard deviation of own offsets about the common one, for pairs that get the common one.
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
        left_out_observations[self.fit.observations.observation_index[~left_out]] = False
        return replace(self, fit=self.fit.without(left_out_observations))

    def value(self, name: str) -> tuple[float, float]:
        """Return a parameter and its standard deviation; (0, 0): it was not estimated."""
        if name not in self.fit.prior.names:
            return 0.0, 0.0
        column = self.fit.prior.names.index(name)
        return float(self.fit.parameters[column]), float(np.sqrt(self.fit.covariance[column, column]))

    def pair(self, tag: int, row: int) -> tuple[float, float]:
        """Return the offset of a tag (its number) and an anchor (its row), m, and its standard deviation."""
        columns, sd = self._columns(tag, row), self.fit.config.anchors.sd
        # The error of an anchor's position looks like an offset. Averaged over all directions from which the tag received it,
        # about half of its variance remains.
        placed = (
            sd[row] ** 2 / 2.0 if len(columns) > 1 else np.mean(sd**2) / len(sd) + self.individual_sd_m**2
        )
        variance = self.fit.covariance[np.ix_(columns, columns)].sum() + placed + self.common_offset_m**2
        return float(self.fit.parameters[columns].sum()), float(np.sqrt(variance))

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
        weight = rows.mean(axis=0)
        placed = float(np.mean(sd**2)) / 2.0 / len(sd)
        variance = weight @ self.fit.covariance @ weight + placed + self.common_offset_m**2
        return float(weight @ self.fit.parameters), float(np.sqrt(variance))

    def _columns(self, tag: int, row: int) -> list[int]:
        """The parameters that are added to the ranges of a tag and an anchor."""
        names = {"offset", f"anchor {row}", f"tag {tag}", f"pair {tag} {row}"}
        return [i for i, name in enumerate(self.fit.prior.names) if name in names]

    def pairs(self) -> list[tuple[int, int]]:
        """Return (tag number, anchor row) of all pairs with ranges."""
        pairs = np.unique(np.stack([self.segments.tag, self.segments.ranges.anchor]), axis=1).T
        return [(int(tag), int(row)) for tag, row in pairs]


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
    extra = regressors or Regressors.none(sum(map(len, tags)))
    detect_anchor_errors(anchors, np.unique(np.concatenate([tag.anchor for tag in tags])), height, area)
    solver = _Solver(config, tags, extra, heights_m)
    if heights_m is not None and height is not None:
        # The spread of the heights was for the initial positions: each height has the accuracy of its measurement.
        solver.config = replace(config, height=Height(height.value, height_sd_m))
    fit = solver.fit_common_offset()
    level, fit, individual_sd = solver.with_own_offsets(fit)
    fit = fit_segments(solver.config, solver.segments, fit.prior, Start(fit.position, fit.parameters))
    solver.check_geometry(fit, has_constant_height=heights_m is None)
    result = SelfCalibration(
        segments=solver.segments,
        fit=fit,
        level=level,
        tag_ids=tuple(tag.tag_id for tag in tags),
        individual_sd_m=individual_sd,
    )
    if not any(result.applied(*pair)[0] for pair in result.pairs()) or solver.common_sd > MAX_COMMON_SD_M:
        result = solver.without_offset(result)
    pseudo, pseudo_sd = leave_one_out_residual(result.fit)
    raw_scatter_m = position_scatter(result.fit, np.zeros(len(result.fit.observations)))
    return replace(
        result,
        notes=tuple(solver.notes),
        pseudo_m=pseudo,
        pseudo_sd_m=pseudo_sd,
        position_scatter_m=(raw_scatter_m, _held_out_scatter(result.fit)),
    )


class _Solver:
    """The steps of `self_calibrate`.

    Attributes:
        config: anchors, noise model, height and area. segments: ranges whose positions can be determined.
        common: regressors of `segments`: the common offset, and the given ones.
        common_sd: standard deviation of the common offset, m.
        notes: messages about parameters that are not observable, and about ranges that were left out.
    """

    def __init__(
        self,
        config: EstimatorConfig,
        tags: Sequence[Ranges],
        extra: Regressors,
        heights_m: NDArray[np.float64] | None,
    ) -> None:
        self.config, self.notes, self.common_sd = config, list[str](), math.inf
        self._tags = tags
        self.segments = find_segments(tags)
        site_rows = np.cumsum([0, *map(len, tags)])[self.segments.tag] + self.segments.row
        extra = extra.select_rows(site_rows)
        if heights_m is not None and config.height is not None:
            relative_height = heights_m[site_rows] - config.height.value
            self.segments = replace(self.segments, relative_height=relative_height)
        expected = extra.rows @ extra.mean
        offset = likely_offset(config, self.segments, expected)
        self._position, has_position = first_positions(config, self.segments, expected + offset)
        common = Regressors.single("offset", np.ones(len(expected)), offset, COMMON_SD_M)
        self.common = replace(common.concat(extra), noise_group=extra.noise_group)
        used = float(has_position[self.segments.segment].mean())
        if used < MIN_POSITION_SHARE:
            scale_m = np.full(int(extra.noise_group.max(initial=0)) + 1, START_SD_M)
            rows = suspects(config, self.segments, expected + offset)
            check_swapped(self.segments, config, self.common, scale_m, rows)
        if not has_position.any():
            raise DatasetError(
                "no position of a tag can be determined",
                valid="four anchors or more that receive a tag at once, --height or --area",
            )
        if not has_position.all():
            self.notes.append(
                f"{int((~has_position).sum())} of {len(has_position)} segments left out: no position of the tag can be "
                "determined"
            )
        self._select(has_position)

    def _select(self, is_selected: NDArray[np.bool_]) -> None:
        self.common = self.common.select_rows(is_selected[self.segments.segment])
        self.segments = self.segments.select(is_selected)

    def fit_common_offset(self) -> JointFit:
        """Fit tracks and common parameters.

        Raises:
            DatasetError: the track is ambiguous, or position and offset cannot be separated.
        """
        # The positions contain no knots of segments that were left out.
        fit = fit_segments(self.config, self.segments, self.common, Start(self._position))
        ambiguous = mirrored(fit)
        if ambiguous.all():
            raise DatasetError(
                "the track has two mirror images, and either explains the ranges equally well",
                valid="--height or --area to choose one, or an anchor that is not on the others' line (above or below their "
                "plane)",
            )
        if ambiguous.any():
            self.notes.append(
                f"{int(ambiguous.sum())} of {len(ambiguous)} segments left out: their mirror images fit equally well"
            )
            position = fit.position[~ambiguous[fit.observations.knot_segment]]
            self._select(~ambiguous)
            fit = fit_segments(self.config, self.segments, self.common, Start(position))
        check_motion(fit)
        self.common_sd = float(np.sqrt(fit.covariance[0, 0]))
        return fit

    def with_own_offsets(self, fit: JointFit) -> tuple[str, JointFit, float]:
        """Add own offsets that are significant; return their level, the fit, and the scatter of those of the anchors, m."""
        level, individual_sd = "one", 0.0
        # Without the common offset the true ranges are unknown: own offsets would contain its error.
        groups = candidates(self.segments) if self.common_sd <= MAX_COMMON_SD_M else []
        for group, members in groups:
            extended, unobservable, sd = with_own_offsets(self.segments, fit, members)
            if group == "anchor":
                individual_sd = sd
            if extended is None:
                self.notes.append(f"own offsets of {group}s are not significant, so that all share one")
                break
            before, after = _held_out_scatter(fit), _held_out_scatter(extended)
            if after > before:
                self.notes.append(
                    f"own offsets of {group}s: positions without one anchor scatter by {after:.3f} m with them, by "
                    f"{before:.3f} m without them, so that all share one"
                )
                break
            fit, level = extended, "pair" if group != "anchor" else "anchor"
            if unobservable:
                names = ", ".join(_with_ids(name, self.config.anchors, self._tags) for name in unobservable)
                self.notes.append(
                    f"{names}: their own offsets are not significant, so that they get the common offset"
                )
        if level == "anchor" and len(np.unique(self.segments.tag)) == 1:
            # With one tag, the offset of an anchor is that of the pair.
            level = "pair"
        return level, fit, individual_sd

    def check_geometry(self, fit: JointFit, *, has_constant_height: bool) -> None:
        """Refuse anchor positions and heights that contradict the ranges.

        These hypotheses compete with that of an own offset of each anchor, whether significant or not.

        Raises:
            DatasetError: names the anchors, or the better height.
        """
        _, members = candidates(self.segments)[0]
        missing = {name: rows for name, rows in members.items() if name not in fit.prior.names}
        if missing:
            columns = own_offset_columns(missing, OWN_SD_M, fit.prior.noise_group)
            start = Start(fit.position, np.append(fit.parameters, np.zeros(len(missing))), is_close=True)
            fit = fit_segments(self.config, self.segments, fit.prior.concat(columns), start)
        check_anchor_positions(self.segments, fit)
        if has_constant_height:
            check_height(fit)

    def without_offset(self, result: SelfCalibration) -> SelfCalibration:
        """Return the solution with an offset of zero, because the estimate is not significant."""
        value, sd = result.mean()
        self.notes.append(
            f"the offset is not significant, so that no offset is subtracted: {value:.2f} m with a standard deviation of "
            f"{sd:.2f} m. Drive between the anchors, not only past them"
        )
        common, fit = self.common, result.fit
        zero = replace(common, mean=np.append(0.0, common.mean[1:]), sd=np.append(1e-4, common.sd[1:]))
        start = Start(fit.position, np.append(0.0, fit.parameters[1 : len(zero.names)]))
        fit = fit_segments(self.config, self.segments, zero, start)
        return replace(result, fit=fit, level="one", common_offset_m=float(np.hypot(value, sd)))


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


def candidates(segments: Segments) -> list[tuple[str, dict[str, NDArray[np.bool_]]]]:
    """Return candidates for separate offsets in the order of their tests: {name: which ranges}."""
    row, tag = segments.ranges.anchor, segments.tag
    tried = [("anchor", {f"anchor {anchor}": row == anchor for anchor in np.unique(row).tolist()})]
    # The offset of a tag that stays at one position can hardly be separated from this position.
    num_segments = {
        number: len(np.unique(segments.segment[tag == number])) for number in np.unique(tag).tolist()
    }
    several = [
        number
        for number, count in num_segments.items()
        if count > 1 or not segments.is_stationary[segments.segment[tag == number][0]]
    ]
    if len(several) > 1:
        tried.append(("tag", {f"tag {number}": tag == number for number in several}))
        pairs = {
            f"pair {number} {anchor}": (tag == number) & (row == anchor)
            for number in several
            for anchor in np.unique(row[tag == number]).tolist()
        }
        tried.append(("pair", pairs))
    return tried


def own_offset_columns(
    members: dict[str, NDArray[np.bool_]], sd: float, noise_group: NDArray[np.intp]
) -> Regressors:
    """Return an offset with prior standard deviation `sd`, m, for each group of ranges, {name: bool (n,)}."""
    rows = np.column_stack([mask.astype(float) for mask in members.values()])
    return Regressors(tuple(members), rows, np.zeros(len(members)), np.full(len(members), sd), noise_group)


def with_own_offsets(
    segments: Segments, fit: JointFit, members: dict[str, NDArray[np.bool_]]
) -> tuple[JointFit | None, list[str], float]:
    """Add offsets of these groups of ranges to a fit, if they are significant.

    Empirical Bayes: the scatter of the offsets beyond their own uncertainty is their prior standard deviation.

    Returns:
        The fit with own offsets (None: not significant), the names of those that are not observable, and their scatter
        in m, which is also the error of the common offset as a replacement of an own one.
    """
    count = len(members)

    def with_groups(names: list[str], sd: float) -> JointFit:
        columns = own_offset_columns({name: members[name] for name in names}, sd, fit.prior.noise_group)
        start = Start(fit.position, np.append(fit.parameters, np.zeros(len(names))), is_close=True)
        return fit_segments(fit.config, segments, fit.prior.concat(columns), start)

    trial = with_groups(list(members), OWN_SD_M)
    # Deviations from their mean: the mean is the common offset.
    centred = np.eye(count) - 1.0 / count
    deviation = centred @ trial.parameters[-count:]
    variance = np.diag(centred @ trial.covariance[-count:, -count:] @ centred)
    # The estimate without the prior.
    prior = OWN_SD_M**2 * (1.0 - 1.0 / count)
    alone = 1.0 / np.maximum(1.0 / variance - 1.0 / prior, 1e-9)
    free = deviation * alone / variance
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


def _with_ids(name: str, anchors: AnchorMap, tags: Sequence[Ranges]) -> str:
    """Return the name of an own offset, with the ids of tag and anchor instead of their numbers."""
    kind, *numbers = name.split()
    if kind == "anchor":
        return f"anchor {anchors.anchors[int(numbers[0])]}"
    if kind == "tag":
        return f"tag {tags[int(numbers[0])].tag_id}"
    return f"tag {tags[int(numbers[0])].tag_id} and anchor {anchors.anchors[int(numbers[1])]}"
