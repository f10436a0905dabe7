"""Where a fit without ground truth starts: first positions of tags, and the likely offset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.joint_fit import KNOT_S
from uwb_mitigation.calibration.motion_segments import Segments
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.online.initialization import candidate_positions, local_optima
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Ranges, Track

OFFSETS_M = np.arange(-1.0, 2.01, 0.5)
"""Common offsets that are tried, m: from usual antenna delays to those that were never set."""

START_SD_M = 0.2
"""Standard deviation of a range from which an offset is subtracted that is wrong by up to half a step."""

WINDOW_S, MAX_WINDOWS = 0.5, 12
"""Duration of a moment, in which a tag at walking speed moves by less than a metre, and the number of moments that are tried."""

NO_POSITION_LOSS = 50.0
"""Loss of a moment without a position, ten times that of bad ones."""

MIN_UNIT_LOSS = 5.0
"""Loss of a moment from which other units are examined."""

_Moments = list[tuple[NDArray[np.intp], NDArray[np.float64]]]

UNITS = {"feet": 0.3048, "millimetres": 1e-3, "centimetres": 1e-2}


def first_positions(
    config: EstimatorConfig, segments: Segments, expected_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return initial positions float64 (K, 3) at the knots of the segments that have any; which these are, bool (s,)."""
    position: list[NDArray[np.float64]] = []
    has_position = np.zeros(len(segments), np.bool_)
    edges = np.searchsorted(segments.segment, np.arange(len(segments) + 1))
    for number in range(len(segments)):
        rows = np.arange(edges[number], edges[number + 1])
        if segments.is_stationary[number]:
            row, value = _medians(segments.ranges, rows, expected_m)
            if len(row) > config.dims:
                where, sd = config.anchors.position[row], np.full(len(row), START_SD_M)
                possible = candidate_positions(
                    where, value, sd, config.model, height=config.height, area=config.area
                )
                position += [best.position[None] for best in possible[:1]]
                has_position[number] = bool(possible)
            continue
        ranges = segments.ranges.take(rows)
        corrected = replace(ranges, range_m=np.maximum(ranges.range_m - expected_m[rows], 0.0))
        track = TagEstimator(config).run(corrected)
        if len(track) >= 2:
            position.append(_at_knots(track, ranges))
            has_position[number] = True
    return np.concatenate(position) if position else np.zeros((0, 3)), has_position


def _at_knots(track: Track, ranges: Ranges) -> NDArray[np.float64]:
    since = (ranges.stamp_ns - ranges.stamp_ns[0]) / NS_PER_S
    knots = np.unique(np.rint(since / KNOT_S).astype(np.int64)) * KNOT_S
    track_s = (track.stamp_ns - ranges.stamp_ns[0]) / NS_PER_S
    return np.stack([np.interp(knots, track_s, axis) for axis in track.position.T], axis=1)


def _medians(
    ranges: Ranges, rows: NDArray[np.intp], expected_m: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the anchors received in `rows`, and the median corrected range of each."""
    value = ranges.range_m[rows] - expected_m[rows]
    received = np.unique(ranges.anchor[rows])
    return received, np.array([np.median(value[ranges.anchor[rows] == row]) for row in received])


def likely_offset(config: EstimatorConfig, segments: Segments, expected_m: NDArray[np.float64]) -> float:
    """Return the one of `OFFSETS_M` with which the ranges of a few moments agree best; 0 if no moment has enough ranges.

    Args:
        config: anchors, noise model, height and area.
        segments: ranges, r in total.
        expected_m: float64 (r,), also subtracted from the ranges.

    Raises:
        DatasetError: ranges and anchor positions fit each other only in another unit; names the unit.
    """
    moments = _moments(config, segments, expected_m)
    if not moments:
        return 0.0
    loss = _moment_losses(config, moments)
    per_moment = float(loss.min()) / len(moments)
    if per_moment >= MIN_UNIT_LOSS:
        for unit, metres in UNITS.items():
            for factor, name in ((metres, "ranges"), (1.0 / metres, "anchor positions")):
                scaled = [(row, value * factor) for row, value in moments]
                if float(_moment_losses(config, scaled).min()) / len(moments) < 0.3 * per_moment:
                    raise DatasetError(
                        f"the ranges do not fit the anchor positions, but would if the {name} were in {unit}",
                        valid="metres",
                    )
    return float(OFFSETS_M[int(np.argmin(loss))])


def _moments(config: EstimatorConfig, segments: Segments, expected_m: NDArray[np.float64]) -> _Moments:
    """Return anchors and median ranges of at most `MAX_WINDOWS` moments with redundant ranges."""
    rng = np.random.default_rng(1)
    moments = []
    ranges = segments.ranges
    window = (ranges.stamp_ns - ranges.stamp_ns[0]) // round(WINDOW_S * NS_PER_S)
    key = np.where(
        segments.is_stationary[segments.segment],
        -1 - segments.segment,
        window * len(segments) + segments.segment,
    )
    for group in rng.permutation(np.unique(key)).tolist():
        row, value = _medians(ranges, np.flatnonzero(key == group), expected_m)
        if len(row) > config.dims + 1:
            moments.append((row, value))
        if len(moments) == MAX_WINDOWS:
            break
    return moments


def _moment_losses(config: EstimatorConfig, moments: _Moments) -> NDArray[np.float64]:
    """Return the loss of all moments with each of `OFFSETS_M`."""
    total = np.zeros(len(OFFSETS_M))
    for row, value in moments:
        where, sd = config.anchors.position[row], np.full(len(row), START_SD_M)
        shifted = value - OFFSETS_M[:, None]
        _, losses, _ = local_optima(where, shifted, sd, config.model, config.height, config.area)
        loss = losses.min(axis=1)
        total += np.where(np.isfinite(loss), loss, NO_POSITION_LOSS)
    return total
