"""Solve for the true ranges and the offsets of the radios of a site, with or without the poses of a localisation."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.anchor_errors import validate_anchor_map
from uwb_mitigation.calibration.pose_alignment import PoseAlignment, align_poses
from uwb_mitigation.calibration.self_calibration import SelfCalibration, self_calibrate
from uwb_mitigation.calibration.site_data import SiteData
from uwb_mitigation.errors import DatasetError, format_id
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.floating import float_network
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import (
    CORRECTED_SLOW_SD_M,
    MAD_TO_SD,
    NETWORK_SD,
    SLOPE_SD,
    Regressors,
)
from uwb_mitigation.training.fit.candidates import network_m
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.tracks import PosePath

MAX_TRUTH_SD_M = 0.25
"""Ranges whose true range has a larger standard deviation are not used."""

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

Progress = Callable[[str, float], None]
"""Called with the current stage and the finished share of it, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class LivePrior:
    """Prior knowledge of the locator: constant height, area, and standard deviation of measured heights, m."""

    height: Height | None = None
    area: Area | None = None
    height_sd_m: float = 0.1


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SiteSolution:
    """True ranges and offsets, before the model is selected.

    Attributes:
        rows: int (n,), the ranges of the site that the model is fitted to. true_m: (n,), their true ranges.
        antenna_position: (n, 3), the position of the tag's antenna at each range, m.
        segment: int (n,), segment of the track. stationary: bool, for each segment.
        pairs, offsets: offsets of the radios. offset_level: `pair`, `anchor`, or `one` (one common offset).
        outliers: number of ranges that were excluded everywhere because their errors are implausible.
        notes: unobservable quantities and excluded data.
        offset_changes_without: returns for held-out rows of `rows` the change of the pair offsets, m, if they are estimated
            without these rows.
        prior: prior knowledge with which the locator runs at this site.
        residual_scale: without ground truth, the size of the errors of ranges relative to that of their differences from
            `true_m`, which contain the error of the track of the other anchors.
        truth: topic of the localisation; None: only ranges were used. alignment: its time offset and lever arms.
        track: (k, 3), positions of the tags. track_of: (k,), their segments.
        stationary_positions: {tag id: position} of stationary tags; {`tag id #number`: position} of a tag with several
            positions.
        network_sd: standard deviation of the network's factor in the joint solution; 0: not estimated.
        line: received power in the joint solution, m/dB, and its standard deviation.
        common_sd_m: standard deviation of the mean offset, which the held-out errors contain too; 0 with ground truth.
        position_scatter_m: scatter of positions between tracks without one anchor, raw and calibrated; NaN: unknown.
    """

    rows: NDArray[np.intp]
    true_m: NDArray[np.float64]
    antenna_position: NDArray[np.float64]
    segment: NDArray[np.intp]
    stationary: NDArray[np.bool_]
    pairs: Pairs
    offsets: Offsets
    offset_level: str
    outliers: int
    notes: tuple[str, ...]
    offset_changes_without: Callable[[NDArray[np.intp]], Mapping[tuple[int, int], float]]
    prior: LivePrior
    residual_scale: float = 1.0
    truth: str | None = None
    alignment: PoseAlignment | None = None
    track: NDArray[np.float64]
    track_of: NDArray[np.intp]
    stationary_positions: Mapping[str, tuple[float, float, float]]
    network_sd: float = 0.0
    line: tuple[float, float] = (0.0, 0.0)
    common_sd_m: float = 0.0
    position_scatter_m: tuple[float, float] = (math.nan, math.nan)

    def with_common_offset(self) -> SiteSolution:
        """Return the solution with the common offset for all pairs."""
        common_m = self.offsets.default

        def changes(held_out: NDArray[np.intp]) -> dict[tuple[int, int], float]:
            by_pair = self.offset_changes_without(held_out)
            return dict.fromkeys(by_pair, float(np.mean(list(by_pair.values() or [0.0]))))

        return replace(
            self,
            pairs={pair: (common_m, sd) for pair, (_, sd) in self.pairs.items()},
            offsets=Offsets(common_m),
            offset_level="one",
            offset_changes_without=changes,
            notes=(*self.notes, "own offsets do not improve the live position, so that all pairs share one"),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """Poses of the robot, used as ground truth.

    Attributes:
        topic: topic of the poses, for reports.
        paths: for each tag, the poses of the robot that carries it, for each recording.
        time_offset_s, lever_arms_m, estimate_lever_arm: see `align_poses`.
    """

    topic: str
    paths: Sequence[Sequence[PosePath]]
    time_offset_s: float | None = None
    lever_arms_m: NDArray[np.float64] | None = None
    estimate_lever_arm: bool = False


def solve_without_truth(
    site: SiteData,
    universal: Bundle,
    *,
    height: Height | None,
    area: Area | None,
    height_sd_m: float = 0.1,
    on_progress: Progress = lambda stage, fraction: None,
) -> SiteSolution:
    """Solve for true ranges and offsets from ranges only, without ground truth.

    Args:
        site: recorded ranges.
        universal: bundle whose corrections are a regressor.
        height: height of all tags, if constant.
        area: area of the tags.
        height_sd_m: standard deviation of measured heights, m.
        on_progress: see `Progress`.

    Raises:
        DatasetError: the solution is not observable, an anchor position in the file is wrong, or an offset is
            implausible.
    """
    stage = "estimating track and offsets"
    on_progress(stage, 0.1)
    calibration = self_calibrate(
        site.anchors,
        site.tags,
        regressors(site, universal),
        height=height,
        area=area,
        heights_m=site.height_m,
        height_sd_m=height_sd_m,
    )
    on_progress(stage, 1.0)
    return _RangesOnly(site, calibration).solution(LivePrior(height, area, height_sd_m))


class _RangesOnly:
    """The result of `self_calibrate` as a `SiteSolution`."""

    def __init__(self, site: SiteData, calibration: SelfCalibration) -> None:
        self._calibration = calibration
        self._anchor_ids = [anchor.id for anchor in site.anchors.anchors]
        segments = calibration.segments
        site_rows = site.first_rows[segments.tag] + segments.row
        has_truth = np.isfinite(calibration.pseudo_m) & (calibration.pseudo_sd_m <= MAX_TRUTH_SD_M)
        has_truth, self._outliers = _without_outliers(
            segments.ranges.range_m - calibration.pseudo_m, has_truth
        )
        self._num_unknown = int((~has_truth).sum()) - self._outliers
        self._labelled = np.flatnonzero(has_truth & usable_ranges(site)[site_rows])
        self._rows = site_rows[self._labelled]

    def solution(self, prior: LivePrior) -> SiteSolution:
        """Return true ranges and offsets."""
        calibration, labelled = self._calibration, self._labelled
        segments, observations = calibration.segments, calibration.fit.observations
        notes = list(calibration.notes)
        if self._num_unknown:
            notes.append(
                f"{self._num_unknown} of {len(segments.ranges)} ranges are not used for the fit: the other anchors do not "
                "determine the tag position"
            )
        pairs = {self._ids(tag, row): calibration.applied(tag, row) for tag, row in calibration.pairs()}
        return SiteSolution(
            rows=self._rows,
            true_m=calibration.pseudo_m[labelled],
            antenna_position=calibration.fit.antenna_position()[observations.observation_index][labelled],
            segment=segments.segment[labelled],
            stationary=segments.is_stationary,
            pairs=pairs,
            offsets=self._offsets(pairs),
            offset_level=calibration.level,
            outliers=self._outliers,
            notes=tuple(notes),
            offset_changes_without=self.offset_changes_without,
            prior=prior,
            residual_scale=self._residual_scale(),
            track=calibration.fit.position,
            track_of=observations.knot_segment,
            stationary_positions=_stationary_positions(calibration),
            network_sd=calibration.value(NETWORK)[1],
            line=calibration.value(LEVEL),
            common_sd_m=calibration.mean()[1],
            position_scatter_m=calibration.position_scatter_m,
        )

    def _residual_scale(self) -> float:
        fit, labelled = self._calibration.fit, self._labelled
        if not len(labelled):
            return 1.0
        anchors = len(np.unique(fit.observations.anchor))
        # The track follows errors: of m ranges with d unknowns, (m - d) / m of the variance remains in the residuals.
        redundancy = max(1.0 - fit.config.dims / anchors, 0.25)
        joint_m = fit.residual_m[fit.observations.observation_index][labelled] / math.sqrt(redundancy)
        corrected_m = (
            self._calibration.segments.ranges.range_m
            - (fit.observations.rows @ fit.parameters)[fit.observations.observation_index]
        )
        residual_m = (corrected_m - self._calibration.pseudo_m)[labelled]
        of_joint, of_residuals = (
            float(np.quantile(np.abs(error_m), 0.68)) for error_m in (joint_m, residual_m)
        )
        return min(1.0, of_joint / max(of_residuals, 1e-3))

    def _ids(self, tag: int, row: int) -> tuple[int, int]:
        return self._calibration.tag_ids[tag], self._anchor_ids[row]

    def _offsets(self, pairs: Pairs) -> Offsets:
        calibration = self._calibration
        common = calibration.mean()[0] if calibration.mean_is_significant else 0.0
        if calibration.level == "pair":
            return _pair_offsets(common, pairs)
        if calibration.level == "anchor":
            return Offsets(common, anchors={anchor_id: value for (_, anchor_id), (value, _) in pairs.items()})
        return Offsets(common)

    def offset_changes_without(self, held_out: NDArray[np.intp]) -> dict[tuple[int, int], float]:
        """See `SiteSolution`."""
        calibration, labelled = self._calibration, self._labelled
        refit = calibration.raw_only(
            _whole_segments(labelled[held_out], labelled, calibration.segments.segment)
        )
        return {
            self._ids(tag, row): refit.pair(tag, row)[0] - calibration.pair(tag, row)[0]
            for tag, row in calibration.pairs()
            if calibration.applied(tag, row)[0] != 0.0
        }


def solve_with_truth(
    site: SiteData,
    universal: Bundle,
    localisation: Localisation,
    *,
    height: Height | None = None,
    on_progress: Progress = lambda stage, fraction: None,
) -> SiteSolution:
    """Solve for true ranges and offsets with the poses of a localisation.

    Args:
        site: recorded ranges.
        universal: bundle whose corrections are a regressor.
        localisation: poses of the robot.
        height: height of the tags, if constant, with which the locator will run.
        on_progress: see `Progress`.

    Raises:
        DatasetError: as for `solve_without_truth`; or too few ranges within the times of the localisation.
    """
    stage = "estimating time offset and lever arm"
    on_progress(stage, 0.1)
    solver = _WithLocalisation(site, regressors(site, universal), localisation)
    on_progress(stage, 1.0)
    return solver.solution(height)


class _WithLocalisation:
    """Ranges aligned with the poses of a localisation, as a `SiteSolution`."""

    def __init__(self, site: SiteData, extra: Regressors, localisation: Localisation) -> None:
        self._site, self._extra, self._localisation = site, extra, localisation
        self._paths = [
            PosePath.joined([path.shifted(by_ns) for path, by_ns in zip(paths, site.shift_ns, strict=True)])
            for paths in localisation.paths
        ]
        self._alignment = align_poses(
            site.anchors,
            site.tags,
            self._paths,
            extra,
            time_offset_s=localisation.time_offset_s,
            lever_arms_m=localisation.lever_arms_m,
            estimate_lever_arm=localisation.estimate_lever_arm,
        )
        error_m = site.ranges.range_m - self._alignment.distance_m
        self._is_used, self._outliers = _without_outliers(error_m, np.isfinite(error_m))
        self._rows = np.flatnonzero(self._is_used & usable_ranges(site))

    def solution(self, height: Height | None) -> SiteSolution:
        """Return true ranges and offsets.

        Raises:
            DatasetError: another lever arm, or other anchor positions, explain the ranges much better.
        """
        site, alignment, rows = self._site, self._alignment, self._rows
        self._check_lever_arm()
        validate_anchor_map(site.anchors, site.ranges, site.tag, alignment.position, self._is_used)
        common, pairs = self._pairs()
        segment = site.tag[rows]
        return SiteSolution(
            rows=rows,
            true_m=alignment.distance_m[rows],
            antenna_position=alignment.position[rows],
            segment=segment,
            stationary=np.zeros(len(site.tags), np.bool_),
            pairs=pairs,
            offsets=_pair_offsets(common, pairs),
            offset_level="pair",
            outliers=self._outliers,
            notes=(),
            offset_changes_without=self.offset_changes_without,
            prior=LivePrior(height or _level_height(alignment.position[rows])),
            truth=self._localisation.topic,
            alignment=alignment,
            track=alignment.position[rows],
            track_of=segment,
            stationary_positions={},
        )

    def _check_lever_arm(self) -> None:
        """Refuse a given lever arm if the ranges determine another one."""
        alignment, localisation = self._alignment, self._localisation
        if localisation.estimate_lever_arm:
            return
        try:
            estimated = align_poses(
                self._site.anchors,
                self._site.tags,
                self._paths,
                self._extra,
                time_offset_s=alignment.time_offset_s,
                lever_arms_m=alignment.lever_arm_m,
                estimate_lever_arm=True,
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
                f"tag {format_id(self._site.tags[tag].tag_id)}: the lever arm ({given_arm}) m contradicts the ranges: they fit "
                f"({better_arm}) m",
                valid="--lever-arm X,Y,Z, a transform in the bag, or --estimate-lever-arm",
            )

    def _ids(self, tag: int, row: int) -> tuple[int, int]:
        return self._site.tags[tag].tag_id, self._site.anchors.anchors[row].id

    def _pairs(self) -> tuple[float, Pairs]:
        """Return the common offset, m, and the offset of each pair."""
        alignment, anchor_sd = self._alignment, self._site.anchors.sd
        pairs = {
            self._ids(tag, row): alignment.pair(tag, row, float(anchor_sd[row]))
            for tag, row in alignment.pairs
        }
        common = float(np.median([value for value, sd in pairs.values() if sd <= MAX_TRUTH_SD_M] or [0.0]))
        scatter_m = MAD_TO_SD * float(np.median([abs(value - common) for value, _ in pairs.values()]))
        # With few ranges, the other pairs determine the offset of a pair better than its own ranges.
        typical_offset = common, math.hypot(MAX_TRUTH_SD_M, scatter_m)
        return common, {
            pair: typical_offset if value[1] > MAX_TRUTH_SD_M else value for pair, value in pairs.items()
        }

    def offset_changes_without(self, held_out: NDArray[np.intp]) -> dict[tuple[int, int], float]:
        """See `SiteSolution`."""
        site, alignment = self._site, self._alignment
        remaining = np.setdiff1d(self._rows, self._rows[held_out])
        tag = site.tag[remaining]
        refit = align_poses(
            site.anchors,
            [
                ranges.take(remaining[tag == number] - first_row)
                for number, (ranges, first_row) in enumerate(zip(site.tags, site.first_rows, strict=True))
            ],
            self._paths,
            self._extra.select_rows(remaining),
            time_offset_s=alignment.time_offset_s,
            lever_arms_m=alignment.lever_arm_m,
        )
        return {
            self._ids(tag, row): refit.pair(tag, row, 0.0)[0] - alignment.pair(tag, row, 0.0)[0]
            for tag, row in refit.pairs
        }


def _level_height(position: NDArray[np.float64]) -> Height | None:
    """Return the height of antennas at (n, 3) if it is constant."""
    if not len(position) or float(np.ptp(position[:, 2])) > LEVEL_M:
        return None
    return Height(float(np.median(position[:, 2])), 0.1)


def regressors(site: SiteData, universal: Bundle) -> Regressors:
    """Return the regressors in addition to offsets: the universal network with CIRs, otherwise the powers."""
    if site.has_cirs:
        predicted = network_m(float_network(universal), site.inputs)
        rows = np.where(np.isfinite(predicted) & site.has_usable_cir, predicted, 0.0)[:, None]
        # Ranges with small corrections have errors of centimetres; those with large ones have errors of decimetres.
        size = np.abs(rows[:, 0])
        edges = np.quantile(size[site.has_usable_cir], np.linspace(0.0, 1.0, NETWORK_GROUPS + 1)[1:-1])
        # Ranges without a CIR are not corrected, so they have their own standard deviation.
        group = np.where(site.has_usable_cir, np.searchsorted(edges, size), NETWORK_GROUPS)
        return Regressors((NETWORK,), rows, np.ones(1), np.array([NETWORK_SD]), group, CORRECTED_SLOW_SD_M)
    power_dbm = site.rx_power_dbm.astype(np.float64)
    columns = [Regressors.none(len(power_dbm))]
    # The line of a site (`SiteLine`) uses the same powers: otherwise the track follows the errors that it removes.
    for name, value in ((LEVEL, power_dbm), (POWER_GAP, power_dbm - site.first_path_power_dbm)):
        is_known = np.isfinite(value)
        if is_known.mean() >= 0.5 and np.ptp(value[is_known]) >= 1.0:
            centred = np.where(is_known, value - np.median(value[is_known]), 0.0)
            columns.append(Regressors.single(name, centred, 0.0, SLOPE_SD))
    return functools.reduce(Regressors.concat, columns)


def _stationary_positions(calibration: SelfCalibration) -> dict[str, tuple[float, float, float]]:
    """Return the positions of stationary tags, see `SiteSolution.stationary_positions`."""
    stationary = np.flatnonzero(calibration.fit.observations.is_stationary).tolist()
    tag_of_segment = dict(
        zip(calibration.segments.segment.tolist(), calibration.segments.tag.tolist(), strict=True)
    )
    positions = Counter(tag_of_segment[segment] for segment in stationary)
    number: Counter[int] = Counter()
    named = {}
    for segment in stationary:
        tag = tag_of_segment[segment]
        number[tag] += 1
        suffix = f" #{number[tag]}" if positions[tag] > 1 else ""
        x, y, z = calibration.fit.position[calibration.fit.observations.knot_segment == segment][0].tolist()
        named[f"{calibration.tag_ids[tag]}{suffix}"] = (x, y, z)
    return named


def _pair_offsets(common: float, pairs: Pairs) -> Offsets:
    sds = {pair: sd for pair, (_, sd) in pairs.items() if math.isfinite(sd)}
    return Offsets(common, pairs={pair: value for pair, (value, _) in pairs.items()}, pair_sd=sds)


def _without_outliers(
    error_m: NDArray[np.float64], is_known: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], int]:
    """Return the mask of known errors that are not outliers, bool (n,), and the number of outliers."""
    if not is_known.any():
        return is_known, 0
    distance_m = np.abs(error_m - np.median(error_m[is_known]))
    limit = max(OUTLIER_M, OUTLIER_SDS * MAD_TO_SD * float(np.median(distance_m[is_known])))
    is_used = is_known & (distance_m <= limit)
    return is_used, int(is_known.sum() - is_used.sum())


def _whole_segments(
    held_out: NDArray[np.intp], labelled: NDArray[np.intp], segment: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return all ranges of the held-out segments, including the unlabelled ranges between the labelled ones.

    Args:
        held_out: subset of `labelled`.
        labelled: sorted indices of the ranges with a known true range.
        segment: int (r,), segment of each range, in the order of time.
    """
    rows = np.arange(len(segment))
    before = np.maximum(np.searchsorted(labelled, rows, side="right") - 1, 0)
    after = np.minimum(before + 1, len(labelled) - 1)
    nearest = np.where(segment[labelled[before]] == segment, labelled[before], labelled[after])
    is_held_out: NDArray[np.bool_] = np.isin(nearest, held_out) & (segment[nearest] == segment)
    return is_held_out


def usable_ranges(site: SiteData) -> NDArray[np.bool_]:
    """Return the mask of ranges for fitting the model, bool (r,). The others affect only track and offsets."""
    return site.has_usable_cir if site.has_cirs else np.ones(len(site.has_usable_cir), np.bool_)
