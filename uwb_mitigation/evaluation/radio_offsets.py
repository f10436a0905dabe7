"""The offset of two radios from ranges of a known length in line of sight: measured - predicted error - distance.

A CIR does not know its radios' antenna delays, so one true distance must be known. What a model cannot know of the place
where the antennas stood is in the answer too, however long they stood there: hence a standard deviation that more
ranges alone do not make small, but more placements do.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError, format_id
from uwb_mitigation.measurement import LINE_OF_SIGHT_DB, RangeMeasurement, Record, Status
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.familiarity import FIRST_PATH_TAPS
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.offsets import MAX_OFFSET_M, Offsets
from uwb_mitigation.preprocessing import Preprocessing, Scaling

PLACEMENT_SD_M = 0.15
"""Of the offset found at one placement, beside noise. The spread (1.48 x median absolute deviation) between the seven
line-of-sight placements of the EVK1000 logs is 0.12 m after `universal`, and seven say that roughly."""

LARGEST_EXCESS_M = 0.25
LARGEST_ERROR_M = 0.5
"""A model that predicts more sees something between the antennas: one of the excess alone, and one whose prior holds the
offset of boards too."""

FEWEST_RANGES = 10
_BATCH = 256
_MAD_TO_SD = 1.4826
_OF_MEDIAN = math.sqrt(math.pi / 2.0)


@dataclass(slots=True)
class _Gathered:
    offset_m: list[float] = field(default_factory=list)
    predicted_m: list[float] = field(default_factory=list)
    gap_db: list[float] = field(default_factory=list)
    others: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class PlacementOffset:
    """What one pair says at one placement.

    Attributes:
        tag_id, anchor_id, placement: which.
        ranges: that it counts on.
        offset_m, sd_m: of its ranges, by medians; NaN where refused.
        noise_sd_m: the part of `sd_m` that more ranges make smaller.
        power_gap_db: receive level less first-path level, median, as reported or from the CIR; NaN = unknown.
        predicted_m: the model's predicted error, median; NaN without any.
        refused: why it does not count; empty = it does.
    """

    tag_id: int
    anchor_id: int
    placement: str
    ranges: int
    offset_m: float
    sd_m: float
    noise_sd_m: float
    power_gap_db: float
    predicted_m: float
    refused: str


@dataclass(frozen=True, slots=True)
class FoundOffset:
    """What a recording says.

    Attributes:
        offset_m, sd_m: median over placements, and how sure it is.
        ranges: that it counts on.
        placements: all of them, those refused too.
        model_id: of the model that predicted.
    """

    offset_m: float
    sd_m: float
    ranges: int
    placements: tuple[PlacementOffset, ...]
    model_id: int

    def offsets(self, *, together: bool = False) -> Offsets:
        """The median for pairs that were not there, and unless `together` each pair's own."""
        pairs: dict[tuple[int, int], list[float]] = {}
        for placement in self.placements:
            if not placement.refused and not together:
                pairs.setdefault((placement.tag_id, placement.anchor_id), []).append(placement.offset_m)
        return Offsets(self.offset_m, pairs={pair: float(np.median(found)) for pair, found in pairs.items()})

    def as_json(self) -> dict[str, object]:
        """The result of `uwb-mitigation offset`."""

        def number(value: float) -> float | None:
            return value if math.isfinite(value) else None

        return {
            "offset_m": self.offset_m,
            "sd_m": self.sd_m,
            "ranges": self.ranges,
            "model_id": self.model_id,
            "pairs": [
                {
                    "tag_id": one.tag_id,
                    "anchor_id": one.anchor_id,
                    "placement": one.placement,
                    "ranges": one.ranges,
                    "offset_m": number(one.offset_m),
                    "sd_m": number(one.sd_m),
                    "noise_sd_m": number(one.noise_sd_m),
                    "power_gap_db": number(one.power_gap_db),
                    "predicted_m": number(one.predicted_m),
                    "refused": one.refused or None,
                }
                for one in self.placements
            ],
        }


def find_offset(
    mitigation: Mitigation,
    records: Iterable[Record],
    distance_m: float | None = None,
    *,
    tag_id: int | None = None,
    anchor_id: int | None = None,
    on_record: Callable[[], None] = lambda: None,
) -> FoundOffset:
    """The offset of the radios in a recording.

    Args:
        mitigation: predicts the excess; its own offsets do not matter.
        distance_m: between the antennas; None = as each record's truth says.
        tag_id, anchor_id: only these; None = any.
        on_record: called for each record that was read.

    Raises:
        ParameterError: one distance is to be that of several pairs.
        DatasetError: nothing looks like line of sight, or there is no truth.
    """
    groups: dict[tuple[int, int, str], _Gathered] = {}
    preprocessing = Preprocessing(mitigation.bundle.preprocessing.samples, Scaling.MAX)
    without_truth = 0
    stream = iter(records)
    while batch := list(islice(stream, _BATCH)):
        for _ in batch:
            on_record()
        wanted = [
            record
            for record in batch
            if (tag_id is None or record.measurement.tag_id == tag_id)
            and (anchor_id is None or record.measurement.anchor_id == anchor_id)
        ]
        results = mitigation.correct([record.measurement for record in wanted])
        for record, result in zip(wanted, results, strict=True):
            measurement, truth = record.measurement, record.truth
            true_m = distance_m if distance_m is not None else math.nan if truth is None else truth.range_m
            if not math.isfinite(true_m):
                without_truth += 1
                continue
            placement = truth.configuration if truth is not None and distance_m is None else ""
            found = groups.setdefault((measurement.tag_id, measurement.anchor_id, placement), _Gathered())
            found.gap_db.append(_power_gap_db(measurement, preprocessing))
            predicted = math.nan
            if result.status is Status.OK:
                offset = mitigation.offsets.of([measurement.tag_id], [measurement.anchor_id])
                predicted = result.correction_m - float(offset[0])
            else:
                found.others[result.status.name] += 1
            found.predicted_m.append(predicted)
            found.offset_m.append(measurement.range_m - predicted - true_m)
    if not groups:
        if without_truth:
            raise DatasetError(f"none of {without_truth} ranges has a true distance", valid="give --distance")
        raise DatasetError("no range of that anchor and tag")
    pairs = sorted({(tag, anchor) for tag, anchor, _ in groups})
    if distance_m is not None and len(pairs) > 1:
        some = ", ".join(f"anchor {format_id(anchor)} tag {format_id(tag)}" for tag, anchor in pairs[:5])
        raise ParameterError(
            f"one distance for {len(pairs)} pairs ({some}{', ...' if len(pairs) > 5 else ''})",
            valid="choose one with --anchor and --tag",
        )
    largest_m = LARGEST_EXCESS_M if mitigation.bundle.prior == LinePrior(0.0) else LARGEST_ERROR_M
    placements = tuple(_judge(*key, groups[key], largest_m) for key in sorted(groups))
    return _together(placements, mitigation.bundle.model_id)


def _power_gap_db(measurement: RangeMeasurement, preprocessing: Preprocessing) -> float:
    """Receive level less first-path level, dB; from the CIR if the radio does not report them; NaN if neither has them."""
    reported_db = measurement.cir.power_gap_db
    if math.isfinite(reported_db):
        return reported_db
    (fault,), (window,) = preprocessing.windows_of([measurement])
    if fault:
        return reported_db
    energy = window * window
    first_path = max(float(energy[FIRST_PATH_TAPS].sum()), 1e-12)
    return 10.0 * math.log10(float(energy.sum()) / first_path)


def _judge(
    tag_id: int, anchor_id: int, placement: str, found: _Gathered, largest_m: float
) -> PlacementOffset:
    offset, predicted, gap = (
        np.array(values, np.float64) for values in (found.offset_m, found.predicted_m, found.gap_db)
    )
    known, judged = np.isfinite(gap), np.isfinite(predicted)
    direct = known & (gap < LINE_OF_SIGHT_DB)
    used = offset[direct & judged]
    n = len(offset)
    median_gap = float(np.median(gap[known])) if known.any() else math.nan
    median_predicted = float(np.median(predicted[judged])) if judged.any() else math.nan
    refused = ""
    if 2 * known.sum() < n:
        refused = "neither the radio nor the CIR has the power of the first path: nothing shows line of sight"
    elif 2 * direct.sum() < known.sum():
        refused = (
            f"not line of sight: the first path is {median_gap:.1f} dB below the receive level "
            f"(line of sight: less than {LINE_OF_SIGHT_DB:g} dB)"
        )
    elif not len(used) or 2 * judged.sum() < n:
        statuses = ", ".join(f"{count} {name}" for name, count in found.others.most_common())
        refused = f"the model can judge {judged.sum()} of {n} ranges ({statuses})"
    elif median_predicted > largest_m:
        refused = f"not line of sight: the model predicts {median_predicted:.2f} m too long"
    elif abs(float(np.median(used))) > MAX_OFFSET_M:
        refused = f"{np.median(used):.1f} m off: is the distance in metres, the antenna delay set?"
    if refused:
        none = math.nan
        return PlacementOffset(
            tag_id, anchor_id, placement, 0, none, none, none, median_gap, median_predicted, refused
        )
    noise = _OF_MEDIAN * _spread(used) / math.sqrt(len(used))
    return PlacementOffset(
        tag_id,
        anchor_id,
        placement,
        len(used),
        float(np.median(used)),
        math.hypot(noise, PLACEMENT_SD_M),
        noise,
        median_gap,
        median_predicted,
        "",
    )


def _together(placements: tuple[PlacementOffset, ...], model_id: int) -> FoundOffset:
    good = [one for one in placements if not one.refused]
    if not good:
        first = placements[0]
        more = f", and so on for {len(placements)} placements" if len(placements) > 1 else ""
        raise DatasetError(
            f"anchor {format_id(first.anchor_id)}, tag {format_id(first.tag_id)}: {first.refused}{more}",
            valid="range with nothing between or beside the antennas",
        )
    if (ranges := sum(one.ranges for one in good)) < FEWEST_RANGES:
        raise DatasetError(
            f"{ranges} ranges look like line of sight",
            valid=f"{FEWEST_RANGES} at least, and some hundred are better",
        )
    offset = np.array([one.offset_m for one in good])
    noise = np.array([one.noise_sd_m for one in good])
    spread = max(_spread(offset), PLACEMENT_SD_M)
    # Of two or fewer the median is the mean.
    factor = _OF_MEDIAN if len(good) > 2 else 1.0
    sd = factor * math.hypot(spread, float(np.sqrt(np.mean(noise * noise)))) / math.sqrt(len(good))
    return FoundOffset(float(np.median(offset)), sd, ranges, placements, model_id)


def _spread(values: NDArray[np.float64]) -> float:
    """A standard deviation that a few wild values do not move."""
    return _MAD_TO_SD * float(np.median(np.abs(values - np.median(values))))
