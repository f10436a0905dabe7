"""Where tags are about, before anything is solved: from many starts, and with an offset that fits all of them best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.joint import KNOT_S
from uwb_mitigation.positioning.locator import TagLocator, run_live
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.rests import Stretches
from uwb_mitigation.positioning.start import Area, Height, places
from uwb_mitigation.positioning.tracks import Ranges, Track

OFFSETS_M = np.arange(-1.0, 2.01, 0.5)
SD_M = 0.2
WINDOW_S = 0.5
MOST_WINDOWS = 12

_SECOND_NS = 1_000_000_000


def likely_offset(
    anchors: AnchorMap,
    found: Stretches,
    expected_m: NDArray[np.float64],
    height: Height | None,
    area: Area | None,
    model: Model,
) -> float:
    """The one of `OFFSETS_M` with which the ranges of a few moments meet best; 0 where no moment tells.

    Args:
        expected_m: float64 (r,), what is taken off the ranges beside it.
    """
    needed = 3 if height is not None else 4
    rng = np.random.default_rng(1)
    moments = []
    window = (found.ranges.stamp_ns - found.ranges.stamp_ns[0]) // round(WINDOW_S * _SECOND_NS)
    key = np.where(found.at_rest[found.of], -1 - found.of, window * len(found) + found.of)
    for one in rng.permutation(np.unique(key)).tolist():
        row, value = _medians(found.ranges, np.flatnonzero(key == one), expected_m)
        if len(row) > needed:
            moments.append((row, value))
        if len(moments) == MOST_WINDOWS:
            break
    if not moments:
        return 0.0
    loss = np.zeros(len(OFFSETS_M))
    for row, value in moments:
        for k, offset in enumerate(OFFSETS_M.tolist()):
            sd = np.full(len(row), SD_M)
            place = places(anchors.position[row], value - offset, sd, model, height=height, area=area)
            loss[k] += place[0].loss if place else 50.0
    return float(OFFSETS_M[int(np.argmin(loss))])


def first_positions(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    found: Stretches,
    expected_m: NDArray[np.float64],
    height: Height | None,
    area: Area | None,
    model: Model,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Positions float64 (K, 3) at the knots of those stretches that have any; which these are, bool (s,)."""
    position: list[NDArray[np.float64]] = []
    placed = np.zeros(len(found), np.bool_)
    edges = np.searchsorted(found.of, np.arange(len(found) + 1))
    needed = 2 if height is not None else 3
    for number in range(len(found)):
        own = np.arange(edges[number], edges[number + 1])
        if found.at_rest[number]:
            row, value = _medians(found.ranges, own, expected_m)
            if len(row) <= needed:
                continue
            sd = np.full(len(row), SD_M)
            possible = places(anchors.position[row], value, sd, model, height=height, area=area)
            if possible:
                position.append(possible[0].position[None])
                placed[number] = True
            continue
        ranges = found.ranges.take(own)
        better = Ranges(
            ranges.stamp_ns,
            ranges.anchor,
            np.maximum(ranges.range_m - expected_m[own], 0.0),
            ranges.variance_m2,
            ranges.rx_power_dbm,
            tags[int(found.tag[own[0]])].tag_id,
        )
        track = run_live(better, TagLocator(anchors, model, height=height, area=area)).track
        if len(track) >= 2:
            position.append(_at_knots(track, ranges))
            placed[number] = True
    return np.concatenate(position) if position else np.zeros((0, 3)), placed


def _at_knots(track: Track, ranges: Ranges) -> NDArray[np.float64]:
    since = (ranges.stamp_ns - ranges.stamp_ns[0]) / _SECOND_NS
    knots = np.unique(np.rint(since / KNOT_S).astype(np.int64)) * KNOT_S
    own = (track.stamp_ns - ranges.stamp_ns[0]) / _SECOND_NS
    return np.stack([np.interp(knots, own, axis) for axis in track.position.T], axis=1)


def _medians(
    ranges: Ranges, rows: NDArray[np.intp], expected_m: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The anchors heard in `rows`, and the median of what each measured."""
    value = ranges.range_m[rows] - expected_m[rows]
    heard = np.unique(ranges.anchor[rows])
    return heard, np.array([np.median(value[ranges.anchor[rows] == one]) for one in heard])
