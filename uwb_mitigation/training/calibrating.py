"""A site calibrated from a drive: truth from a joint solution or a localisation, then a model and offsets of its own."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, format_id
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.site_data import SiteData
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.float_networks import float_network
from uwb_mitigation.offsets import Offsets
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.localised import PosePath, solve_localised
from uwb_mitigation.positioning.model import MAD_TO_SD, NETWORK_SD, SLOPE_SD, Regressors
from uwb_mitigation.positioning.self_calibration import SelfCalibration, calibrate
from uwb_mitigation.training import site_model
from uwb_mitigation.training.calibrated import Calibrated

UNSURE_M = 0.25
"""Ranges whose pseudo-truth has a larger deviation are left out."""

LEAST_LABELLED = 40
MOST_OFFSET_M = 1.0
"""Radios of one kind without individual antenna delays differ by 0.3 m at three sigma (Decawave APS014)."""

OUTLIER_M, OUTLIER_SDS = 3.0, 10.0
"""A range is an outlier if its error is further than both from the median error."""

KINDS = 8
"""Of ranges, by how much the network corrects them: as many of each."""

NETWORK, LEVEL = "network", "level"

Progress = Callable[[str, float], None]
"""Is told what is being done, and the share of it that is, 0 to 1."""


def without_truth(
    site: SiteData,
    source: Bundle,
    *,
    height: Height | None,
    area: Area | None,
    seed: int,
    on_progress: Progress = lambda what, share: None,
) -> Calibrated:
    """Calibrate from the ranges alone.

    Args:
        source: the universal model.

    Raises:
        DatasetError: geometry does not tell; says what is missing.
    """
    on_progress("solving for track and offsets", 0.05)
    found = calibrate(
        site.anchors, site.tags, regressors(site, source), height=height, area=area, heights_m=site.height_m
    )
    on_progress("solving for track and offsets", 0.4)
    of_range = site.begins[found.stretches.tag] + found.stretches.row
    known = np.isfinite(found.pseudo_m) & (found.pseudo_sd_m <= UNSURE_M)
    known, outliers = _without_outliers(found.stretches.ranges.range_m - found.pseudo_m, known)
    notes = [*found.not_told, *_without_cir(site)]
    if (unsure := int((~known).sum()) - outliers) > 0:
        notes.append(
            f"{unsure} of {len(known)} ranges left out of the fit: the other anchors tell too little of where the tag was"
        )
    known &= _fits_model(site)[of_range]
    _check_labelled(int(known.sum()))
    ids = [anchor.id for anchor in site.anchors.anchors]
    pair_m = {(found.tag_ids[tag], ids[row]): found.applied(tag, row) for tag, row in found.pairs()}
    _check_offsets(pair_m)
    offsets = _offsets(found, ids, pair_m)
    data, raw = _labelled(
        site,
        offsets,
        of_range[known],
        found.pseudo_m[known],
        found.stretches.of[known],
        found.stretches.at_rest,
    )
    used = np.flatnonzero(known)

    def offsets_without(held_out: NDArray[np.intp]) -> NDArray[np.float64]:
        again = found.found_without(_whole_stretch(used[held_out], used, found.stretches.of))
        grown = {
            (found.tag_ids[tag], ids[row]): again.pair(tag, row)[0] - found.pair(tag, row)[0]
            for tag, row in found.pairs()
            if found.applied(tag, row)[0] != 0.0
        }
        return _of_rows(data, grown)

    choice = site_model.choose(
        data,
        site.has_cirs,
        source,
        seed,
        lambda share: on_progress("choosing", 0.4 + 0.6 * share),
        offsets_without=offsets_without,
    )
    return Calibrated(
        site,
        None,
        offsets,
        pair_m,
        found.level,
        data,
        raw,
        choice,
        (*notes, *choice.notes),
        found.fit.position,
        found.links.knot_stretch,
        (choice.factor, found.value(NETWORK)[1]),
        found.value(LEVEL),
        None,
        _places(found),
        outliers,
        found.mean()[1],
        found.position_scatter_m,
    )


def with_truth(
    site: SiteData,
    source: Bundle,
    paths: Sequence[Sequence[PosePath]],
    topic: str,
    *,
    time_offset_s: float | None,
    lever_arms_m: NDArray[np.float64] | None = None,
    estimate_lever_arm: bool = False,
    seed: int,
    on_progress: Progress = lambda what, share: None,
) -> Calibrated:
    """Calibrate against the poses of a localisation.

    Args:
        paths: for each tag, the poses of the robot that carries it, for each recording.
        time_offset_s, lever_arms_m, estimate_lever_arm: as of `solve_localised`. The others as of `without_truth`.
    """
    on_progress("time offset and lever arm", 0.05)
    joined = [
        PosePath.joined([one.shifted(by) for one, by in zip(own, site.shift_ns, strict=True)])
        for own in paths
    ]
    known = regressors(site, source)
    found = solve_localised(
        site.anchors,
        site.tags,
        joined,
        known,
        time_offset_s=time_offset_s,
        lever_arms_m=lever_arms_m,
        estimate_lever_arm=estimate_lever_arm,
    )
    on_progress("time offset and lever arm", 0.3)
    value = np.concatenate([one.range_m for one in site.tags])
    error = value - found.distance_m
    kept, outliers = _without_outliers(error, np.isfinite(error))
    rows = np.flatnonzero(kept & _fits_model(site))
    _check_labelled(len(rows))
    ids = [anchor.id for anchor in site.anchors.anchors]
    pair_m = {
        (site.tags[tag].tag_id, ids[row]): found.pair(tag, row, float(site.anchors.sd[row]))
        for tag, row in found.pairs
    }
    common = float(np.median([value for value, sd in pair_m.values() if sd <= UNSURE_M] or [0.0]))
    spread = MAD_TO_SD * float(np.median([abs(value - common) for value, _ in pair_m.values()]))
    # Few ranges say less about the offset of a pair than the other pairs do.
    unsure = math.hypot(UNSURE_M, spread)
    pair_m = {
        pair: (common, unsure) if sd > UNSURE_M else (value, sd) for pair, (value, sd) in pair_m.items()
    }
    _check_offsets(pair_m)
    offsets = _of_pairs(common, pair_m)
    tag = np.repeat(np.arange(len(site.tags)), list(map(len, site.tags)))
    data, raw = _labelled(
        site, offsets, rows, found.distance_m[rows], tag[rows], np.zeros(len(site.tags), np.bool_)
    )

    def offsets_without(held_out: NDArray[np.intp]) -> NDArray[np.float64]:
        kept = np.setdiff1d(rows, rows[held_out])
        own = [kept[tag[kept] == number] for number in range(len(site.tags))]
        again = solve_localised(
            site.anchors,
            [one.take(part - begin) for one, part, begin in zip(site.tags, own, site.begins, strict=True)],
            joined,
            known.take(kept),
            time_offset_s=found.time_offset_s,
            lever_arms_m=found.lever_arm_m,
        )
        grown = {
            (site.tags[number].tag_id, ids[row]): again.pair(number, row, 0.0)[0]
            - found.pair(number, row, 0.0)[0]
            for number, row in again.pairs
        }
        return _of_rows(data, grown)

    choice = site_model.choose(
        data,
        site.has_cirs,
        source,
        seed,
        lambda share: on_progress("choosing", 0.3 + 0.7 * share),
        offsets_without=offsets_without,
    )
    track = found.position[rows]
    return Calibrated(
        site,
        topic,
        offsets,
        pair_m,
        "pair",
        data,
        raw,
        choice,
        (*_without_cir(site), *choice.notes),
        track,
        tag[rows],
        (choice.factor, 0.0),
        (0.0, 0.0),
        found,
        {},
        outliers,
        0.0,
        (math.nan, math.nan),
    )


def regressors(site: SiteData, source: Bundle) -> Regressors:
    """What may make ranges long: the universal network's prediction where there are CIRs, else the received power."""
    if site.has_cirs:
        predicted = site_model.network_m(float_network(source), site.inputs)
        rows = np.where(np.isfinite(predicted) & site.with_cir, predicted, 0.0)[:, None]
        # What it takes for undisturbed errs by centimetres, what it corrects by decimetres.
        size = np.abs(rows[:, 0])
        edges = np.quantile(size[site.with_cir], np.linspace(0.0, 1.0, KINDS + 1)[1:-1])
        # Ranges without a CIR are not corrected, so that they have a standard deviation of their own.
        alike = np.where(site.with_cir, np.searchsorted(edges, size), KINDS)
        return Regressors((NETWORK,), rows, np.ones(1), np.array([NETWORK_SD]), alike)
    power = site.rx_power_dbm.astype(np.float64)
    known = np.isfinite(power)
    if known.mean() < 0.5 or np.ptp(power[known]) < 1.0:
        return Regressors.none(len(power))
    return Regressors.one(LEVEL, np.where(known, power - np.median(power[known]), 0.0), 0.0, SLOPE_SD)


def _offsets(
    found: SelfCalibration, ids: list[int], pair_m: dict[tuple[int, int], tuple[float, float]]
) -> Offsets:
    common = found.mean()[0] if found.mean_is_significant else 0.0
    if found.level == "pair":
        return _of_pairs(common, pair_m)
    if found.level == "anchor":
        return Offsets(common, anchors={ids[row]: found.applied(tag, row)[0] for tag, row in found.pairs()})
    return Offsets(common)


def _places(found: SelfCalibration) -> dict[str, tuple[float, float, float]]:
    """Where tags stood, as `Calibrated.places`."""
    resting = np.flatnonzero(found.links.at_rest).tolist()
    # Of a stretch all ranges are of one tag.
    tag_of = dict(zip(found.stretches.of.tolist(), found.stretches.tag.tolist(), strict=True))
    stood = Counter(tag_of[stretch] for stretch in resting)
    number: Counter[int] = Counter()
    places = {}
    for stretch in resting:
        tag = tag_of[stretch]
        number[tag] += 1
        several = f" #{number[tag]}" if stood[tag] > 1 else ""
        x, y, z = found.fit.position[found.links.knot_stretch == stretch][0].tolist()
        places[f"{found.tag_ids[tag]}{several}"] = (x, y, z)
    return places


def _of_pairs(common: float, pair_m: dict[tuple[int, int], tuple[float, float]]) -> Offsets:
    sds = {pair: sd for pair, (_, sd) in pair_m.items() if math.isfinite(sd)}
    return Offsets(common, pairs={pair: value for pair, (value, _) in pair_m.items()}, pair_sd=sds)


def _labelled(
    site: SiteData,
    offsets: Offsets,
    rows: NDArray[np.intp],
    true_m: NDArray[np.float64],
    stretch: NDArray[np.intp],
    at_rest: NDArray[np.bool_],
) -> tuple[Dataset, NDArray[np.float64]]:
    """The dataset, and its errors as measured."""
    nothing = site.labelled(rows, true_m, np.zeros(len(rows)), stretch, at_rest[stretch])
    assert nothing.tags is not None
    assert nothing.anchors is not None
    off = offsets.of(nothing.tags, nothing.anchors).astype(np.float64)
    return replace(nothing, range_m=nothing.range_m - off, error_m=nothing.error_m - off), nothing.error_m


def _without_outliers(
    error_m: NDArray[np.float64], known: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], int]:
    """Which of the `known` errors are no outliers, bool (n,), and the number of outliers."""
    if not known.any():
        return known, 0
    away = np.abs(error_m - np.median(error_m[known]))
    limit = max(OUTLIER_M, OUTLIER_SDS * MAD_TO_SD * float(np.median(away[known])))
    kept = known & (away <= limit)
    return kept, int(known.sum() - kept.sum())


def _whole_stretch(
    held_out: NDArray[np.intp], labelled: NDArray[np.intp], stretch: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Which ranges are held out when those of a part of a stretch are: also those of unknown truth among them.

    Args:
        held_out: rows, some of `labelled`, which ascend.
        stretch: int (r,), of all ranges, each stretch in the order of time.
    """
    every = np.arange(len(stretch))
    before = np.maximum(np.searchsorted(labelled, every, side="right") - 1, 0)
    after = np.minimum(before + 1, len(labelled) - 1)
    beside = np.where(stretch[labelled[before]] == stretch, labelled[before], labelled[after])
    found: NDArray[np.bool_] = np.isin(beside, held_out) & (stretch[beside] == stretch)
    return found


def _of_rows(data: Dataset, of_pair: dict[tuple[int, int], float]) -> NDArray[np.float64]:
    """What holds of each range's pair; 0 where nothing is known of it."""
    assert data.tags is not None
    assert data.anchors is not None
    pairs = zip(data.tags.tolist(), data.anchors.tolist(), strict=True)
    return np.array([of_pair.get(pair, 0.0) for pair in pairs])


def _fits_model(site: SiteData) -> NDArray[np.bool_]:
    """Which ranges the model is fitted to, bool (r,): the others contribute to track and offsets only."""
    return site.with_cir if site.has_cirs else np.ones(len(site.with_cir), np.bool_)


def _without_cir(site: SiteData) -> tuple[str, ...]:
    count = int((~_fits_model(site)).sum())
    return (f"{count} ranges without a usable CIR: used for track and offsets only",) if count else ()


def _check_labelled(count: int) -> None:
    if count < LEAST_LABELLED:
        raise DatasetError(
            f"{count} ranges whose true length can be told: too few", valid=f"{LEAST_LABELLED} or more"
        )


def _check_offsets(pair_m: dict[tuple[int, int], tuple[float, float]]) -> None:
    median = float(np.median([value for value, _ in pair_m.values()]))
    for (tag, anchor), (value, _) in pair_m.items():
        what = f"an offset of {value:.2f} m of tag {format_id(tag)} and anchor {format_id(anchor)}"
        if abs(value - median) > MOST_OFFSET_M:
            raise DatasetError(
                f"{what}; the median of all pairs is {median:.2f} m",
                valid=f"the true position of anchor {format_id(anchor)} in the anchors file; radios of one kind differ by less than "
                f"{MOST_OFFSET_M:g} m",
            )
        if abs(value) > MOST_OFFSET_M:
            raise DatasetError(
                what,
                valid=f"{MOST_OFFSET_M:g} m at most: set the antenna delay first (`uwb-mitigation board antenna-delay`)",
            )
