"""Solve for the true ranges and the offsets of the radios of a site, with or without the poses of a localisation."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.floating import float_network
from uwb_mitigation.positioning.batch.pose_alignment import PoseAlignment, align_poses
from uwb_mitigation.positioning.batch.self_calibration import SelfCalibration
from uwb_mitigation.positioning.batch.self_calibration import self_calibrate as self_calibrate
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import MAD_TO_SD, NETWORK_SD, SLOPE_SD, Regressors
from uwb_mitigation.training.fit.candidates import network_m
from uwb_mitigation.training.site.anchor_check import validate_anchor_map
from uwb_mitigation.training.site.data import SiteData
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.tracks import PosePath

MAX_TRUTH_SD_M = 0.25
"""Ranges whose true range has a larger standard deviation are not used."""

OUTLIER_M, OUTLIER_SDS = 3.0, 10.0
"""A range is an outlier if the distance of its error from the median exceeds both limits."""

NETWORK_GROUPS = 8
"""Number of equal groups by size of the correction; the ranges of a group have a common standard deviation."""

NETWORK, LEVEL = "network", "level"

Pairs = Mapping[tuple[int, int], tuple[float, float]]
"""{(tag id, anchor id): (offset, standard deviation)}, m."""

Progress = Callable[[str, float], None]
"""Called with the current stage and the finished share of it, 0 to 1."""


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
    truth: str | None = None
    alignment: PoseAlignment | None = None
    track: NDArray[np.float64]
    track_of: NDArray[np.intp]
    stationary_positions: Mapping[str, tuple[float, float, float]]
    network_sd: float = 0.0
    line: tuple[float, float] = (0.0, 0.0)
    common_sd_m: float = 0.0
    position_scatter_m: tuple[float, float] = (math.nan, math.nan)


def solve_without_truth(
    site: SiteData,
    universal: Bundle,
    *,
    height: Height | None,
    area: Area | None,
    height_sd_m: float = 0.1,
    on_progress: Progress = lambda stage, share: None,
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
    on_progress("estimating track and offsets", 0.1)
    extra_regressors = regressors(site, universal)
    calibration = self_calibrate(
        site.anchors,
        site.tags,
        extra_regressors,
        height=height,
        area=area,
        heights_m=site.height_m,
        height_sd_m=height_sd_m,
    )
    on_progress("estimating track and offsets", 1.0)
    track, ids = calibration.segments, [anchor.id for anchor in site.anchors.anchors]
    site_rows = site.first_rows[track.tag] + track.row
    is_known = np.isfinite(calibration.pseudo_m) & (calibration.pseudo_sd_m <= MAX_TRUTH_SD_M)
    is_known, outliers = _without_outliers(track.ranges.range_m - calibration.pseudo_m, is_known)
    notes = list(calibration.notes)
    if (unknown := int((~is_known).sum()) - outliers) > 0:
        notes.append(
            f"{unknown} of {len(is_known)} ranges are not used for the fit: the other anchors do not determine the tag position"
        )
    used = np.flatnonzero(is_known & usable_ranges(site)[site_rows])
    pairs = {
        (calibration.tag_ids[tag], ids[row]): calibration.applied(tag, row)
        for tag, row in calibration.pairs()
    }
    common = calibration.mean()[0] if calibration.mean_is_significant else 0.0
    offsets = Offsets(common)
    if calibration.level == "pair":
        offsets = _pair_offsets(common, pairs)
    elif calibration.level == "anchor":
        anchor_offsets = {ids[row]: calibration.applied(tag, row)[0] for tag, row in calibration.pairs()}
        offsets = Offsets(common, anchors=anchor_offsets)

    def offset_changes_without(held_out: NDArray[np.intp]) -> dict[tuple[int, int], float]:
        recalibrated = calibration.raw_only(_whole_segments(used[held_out], used, track.of))
        return {
            (calibration.tag_ids[tag], ids[row]): recalibrated.pair(tag, row)[0]
            - calibration.pair(tag, row)[0]
            for tag, row in calibration.pairs()
            if calibration.applied(tag, row)[0] != 0.0
        }

    return SiteSolution(
        rows=site_rows[used],
        true_m=calibration.pseudo_m[used],
        antenna_position=calibration.fit.position[
            calibration.fit.observations.knot[calibration.fit.observations.of]
        ][used],
        segment=track.of[used],
        stationary=track.is_stationary,
        pairs=pairs,
        offsets=offsets,
        offset_level=calibration.level,
        outliers=outliers,
        notes=tuple(notes),
        offset_changes_without=offset_changes_without,
        track=calibration.fit.position,
        track_of=calibration.fit.observations.knot_segment,
        stationary_positions=_stationary_positions(calibration),
        network_sd=calibration.value(NETWORK)[1],
        line=calibration.value(LEVEL),
        common_sd_m=calibration.mean()[1],
        position_scatter_m=calibration.position_scatter_m,
    )


def solve_with_truth(
    site: SiteData,
    universal: Bundle,
    paths: Sequence[Sequence[PosePath]],
    topic: str,
    *,
    time_offset_s: float | None,
    lever_arms_m: NDArray[np.float64] | None = None,
    estimate_lever_arm: bool = False,
    on_progress: Progress = lambda stage, share: None,
) -> SiteSolution:
    """Solve for true ranges and offsets with the poses of a localisation.

    Args:
        site: recorded ranges.
        universal: bundle whose corrections are a regressor.
        paths: for each tag, the poses of the robot that carries it, for each recording.
        topic: topic of the poses, for reports.
        time_offset_s: see `align_poses`.
        lever_arms_m: see `align_poses`.
        estimate_lever_arm: see `align_poses`.
        on_progress: see `Progress`.

    Raises:
        DatasetError: as for `solve_without_truth`; or too few ranges within the times of the localisation.
    """
    on_progress("estimating time offset and lever arm", 0.1)
    joined = [
        PosePath.joined([path.shifted(by) for path, by in zip(tag_paths, site.shift_ns, strict=True)])
        for tag_paths in paths
    ]
    extra_regressors = regressors(site, universal)
    alignment = align_poses(
        site.anchors,
        site.tags,
        joined,
        extra_regressors,
        time_offset_s=time_offset_s,
        lever_arms_m=lever_arms_m,
        estimate_lever_arm=estimate_lever_arm,
    )
    on_progress("estimating time offset and lever arm", 1.0)
    error = site.ranges.range_m - alignment.distance_m
    is_used, outliers = _without_outliers(error, np.isfinite(error))
    rows = np.flatnonzero(is_used & usable_ranges(site))
    validate_anchor_map(site, alignment.position, is_used)
    ids = [anchor.id for anchor in site.anchors.anchors]
    pairs = {
        (site.tags[tag].tag_id, ids[row]): alignment.pair(tag, row, float(site.anchors.sd[row]))
        for tag, row in alignment.pairs
    }
    common = float(np.median([value for value, sd in pairs.values() if sd <= MAX_TRUTH_SD_M] or [0.0]))
    scatter_m = MAD_TO_SD * float(np.median([abs(value - common) for value, _ in pairs.values()]))
    # With few ranges, the other pairs determine the offset of a pair better than its own ranges.
    typical_offset = common, math.hypot(MAX_TRUTH_SD_M, scatter_m)
    pairs = {pair: typical_offset if value[1] > MAX_TRUTH_SD_M else value for pair, value in pairs.items()}
    tag = site.tag

    def offset_changes_without(held_out: NDArray[np.intp]) -> dict[tuple[int, int], float]:
        remaining = np.setdiff1d(rows, rows[held_out])
        rows_of_tags = [remaining[tag[remaining] == number] for number in range(len(site.tags))]
        realigned = align_poses(
            site.anchors,
            [
                ranges.take(rows_of_tag - begin)
                for ranges, rows_of_tag, begin in zip(site.tags, rows_of_tags, site.first_rows, strict=True)
            ],
            joined,
            extra_regressors.take(remaining),
            time_offset_s=alignment.time_offset_s,
            lever_arms_m=alignment.lever_arm_m,
        )
        return {
            (site.tags[number].tag_id, ids[row]): realigned.pair(number, row, 0.0)[0]
            - alignment.pair(number, row, 0.0)[0]
            for number, row in realigned.pairs
        }

    return SiteSolution(
        rows=rows,
        true_m=alignment.distance_m[rows],
        antenna_position=alignment.position[rows],
        segment=tag[rows],
        stationary=np.zeros(len(site.tags), np.bool_),
        pairs=pairs,
        offsets=_pair_offsets(common, pairs),
        offset_level="pair",
        outliers=outliers,
        notes=(),
        offset_changes_without=offset_changes_without,
        truth=topic,
        alignment=alignment,
        track=alignment.position[rows],
        track_of=tag[rows],
        stationary_positions={},
    )


def regressors(site: SiteData, universal: Bundle) -> Regressors:
    """Return the regressors in addition to offsets: the universal network with CIRs, otherwise the received power."""
    if site.has_cirs:
        predicted = network_m(float_network(universal), site.inputs)
        rows = np.where(np.isfinite(predicted) & site.has_usable_cir, predicted, 0.0)[:, None]
        # Ranges with small corrections have errors of centimetres; those with large ones have errors of decimetres.
        size = np.abs(rows[:, 0])
        edges = np.quantile(size[site.has_usable_cir], np.linspace(0.0, 1.0, NETWORK_GROUPS + 1)[1:-1])
        # Ranges without a CIR are not corrected, so they have their own standard deviation.
        group = np.where(site.has_usable_cir, np.searchsorted(edges, size), NETWORK_GROUPS)
        return Regressors((NETWORK,), rows, np.ones(1), np.array([NETWORK_SD]), group)
    power = site.rx_power_dbm.astype(np.float64)
    known = np.isfinite(power)
    if known.mean() < 0.5 or np.ptp(power[known]) < 1.0:
        return Regressors.none(len(power))
    return Regressors.one(LEVEL, np.where(known, power - np.median(power[known]), 0.0), 0.0, SLOPE_SD)


def _stationary_positions(calibration: SelfCalibration) -> dict[str, tuple[float, float, float]]:
    """Return the positions of stationary tags, see `SiteSolution.stationary_positions`."""
    stationary = np.flatnonzero(calibration.fit.observations.is_stationary).tolist()
    tag_of = dict(zip(calibration.segments.of.tolist(), calibration.segments.tag.tolist(), strict=True))
    positions = Counter(tag_of[segment] for segment in stationary)
    number: Counter[int] = Counter()
    named = {}
    for segment in stationary:
        tag = tag_of[segment]
        number[tag] += 1
        suffix = f" #{number[tag]}" if positions[tag] > 1 else ""
        x, y, z = calibration.fit.position[calibration.fit.observations.knot_segment == segment][0].tolist()
        named[f"{calibration.tag_ids[tag]}{suffix}"] = (x, y, z)
    return named


def _pair_offsets(common: float, pairs: Pairs) -> Offsets:
    sds = {pair: sd for pair, (_, sd) in pairs.items() if math.isfinite(sd)}
    return Offsets(common, pairs={pair: value for pair, (value, _) in pairs.items()}, pair_sd=sds)


def _without_outliers(
    error_m: NDArray[np.float64], known: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], int]:
    """Return the mask of `known` errors that are not outliers, bool (n,), and the number of outliers."""
    if not known.any():
        return known, 0
    distance_m = np.abs(error_m - np.median(error_m[known]))
    limit = max(OUTLIER_M, OUTLIER_SDS * MAD_TO_SD * float(np.median(distance_m[known])))
    is_used = known & (distance_m <= limit)
    return is_used, int(known.sum() - is_used.sum())


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
