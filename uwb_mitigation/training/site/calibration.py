"""Calibrate a site from a drive: select a model for the true ranges and offsets of `site_solution`, and write it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ModelError, format_id
from uwb_mitigation.files import write_all_atomically
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.bundle import Bundle, build_bundle
from uwb_mitigation.mitigation.model.floating import float_network, scaled
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit import candidates as models
from uwb_mitigation.training.fit import selection as selections
from uwb_mitigation.training.fit.cards import card_of, ood_bands_of
from uwb_mitigation.training.fit.selection import MIN_GAIN, Selection
from uwb_mitigation.training.site.data import SiteData
from uwb_mitigation.training.site.solution import Pairs, Progress, SiteSolution, usable_ranges
from uwb_mitigation.types.offsets import Offsets, dump_offsets

MIN_LABELLED = 40
MAX_OFFSET_M = 1.0
"""Radios of one kind without individual antenna delays differ by 0.3 m at three sigma (Decawave APS014)."""

WINDOW_S = 1.0
"""Duration of the ranges from which one position error is computed."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SiteCalibration:
    """A calibration, before it is written.

    Attributes:
        site: recorded data. solution: true ranges and offsets.
        data: the ranges of `solution.rows`, with the offsets subtracted. raw_error_m: their errors as measured, (n,).
        selection: the selected model. notes: all notes.
        position_error_m: RMSE of the horizontal position due to held-out errors, raw and with the chosen model.
    """

    site: SiteData
    solution: SiteSolution
    data: Dataset
    raw_error_m: NDArray[np.float64]
    selection: Selection
    notes: tuple[str, ...]
    position_error_m: tuple[float, float]

    @property
    def offsets(self) -> Offsets:
        """Offsets of the radios."""
        return self.solution.offsets

    @property
    def held_out_error_m(self) -> NDArray[np.float64]:
        """Return the errors of the chosen model on held-out segments, shape (n,), m."""
        return self.selection.errors[self.selection.chosen][: len(self.data)]

    @property
    def raw_mae_m(self) -> float:
        """Return the MAE of the measured ranges."""
        return float(np.abs(self.raw_error_m).mean())

    @property
    def calibrated_mae_m(self) -> float:
        """Return the MAE of the chosen model on held-out segments and anchors."""
        return self.selection.mae()[self.selection.chosen]

    @property
    def lacks_gain(self) -> bool:
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
        raw, residual = self.raw_error_m, self.held_out_error_m
        return min(
            1.0 - float(np.abs(residual + by).mean() / max(np.abs(raw + by).mean(), 1e-9))
            for by in (-wrong, 0.0, wrong)
        )

    def summary(self) -> str:
        """Return the result in one sentence."""
        truth, chosen = self.solution.truth, self.selection.chosen
        kind = "residual" if truth is None else "error"
        against = (
            "against the other anchors, not against ground truth" if truth is None else f"against {truth}"
        )
        text = (
            f"Mean absolute range {kind} on held-out segments, {against}: {self.raw_mae_m:.3f} m raw, "
            f"{self.calibrated_mae_m:.3f} m calibrated ({chosen})"
        )
        for what, (raw, calibrated) in (
            ("positions without one anchor scatter by", self.solution.position_scatter_m),
            ("position error on held-out segments", self.position_error_m),
        ):
            if not math.isnan(raw):
                text += f"; {what} {raw:.3f} m raw, {calibrated:.3f} m calibrated"
        if self.lacks_gain:
            return f"{text}. Calibration does not improve both ranges and positions."
        if (gain := self.gain_lower_bound) <= 0.0:
            return f"{text}. The reduction of the range {kind} is smaller than its uncertainty."
        return f"{text}. Calibration reduces the range {kind} by at least {gain:.0%}."

    def as_json(self) -> dict[str, object]:
        """Return the result of `uwb-mitigation calibrate`."""
        solution, model = self.solution, self.selection.model
        factor = 0.0 if model.network is None else 1.0 if model.factor is None else model.factor
        linear_bias = model.linear_bias
        return {
            "offsets_m": {f"{tag}-{anchor}": value for (tag, anchor), (value, _) in solution.pairs.items()},
            "offset_sd_m": {f"{tag}-{anchor}": sd for (tag, anchor), (_, sd) in solution.pairs.items()},
            "offsets_of": solution.offset_level,
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
            "places": {name: list(position) for name, position in solution.stationary_positions.items()},
            "notes": list(self.notes),
            "left_out": dict(self.site.skipped),
            "localisation": None if solution.alignment is None else solution.alignment.as_json(),
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
        truth, model, n = self.solution.truth, self.selection.model, len(self.data)
        method = "without truth" if truth is None else f"with truth from {truth}"
        metrics = {"raw": self.raw_mae_m, **self.selection.mae()}
        training = {
            "data": f"{name}, calibrated {method}",
            "calibrated": method,
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
        card = card_of(*fitted, self.data, self.held_out_error_m, training, ood_bands)
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


def _json_pair(pair: tuple[float, float]) -> list[float | None]:
    return [None if math.isnan(value) else value for value in pair]


def offsets_file(bundle: Path) -> Path:
    """Return the path of the offsets file that belongs to the bundle of a site."""
    return bundle.with_suffix(".offsets.yaml")


def calibrate_site(
    site: SiteData,
    universal: Bundle,
    solution: SiteSolution,
    *,
    seed: int,
    on_progress: Progress = lambda stage, share: None,
) -> SiteCalibration:
    """Select a model for the ranges and offsets of a solution.

    Args:
        site: recorded ranges.
        universal: bundle that the candidates start from.
        solution: true ranges and offsets, from `site_solution`.
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
    raw = site.to_dataset(
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
    selection = selections.select_for_site(
        with_network, candidates, seed, offset_change, lambda share: on_progress("selecting the model", share)
    )
    without_cir = int((~usable_ranges(site)).sum())
    notes = (
        [f"{without_cir} ranges without a usable CIR are only used for track and offsets"]
        if without_cir
        else []
    )
    residual = selection.errors[selection.chosen][: len(data)]
    raw_error, error = (position_error_m(site, solution, error_m) for error_m in (raw.error_m, residual))
    return SiteCalibration(
        site=site,
        solution=solution,
        data=data,
        raw_error_m=raw.error_m,
        selection=selection,
        notes=(*solution.notes, *notes, *missing),
        position_error_m=(raw_error, error),
    )


def position_error_m(site: SiteData, solution: SiteSolution, error_m: NDArray[np.float64]) -> float:
    """Return the RMSE of the horizontal position due to range errors, m: least squares on the ranges of each second.

    Args:
        site: recorded ranges.
        solution: positions of the tags.
        error_m: (n,), errors of the ranges of `solution.rows`.

    Returns:
        NaN if no second has ranges to three anchors that determine a position.
    """
    ranges = site.ranges.take(solution.rows)
    stamp, row = ranges.stamp_ns, ranges.anchor
    difference = solution.antenna_position - site.anchors.position[row]
    unit = difference[:, :2] / np.maximum(np.linalg.norm(difference, axis=1), 0.05)[:, None]
    window = (stamp - stamp.min()) // round(WINDOW_S * 1e9)
    squared = []
    _, index = np.unique(np.stack([solution.segment, window]), axis=1, return_inverse=True)
    index = index.reshape(-1)
    order = np.argsort(index, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(index[order])) + 1):
        # Check that the position is observable: singular values of unit vectors grow with the square root of their number.
        if len(np.unique(row[part])) >= 3 and np.linalg.svd(unit[part])[1][1] > 0.3 * math.sqrt(len(part)):
            position_error = np.linalg.lstsq(unit[part], error_m[part], rcond=None)[0]
            squared.append(float(position_error @ position_error))
    return math.sqrt(float(np.mean(squared))) if squared else math.nan


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
