"""Calibrate a site from a drive: select a model for the true ranges and offsets of a `SiteSolution`, and write it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.live_position import RAW, LiveError, live_errors
from uwb_mitigation.calibration.selection import SiteErrors, held_out_site_errors
from uwb_mitigation.calibration.site_data import SiteData, read_site
from uwb_mitigation.calibration.solution import (
    Pairs,
    Progress,
    SiteSolution,
    solve_without_truth,
    usable_ranges,
)
from uwb_mitigation.errors import DatasetError, ModelError, ParameterError, format_id
from uwb_mitigation.files import write_all_atomically
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.bundle import Bundle, build_bundle
from uwb_mitigation.mitigation.model.floating import float_network, scaled
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.evaluation.intervals import fit_intervals
from uwb_mitigation.training.fit.candidates import FittedModel, site_models
from uwb_mitigation.training.fit.model_card import card_of, ood_bands_of
from uwb_mitigation.training.fit.selection import MIN_GAIN
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.offsets import Offsets, dump_offsets

MIN_LABELLED = 40
MAX_OFFSET_M = 1.0
"""Radios of one kind without individual antenna delays differ by 0.3 m at three sigma (Decawave APS014)."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SiteCalibration:
    """A calibration, before it is written.

    Attributes:
        site: recorded data. solution: true ranges and offsets.
        data: the ranges of `solution.rows`, with the offsets subtracted. raw_error_m: their errors as measured, (n,).
        errors: held-out errors of each candidate. chosen: name of the selected candidate, `model`: fitted to all ranges.
        live: {`raw` or candidate: error of the live position on held-out segments}.
        notes: all notes.
    """

    site: SiteData
    solution: SiteSolution
    data: Dataset
    raw_error_m: NDArray[np.float64]
    errors: SiteErrors
    chosen: str
    model: FittedModel
    live: dict[str, LiveError]
    notes: tuple[str, ...]

    @property
    def offsets(self) -> Offsets:
        """Offsets of the radios."""
        return self.solution.offsets

    @property
    def held_out_error_m(self) -> NDArray[np.float64]:
        """Return the errors of the chosen model on held-out segments, shape (n,), m."""
        return self.errors.by_segment[self.chosen]

    @property
    def raw_mae_m(self) -> float:
        """Return the MAE of the measured ranges."""
        return float(np.abs(self.raw_error_m).mean())

    @property
    def calibrated_mae_m(self) -> float:
        """Return the MAE of the chosen model on held-out segments and anchors."""
        return self.errors.mae()[self.chosen]

    @property
    def live_position_change(self) -> float:
        """Return the change of the live position error (share); negative: it decreases; NaN: unknown."""
        return self.live[self.chosen].change_from(self.live[RAW])

    @property
    def refusal(self) -> str:
        """Return why the calibration does not help; empty: it does."""
        if self.live[self.chosen].is_worse_than(self.live[RAW]):
            return "the live position becomes worse"
        if self.calibrated_mae_m > (1.0 - MIN_GAIN) * self.raw_mae_m:
            return "the ranges do not improve"
        raw_m, calibrated_m = self.solution.position_scatter_m
        if calibrated_m > raw_m:
            return "the anchors agree less about the positions"
        return ""

    @property
    def lacks_gain(self) -> bool:
        """Whether the calibration does not help."""
        return bool(self.refusal)

    def summary(self) -> str:
        """Return the result in a few sentences, live position first."""
        truth = self.solution.truth
        raw, calibrated = self.live[RAW], self.live[self.chosen]
        text = ""
        if not math.isnan(raw.locator_m):
            against = (
                "an estimate: the reference is the smoothed track" if truth is None else f"against {truth}"
            )
            text = (
                f"Live position error on held-out segments ({against}): {raw.locator_m:.3f} m raw, "
                f"{calibrated.locator_m:.3f} m calibrated ({self.live_position_change:+.0%}). "
            )
        kind = "residual against the other anchors" if truth is None else f"error against {truth}"
        text += (
            f"Mean absolute range {kind}: {self.raw_mae_m:.3f} m raw, {self.calibrated_mae_m:.3f} m calibrated "
            f"({self.chosen})."
        )
        if self.refusal:
            text += f" Calibration does not help: {self.refusal}."
        return text

    def as_json(self) -> dict[str, object]:
        """Return the result of `uwb-mitigation calibrate`."""
        solution, model = self.solution, self.model
        factor = 0.0 if model.network is None else 1.0 if model.factor is None else model.factor
        return {
            "offsets_m": {pair: value for pair, (value, _) in solution.pairs.items()},
            "offset_sd_m": {pair: sd for pair, (_, sd) in solution.pairs.items()},
            "offsets_of": solution.offset_level,
            "live_position_change": self.live_position_change,
            "live_position_m": self.live,
            "raw_mae_m": self.raw_mae_m,
            "calibrated_mae_m": self.calibrated_mae_m,
            "truth": solution.truth or "none",
            "refused": None,
            "chosen": self.chosen,
            "candidates": self.errors.mae(),
            "ranges": sum(map(len, self.site.tags)),
            "labelled": len(self.data),
            "outliers": solution.outliers,
            "position_scatter_m": solution.position_scatter_m,
            "network_factor": [factor, solution.network_sd],
            "line": model.linear_bias,
            "positions": solution.stationary_positions,
            "notes": self.notes,
            "skipped": self.site.skipped,
            "localisation": solution.alignment,
        }

    def write(self, output: Path, universal: Bundle, name: str) -> tuple[Bundle, Path]:
        """Write the bundle and the offsets (`X.offsets.yaml`) atomically.

        Args:
            output: path of the bundle.
            universal: bundle that the candidates started from.
            name: human-readable name of the recordings.

        Raises:
            ModelError: they cannot be written.
        """
        truth, model = self.solution.truth, self.model
        method = "without truth" if truth is None else f"with truth from {truth}"
        metrics = {"raw": self.raw_mae_m, **self.errors.mae()}
        training = {
            "data": f"{name}, calibrated {method}",
            "calibrated": method,
            "chosen": self.chosen,
            "measurements": len(self.data),
            "configurations": len(self.data.names),
            "split": "held out: segments of the track, and anchors",
            "started_from": f"{universal.model_id:08x}",
            "recipe": {"line": model.linear_bias.needs_power, "network": model.network is not None},
            "metrics_m": {row: {"mae": round(value, 4)} for row, value in metrics.items()},
        }
        has_network = model.network is not None
        network = scaled(float_network(universal), 0.0) if model.network is None else model.network
        ood_bands = ood_bands_of(self.data) if has_network else None
        residual_m = self.held_out_error_m * self.solution.residual_scale
        fitted = output.stem, universal.architecture, self.data, model.linear_bias
        card = card_of(*fitted, self.data, residual_m, training, ood_bands)
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
            f"Estimated by uwb-mitigation calibrate in {name}, {method}."
        )
        write_all_atomically({output: content, offsets_path: dump_offsets(self.offsets, comment)}, ModelError)
        return bundle, offsets_path


def offsets_file(bundle: Path) -> Path:
    """Return the path of the offsets file that belongs to the bundle of a site."""
    return bundle.with_suffix(".offsets.yaml")


def calibrate(
    recordings: Iterable[Iterable[Record]],
    anchors: AnchorMap,
    model: Bundle,
    *,
    height_m: float | None = None,
) -> SiteCalibration:
    """Calibrate a site from drives, without true positions of the tags.

    The same as `uwb-mitigation calibrate`, except that a calibration that does not help is returned: see `refusal`.

    Args:
        recordings: records of each drive, in the order of time.
        anchors: surveyed positions of the anchors.
        model: bundle to start from, such as `load_model("universal")`.
        height_m: constant height of the tags' antennas in the frame of the anchors; None: unknown.

    Raises:
        DatasetError: the drives do not determine the calibration, or an anchor position is wrong.
        ParameterError: several models, as `load_model()` returns.
    """
    if not isinstance(model, Bundle):
        raise ParameterError("several models", valid='one to start from, such as load_model("universal")')
    site = read_site(recordings, anchors, model.card)
    height = None if height_m is None else Height(height_m)
    return calibrate_site(site, model, solve_without_truth(site, model, height=height, area=None), seed=0)


def calibrate_site(
    site: SiteData,
    universal: Bundle,
    solution: SiteSolution,
    *,
    seed: int,
    on_progress: Progress = lambda stage, fraction: None,
) -> SiteCalibration:
    """Select a model for the ranges and offsets of a solution.

    See `SiteErrors.select`. If offsets of pairs increase the error of the live position, all pairs share one offset.

    Args:
        site: recorded ranges.
        universal: bundle that the candidates start from.
        solution: true ranges and offsets.
        seed: seed of the splits and of the training.
        on_progress: called with the stage and the finished share of it, 0 to 1.

    Raises:
        DatasetError: too few ranges have a known true range, or an offset is implausible.
    """
    if len(solution.rows) < MIN_LABELLED:
        raise DatasetError(
            f"too few ranges whose true value can be estimated: {len(solution.rows)}",
            valid=f"at least {MIN_LABELLED}",
        )
    _check_offsets(solution.pairs)
    calibration = _select_model(site, universal, solution, seed, on_progress)
    if calibration.refusal and solution.offset_level != "one":
        common = _select_model(site, universal, solution.with_common_offset(), seed, on_progress)
        if not common.refusal:
            return common
    return calibration


def _select_model(
    site: SiteData, universal: Bundle, solution: SiteSolution, seed: int, on_progress: Progress
) -> SiteCalibration:
    raw = site.to_dataset(
        solution.rows, solution.true_m, solution.segment, solution.stationary[solution.segment]
    )
    assert raw.tags is not None
    assert raw.anchors is not None
    data = raw.shifted(-solution.offsets.lookup(raw.tags, raw.anchors).astype(np.float64))
    data, candidates, notes = site_models(data, site.has_cirs, universal)
    if without_cir := int((~usable_ranges(site)).sum()):
        notes = [f"{without_cir} ranges without a usable CIR are only used for track and offsets", *notes]
    pairs = list(zip(raw.tags.tolist(), raw.anchors.tolist(), strict=True))

    def offset_change(held_out: NDArray[np.intp]) -> NDArray[np.float64]:
        changes = solution.offset_changes_without(held_out)
        return np.array([-changes.get(pair, 0.0) for pair in pairs])

    errors = held_out_site_errors(
        data, candidates, seed, offset_change, lambda fraction: on_progress("selecting the model", fraction)
    )
    live = live_errors(site, solution, errors.by_segment, _variances(raw, errors, solution.residual_scale))
    chosen = errors.select(live)
    (candidate,) = (item for item in candidates if item.name == chosen)
    return SiteCalibration(
        site=site,
        solution=solution,
        data=data,
        raw_error_m=raw.error_m,
        errors=errors,
        chosen=chosen,
        model=candidate.fit(data, seed),
        live=live,
        notes=(*solution.notes, *notes),
    )


def _variances(raw: Dataset, errors: SiteErrors, scale: float) -> dict[str, NDArray[np.float64]]:
    """Return the variances (n,) that a bundle with each model publishes, m^2."""
    variances = {}
    for name, error_m in errors.by_segment.items():
        predicted_m = raw.error_m - error_m
        intervals = fit_intervals(scale * error_m, predicted_m, raw.configurations)
        variances[name] = intervals.variance_m2 + intervals.variance_per_m2 * predicted_m**2
    return variances


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
