"""Measure position errors on real recordings and in the simulated flat. Needs neither ROS nor torch.

The recordings are not part of the repository.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.positioning.batch.smoother import smooth
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.initialization import candidate_positions, snapshot
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig, TagEstimator
from uwb_mitigation.positioning.track_errors import TrackErrors, errors_of, track_errors
from uwb_mitigation.recordings.decaranging import DecaRangingFolder
from uwb_mitigation.recordings.formats import open_mapped
from uwb_mitigation.simulation.simulated import SimulatedSource, SimulatedSurvey
from uwb_mitigation.training.fit.linear_fit import fit_linear_bias
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Ranges, Track, TruePath

TIME_OFFSET_S = 0.2
"""Time offset of the ranges relative to the ground truth in every Hanyang run."""

HEIGHT = Height(1.0, 0.2)
"""Height of the tag in the Hanyang runs."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one recording: live, smoothed, and from snapshots of raw ranges."""

    name: str
    live: TrackErrors
    smoothed: TrackErrors
    snapshot: TrackErrors

    def as_json(self) -> dict[str, Any]:
        """Return the errors by kind of track."""
        return {kind: getattr(self, kind).as_json() for kind in ("live", "smoothed", "snapshot")}


def columns(source: Source, anchors: AnchorMap, variance_m2: float = math.nan) -> tuple[Ranges, TruePath]:
    """Return the ranges of a source with one tag, and its true path."""
    records = list(source)
    stamps = np.array([record.measurement.stamp_ns for record in records], np.int64)
    known = [i for i, record in enumerate(records) if record.tag_position is not None]
    truth = TruePath(stamps[known], np.array([records[i].tag_position for i in known], float).reshape(-1, 3))
    ranges = Ranges(
        stamps,
        np.array([anchors.index[record.measurement.anchor_id] for record in records], np.intp),
        np.array([record.measurement.range_m for record in records], float),
        np.full(len(records), variance_m2),
        np.array([record.measurement.cir.rx_power_dbm for record in records], float),
        records[0].measurement.tag_id,
    )
    return ranges, truth


def hanyang_run(folder: Path) -> tuple[AnchorMap, Ranges, TruePath, TruePath]:
    """Return anchors, ranges without their time offset, and the true path of a run: complete, and in the authors' window.

    The window of trajectory A is from the first x > 49.3 and y > -5 to the next x <= 12 and y > 3.4; that of B from
    the first x < 8.6 and y < -7 to the next x > 8.6 and y < -7.
    """
    run = open_mapped(folder, "hanyang")
    ranges, _ = columns(run, run.anchors)
    shifted = Ranges(
        ranges.stamp_ns - round(TIME_OFFSET_S * NS_PER_S),
        ranges.anchor,
        ranges.range_m,
        ranges.variance_m2,
        ranges.rx_power_dbm,
        ranges.tag_id,
    )
    kind_a = folder.name.rpartition("_")[2].startswith("A")
    return run.anchors, shifted, run.truth, _window(run.truth, kind_a)


def hanyang(folder: Path, model: NoiseModel | None = None) -> Errors:
    """Return the errors of one run in the authors' window, with known height."""
    model = model or NoiseModel()
    anchors, ranges, _, truth = hanyang_run(folder)
    live = TagEstimator(EstimatorConfig(anchors, model, height=HEIGHT)).run(ranges)
    smoothed = smooth(EstimatorConfig(anchors, model, HEIGHT), ranges, live)
    tracks = (live, smoothed, snapshot(anchors, ranges, HEIGHT))
    return Errors(folder.name, *(at_truths(track, truth) for track in tracks))


def _window(path: TruePath, kind_a: bool) -> TruePath:
    x, y, _ = path.position.T
    enters = (x > 49.3) & (y > -5.0) if kind_a else (x < 8.6) & (y < -7.0)
    leaves = (x <= 12.0) & (y > 3.4) if kind_a else (x > 8.6) & (y < -7.0)
    first = int(np.flatnonzero(enters)[0])
    last = first + int(np.flatnonzero(leaves[first:])[0])
    return TruePath(path.stamp_ns[first:last], path.position[first:last])


def at_truths(track: Track, truth: TruePath) -> TrackErrors:
    """Compare each true position with the latest estimate at its time."""
    latest = np.searchsorted(track.stamp_ns, truth.stamp_ns, side="right") - 1
    some = latest >= 0
    return errors_of(track.position[latest[some]], track.covariance[latest[some]], truth.position[some])


@dataclass(frozen=True, slots=True)
class StaticErrors:
    """Errors of stationary tags with ranges to three or more anchors.

    Contains the number of tags, the mean horizontal error with raw and with corrected ranges in m, and the mean NEES
    per degree of freedom with corrected ranges.
    """

    tags: int
    raw_m: float
    corrected_m: float
    nees_per_dof: float


def apartment(folder: Path) -> StaticErrors:
    """Locate each tag of the EVK1000 logs with a line in received power that was fitted to the *other* tags.

    The area is the bounding box of all anchors plus half a metre, which resolves mirror images.
    """
    with DecaRangingFolder(folder) as source:
        records = [
            record for record in source if record.truth is not None and record.tag_position is not None
        ]
        anchors = source.anchors
    tag = np.array([record.measurement.tag_id for record in records])
    row = np.array([anchors.index[record.measurement.anchor_id] for record in records])
    configuration = np.array([record.truth.configuration for record in records if record.truth is not None])
    range_m = np.array([record.measurement.range_m for record in records])
    error = range_m - np.array([record.truth.range_m for record in records if record.truth is not None])
    power = np.array([record.measurement.cir.rx_power_dbm for record in records], np.float32)
    first = np.array([record.measurement.cir.first_path_power_dbm for record in records], np.float32)
    low, high = anchors.position.min(axis=0) - 0.5, anchors.position.max(axis=0) + 0.5
    area = Area((low[0], low[1], -1.0), (high[0], high[1], 1.0))
    raw: list[float] = []
    corrected: list[float] = []
    nees: list[float] = []
    for tag_id in np.unique(tag):
        is_tag, model = tag == tag_id, NoiseModel()
        used = np.unique(row[is_tag])
        if len(used) < 3:
            continue
        linear_bias = fit_linear_bias(configuration[~is_tag], power[~is_tag], first[~is_tag], error[~is_tag])
        corrected_range_m = range_m - linear_bias.predict_m(power, first)
        residual = [
            np.nanmean((corrected_range_m - range_m + error)[~is_tag & (configuration == c)])
            for c in np.unique(configuration[~is_tag])
        ]
        # The line fit minimises the mean absolute error; 1.25 times it is the standard deviation of a normal error.
        sd = 1.2533 * float(np.nanmean(np.abs(residual)))
        true_position = np.array(
            next(r.tag_position for r, is_own in zip(records, is_tag, strict=True) if is_own)
        )
        for values, range_sd_m, errors in (
            (range_m, model.range_sd, raw),
            (corrected_range_m, sd, corrected),
        ):
            means = np.array([np.nanmedian(values[is_tag & (row == a)]) for a in used])
            inputs = anchors.position[used], means, np.full(len(used), range_sd_m), model
            inside = candidate_positions(*inputs, height=Height(0.0), area=area)
            estimate = (inside or candidate_positions(*inputs, height=Height(0.0)))[0]
            difference = estimate.position[:2] - true_position[:2]
            errors.append(float(np.hypot(*difference)))
        nees.append(float(difference @ np.linalg.solve(estimate.covariance[:2, :2], difference)) / 2.0)
    return StaticErrors(len(raw), float(np.mean(raw)), float(np.mean(corrected)), float(np.mean(nees)))


@dataclass(frozen=True, slots=True)
class FlatErrors:
    """Errors of a drive through the simulated flat.

    Compares raw ranges, ranges corrected by a line in received power, and by the universal model, which was not
    trained in this flat and does not remove the offset of the radios.
    """

    anchors: int
    raw: Errors
    corrected: Errors
    universal: Errors


def flat(anchor_count: int, seed: int = 1, ranges: int = 3000) -> FlatErrors:
    """Drive past 4 to 8 anchors; the line is fitted to a survey of 150 other placements in the same flat."""
    linear_bias, variance = _flat_line()
    drive = SimulatedSource.with_anchors(anchor_count, seed=seed, count=ranges, rate_hz=40.0)
    records = list(drive)
    raw, truth = columns(drive, drive.anchors)
    first = np.array([record.measurement.cir.first_path_power_dbm for record in records], np.float32)
    predicted = linear_bias.predict_m(raw.rx_power_dbm.astype(np.float32), first)
    corrections = Mitigation(load_bundle(default_model_path())).correct(
        [record.measurement for record in records]
    )
    by_line = raw.range_m - predicted, np.full(len(raw), variance)
    by_network = (
        np.array([result.range_m for result in corrections]),
        np.array([result.variance_m2 for result in corrections]),
    )
    lines, networks = (
        replace(raw, range_m=np.maximum(range_m, 0.0), variance_m2=variance_m2)
        for range_m, variance_m2 in (by_line, by_network)
    )
    found = [
        _flat_errors(name, drive.anchors, some, truth)
        for name, some in (("raw", raw), ("line", lines), ("universal", networks))
    ]
    return FlatErrors(anchor_count, *found)


def _flat_errors(name: str, anchors: AnchorMap, ranges: Ranges, truth: TruePath) -> Errors:
    model, height = NoiseModel(), Height(0.0, 0.05)
    live = TagEstimator(EstimatorConfig(anchors, model, height=height)).run(ranges)
    smoothed = smooth(EstimatorConfig(anchors, model, height), ranges, live)
    tracks = (live, smoothed, snapshot(anchors, ranges, height))
    return Errors(name, *(track_errors(track, truth) for track in tracks))


def _flat_line() -> tuple[LinearBiasModel, float]:
    """Return the line and the variance of its residuals, from the mean absolute error, which the fit minimises."""
    survey = list(SimulatedSurvey(seed=11, configurations=150, exchanges=6))
    truths = [record.truth for record in survey if record.truth is not None]
    error: NDArray[np.float64] = np.array([record.measurement.range_m for record in survey]) - [
        truth.range_m for truth in truths
    ]
    power = np.array([record.measurement.cir.rx_power_dbm for record in survey], np.float32)
    first = np.array([record.measurement.cir.first_path_power_dbm for record in survey], np.float32)
    linear_bias = fit_linear_bias(np.array([truth.configuration for truth in truths]), power, first, error)
    residual = np.abs(error - linear_bias.predict_m(power, first))
    return linear_bias, (1.2533 * float(residual.mean())) ** 2
