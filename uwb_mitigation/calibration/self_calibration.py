"""Offsets of radios and other common parameters of ranges, estimated without ground truth from known anchors.

Geometry separates offsets of anchors, tags and pairs only partly. Their prior is estimated from the same ranges (empirical
Bayes), so that what a drive does not determine is not far from the common offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.first_positions import first_positions, likely_offset
from uwb_mitigation.calibration.hypotheses import check_anchors, displacement_note
from uwb_mitigation.calibration.joint_fit import SD_INFLATION, JointFit, Start, fit_segments
from uwb_mitigation.calibration.motion_segments import Segments, find_segments
from uwb_mitigation.calibration.observability import check_height, check_layout, check_motion, mirrored
from uwb_mitigation.calibration.regression import Regressors
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import Area, Height, unit_vectors
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Ranges

MODEL = NoiseModel(long=1.5, short=1.5)
"""Once offsets and predictions are subtracted, errors are as often too long as too short. Different thresholds would bias
the offsets."""

RAW_MODEL = NoiseModel()
"""Obstacles only lengthen raw ranges: with these thresholds, walls look less like offsets of anchors. Without redundant anchors, they
bias the common offset more than walls do."""

MIN_REDUNDANT = 5
"""Anchors in addition to the dimensions of the position, from which offsets of single ones are used: with one to four, those that fit
walls increased the live error of another drive by up to 52 % (simulated sites, seeds 100 to 122)."""

COMMON_SD_M, OWN_SD_M = 1.0, 0.3
"""Prior standard deviations of the common offset, and of own offsets about it while their scatter is unknown."""

SCATTERS_M = np.geomspace(0.01, 0.5, 12)
"""Standard deviations of own offsets that are compared: radios of one kind have 0.1 m (0.3 m at three sigma, Decawave APS014),
and real deployments up to 0.3 m."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SelfCalibration:
    """The result.

    Attributes:
        segments, fit: as in `joint_fit`. Parameters: `offset`, `anchor ROW`, `tag NUMBER`, `pair NUMBER ROW`, and the
            regressors'.
        notes: messages about ranges that were left out.
        tag_ids: of the tags.
        has_redundant_anchors: whether there are enough anchors for offsets of single ones.
        antenna: float64 (r, 3), in the order of `segments.ranges`: where the tag was according to the *other* anchors, m, and
            `distance_sd_m`, float64 (r,), the standard deviation of its distance from the anchor; NaN: unknown.
    """

    segments: Segments
    fit: JointFit
    notes: tuple[str, ...]
    tag_ids: tuple[int, ...]
    antenna: NDArray[np.float64]
    distance_sd_m: NDArray[np.float64]
    has_redundant_anchors: bool

    @property
    def distance_m(self) -> NDArray[np.float64]:
        """The distance of each range's anchor from the track of the other anchors, float64 (r,); NaN: unknown."""
        anchor = self.fit.config.anchors.position[self.segments.ranges.anchor]
        return np.asarray(np.linalg.norm(self.antenna - anchor, axis=1), np.float64)

    def pairs(self) -> list[tuple[int, int]]:
        """Return (tag number, anchor row) of all pairs with ranges."""
        pairs = np.unique(np.stack([self.segments.tag, self.segments.ranges.anchor]), axis=1).T
        return [(int(tag), int(row)) for tag, row in pairs]

    def pair(self, tag: int, row: int) -> tuple[float, float]:
        """Return the offset of a tag (its number) and an anchor (its row), m, and its standard deviation."""
        return self._mean_of([(tag, row)])

    def mean(self) -> tuple[float, float]:
        """The mean offset of all pairs, m, and its standard deviation."""
        return self._mean_of(self.pairs())

    def displacement(self) -> tuple[float, float]:
        """Return the part of the differences of the offsets that a displacement of the whole track explains, and its standard deviation.

        Both are root mean squares over the pairs, m. Seen from the middle of the anchors, each of them is always in about the same
        direction, so that offsets and a displacement of the track have nearly the same effect.
        """
        pairs, positions, fit = self.pairs(), self.fit.config.anchors.position, self.fit
        directions = np.stack(
            [
                unit_vectors(fit.position, positions[row])[0].mean(axis=0)[: fit.config.dims]
                for _, row in pairs
            ]
        )
        directions -= directions.mean(axis=0)
        weights = self._weights(pairs)
        displaced = directions @ np.linalg.pinv(directions) @ (weights - weights.mean(axis=0))
        mean_square = np.mean((displaced @ fit.parameters) ** 2)
        variance = np.trace(displaced @ fit.covariance @ displaced.T) / len(pairs)
        return float(np.sqrt(mean_square)), float(np.sqrt(variance))

    def _weights(self, pairs: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
        """Return the weights of the q parameters in the offset of each pair, (p, q)."""
        return np.array(
            [
                [
                    name in ("offset", f"anchor {row}", f"tag {tag}", f"pair {tag} {row}")
                    for name in self.fit.prior.names
                ]
                for tag, row in pairs
            ],
            np.float64,
        )

    def _mean_of(self, pairs: Sequence[tuple[int, int]]) -> tuple[float, float]:
        """Return the mean of the offsets of pairs and its standard deviation, m."""
        weight = self._weights(pairs).mean(axis=0)
        # The error of an anchor's position looks like an offset. Averaged over all directions from which the tag received it,
        # about half of its variance remains.
        placed = self.fit.config.anchors.sd[[row for _, row in pairs]] ** 2 / 2.0
        variance = float(weight @ self.fit.covariance @ weight) + float(placed.sum()) / len(pairs) ** 2
        return float(weight @ self.fit.parameters), float(np.sqrt(variance))


def self_calibrate(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    regressors: Regressors | None = None,
    *,
    height: Height | None = None,
    area: Area | None = None,
    heights_m: NDArray[np.float64] | None = None,
    height_sd_m: float = 0.1,
    near_offset_m: float | None = None,
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
        near_offset_m: common offset from more ranges of the site, which did not contradict anchors and heights either; None: it
            is searched, and these are checked.

    Raises:
        DatasetError: the geometry does not determine the solution; the message says what is missing.
    """
    if heights_m is not None:
        # Initial positions are found with the median height.
        height = Height(float(np.median(heights_m)), max(float(np.std(heights_m)), height_sd_m))
    config = EstimatorConfig(anchors, MODEL, height, area)
    check_layout(anchors, np.unique(np.concatenate([tag.anchor for tag in tags])), height, area)
    segments = find_segments(tags)
    site_rows = np.cumsum([0, *map(len, tags)])[segments.tag] + segments.row
    extra = (regressors or Regressors.none(sum(map(len, tags)))).select_rows(site_rows)
    if heights_m is not None and height is not None:
        segments = replace(segments, relative_height=heights_m[site_rows] - height.value)
    expected_m = extra.rows @ extra.mean
    offset_m = likely_offset(config, segments, expected_m) if near_offset_m is None else near_offset_m
    start, has_position = first_positions(config, segments, expected_m + offset_m)
    prior = Regressors.single("offset", np.ones(len(site_rows)), offset_m, COMMON_SD_M)
    prior = replace(prior.concat(extra), noise_group=extra.noise_group)
    if heights_m is not None and height is not None:
        # The spread of the heights was for the initial positions: each height has the accuracy of its measurement.
        config = replace(config, height=Height(height.value, height_sd_m))
    segments, common, notes = _fit_common_offset(config, segments, prior, start, has_position)

    def solve(model: NoiseModel) -> SelfCalibration:
        fit = replace(common, config=replace(common.config, model=model))
        for members in own_offset_groups(segments):
            fit = with_own_offsets(segments, fit, members)
        antenna, sd_m = fit.leave_anchors_out(
            fit.observations.range_m - fit.observations.rows @ fit.parameters
        )
        index = fit.observations.observation_index
        return SelfCalibration(
            segments=segments,
            fit=fit,
            notes=tuple(notes),
            tag_ids=tuple(tag.tag_id for tag in tags),
            antenna=antenna[index],
            distance_sd_m=sd_m[index],
            has_redundant_anchors=has_redundant_anchors,
        )

    has_redundant_anchors = len(np.unique(segments.ranges.anchor)) >= config.dims + MIN_REDUNDANT
    is_raw = not extra.names and has_redundant_anchors
    if near_offset_m is None:
        # The limits of these checks are for equal thresholds.
        result = solve(MODEL)
        check_anchors(segments, result.fit, result.antenna)
        if extra.names and (note := displacement_note(result.fit)):
            result = replace(result, notes=(*result.notes, note))
        if heights_m is None:
            check_height(result.fit)
        if not is_raw:
            return result
    return solve(RAW_MODEL if is_raw else MODEL)


def _fit_common_offset(
    config: EstimatorConfig,
    segments: Segments,
    prior: Regressors,
    position: NDArray[np.float64],
    has_position: NDArray[np.bool_],
) -> tuple[Segments, JointFit, list[str]]:
    """Fit tracks and common parameters; return the segments whose positions are determined, the fit, and notes on the others.

    Args:
        config: anchors, noise model, height and area.
        segments: all segments.
        prior: common parameters of their ranges.
        position: initial positions, as `first_positions` returns them.
        has_position: which segments have any, bool (s,).

    Raises:
        DatasetError: the track is ambiguous, or position and offset cannot be separated.
    """
    if not has_position.any():
        raise DatasetError(
            "no position of a tag can be determined",
            valid="four anchors or more that receive a tag at once, --height or --area",
        )
    notes = list[str]()
    if not has_position.all():
        notes.append(
            f"{int((~has_position).sum())} of {len(has_position)} segments left out: no position of the tag can be determined"
        )
    prior, segments = prior.select_rows(has_position[segments.segment]), segments.select(has_position)
    # The positions contain no knots of segments that were left out.
    fit = fit_segments(config, segments, prior, Start(position))
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
        prior, segments = prior.select_rows(~ambiguous[segments.segment]), segments.select(~ambiguous)
        fit = fit_segments(config, segments, prior, Start(position))
    check_motion(fit)
    return segments, fit, notes


def own_offset_groups(segments: Segments) -> list[dict[str, NDArray[np.bool_]]]:
    """Return groups of ranges with separate offsets, {name: which ranges}: of anchors, and if there are several, of tags and pairs."""
    row, tag = segments.ranges.anchor, segments.tag
    groups = [{f"anchor {anchor}": row == anchor for anchor in np.unique(row).tolist()}]
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
        groups.append({f"tag {number}": tag == number for number in several})
        pairs = {
            f"pair {number} {anchor}": (tag == number) & (row == anchor)
            for number in several
            for anchor in np.unique(row[tag == number]).tolist()
        }
        groups.append(pairs)
    return groups


def with_own_offsets(segments: Segments, fit: JointFit, members: dict[str, NDArray[np.bool_]]) -> JointFit:
    """Return the fit with an offset of each of these groups of ranges.

    Empirical Bayes: the scatter of offsets beyond their own uncertainty is their prior standard deviation. The scatter of a
    few offsets is uncertain itself, so that it is averaged over its likelihood.
    """
    names, count = tuple(members), len(members)
    rows = np.column_stack([mask.astype(float) for mask in members.values()])

    def fit_with(sd_m: float) -> JointFit:
        columns = Regressors(names, rows, np.zeros(count), np.full(count, sd_m), fit.prior.noise_group)
        start = Start(fit.position, np.append(fit.parameters, np.zeros(count)), is_close=True)
        return fit_segments(fit.config, segments, fit.prior.concat(columns), start)

    wide = fit_with(OWN_SD_M)
    # Deviations from the mean: the mean is the common offset.
    contrasts = np.linalg.svd(np.eye(count) - 1.0 / count)[0][:, : count - 1]
    inverse = np.linalg.inv(contrasts.T @ wide.covariance[-count:, -count:] @ contrasts)
    # The estimate without the prior, which `covariance` contains with `SD_INFLATION`.
    information = inverse - np.eye(count - 1) / (OWN_SD_M * SD_INFLATION) ** 2
    values, vectors = np.linalg.eigh(information)
    variance = 1.0 / np.maximum(values, 1.0)
    deviation = variance * (vectors.T @ inverse @ contrasts.T @ wide.parameters[-count:])
    total = variance + SCATTERS_M[:, None] ** 2
    likelihood = -0.5 * (np.log(total) + deviation**2 / total).sum(axis=1)
    weight = np.exp(likelihood - likelihood.max())
    return fit_with(float(np.sqrt(weight @ SCATTERS_M**2 / weight.sum())))
