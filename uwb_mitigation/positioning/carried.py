"""A tag that was carried from place to place, and recorded only where it rested: places told by jumps, without a silence.

However long a pause was, and whether each anchor was heard once or a hundred times: between two places most ranges change
at once by more than they scatter around either, which no motion does that is followed by ranges.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.scatter import MAD_TO_SD
from uwb_mitigation.positioning.start import Height, places
from uwb_mitigation.positioning.tracks import Ranges

APART_M = 0.3
"""Ranges of an anchor that differ by more are not from one place, unless a reflection was taken for the first path."""

ASKED = 5
"""So many anchors are asked whether the tag is elsewhere now; half of them, or more, must say so."""

LEAST_JUMP_M = 0.6
JUMPS = 5.0
"""By so many times more than they scatter around a place, most ranges change between places. In motion that is cut into
pieces, ranges scatter around the middle of a piece by about a third of what they change to the next."""

STILL_M = 0.06
"""What an anchor measured at one place, more than once, scatters by less (1.48 x median absolute deviation)."""

SPARE_ONCE = 4
"""Anchors beyond the unknowns, where each was heard once at a place: nothing else tells that the tag rested."""

SD_M = 0.2
MOST_FITTED = 20
"""Places that are looked at."""


def rests_between_jumps(
    ranges: Ranges, rows: NDArray[np.intp], anchors: AnchorMap, height: Height | None, model: Model
) -> list[NDArray[np.intp]] | None:
    """The rows of each place, or None: it was not carried from place to place.

    Args:
        ranges: of one tag. rows: int (k,), of which, in order.
    """
    pieces, unsure = _pieces(ranges, rows)
    needed = (2 if height is not None else 3) + 2
    if len(pieces) < 2 or not _may_rest(ranges, pieces, needed):
        return None
    jumps = [_jump(ranges, one, other) for one, other in pairwise(pieces)]
    if not np.nanmedian(jumps) > LEAST_JUMP_M:
        return None
    found = [_place(ranges, piece, anchors, height, model) for piece in pieces[:MOST_FITTED]]
    scatter = [
        _scatter(_errors(ranges, piece, anchors, place), needed - 1)
        for piece, place in zip(pieces, found, strict=False)
        if place is not None and len(np.unique(ranges.anchor[piece])) >= needed
    ]
    if not scatter or np.nanmedian(jumps) < JUMPS * np.median(scatter):
        return None
    found += [_place(ranges, piece, anchors, height, model) for piece in pieces[MOST_FITTED:]]
    edges = [0]
    for k, (first, last) in enumerate(unsure):
        here, there = found[k], found[k + 1]
        edge = last
        if here is not None and there is not None and first < last:
            between = rows[first:last]
            left = model.loss(_errors(ranges, between, anchors, here) / SD_M)
            right = model.loss(_errors(ranges, between, anchors, there) / SD_M)
            # What comes before the edge is of the one place, what follows of the other.
            cost = np.concatenate([[0.0], np.cumsum(left)]) + np.concatenate(
                [np.cumsum(right[::-1])[::-1], [0.0]]
            )
            edge = first + int(np.argmin(cost))
        edges.append(max(edge, edges[-1]))
    return [piece for piece in np.split(rows, edges[1:]) if len(piece)]


def _pieces(ranges: Ranges, rows: NDArray[np.intp]) -> tuple[list[NDArray[np.intp]], list[tuple[int, int]]]:
    """Pieces in which the ranges of each anchor agree; and between which places (first, last) in `rows` each edge lies."""
    anchor, value = ranges.anchor[rows].tolist(), ranges.range_m[rows].tolist()
    edges, unsure = [0], list[tuple[int, int]]()
    known: dict[int, tuple[float, int]] = {}
    for i, (one, range_m) in enumerate(zip(anchor, value, strict=True)):
        before = known.get(one)
        if before is not None and abs(range_m - before[0]) > APART_M:
            if _is_elsewhere(anchor, value, i, known):
                edges.append(i)
                unsure.append((before[1] + 1, i))
                known = {}
            else:
                continue
        known[one] = (range_m, i)
    return np.split(rows, edges[1:]), unsure


def _is_elsewhere(anchor: list[int], value: list[float], i: int, known: dict[int, tuple[float, int]]) -> bool:
    asked: dict[int, bool] = {}
    for one, range_m in zip(anchor[i:], value[i:], strict=True):
        if one in known and one not in asked:
            asked[one] = abs(range_m - known[one][0]) > APART_M
            if len(asked) == min(ASKED, len(known)):
                break
    return 2 * sum(asked.values()) >= len(asked)


def _may_rest(ranges: Ranges, pieces: list[NDArray[np.intp]], needed: int) -> bool:
    """Whether anchors are enough, and whether what each of them says again and again is the same."""
    heard, spread = [], []
    for piece in pieces:
        anchor, value = ranges.anchor[piece], ranges.range_m[piece]
        found, count = np.unique(anchor, return_counts=True)
        heard.append(len(found))
        for one in found[count > 1]:
            own = value[anchor == one]
            spread.append(MAD_TO_SD * float(np.median(np.abs(own - np.median(own)))))
    again = len(spread) >= 0.5 * sum(heard)
    if again and np.median(spread) > STILL_M:
        return False
    return bool(np.median(heard) >= (needed if again else needed - 2 + SPARE_ONCE))


def _jump(ranges: Ranges, one: NDArray[np.intp], other: NDArray[np.intp]) -> float:
    """By how much most ranges change from one place to another; NaN = too few anchors were heard at both."""
    both = np.intersect1d(ranges.anchor[one], ranges.anchor[other])
    if len(both) < 3:
        return float("nan")
    here, there = (
        np.array([np.median(ranges.range_m[piece][ranges.anchor[piece] == a]) for a in both])
        for piece in (one, other)
    )
    return float(np.median(np.abs(here - there)))


def _place(
    ranges: Ranges, piece: NDArray[np.intp], anchors: AnchorMap, height: Height | None, model: Model
) -> NDArray[np.float64] | None:
    heard = np.unique(ranges.anchor[piece])
    value = np.array([np.median(ranges.range_m[piece][ranges.anchor[piece] == one]) for one in heard])
    possible = places(anchors.position[heard], value, np.full(len(heard), SD_M), model, height=height)
    return possible[0].position if possible else None


def _errors(
    ranges: Ranges, piece: NDArray[np.intp], anchors: AnchorMap, place: NDArray[np.float64]
) -> NDArray[np.float64]:
    away = np.linalg.norm(anchors.position[ranges.anchor[piece]] - place, axis=1)
    error: NDArray[np.float64] = ranges.range_m[piece] - away
    return error


def _scatter(error: NDArray[np.float64], unknowns: int) -> float:
    """Of errors around a place and an offset that were fitted to them."""
    spread = MAD_TO_SD * float(np.median(np.abs(error - np.median(error))))
    return spread * float(np.sqrt(len(error) / max(len(error) - unknowns, 1)))
