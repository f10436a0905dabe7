"""Solve for the true ranges and the offsets of the radios of a site, with or without the poses of a localisation."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwb_mitigation.calibration import regression
from uwb_mitigation.calibration.hypotheses import AnchorHypotheses
from uwb_mitigation.calibration.joint_fit import medians
from uwb_mitigation.calibration.pose_alignment import PoseAlignment, align_poses
from uwb_mitigation.calibration.self_calibration import SelfCalibration, self_calibrate
from uwb_mitigation.calibration.site_data import SiteData
from uwb_mitigation.errors import DatasetError, format_id
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.tracks import PosePath

MAX_TRUTH_SD_M = 0.25
"""Ranges whose true range has a larger standard deviation are not used."""

MAX_OFFSET_SD_M = 0.2
"""An offset with a larger standard deviation is unknown: uncalibrated antenna delays differ by as much."""

MAX_SKEWNESS = 1.4
"""Offsets of single anchors are not used if errors are more skewed (distance of the 95 % quantile from the median, relative to that of
the 5 % quantile): obstacles lengthen ranges in some directions only, which looks like offsets. Simulated: 0.93 to 1.40 in layouts
without many obstacles, 1.41 or more in 16 of 20 sites with walls (seeds 103 to 309)."""

MIN_DISPLACEMENT_SD_M = 0.05
"""Offsets of single anchors are not used if a displacement of the whole track explains less of them than its standard deviation, if
that is larger than this. In a simulated room (`box` in 3-D, seed 347), offsets of two opposite pairs of corners were wrong by 0.06 to
0.15 m, together, and the live error of another drive increased by 9 %. Seen on rings of anchors: 0.03 m. The limit is cautious: in 15
drives in similar rooms (seeds 400 to 407), offsets that it accepts reduced the live error by 13 to 56 %, but those that it refuses by 7 to
49 %, too."""

SUBTRACTED_SHARE = 0.5
"""Share of an estimate that is subtracted where obstacles contribute to it: without ground truth and with CIRs, of the common offset;
without ground truth or with CIRs, of the differences from it. Whole differences increased the live error of another drive by up to 32 %,
and with ground truth and CIRs by 21 %, half of them by up to 10 % and not (simulated sites 118, 304 and 368)."""

OUTLIER_M, OUTLIER_SDS = 3.0, 10.0
"""A range is an outlier if the distance of its error from the median exceeds both limits."""

NETWORK_GROUPS = 8
"""Number of equal groups by size of the correction; the ranges of a group have a common standard deviation."""

MAX_LEVER_ARM_ERROR_M = 0.2
"""A given lever arm is refused if the ranges determine one that differs more, and by four standard deviations."""

NETWORK, LEVEL, POWER_GAP = "network", "level", "power gap"

LEVEL_M = 0.3
"""A tag whose height changes by less drives on a level floor: the locator gets its height."""

Pairs = Mapping[tuple[int, int], tuple[float, float]]
"""{(tag id, anchor id): (offset, standard deviation)}, m."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SiteSolution:
    """True ranges and offsets of a site, or of a part of it, before the model is selected.

    Attributes:
        rows: int (n,), the ranges of the site that the model is fitted to. true_m: (n,), their true ranges.
        pairs: offsets of the radios. common_m: the offset that they have in common, m.
        common_share, offset_share: shares of the common offset, and of the differences from it, that are subtracted.
        offsets_refused: why offsets of single anchors are not used; empty: they can be used.
        outliers: number of ranges that were excluded everywhere because their errors are implausible.
        notes: what was left out.
        errors_of: returns for corrected ranges of all tags, (r,), m, their errors against the reference, (r,), m; NaN:
            unknown. With ground truth the reference is the localisation. Otherwise it is the track of the other anchors, which
            is estimated from the same corrected ranges.
        solve_part: solves for a part of the same site, or for another drive there, with the same prior knowledge.
        truth: topic of the localisation; None: only ranges were used. alignment: its time offset and lever arms.
        height: height with which the locator runs at this site, if it is constant.
        antenna_position: with ground truth the true position of the antenna at each range, (r, 3), m; NaN: unknown.
        track: (k, 3), positions of the tags. track_of: (k,), their segments.
    """

    rows: NDArray[np.intp]
    true_m: NDArray[np.float64]
    pairs: Pairs
    common_m: float
    outliers: int
    notes: tuple[str, ...]
    errors_of: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    solve_part: Callable[[SiteData], SiteSolution]
    truth: str | None = None
    alignment: PoseAlignment | None = None
    height: Height | None = None
    antenna_position: NDArray[np.float64]
    track: NDArray[np.float64]
    track_of: NDArray[np.intp]
    common_share: float = 1.0
    offset_share: float = SUBTRACTED_SHARE
    offsets_refused: str = ""

    def subtracted(self, level: str) -> Pairs:
        """Return what is subtracted from the ranges of each pair with the level `ONE` or `PAIR`, and its standard deviation, m.

        The standard deviation contains the part of the estimate that is not subtracted, also of the common offset. It is only
        reported: variances of corrected ranges do not depend on it.
        """
        common_m, pair_share = self.common_share * self.common_m, self.offset_share if level == PAIR else 0.0
        pairs = {}
        for pair, (value, sd) in self.pairs.items():
            subtracted_m = common_m + pair_share * (value - self.common_m)
            pairs[pair] = subtracted_m, math.hypot(sd, value - subtracted_m)
        return pairs

    def offsets(self, level: str) -> Offsets:
        """Return the offset of each pair, with the level `ONE` the common offset for all, and with `NONE` none."""
        if level == NONE:
            return Offsets()
        common_m = self.common_share * self.common_m
        if level == ONE:
            return Offsets(common_m)
        pairs = self.subtracted(PAIR)
        values = {pair: value for pair, (value, _) in pairs.items()}
        sds = {pair: sd for pair, (_, sd) in pairs.items() if math.isfinite(sd)}
        return Offsets(common_m, pairs=values, pair_sd=sds)


NONE, ONE, PAIR = "none", "one", "pair"
"""What has a separate offset."""


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """Poses of the robot, used as ground truth.

    Attributes:
        topic: topic of the poses, for reports.
        paths: {tag id: poses of the robot that carries it, for each recording}.
        time_offset_s, estimate_lever_arm: see `align_poses`.
        lever_arms_m: {tag id: its lever arm, float64 (3,)}, m; without an entry it is 0.
    """

    topic: str
    paths: Mapping[int, Sequence[PosePath]]
    time_offset_s: float | None = None
    lever_arms_m: Mapping[int, ArrayLike] = field(default_factory=dict)
    estimate_lever_arm: bool = False


def solve_without_truth(
    site: SiteData,
    *,
    height: Height | None,
    area: Area | None,
    height_sd_m: float = 0.1,
) -> SiteSolution:
    """Solve for true ranges and offsets from ranges only, without ground truth.

    Args:
        site: recorded ranges.
        height: height of all tags, if constant.
        area: area of the tags.
        height_sd_m: standard deviation of measured heights, m.

    Raises:
        DatasetError: the solution is not observable, or an anchor position in the file is wrong.
    """

    def solve(data: SiteData, near_offset_m: float | None) -> SelfCalibration:
        return self_calibrate(
            data.anchors,
            data.tags,
            regressors(data, has_truth=False),
            height=height,
            area=area,
            heights_m=data.height_m,
            height_sd_m=height_sd_m,
            near_offset_m=near_offset_m,
        )

    def solve_part(data: SiteData) -> SiteSolution:
        return _solution_of(data, solve(data, offset_m), solve_part)

    complete = solve(site, None)
    offset_m = _checked_offset_m(site, complete)
    return _solution_of(site, complete, solve_part)


def _pairs_of(site: SiteData, calibration: SelfCalibration) -> Pairs:
    return {
        (calibration.tag_ids[tag], site.anchors.anchors[row].id): calibration.pair(tag, row)
        for tag, row in calibration.pairs()
    }


def _checked_offset_m(site: SiteData, calibration: SelfCalibration) -> float:
    """Return the common offset, m, and refuse offsets that the drive does not determine.

    Raises:
        DatasetError: states the offset and its standard deviation.
    """
    remedy = f"at most {MAX_OFFSET_SD_M:g} m: drive between the anchors, not only past them"
    common_m, common_sd_m = calibration.mean()
    if common_sd_m > MAX_OFFSET_SD_M:
        raise DatasetError(
            f"the common offset is not observable: {common_m:.2f} m with a standard deviation of {common_sd_m:.2f} m",
            valid=remedy,
        )
    for (tag, anchor), (value, sd) in _pairs_of(site, calibration).items():
        # With CIRs, only the common offset is subtracted.
        if sd > MAX_OFFSET_SD_M and not site.has_cirs:
            raise DatasetError(
                f"the offset of tag {format_id(tag)} and anchor {format_id(anchor)} is not observable: {value:.2f} m with a "
                f"standard deviation of {sd:.2f} m",
                valid=f"{remedy}; or an anchors file without this anchor",
            )
    return common_m


def _solution_of(
    site: SiteData, calibration: SelfCalibration, solve_part: Callable[[SiteData], SiteSolution]
) -> SiteSolution:
    """Return true ranges and offsets; the true ranges are distances from the track of the other anchors."""
    segments, fit, distance_m = calibration.segments, calibration.fit, calibration.distance_m
    site_rows = site.first_rows[segments.tag] + segments.row
    common_m, _ = calibration.mean()
    has_truth = np.isfinite(distance_m) & (calibration.distance_sd_m <= MAX_TRUTH_SD_M)
    has_truth, outliers = _without_outliers(segments.ranges.range_m - distance_m, has_truth)
    notes = list(calibration.notes)
    if num_unknown := int((~has_truth).sum()) - outliers:
        notes.append(
            f"{num_unknown} of {len(segments.ranges)} ranges are not used for the fit: the other anchors do not determine "
            "the tag position"
        )
    labelled = np.flatnonzero(has_truth & site.table["is_usable"][site_rows])

    def errors_of(range_m: NDArray[np.float64]) -> NDArray[np.float64]:
        index, corrected_m = fit.observations.observation_index, range_m[site_rows]
        antenna, _ = fit.leave_anchors_out(medians(corrected_m, index))
        anchor = site.anchors.position[segments.ranges.anchor]
        error_m = corrected_m - np.linalg.norm(antenna[index] - anchor, axis=1)
        errors_m = np.full(len(range_m), np.nan)
        errors_m[site_rows] = np.where(has_truth, error_m, np.nan)
        return errors_m

    return SiteSolution(
        rows=site_rows[labelled],
        true_m=distance_m[labelled],
        pairs=_pairs_of(site, calibration),
        common_m=common_m,
        common_share=SUBTRACTED_SHARE if site.has_cirs else 1.0,
        offsets_refused=_offsets_refused(calibration, has_truth),
        outliers=outliers,
        notes=tuple(notes),
        errors_of=errors_of,
        solve_part=solve_part,
        height=fit.config.height if site.height_m is None else None,
        antenna_position=np.full((len(site.table), 3), np.nan),
        track=fit.position,
        track_of=fit.observations.knot_segment,
    )


def _offsets_refused(calibration: SelfCalibration, has_truth: NDArray[np.bool_]) -> str:
    """Return why offsets of single anchors are not used, see `SiteSolution`."""
    if not calibration.has_redundant_anchors:
        return "need more anchors"
    displacement_m, displacement_sd_m = calibration.displacement()
    if displacement_sd_m > max(MIN_DISPLACEMENT_SD_M, displacement_m):
        return "look like a displacement of the whole track: drive nearer to each anchor"
    ranges = calibration.segments.ranges
    anchor, error_m = ranges.anchor[has_truth], (ranges.range_m - calibration.distance_m)[has_truth]
    for row in np.unique(anchor):
        error_m[anchor == row] -= np.median(error_m[anchor == row])
    low, high = np.quantile(error_m, (0.05, 0.95)) if len(error_m) else (0.0, math.inf)
    if high > -MAX_SKEWNESS * low:
        return "look like those of walls, which make many ranges longer"
    return ""


def solve_with_truth(
    site: SiteData,
    localisation: Localisation,
    *,
    height: Height | None = None,
    is_part: bool = False,
) -> SiteSolution:
    """Solve for true ranges and offsets with the poses of a localisation.

    Args:
        site: recorded ranges.
        localisation: poses of the robot.
        height: height of the tags, if constant, with which the locator will run.
        is_part: the site was already solved for more ranges.

    Raises:
        DatasetError: another lever arm, or other anchor positions, explain the ranges much better; or too few ranges are
            within the times of the localisation.
    """
    ids = [tag.tag_id for tag in site.tags]
    paths = [
        PosePath.merged([path.shifted(by_ns) for path, by_ns in zip(paths, site.shift_ns, strict=True)])
        for paths in map(localisation.paths.__getitem__, ids)
    ]
    align = functools.partial(align_poses, site.anchors, site.tags, paths, regressors(site, has_truth=True))
    alignment = align(
        time_offset_s=localisation.time_offset_s,
        lever_arms_m=np.array([localisation.lever_arms_m.get(tag_id, np.zeros(3)) for tag_id in ids]),
        estimate_lever_arm=localisation.estimate_lever_arm,
    )
    error_m = site.ranges.range_m - alignment.distance_m
    is_used, outliers = _without_outliers(error_m, np.isfinite(error_m))
    if not is_part:
        if not localisation.estimate_lever_arm:
            _check_lever_arm(site, align, alignment)
        # With outliers: many ranges of swapped anchors are some.
        ranges = replace(site.ranges, range_m=site.ranges.range_m - site.table["universal_m"])
        hypotheses = AnchorHypotheses(site.anchors, ranges, alignment.position, site.tag)
        hypotheses.check("the localisation", is_independent=True)
    aligned = replace(
        localisation,
        time_offset_s=alignment.time_offset_s,
        lever_arms_m=dict(zip(ids, alignment.lever_arm_m, strict=True)),
        estimate_lever_arm=False,
    )
    common_m, pairs = _aligned_offsets(site, alignment)
    rows = np.flatnonzero(is_used & site.table["is_usable"])
    level = height or _level_height(alignment.position[rows])
    return SiteSolution(
        rows=rows,
        true_m=alignment.distance_m[rows],
        pairs=pairs,
        common_m=common_m,
        offset_share=SUBTRACTED_SHARE if site.has_cirs else 1.0,
        outliers=outliers,
        notes=(),
        errors_of=lambda range_m: np.where(is_used, range_m - alignment.distance_m, np.nan),
        solve_part=functools.partial(solve_with_truth, localisation=aligned, height=level, is_part=True),
        truth=localisation.topic,
        alignment=alignment,
        height=level,
        antenna_position=alignment.position,
        track=alignment.position[rows],
        track_of=site.tag[rows],
    )


def _check_lever_arm(site: SiteData, align: Callable[..., PoseAlignment], alignment: PoseAlignment) -> None:
    """Refuse a given lever arm if the ranges determine another one."""
    try:
        estimated = align(
            time_offset_s=alignment.time_offset_s, lever_arms_m=alignment.lever_arm_m, estimate_lever_arm=True
        )
    except DatasetError:
        # The drive does not determine it.
        return
    change_m = np.abs(estimated.lever_arm_m - alignment.lever_arm_m)[:, :2]
    limit_m = np.maximum(MAX_LEVER_ARM_ERROR_M, 4.0 * estimated.lever_arm_sd_m[:, :2])
    for tag in np.flatnonzero((change_m > limit_m).any(axis=1)).tolist():
        given_arm, better_arm = (
            ", ".join(f"{value:.2f}" for value in arms[tag, :2].tolist())
            for arms in (alignment.lever_arm_m, estimated.lever_arm_m)
        )
        raise DatasetError(
            f"tag {format_id(site.tags[tag].tag_id)}: the lever arm ({given_arm}) m contradicts the ranges: they fit "
            f"({better_arm}) m",
            valid="--lever-arm X,Y,Z, a transform in the bag, or --estimate-lever-arm",
        )


def _aligned_offsets(site: SiteData, alignment: PoseAlignment) -> tuple[float, Pairs]:
    """Return the common offset, m, and the offset of each pair; its standard deviation includes the anchor's position error."""
    offsets = zip(alignment.pairs, alignment.offset_m.tolist(), alignment.offset_sd_m.tolist(), strict=True)
    placed_m = site.anchors.sd / math.sqrt(2.0)
    pairs = {
        (site.tags[tag].tag_id, site.anchors.anchors[row].id): (offset_m, math.hypot(sd_m, placed_m[row]))
        for (tag, row), offset_m, sd_m in offsets
    }
    common = float(np.median([value for value, sd in pairs.values() if sd <= MAX_TRUTH_SD_M] or [0.0]))
    scatter_m = regression.MAD_TO_SD * float(np.median([abs(value - common) for value, _ in pairs.values()]))
    # With few ranges, the other pairs determine the offset of a pair better than its own ranges.
    typical_offset = common, math.hypot(MAX_TRUTH_SD_M, scatter_m)
    return common, {
        pair: typical_offset if value[1] > MAX_TRUTH_SD_M else value for pair, value in pairs.items()
    }


def _level_height(position: NDArray[np.float64]) -> Height | None:
    """Return the height of antennas at (n, 3) if it is constant."""
    if not len(position) or float(np.ptp(position[:, 2])) > LEVEL_M:
        return None
    return Height(float(np.median(position[:, 2])), 0.1)


def regressors(site: SiteData, *, has_truth: bool) -> regression.Regressors:
    """Return the regressors in addition to offsets: the universal network with CIRs, otherwise with ground truth the powers.

    Without ground truth a line in the powers follows the track as much as the errors of the ranges.
    """
    if site.has_cirs:
        # Ranges with small corrections have errors of centimetres; those with large ones have errors of decimetres.
        size = np.abs(site.table["universal_m"])
        edges = np.quantile(size[site.table["is_usable"]], np.linspace(0.0, 1.0, NETWORK_GROUPS + 1)[1:-1])
        # Ranges without a CIR are not corrected, so they have their own standard deviation.
        group = np.where(site.table["is_usable"], np.searchsorted(edges, size), NETWORK_GROUPS)
        row, mean, sd = site.table["universal_m"][:, None], np.ones(1), np.array([regression.NETWORK_SD])
        return regression.Regressors((NETWORK,), row, mean, sd, group, regression.CORRECTED_SLOW_SD_M)
    power_dbm = site.table["rx_power_dbm"].astype(np.float64)
    columns = [regression.Regressors.none(len(power_dbm))]
    for name, value in ((LEVEL, power_dbm), (POWER_GAP, power_dbm - site.table["first_path_power_dbm"])):
        is_known = np.isfinite(value)
        if has_truth and is_known.mean() >= 0.5 and np.ptp(value[is_known]) >= 1.0:
            centred = np.where(is_known, value - np.median(value[is_known]), 0.0)
            columns.append(regression.Regressors.single(name, centred, 0.0, regression.SLOPE_SD))
    return functools.reduce(regression.Regressors.concat, columns)


def _without_outliers(
    error_m: NDArray[np.float64], is_known: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], int]:
    """Return the mask of known errors that are not outliers, bool (n,), and the number of outliers."""
    if not is_known.any():
        return is_known, 0
    distance_m = np.abs(error_m - np.median(error_m[is_known]))
    limit = max(OUTLIER_M, OUTLIER_SDS * regression.MAD_TO_SD * float(np.median(distance_m[is_known])))
    is_used = is_known & (distance_m <= limit)
    return is_used, int(is_known.sum() - is_used.sum())
