"""Calibrate a site from a drive: select a model for the true ranges and offsets of a `SiteSolution`, and write it."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.held_out import (
    BLOCK_S,
    PROMISED_SHARE,
    RAW,
    HeldOut,
    decisive,
    ranges_text,
    select,
)
from uwb_mitigation.calibration.site_data import SiteData, read_site
from uwb_mitigation.calibration.solution import (
    NONE,
    ONE,
    PAIR,
    Pairs,
    SiteSolution,
    solve_without_truth,
)
from uwb_mitigation.errors import DatasetError, ModelError, ParameterError, format_id
from uwb_mitigation.files import write_all_atomically
from uwb_mitigation.mitigation.correction import CorrectionRule
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.bundle import Bundle, build_bundle
from uwb_mitigation.mitigation.model.floating import float_network, scaled
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.evaluation.intervals import fit_intervals
from uwb_mitigation.training.fit.linear_fit import fit_linear_bias
from uwb_mitigation.training.fit.model_card import card_of
from uwb_mitigation.types.anchors import AnyAnchors, as_anchors
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.offsets import Offsets, dump_offsets
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Heights

MIN_LABELLED = 40
"""Ranges with a known true value: with fewer, the held-out half does not show a gain of `MIN_GAIN`."""

MAX_OFFSET_M = 1.0
"""Radios of one kind without individual antenna delays differ by 0.3 m at three sigma (Decawave APS014)."""

MIN_PROMISE = 0.012
"""Offsets of single anchors without ground truth are refused if less is promised: with 0.008, those that fit walls increased the live
error of another drive by 4 % (simulated site 219). On rings of anchors, refused offsets would have reduced it by 5 to 21 % in seven drives
(`docs/experiments/calibrate_drives.py`): no statistic was found that separates these cases."""

HEIGHT_SD_M = 0.1
"""Standard deviation of measured heights for the locator of a test."""

COMMON = "common offset"
"""The correction that subtracts one offset from all ranges."""

NO_MODEL, LINE, NETWORK = "", "line", "universal network"
"""Offsets only; a line in the received power and, if it is known, the power gap; the universal network."""

SHIPPED = "shipped model alone"
"""The universal network without offsets: what is used without a calibration."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteModel:
    """A model of the kind `NO_MODEL`, `LINE` or `NETWORK`, and the linear bias of its model card."""

    kind: str
    linear_bias: LinearBiasModel

    def correction_m(self, site: SiteData) -> NDArray[np.float64]:
        """Return the predicted errors of all ranges, float64 (r,), m; 0 where a power that the line needs is unknown."""
        if self.kind == NETWORK:
            return site.table["universal_m"]
        line = self.linear_bias
        # Without a power gap, the first-path power is not needed.
        first_path_dbm = (
            site.table["first_path_power_dbm"] if line.per_power_gap else site.table["rx_power_dbm"]
        )
        predicted_m = line.predict_m(site.table["rx_power_dbm"], first_path_dbm).astype(np.float64)
        return np.where(np.isfinite(predicted_m), predicted_m, 0.0)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SiteCalibration:
    """A calibration, before it is written.

    Attributes:
        site: recorded data. solution: true ranges and offsets.
        held_out: errors of `raw` and of each correction on the halves of the drive, each corrected by the other half, and on
            each drive of the check.
        baseline: what is used without a calibration: `SHIPPED` if it applies, otherwise `raw`.
        chosen: name of the selected correction. level: what has a separate offset. model: fitted to all ranges.
        notes: all notes.
    """

    site: SiteData
    solution: SiteSolution
    held_out: tuple[HeldOut, ...]
    baseline: str
    chosen: str
    level: str
    model: SiteModel
    notes: tuple[str, ...]

    @property
    def offsets(self) -> Offsets:
        """Offsets of the radios."""
        return self.solution.offsets(self.level)

    @property
    def pairs(self) -> Pairs:
        """The offset of each pair that is subtracted, and its standard deviation, m."""
        return self.solution.subtracted(self.level)

    @property
    def raw_error_m(self) -> NDArray[np.float64]:
        """The errors of the ranges of `solution.rows` as measured, (n,), m."""
        return self.site.ranges.range_m[self.solution.rows] - self.solution.true_m

    @property
    def held_out_error_m(self) -> NDArray[np.float64]:
        """The held-out errors of the ranges of `solution.rows`, corrected by the chosen correction, (n,), m; NaN: unknown."""
        return self.held_out[0].residual_m[self.chosen][self.solution.rows]

    @property
    def mae_m(self) -> dict[str, float]:
        """Return {`raw` or correction: MAE on the held-out halves}, m."""
        return {name: self.held_out[0].mae_m(name) for name in self.held_out[0].residual_m}

    @property
    def live_position_change(self) -> float:
        """Return the promised change of the live position error on another drive, relative to the baseline; NaN: unknown.

        It is the upper end of an interval. The locator estimates the common offset itself, so that without ground truth only
        offsets of single anchors promise a change.
        """
        if self.solution.truth is not None:
            return -min(
                errors.live_gain(self.chosen, self.baseline).low for errors in decisive(self.held_out)
            )
        if self.level == ONE:
            return 0.0
        gain = min(errors.range_gain(self.chosen, COMMON).low for errors in self.held_out)
        return -PROMISED_SHARE * max(gain, 0.0)

    @property
    def refusal(self) -> str:
        """Return why the calibration does not help; empty: it does."""
        for errors in self.held_out:
            drive = "on the drive of the check " if errors is not self.held_out[0] else ""
            if reason := errors.refusal(self.chosen, self.baseline):
                return drive + reason
        is_raw = self.solution.truth is None and self.baseline == RAW
        if is_raw and not self.live_position_change <= -MIN_PROMISE:
            reason = self.solution.offsets_refused or "are not clearly better"
            return f"the locator estimates the common offset itself, and offsets of single anchors {reason}"
        return ""

    def summary(self) -> str:
        """Return the result in a sentence."""
        change = self.live_position_change
        text = f"Compared with {ranges_text(self.baseline)}, the live position error on another drive "
        text += f"decreases by at least {-change:.0%}." if change < 0.0 else "is not expected to change."
        return f"Calibration does not help: {self.refusal}. {text}" if self.refusal else text

    def as_json(self) -> dict[str, object]:
        """Return the result of `uwb-mitigation calibrate`."""
        solution, halves, mae_m = self.solution, self.held_out[0], self.mae_m
        return {
            "offsets_m": {pair: value for pair, (value, _) in self.pairs.items()},
            "offset_sd_m": {pair: sd for pair, (_, sd) in self.pairs.items()},
            "live_position_change": self.live_position_change,
            "live_position_m": {name: halves.live_rmse_m(name) for name in halves.residual_m},
            "compared_with": self.baseline,
            "raw_mae_m": mae_m[RAW],
            "baseline_mae_m": mae_m[self.baseline],
            "calibrated_mae_m": mae_m[self.chosen],
            "check_mae_m": [
                [errors.mae_m(self.baseline), errors.mae_m(self.chosen)] for errors in self.held_out[1:]
            ],
            "truth": solution.truth or "none",
            "refused": None,
            "chosen": self.chosen,
            "candidates": {name: value for name, value in mae_m.items() if name != RAW},
            "ranges": sum(map(len, self.site.tags)),
            "labelled": len(solution.rows),
            "outliers": solution.outliers,
            "notes": self.notes,
            "skipped": self.site.skipped,
            "localisation": solution.alignment,
        }

    def write(self, output: Path, universal: Bundle, name: str) -> tuple[Bundle, Path]:
        """Write the bundle and the offsets (`X.offsets.yaml`) atomically.

        Args:
            output: path of the bundle.
            universal: bundle that the models started from.
            name: human-readable name of the recordings.

        Raises:
            ModelError: they cannot be written.
        """
        truth, model = self.solution.truth, self.model
        method = "without truth" if truth is None else f"with truth from {truth}"
        training = {
            "data": f"{name}, calibrated {method}",
            "calibrated": method,
            "chosen": self.chosen,
            "measurements": len(self.solution.rows),
            "split": "held out: halves of the drive",
            "started_from": f"{universal.model_id:08x}",
            "recipe": {"line": model.kind == LINE, "network": model.kind == NETWORK},
            "metrics_m": {row: {"mae": round(value, 4)} for row, value in self.mae_m.items()},
        }
        card = replace(
            universal.card,
            name=output.stem,
            linear_bias=model.linear_bias,
            training=training,
        )
        network = universal.model
        if model.kind == LINE:
            network = graph.float_model(scaled(float_network(universal), 0.0))
            data = _labelled(self.site, self.solution, self.level)
            fitted = output.stem, universal.card.architecture, data, model.linear_bias
            card = replace(
                card_of(*fitted, data, self.held_out_error_m, training), needs_cir=False, quantised=False
            )
        bundle, content = build_bundle(output, network, card)
        offsets_path = offsets_file(output)
        comment = (
            f"Offsets of the radios, m, for model {bundle.model_id:08x} ({output.name}): use both together.\n"
            f"Estimated by uwb-mitigation calibrate in {name}, {method}."
        )
        write_all_atomically({output: content, offsets_path: dump_offsets(self.offsets, comment)}, ModelError)
        return bundle, offsets_path


def offsets_file(bundle: Path) -> Path:
    """Return the path of the offsets file that belongs to the bundle of a site."""
    return bundle.with_suffix(".offsets.yaml")


def calibrate(
    recordings: Iterable[Iterable[Record]],
    anchors: AnyAnchors,
    model: Bundle,
    *,
    height_m: float | None = None,
    check: Iterable[Iterable[Record]] = (),
) -> SiteCalibration:
    """Calibrate a site from drives, without true positions of the tags.

    The same as `uwb-mitigation calibrate`, except that a calibration that does not help is returned: see `refusal`.

    Args:
        recordings: records of each drive, in the order of time.
        anchors: surveyed positions of the anchors: a map, {id: (x, y, z)} in m, or the path of a file.
        model: bundle to start from, such as `load_model("universal")`.
        height_m: constant height of the tags' antennas in the frame of the anchors; None: unknown.
        check: records of other drives, on which the calibration is only tested.

    Raises:
        DatasetError: the drives do not determine the calibration, or an anchor position is wrong.
        ParameterError: several models, as `load_model()` returns.
    """
    if not isinstance(model, Bundle):
        raise ParameterError("several models", valid='one to start from, such as load_model("universal")')
    height, anchors = None if height_m is None else Height(height_m), as_anchors(anchors)
    site = read_site(recordings, anchors, model)
    checks = [read_site([records], anchors, model) for records in check]
    return calibrate_site(site, model, solve_without_truth(site, height=height, area=None), check=checks)


def calibrate_site(
    site: SiteData,
    universal: Bundle,
    solution: SiteSolution,
    *,
    check: Sequence[SiteData] = (),
) -> SiteCalibration:
    """Select a correction for the ranges of a solution, see `held_out.select`.

    Args:
        site: recorded ranges.
        universal: bundle that the models start from.
        solution: true ranges and offsets.
        check: other drives at the site, on which the correction must not be worse, either.

    Raises:
        DatasetError: too few ranges have a known true range, an offset is implausible, or a half of the drive does not
            determine the calibration.
    """
    if len(solution.rows) < MIN_LABELLED:
        raise DatasetError(
            f"too few ranges whose true value can be estimated: {len(solution.rows)}",
            valid=f"at least {MIN_LABELLED}",
        )
    _check_offsets(solution.pairs)
    is_first, is_separate = site.halves()
    halves = [site.select(mask) for mask in (is_first, ~is_first)]
    try:
        solved = [solution.solve_part(half) for half in halves]
    except DatasetError as error:
        raise DatasetError(f"a half of the drive: {error}", valid="a longer drive") from error
    notes = list(solution.notes)
    corrections = {RAW: (NONE, NO_MODEL)}
    if site.has_cirs:
        corrections[SHIPPED] = NONE, NETWORK
        if without_cir := int((~site.table["is_usable"]).sum()):
            notes.append(f"{without_cir} ranges without a usable CIR are only used for track and offsets")
    else:
        notes.append("no networks: the recording has no CIRs that the universal model was trained for")
    baseline = list(corrections)[-1]
    candidates = {_name(level, kind): (level, kind) for level, kind in _candidates(site, solution)}
    corrections |= candidates
    evaluate = functools.partial(_held_out, universal, corrections)
    first, second = zip(halves, solved, strict=True)
    first_half = evaluate(*first, second, is_separate=is_separate)
    second_half = evaluate(*second, first, is_separate=is_separate)
    drives = (
        evaluate(drive, solution.solve_part(drive), (site, solution), is_separate=True) for drive in check
    )
    held_out = [first_half.merged(second_half, is_first), *drives]
    chosen = select(held_out, list(candidates), baseline)
    level, kind = candidates[chosen]
    return SiteCalibration(
        site=site,
        solution=solution,
        held_out=tuple(held_out),
        baseline=baseline,
        chosen=chosen,
        level=level,
        model=_fit(kind, site, solution, level),
        notes=tuple(notes),
    )


def _held_out(
    universal: Bundle,
    corrections: Mapping[str, tuple[str, str]],
    site: SiteData,
    reference: SiteSolution,
    training: tuple[SiteData, SiteSolution],
    *,
    is_separate: bool,
) -> HeldOut:
    """Return the errors of corrections, {name: (level of the offsets, kind of the model)}, that were fitted to other data."""
    training_site, solution = training
    block = site.ranges.stamp_ns // round(BLOCK_S * NS_PER_S)
    residual_m, live_m = dict[str, NDArray[np.float64]](), dict[str, NDArray[np.float64]]()
    for name, (level, kind) in corrections.items():
        model = _fit(kind, training_site, solution, level)
        predicted_m = np.where(site.table["is_usable"], model.correction_m(site), 0.0)
        range_m = site.ranges.range_m - predicted_m
        offsets = solution.offsets(level)
        corrected_m = np.maximum(range_m - _offsets_m(site, offsets), 0.0)
        # Without ground truth the track of the reference contains no common offset, because the locator estimates it.
        remaining_m = solution.common_m - offsets.default if solution.truth is None else 0.0
        residual_m[name] = reference.errors_of(corrected_m - remaining_m) + remaining_m
        if solution.truth is not None:
            # The locator does not use the variance of ranges that no model corrected.
            variance_m2 = np.full(len(range_m), np.nan)
            if model.kind == NETWORK:
                unscored = np.zeros(len(range_m), np.float32)
                rule = CorrectionRule(universal.card)
                variance_m2 = rule.apply(predicted_m.astype(np.float32), unscored)[1].astype(np.float64)
            elif model.kind == LINE:
                intervals = fit_intervals(residual_m[name], predicted_m, block.astype(str))
                variance_m2 = intervals.variance_of(predicted_m)
            live_m[name] = _live_errors_m(site, reference, corrected_m, variance_m2)
    return HeldOut(block, residual_m, live_m, is_separate)


def _live_errors_m(
    site: SiteData, reference: SiteSolution, range_m: NDArray[np.float64], variance_m2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the error of the live position at each range, (r,), m; NaN: no position, or no reference."""
    height = reference.height
    corrected = replace(
        site.ranges, range_m=range_m, variance_m2=variance_m2, is_corrected=np.isfinite(variance_m2)
    )
    error_m = np.full(len(range_m), np.nan)
    axes = slice(0, 3 if height is None and site.height_m is None else 2)
    for number in range(len(site.tags)):
        rows = np.flatnonzero(site.tag == number)
        ranges, heights = corrected.take(rows), None
        if site.height_m is not None:
            heights = Heights(ranges.stamp_ns, site.height_m[rows], np.full(len(rows), HEIGHT_SD_M**2))
        config = EstimatorConfig(site.anchors, height=height, heights=heights)
        track = TagEstimator(config).run(ranges)
        if not len(track):
            continue
        index = np.searchsorted(track.stamp_ns, ranges.stamp_ns, side="right").clip(1) - 1
        difference = track.position[index] - reference.antenna_position[rows]
        has_position = track.stamp_ns[index] == ranges.stamp_ns
        error_m[rows[has_position]] = np.linalg.norm(difference[has_position, axes], axis=1)
    return error_m


def _candidates(site: SiteData, solution: SiteSolution) -> list[tuple[str, str]]:
    """Return (level of the offsets, kind of the model) of the corrections that can be selected, in order of complexity."""
    if solution.truth is None and site.has_cirs:
        # What the network leaves behind walls looks like offsets of anchors, on each drive the same.
        return [(ONE, NETWORK)]
    if site.has_cirs:
        return [(ONE, NETWORK), (PAIR, NETWORK)]
    if solution.truth is None:
        # A line in the received power does not transfer to other drives.
        return [(ONE, NO_MODEL), *([] if solution.offsets_refused else [(PAIR, NO_MODEL)])]
    return [(ONE, NO_MODEL), (PAIR, NO_MODEL), (ONE, LINE), (PAIR, LINE)]


def _name(level: str, kind: str) -> str:
    """Return the name of a correction: what is subtracted, and the kind of the model."""
    offsets = COMMON if level == ONE else "offsets"
    return f"{offsets} + {kind}" if kind else offsets


def _check_offsets(pairs: Pairs) -> None:
    median = float(np.median([value for value, _ in pairs.values()]))
    for (tag, anchor), (value, _) in pairs.items():
        what = f"offset of {value:.2f} m of tag {format_id(tag)} and anchor {format_id(anchor)}"
        if abs(value - median) > MAX_OFFSET_M:
            raise DatasetError(
                f"{what}; the median of all pairs is {median:.2f} m",
                valid=f"the true position of anchor {format_id(anchor)} in the anchors file; radios of one kind differ by "
                f"less than {MAX_OFFSET_M:g} m",
            )
        if abs(value) > MAX_OFFSET_M:
            raise DatasetError(
                what,
                valid=f"at most {MAX_OFFSET_M:g} m: check the unit (metres) and the antenna delays of the radios",
            )


def _offsets_m(site: SiteData, offsets: Offsets) -> NDArray[np.float64]:
    """Return the offset of each range, (r,), m."""
    tag_ids = np.array([tag.tag_id for tag in site.tags], np.uint64)[site.tag]
    anchor_ids = np.array([anchor.id for anchor in site.anchors.anchors], np.uint64)[site.ranges.anchor]
    return offsets.lookup(tag_ids, anchor_ids).astype(np.float64)


def _fit(kind: str, site: SiteData, solution: SiteSolution, level: str) -> SiteModel:
    """Return a model of this kind for ranges with the offsets subtracted."""
    if kind != LINE:
        return SiteModel(kind, LinearBiasModel(0.0))
    data = _labelled(site, solution, level)
    has_gap = bool(np.isfinite(data.rx_power_dbm - data.first_path_power_dbm).mean() > 0.5)
    first_path_dbm = data.first_path_power_dbm if has_gap else None
    line = fit_linear_bias(data.configurations, data.rx_power_dbm, first_path_dbm, data.error_m)
    return SiteModel(LINE, line)


def _labelled(site: SiteData, solution: SiteSolution, level: str) -> Dataset:
    """Return the ranges of `solution.rows` with the offsets subtracted."""
    offset_m = _offsets_m(site, solution.offsets(level))[solution.rows]
    return site.to_dataset(solution.rows, solution.true_m, offset_m)
