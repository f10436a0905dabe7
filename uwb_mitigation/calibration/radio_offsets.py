"""Estimate the offset of two radios from LOS ranges at a known distance: measured - predicted error - distance.

A CIR does not show the antenna delays of its radios, so one true distance must be known. The offset also contains the
model error of the placement. More placements reduce its standard deviation; more ranges at one placement hardly do.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.regression import MAD_TO_SD
from uwb_mitigation.errors import DatasetError, ParameterError, format_id
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.choice import CirKind
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.ood import FIRST_PATH_TAPS
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.types.measurement import (
    LINE_OF_SIGHT_DB,
    CorrectedRange,
    RangeMeasurement,
    Record,
    Segment,
    Status,
    Truth,
)
from uwb_mitigation.types.offsets import MAX_OFFSET_M, Offsets

PLACEMENT_SD_M = 0.15
"""Standard deviation of the offset of one placement without noise: 0.12 m between the seven LOS placements of the EVK1000
logs (1.48 x median absolute deviation after `universal`), a rough estimate from seven placements."""

MAX_EXCESS_M, MAX_ERROR_M = 0.15, 0.5
"""If the predicted error is larger, the path is NLOS. In held-out simulated buildings with boards like the EVB1000, `universal`
predicts less for 89 % of the LOS ranges whose power gap is small. The second limit is for models with a linear bias that contains the offset."""

MIN_RANGES = 10
_MEDIAN_SD_FACTOR = math.sqrt(math.pi / 2.0)

_Sample = tuple[float, float, float, float, float, str]
"""Offset, m; predicted error, m, or NaN; power gap, dB, or NaN; first-path level, dBm, or NaN; 1: LOS, 0: NLOS, NaN: unknown;
status."""


@dataclass(frozen=True, slots=True)
class PlacementOffset:
    """The offset of one pair at one placement.

    Attributes:
        ranges: number of ranges that were used.
        offset_m, sd_m: computed with medians; NaN if not used.
        noise_sd_m: the part of `sd_m` that more ranges reduce.
        power_gap_db: median of receive level minus first-path level, as reported or from the CIR; NaN: unknown.
        first_path_dbm: median of the reported first-path levels; NaN: unknown.
        predicted_m: median of the predicted errors; NaN if no error was predicted.
        refused: reason why the placement is not used; empty if it is.
    """

    tag_id: int
    anchor_id: int
    placement: str
    ranges: int
    offset_m: float
    sd_m: float
    noise_sd_m: float
    power_gap_db: float
    first_path_dbm: float
    predicted_m: float
    refused: str


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """The offset of a recording.

    Attributes:
        offset_m, sd_m: median over placements, and its standard deviation.
        ranges: number of ranges that were used.
        placements: all placements, including those that are not used.
        model_id: id of the model for the predicted errors.
    """

    offset_m: float
    sd_m: float
    ranges: int
    placements: tuple[PlacementOffset, ...]
    model_id: int

    def offsets(self, *, common: bool = False) -> Offsets:
        """Return the median for unknown pairs and, unless `common`, the offset of each pair."""
        pairs: dict[tuple[int, int], list[float]] = {}
        for placement in self.placements:
            if not placement.refused and not common:
                pairs.setdefault((placement.tag_id, placement.anchor_id), []).append(placement.offset_m)
        return Offsets(
            self.offset_m, pairs={pair: float(np.median(values)) for pair, values in pairs.items()}
        )

    def as_json(self) -> dict[str, object]:
        """Return the result of `uwb-mitigation offset`; null: unknown."""
        return {
            "offset_m": self.offset_m,
            "sd_m": self.sd_m,
            "ranges": self.ranges,
            "model_id": self.model_id,
            "pairs": [asdict(row) | {"refused": row.refused or None} for row in self.placements],
        }


def estimate_offset(
    mitigation: Mitigation,
    records: Iterable[Record],
    distance_m: float | None = None,
    *,
    tag_id: int | None = None,
    anchor_id: int | None = None,
) -> OffsetEstimate:
    """Estimate the offset of the radios in a recording.

    Args:
        mitigation: predicts the range error; its own offsets have no effect.
        records: ranges.
        distance_m: distance of the antennas; None: use the true range of each record.
        tag_id: use only this tag; None: all.
        anchor_id: use only this anchor; None: all.

    Raises:
        ParameterError: `distance_m` is given, but there are several pairs.
        DatasetError: no placement is in LOS, or there are no true ranges.
    """
    groups: dict[tuple[int, int, str], list[_Sample]] = {}
    without_truth = 0
    selected = (
        record
        for record in records
        if tag_id in (None, record.measurement.tag_id) and anchor_id in (None, record.measurement.anchor_id)
    )
    for record, result in mitigation.correct_records(selected):
        measured = record.measurement
        truth = Truth(distance_m) if distance_m is not None else record.truth or Truth(math.nan)
        if not math.isfinite(truth.range_m):
            without_truth += 1
            continue
        predicted_m = _predicted_m(mitigation, measured, result)
        model = mitigation.bundles[mitigation.choose(CirKind.of(measured.cir)).model]
        gap_db = _power_gap_db(measured, Preprocessing(model.card.preprocessing.samples, Scaling.MAX))
        has_preamble_cir = len(measured.cir) > 0 and measured.cir.segment is not Segment.STS
        is_los = _is_los(gap_db, None if has_preamble_cir else truth.label)
        offset_m = measured.range_m - predicted_m - truth.range_m
        level_dbm = measured.cir.first_path_power_dbm
        sample = offset_m, predicted_m, gap_db, level_dbm, is_los, result.status.name
        groups.setdefault((measured.tag_id, measured.anchor_id, truth.configuration), []).append(sample)
    pairs = sorted({(tag, anchor) for tag, anchor, _ in groups})
    _check_pairs(pairs, without_truth, has_one_distance=distance_m is not None)
    includes_offset = any(bundle.card.linear_bias != LinearBiasModel(0.0) for bundle in mitigation.bundles)
    limit_m = MAX_ERROR_M if includes_offset else MAX_EXCESS_M
    placements = tuple(_placement_offset(*key, groups[key], limit_m) for key in sorted(groups))
    return _combined(placements, mitigation.bundle.model_id)


def _check_pairs(pairs: list[tuple[int, int]], without_truth: int, *, has_one_distance: bool) -> None:
    if not pairs:
        if without_truth:
            raise DatasetError(f"none of {without_truth} ranges has a true distance", valid="set --distance")
        raise DatasetError("no ranges of this anchor and tag")
    if has_one_distance and len(pairs) > 1:
        listed = ", ".join(f"anchor {format_id(anchor)} tag {format_id(tag)}" for tag, anchor in pairs[:5])
        raise ParameterError(
            f"one distance for {len(pairs)} pairs ({listed}{', ...' if len(pairs) > 5 else ''})",
            valid="choose one with --anchor and --tag",
        )


def _predicted_m(mitigation: Mitigation, measured: RangeMeasurement, result: CorrectedRange) -> float:
    """Return the error that the model predicts; NaN: it predicts none."""
    cir = measured.cir
    is_foreign = not mitigation.choose(CirKind.of(cir)).is_trained
    if is_foreign or (len(cir) == 0 and result.status is Status.NO_CIR):
        # Without a CIR, or with that of another radio, the whole error is the offset.
        return 0.0
    if not result.status.is_corrected:
        return math.nan
    return result.correction_m - float(mitigation.offsets.lookup([measured.tag_id], [measured.anchor_id])[0])


def _is_los(gap_db: float, label: str | None) -> float:
    """Return 1: LOS, 0: NLOS, NaN: unknown.

    Args:
        gap_db: receive level minus first-path level; NaN: unknown.
        label: label of a range without a CIR of the preamble, empty: none; None: the range has one.
    """
    if label or (label is not None and math.isnan(gap_db)):
        # Without such a CIR the label decides, then the levels; ranges with neither are used.
        return float(label in ("", "LOS"))
    return float(gap_db < LINE_OF_SIGHT_DB) if math.isfinite(gap_db) else math.nan


def _power_gap_db(measurement: RangeMeasurement, preprocessing: Preprocessing) -> float:
    """Return receive level minus first-path level, dB, as reported or else from the CIR; NaN if unknown."""
    reported_db = measurement.cir.power_gap_db
    # The few taps of an STS are too short for the energy of reflections.
    if math.isfinite(reported_db) or measurement.cir.segment is Segment.STS:
        return reported_db
    (fault,), (window,) = preprocessing.windows_of([measurement])
    if fault:
        return reported_db
    energy = window * window
    first_path = max(float(energy[FIRST_PATH_TAPS].sum()), 1e-12)
    return 10.0 * math.log10(float(energy.sum()) / first_path)


def _placement_offset(
    tag_id: int, anchor_id: int, placement: str, samples: list[_Sample], limit_m: float
) -> PlacementOffset:
    offset, predicted, gap, level, los = np.array([sample[:5] for sample in samples], np.float64).T
    is_predicted, is_labelled, is_los = np.isfinite(predicted), np.isfinite(los), los == 1.0
    used, n = offset[is_los & is_predicted], len(offset)
    median_gap, median_level, median_predicted = (_median(values) for values in (gap, level, predicted))
    median_offset, noise, refused = math.nan, math.nan, ""
    if 2 * is_labelled.sum() < n:
        refused = "the first-path power is unknown, so that line of sight cannot be checked"
    elif 2 * is_los.sum() < is_labelled.sum():
        refused = "not line of sight: labelled as NLOS"
        if median_gap >= LINE_OF_SIGHT_DB:
            refused = (
                f"not line of sight: the first path is {median_gap:.1f} dB below the receive level "
                f"(line of sight: less than {LINE_OF_SIGHT_DB:g} dB)"
            )
    elif not len(used) or 2 * is_predicted.sum() < n:
        counts = Counter(status for *_, status in samples if not Status[status].is_corrected).most_common()
        statuses = ", ".join(f"{count} {name}" for name, count in counts)
        refused = f"the model corrects only {is_predicted.sum()} of {n} ranges ({statuses})"
    elif median_predicted > limit_m:
        refused = f"not line of sight: the model predicts an error of {median_predicted:.2f} m"
    elif abs(float(np.median(used))) > MAX_OFFSET_M:
        refused = (
            f"an offset of {np.median(used):.1f} m: check the distance (in metres) and the antenna delay"
        )
    else:
        median_offset = float(np.median(used))
        noise = _MEDIAN_SD_FACTOR * _spread(used) / math.sqrt(len(used))
    sd, count = math.hypot(noise, PLACEMENT_SD_M), 0 if refused else len(used)
    levels = median_gap, median_level, median_predicted
    return PlacementOffset(tag_id, anchor_id, placement, count, median_offset, sd, noise, *levels, refused)


def _combined(placements: tuple[PlacementOffset, ...], model_id: int) -> OffsetEstimate:
    accepted = [placement for placement in placements if not placement.refused]
    if not accepted:
        first = placements[0]
        more = f" (and {len(placements) - 1} other placements)" if len(placements) > 1 else ""
        raise DatasetError(
            f"anchor {format_id(first.anchor_id)}, tag {format_id(first.tag_id)}: {first.refused}{more}",
            valid="no obstacles between or next to the antennas; CIRs with levels or a first-path index, or ranges without CIRs",
        )
    if (ranges := sum(placement.ranges for placement in accepted)) < MIN_RANGES:
        raise DatasetError(
            f"only {ranges} ranges are in line of sight", valid=f"at least {MIN_RANGES}, better some hundred"
        )
    offset, noise = np.array([(placement.offset_m, placement.noise_sd_m) for placement in accepted]).T
    spread = max(_spread(offset), PLACEMENT_SD_M)
    # The median of two or fewer is their mean.
    factor = _MEDIAN_SD_FACTOR if len(accepted) > 2 else 1.0
    sd = factor * math.hypot(spread, float(np.sqrt(np.mean(noise * noise)))) / math.sqrt(len(accepted))
    return OffsetEstimate(float(np.median(offset)), sd, ranges, placements, model_id)


def _median(values: NDArray[np.float64]) -> float:
    """Return the median of the known values; NaN: there is none."""
    is_known = np.isfinite(values)
    return float(np.median(values[is_known])) if is_known.any() else math.nan


def _spread(values: NDArray[np.float64]) -> float:
    """Return a robust standard deviation."""
    return MAD_TO_SD * float(np.median(np.abs(values - np.median(values))))
