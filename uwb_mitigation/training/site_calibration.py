"""Calibrate a site from a drive: true ranges from a joint solution or a localisation, then offsets and a model.

`calibrate_without_truth` and `calibrate_with_truth` solve for the true ranges and the offsets; `_select_model` selects the model for both.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ModelError, format_id
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.site_data import SiteData
from uwb_mitigation.files import write_all_atomically
from uwb_mitigation.model import graph
from uwb_mitigation.model.bundle import Bundle, build_bundle
from uwb_mitigation.model.floating import float_network, scaled
from uwb_mitigation.offsets import Offsets, dump_offsets
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import MAD_TO_SD, NETWORK_SD, SLOPE_SD, Regressors
from uwb_mitigation.positioning.pose_alignment import PoseAlignment, PosePath, align_poses
from uwb_mitigation.positioning.self_calibration import SelfCalibration, calibrate
from uwb_mitigation.training import candidates as models
from uwb_mitigation.training import selection as selections
from uwb_mitigation.training.anchor_check import check_anchors
from uwb_mitigation.training.cards import card_of, ood_bands_of
from uwb_mitigation.training.selection import MIN_GAIN, Selection

MAX_TRUTH_SD_M = 0.25
"""Ranges whose true range has a larger standard deviation are not used."""

MIN_LABELLED = 40
MAX_OFFSET_M = 1.0
"""Radios of one kind without individual antenna delays differ by 0.3 m at three sigma (Decawave APS014)."""

OUTLIER_M, OUTLIER_SDS = 3.0, 10.0
"""A range is an outlier if the distance of its error from the median exceeds both limits."""

NETWORK_GROUPS = 8
"""Number of equal groups by size of the correction; the ranges of a group have a common standard deviation."""

WINDOW_S = 1.0
"""Duration of the ranges from which one position error is computed."""

NETWORK, LEVEL = "network", "level"
NAN_PAIR = (math.nan, math.nan)

Pairs = Mapping[tuple[int, int], tuple[float, float]]
"""{(tag id, anchor id): (offset, standard deviation)}, m."""

Progress = Callable[[str, float], None]
"""Called with the current step and the finished share of it, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SiteSolution:
    """True ranges and offsets, before the model is selected.

    Attributes:
        rows: int (n,), the ranges of the site that the model is fitted to. true_m: (n,), their true ranges.
        antenna: (n, 3), the position of the tag's antenna at each of them, m.
        segment: int (n,), segment of the track. stationary: bool, for each segment.
        pairs, offsets: offsets of the radios. level: granularity of the offsets: `pair`, `anchor` or `one`.
        outliers: number of ranges that were excluded everywhere because their errors are implausible.
        notes: unobservable quantities and excluded data.
        offset_changes_without: returns for held-out rows of `rows` the change of the pair offsets, m, if they are estimated
            without these rows.
        truth: topic of the localisation; None: only ranges were used. alignment: its time offset and lever arms.
        track: (k, 3), positions of the tags. track_of: (k,), their segments.
        places: {tag id: position} of stationary tags; {`tag id #number`: position} of a tag with several positions.
        network_sd: standard deviation of the network's factor in the joint solution; 0: not estimated.
        line: received power in the joint solution, m/dB, and its standard deviation.
        common_sd_m: standard deviation of the mean offset, which the held-out errors contain too; 0 with ground truth.
        position_scatter_m: scatter of positions between tracks without one anchor, raw and calibrated; NaN: unknown.
    """

    rows: NDArray[np.intp]
    true_m: NDArray[np.float64]
    antenna: NDArray[np.float64]
    segment: NDArray[np.intp]
    stationary: NDArray[np.bool_]
    pairs: Pairs
    offsets: Offsets
    level: str
    outliers: int
    notes: tuple[str, ...]
    offset_changes_without: Callable[[NDArray[np.intp]], Mapping[tuple[int, int], float]]
    truth: str | None = None
    alignment: PoseAlignment | None = None
    track: NDArray[np.float64]
    track_of: NDArray[np.intp]
    places: Mapping[str, tuple[float, float, float]]
    network_sd: float = 0.0
    line: tuple[float, float] = (0.0, 0.0)
    common_sd_m: float = 0.0
    position_scatter_m: tuple[float, float] = NAN_PAIR


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SiteCalibration:
    """A calibration, before it is written.

    Attributes:
        site: recorded data. solution: true ranges and offsets.
        data: the ranges of `solution.rows`, with the offsets subtracted. raw_m: their errors as measured, (n,).
        selection: the selected model. notes: all notes.
        position_error_m: RMSE of the horizontal position due to held-out errors, raw and with the chosen model.
    """

    site: SiteData
    solution: SiteSolution
    data: Dataset
    raw_m: NDArray[np.float64]
    selection: Selection
    notes: tuple[str, ...]
    position_error_m: tuple[float, float]

    @property
    def offsets(self) -> Offsets:
        """Offsets of the radios."""
        return self.solution.offsets

    @property
    def held_out_m(self) -> NDArray[np.float64]:
        """Return the errors of the chosen model on held-out segments, shape (n,), m."""
        return self.selection.errors[self.selection.chosen][: len(self.data)]

    @property
    def raw_mae_m(self) -> float:
        """Return the MAE of the measured ranges."""
        return float(np.abs(self.raw_m).mean())

    @property
    def calibrated_mae_m(self) -> float:
        """Return the MAE of the chosen model on held-out segments and anchors."""
        return self.selection.mae()[self.selection.chosen]

    @property
    def is_harmful(self) -> bool:
        """Whether held-out ranges improve by less than `MIN_GAIN`, or positions become worse."""
        raw, calibrated = self.solution.position_scatter_m
        scatters = calibrated > raw
        if self.solution.truth is not None:
            raw, calibrated = self.position_error_m
            scatters = calibrated > (1.0 + MIN_GAIN) * raw
        return self.calibrated_mae_m > (1.0 - MIN_GAIN) * self.raw_mae_m or scatters

    @property
    def gain_lower_bound(self) -> float:
        """Return the reduction of the held-out error (share) if the mean offset is wrong by two standard deviations.

        Without ground truth the held-out ranges are compared with a track that contains the error of the mean offset.
        """
        wrong = 2.0 * self.solution.common_sd_m
        raw, left = self.raw_m, self.held_out_m
        return min(
            1.0 - float(np.abs(left + by).mean() / max(np.abs(raw + by).mean(), 1e-9))
            for by in (-wrong, 0.0, wrong)
        )

    def summary(self) -> str:
        """Return the result in one sentence."""
        truth, chosen = self.solution.truth, self.selection.chosen
        against = "residuals against the other anchors (not ground truth)"
        text = (
            f"Held-out range {against if truth is None else f'errors against {truth}'}: {self.raw_mae_m:.3f} m raw, "
            f"{self.calibrated_mae_m:.3f} m calibrated ({chosen})"
        )
        for what, (raw, calibrated) in (
            ("positions without one anchor scatter by", self.solution.position_scatter_m),
            ("position error on held-out segments", self.position_error_m),
        ):
            if not math.isnan(raw):
                text += f"; {what} {raw:.3f} m raw, {calibrated:.3f} m calibrated"
        if self.is_harmful:
            return f"{text}: no gain."
        if (gain := self.gain_lower_bound) <= 0.0:
            return f"{text}. The gain is smaller than its uncertainty."
        return f"{text}: at least {gain:.0%} less."

    def as_json(self) -> dict[str, object]:
        """Return the result of `uwb-mitigation calibrate`."""
        solution, model = self.solution, self.selection.model
        factor = 0.0 if model.network is None else 1.0 if model.factor is None else model.factor
        linear_bias = model.linear_bias
        return {
            "offsets_m": {f"{tag}-{anchor}": value for (tag, anchor), (value, _) in solution.pairs.items()},
            "offset_sd_m": {f"{tag}-{anchor}": sd for (tag, anchor), (_, sd) in solution.pairs.items()},
            "offsets_of": solution.level,
            "raw_mae_m": self.raw_mae_m,
            "calibrated_mae_m": self.calibrated_mae_m,
            "truth": solution.truth or "none",
            "refused": None,
            "chosen": self.selection.chosen,
            "candidates": self.selection.mae(),
            "ranges": sum(map(len, self.site.tags)),
            "labelled": len(self.data),
            "outliers": solution.outliers,
            "position_scatter_m": _json_pair(solution.position_scatter_m),
            "position_error_m": _json_pair(self.position_error_m),
            "network_factor": [factor, solution.network_sd],
            "line": {
                "offset_m": linear_bias.offset_m,
                "per_rx_power": linear_bias.per_rx_power,
                "per_power_gap": linear_bias.per_power_gap,
            },
            "places": {name: list(position) for name, position in solution.places.items()},
            "notes": list(self.notes),
            "left_out": dict(self.site.left_out),
            "localisation": None if solution.alignment is None else solution.alignment.as_json(),
        }

    def write(self, output: Path, universal: Bundle, name: str) -> tuple[Bundle, Path]:
        """Write the bundle and the offsets (`X.offsets.yaml`) atomically.

        Args:
            name: human-readable name of the recordings.

        Raises:
            ModelError: they cannot be written.
        """
        truth, model, n = self.solution.truth, self.selection.model, len(self.data)
        how = "without truth" if truth is None else f"with truth from {truth}"
        metrics = {"raw": self.raw_mae_m, **self.selection.mae()}
        training = {
            "data": f"{name}, calibrated {how}",
            "calibrated": how,
            "chosen": self.selection.chosen,
            "measurements": n,
            "configurations": len(self.data.names),
            "split": "held out: segments of the track, and anchors",
            "started_from": f"{universal.model_id:08x}",
            "recipe": {"line": model.linear_bias.needs_power, "network": model.network is not None},
            "metrics_m": {row: {"mae": round(value, 4)} for row, value in metrics.items()},
        }
        has_network = model.network is not None
        network = scaled(float_network(universal), 0.0) if model.network is None else model.network
        ood_bands = ood_bands_of(self.data) if has_network else None
        fitted = output.stem, universal.architecture, self.data, model.linear_bias
        card = card_of(*fitted, self.data, self.held_out_m, training, ood_bands)
        if has_network:
            # The drive does not cover the whole site, so the limits include those of the universal model.
            (low, high), (lowest, highest) = universal.card.correction_limits_m, card.correction_limits_m
            card = replace(card, correction_limits_m=(min(low, lowest), max(high, highest)))
        bundle, content = build_bundle(
            output, graph.float_model(network), replace(card, needs_cir=has_network)
        )
        offsets_path = offsets_file(output)
        comment = (
            f"Offsets of the radios, m, for model {bundle.model_id:08x} ({output.name}): use both together.\n"
            f"Estimated by uwb-mitigation calibrate in {name}, {how}."
        )
        write_all_atomically({output: content, offsets_path: dump_offsets(self.offsets, comment)}, ModelError)
        return bundle, offsets_path


def _json_pair(pair: tuple[float, float]) -> list[float | None]:
    return [None if math.isnan(value) else value for value in pair]


def offsets_file(bundle: Path) -> Path:
    """Return the path of the offsets file that belongs to the bundle of a site."""
    return bundle.with_suffix(".offsets.yaml")


def calibrate_without_truth(
    site: SiteData,
    universal: Bundle,
    *,
    height: Height | None,
    area: Area | None,
    seed: int,
    height_sd_m: float = 0.1,
    on_progress: Progress = lambda what, share: None,
) -> SiteCalibration:
    """Calibrate from ranges only, without ground truth.

    Args:
        height_sd_m: standard deviation of measured heights.

    Raises:
        DatasetError: the solution is not observable, an anchor position in the file is wrong, or an offset is
            implausible.
    """
    on_progress("solving for track and offsets", 0.05)
    known = regressors(site, universal)
    found = calibrate(
        site.anchors,
        site.tags,
        known,
        height=height,
        area=area,
        heights_m=site.height_m,
        height_sd_m=height_sd_m,
    )
    on_progress("solving for track and offsets", 0.4)
    track, ids = found.segments, [anchor.id for anchor in site.anchors.anchors]
    of_range = site.begins[track.tag] + track.row
    is_known = np.isfinite(found.pseudo_m) & (found.pseudo_sd_m <= MAX_TRUTH_SD_M)
    is_known, outliers = _without_outliers(track.ranges.range_m - found.pseudo_m, is_known)
    notes = list(found.notes)
    if (unknown := int((~is_known).sum()) - outliers) > 0:
        notes.append(
            f"{unknown} of {len(is_known)} ranges left out of the fit: the other anchors do not determine the tag position"
        )
    used = np.flatnonzero(is_known & _has_input(site)[of_range])
    pairs = {(found.tag_ids[tag], ids[row]): found.applied(tag, row) for tag, row in found.pairs()}
    common = found.mean()[0] if found.mean_is_significant else 0.0
    offsets = Offsets(common)
    if found.level == "pair":
        offsets = _pair_offsets(common, pairs)
    elif found.level == "anchor":
        own = {ids[row]: found.applied(tag, row)[0] for tag, row in found.pairs()}
        offsets = Offsets(common, anchors=own)

    def offset_changes_without(held_out: NDArray[np.intp]) -> dict[tuple[int, int], float]:
        again = found.without_ranges(_whole_segments(used[held_out], used, track.of))
        return {
            (found.tag_ids[tag], ids[row]): again.pair(tag, row)[0] - found.pair(tag, row)[0]
            for tag, row in found.pairs()
            if found.applied(tag, row)[0] != 0.0
        }

    solution = SiteSolution(
        rows=of_range[used],
        true_m=found.pseudo_m[used],
        antenna=found.fit.position[found.fit.observations.knot[found.fit.observations.of]][used],
        segment=track.of[used],
        stationary=track.is_stationary,
        pairs=pairs,
        offsets=offsets,
        level=found.level,
        outliers=outliers,
        notes=tuple(notes),
        offset_changes_without=offset_changes_without,
        track=found.fit.position,
        track_of=found.fit.observations.knot_segment,
        places=_places(found),
        network_sd=found.value(NETWORK)[1],
        line=found.value(LEVEL),
        common_sd_m=found.mean()[1],
        position_scatter_m=found.position_scatter_m,
    )
    return _select_model(site, universal, solution, seed, lambda s: on_progress("choosing", 0.4 + 0.6 * s))


def calibrate_with_truth(
    site: SiteData,
    universal: Bundle,
    paths: Sequence[Sequence[PosePath]],
    topic: str,
    *,
    time_offset_s: float | None,
    lever_arms_m: NDArray[np.float64] | None = None,
    estimate_lever_arm: bool = False,
    seed: int,
    on_progress: Progress = lambda what, share: None,
) -> SiteCalibration:
    """Calibrate against the poses of a localisation.

    Args:
        paths: for each tag, the poses of the robot that carries it, for each recording.
        time_offset_s, lever_arms_m, estimate_lever_arm: see `align_poses`.

    Raises:
        DatasetError: as for `calibrate_without_truth`; or too few ranges within the times of the localisation.
    """
    on_progress("time offset and lever arm", 0.05)
    joined = [
        PosePath.joined([one.shifted(by) for one, by in zip(own, site.shift_ns, strict=True)])
        for own in paths
    ]
    known = regressors(site, universal)
    found = align_poses(
        site.anchors,
        site.tags,
        joined,
        known,
        time_offset_s=time_offset_s,
        lever_arms_m=lever_arms_m,
        estimate_lever_arm=estimate_lever_arm,
    )
    on_progress("time offset and lever arm", 0.3)
    error = site.ranges.range_m - found.distance_m
    kept, outliers = _without_outliers(error, np.isfinite(error))
    rows = np.flatnonzero(kept & _has_input(site))
    check_anchors(site, found.position, kept)
    ids = [anchor.id for anchor in site.anchors.anchors]
    pairs = {
        (site.tags[tag].tag_id, ids[row]): found.pair(tag, row, float(site.anchors.sd[row]))
        for tag, row in found.pairs
    }
    common = float(np.median([value for value, sd in pairs.values() if sd <= MAX_TRUTH_SD_M] or [0.0]))
    spread = MAD_TO_SD * float(np.median([abs(value - common) for value, _ in pairs.values()]))
    # With few ranges, the other pairs determine the offset of a pair better than its own ranges.
    few = common, math.hypot(MAX_TRUTH_SD_M, spread)
    pairs = {pair: few if own[1] > MAX_TRUTH_SD_M else own for pair, own in pairs.items()}
    tag = site.tag

    def offset_changes_without(held_out: NDArray[np.intp]) -> dict[tuple[int, int], float]:
        rest = np.setdiff1d(rows, rows[held_out])
        own = [rest[tag[rest] == number] for number in range(len(site.tags))]
        again = align_poses(
            site.anchors,
            [one.take(part - begin) for one, part, begin in zip(site.tags, own, site.begins, strict=True)],
            joined,
            known.take(rest),
            time_offset_s=found.time_offset_s,
            lever_arms_m=found.lever_arm_m,
        )
        return {
            (site.tags[number].tag_id, ids[row]): again.pair(number, row, 0.0)[0]
            - found.pair(number, row, 0.0)[0]
            for number, row in again.pairs
        }

    solution = SiteSolution(
        rows=rows,
        true_m=found.distance_m[rows],
        antenna=found.position[rows],
        segment=tag[rows],
        stationary=np.zeros(len(site.tags), np.bool_),
        pairs=pairs,
        offsets=_pair_offsets(common, pairs),
        level="pair",
        outliers=outliers,
        notes=(),
        offset_changes_without=offset_changes_without,
        truth=topic,
        alignment=found,
        track=found.position[rows],
        track_of=tag[rows],
        places={},
    )
    return _select_model(site, universal, solution, seed, lambda s: on_progress("choosing", 0.3 + 0.7 * s))


def _select_model(
    site: SiteData, universal: Bundle, solution: SiteSolution, seed: int, on_share: Callable[[float], None]
) -> SiteCalibration:
    """Select the model; raises `DatasetError` for too few ranges and implausible offsets."""
    if len(solution.rows) < MIN_LABELLED:
        raise DatasetError(
            f"{len(solution.rows)} ranges whose true value can be estimated: too few",
            valid=f"{MIN_LABELLED} or more",
        )
    _check_offsets(solution.pairs)
    raw = site.labelled(
        solution.rows, solution.true_m, solution.segment, solution.stationary[solution.segment]
    )
    assert raw.tags is not None
    assert raw.anchors is not None
    pair_of = list(zip(raw.tags.tolist(), raw.anchors.tolist(), strict=True))
    data = raw.shifted(-solution.offsets.of(raw.tags, raw.anchors).astype(np.float64))

    def offset_change(held_out: NDArray[np.intp]) -> NDArray[np.float64]:
        of_pair = solution.offset_changes_without(held_out)
        return np.array([-of_pair.get(pair, 0.0) for pair in pair_of])

    with_network, candidates, missing = models.site_models(data, site.has_cirs, universal)
    selection = selections.select_for_site(with_network, candidates, seed, offset_change, on_share)
    without_cir = int((~_has_input(site)).sum())
    notes = (
        [f"{without_cir} ranges without a usable CIR: used for track and offsets only"] if without_cir else []
    )
    left = selection.errors[selection.chosen][: len(data)]
    raw_error, error = (position_error_m(site, solution, error_m) for error_m in (raw.error_m, left))
    return SiteCalibration(
        site=site,
        solution=solution,
        data=data,
        raw_m=raw.error_m,
        selection=selection,
        notes=(*solution.notes, *notes, *missing),
        position_error_m=(raw_error, error),
    )


def position_error_m(site: SiteData, solution: SiteSolution, error_m: NDArray[np.float64]) -> float:
    """Return the RMSE of the horizontal position due to range errors, m: least squares on the ranges of each second.

    Args:
        error_m: (n,), errors of the ranges of `solution.rows`.

    Returns:
        NaN if no second has ranges to three anchors that determine a position.
    """
    ranges = site.ranges.take(solution.rows)
    stamp, row = ranges.stamp_ns, ranges.anchor
    away = solution.antenna - site.anchors.position[row]
    unit = away[:, :2] / np.maximum(np.linalg.norm(away, axis=1), 0.05)[:, None]
    window = (stamp - stamp.min()) // round(WINDOW_S * 1e9)
    squared = []
    _, index = np.unique(np.stack([solution.segment, window]), axis=1, return_inverse=True)
    index = index.reshape(-1)
    order = np.argsort(index, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(index[order])) + 1):
        # Check that the position is observable: singular values of unit vectors grow with the square root of their number.
        if len(np.unique(row[part])) >= 3 and np.linalg.svd(unit[part])[1][1] > 0.3 * math.sqrt(len(part)):
            shift = np.linalg.lstsq(unit[part], error_m[part], rcond=None)[0]
            squared.append(float(shift @ shift))
    return math.sqrt(float(np.mean(squared))) if squared else math.nan


def regressors(site: SiteData, universal: Bundle) -> Regressors:
    """Return the regressors in addition to offsets: the universal network with CIRs, otherwise the received power."""
    if site.has_cirs:
        predicted = models.network_m(float_network(universal), site.inputs)
        rows = np.where(np.isfinite(predicted) & site.with_cir, predicted, 0.0)[:, None]
        # Ranges with small corrections have errors of centimetres; those with large ones have errors of decimetres.
        size = np.abs(rows[:, 0])
        edges = np.quantile(size[site.with_cir], np.linspace(0.0, 1.0, NETWORK_GROUPS + 1)[1:-1])
        # Ranges without a CIR are not corrected, so they have their own standard deviation.
        group = np.where(site.with_cir, np.searchsorted(edges, size), NETWORK_GROUPS)
        return Regressors((NETWORK,), rows, np.ones(1), np.array([NETWORK_SD]), group)
    power = site.rx_power_dbm.astype(np.float64)
    known = np.isfinite(power)
    if known.mean() < 0.5 or np.ptp(power[known]) < 1.0:
        return Regressors.none(len(power))
    return Regressors.one(LEVEL, np.where(known, power - np.median(power[known]), 0.0), 0.0, SLOPE_SD)


def _places(found: SelfCalibration) -> dict[str, tuple[float, float, float]]:
    """Return the positions of stationary tags, see `SiteSolution.places`."""
    stationary = np.flatnonzero(found.fit.observations.is_stationary).tolist()
    tag_of = dict(zip(found.segments.of.tolist(), found.segments.tag.tolist(), strict=True))
    positions = Counter(tag_of[segment] for segment in stationary)
    number: Counter[int] = Counter()
    places = {}
    for segment in stationary:
        tag = tag_of[segment]
        number[tag] += 1
        suffix = f" #{number[tag]}" if positions[tag] > 1 else ""
        x, y, z = found.fit.position[found.fit.observations.knot_segment == segment][0].tolist()
        places[f"{found.tag_ids[tag]}{suffix}"] = (x, y, z)
    return places


def _pair_offsets(common: float, pairs: Pairs) -> Offsets:
    sds = {pair: sd for pair, (_, sd) in pairs.items() if math.isfinite(sd)}
    return Offsets(common, pairs={pair: value for pair, (value, _) in pairs.items()}, pair_sd=sds)


def _without_outliers(
    error_m: NDArray[np.float64], known: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], int]:
    """Return the mask of `known` errors that are not outliers, bool (n,), and the number of outliers."""
    if not known.any():
        return known, 0
    away = np.abs(error_m - np.median(error_m[known]))
    limit = max(OUTLIER_M, OUTLIER_SDS * MAD_TO_SD * float(np.median(away[known])))
    kept = known & (away <= limit)
    return kept, int(known.sum() - kept.sum())


def _whole_segments(
    held_out: NDArray[np.intp], labelled: NDArray[np.intp], segment: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return all ranges of the held-out segments, including the unlabelled ranges between the labelled ones.

    Args:
        held_out: subset of `labelled`, which is sorted.
        segment: int (r,), segment of each range, in the order of time.
    """
    every = np.arange(len(segment))
    before = np.maximum(np.searchsorted(labelled, every, side="right") - 1, 0)
    after = np.minimum(before + 1, len(labelled) - 1)
    nearest = np.where(segment[labelled[before]] == segment, labelled[before], labelled[after])
    found: NDArray[np.bool_] = np.isin(nearest, held_out) & (segment[nearest] == segment)
    return found


def _has_input(site: SiteData) -> NDArray[np.bool_]:
    """Return the mask of ranges for fitting the model, bool (r,). The others affect only track and offsets."""
    return site.with_cir if site.has_cirs else np.ones(len(site.with_cir), np.bool_)


def _check_offsets(pairs: Pairs) -> None:
    median = float(np.median([value for value, _ in pairs.values()]))
    for (tag, anchor), (value, _) in pairs.items():
        what = f"an offset of {value:.2f} m of tag {format_id(tag)} and anchor {format_id(anchor)}"
        if abs(value - median) > MAX_OFFSET_M:
            raise DatasetError(
                f"{what}; the median of all pairs is {median:.2f} m",
                valid=f"the true position of anchor {format_id(anchor)} in the anchors file; radios of one kind differ by "
                f"less than {MAX_OFFSET_M:g} m",
            )
        if abs(value) > MAX_OFFSET_M:
            raise DatasetError(
                what,
                valid=f"{MAX_OFFSET_M:g} m at most: set the antenna delay first (`uwb-mitigation board antenna-delay`)",
            )
