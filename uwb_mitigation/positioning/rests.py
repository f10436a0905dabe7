"""Where a tag stands still: places, among which it is carried or driven, or as many tags that never move.

While a tag rests every range of a pair errs alike, so that a thousand of them say no more than one; and a place from
which each anchor was heard once has no motion to be followed by.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.carried import rests_between_jumps
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.start import Height
from uwb_mitigation.positioning.tracks import Ranges

STILL_M = 0.06
"""Ranges of one pair that scatter less (1.48 x median absolute deviation) come from a tag at rest: a DW1000's noise is
2 to 5 cm."""

FEW = 3
"""A tag, or what it does between two silences, of which each anchor has fewer ranges than so many, at the median, can be
at one place only."""

BIN_S = 1.0
LEAST_S = 4.0
"""A rest among motion is as long at least; what is shorter a track follows."""

HEARD_AT_ONCE = 3
"""Between silences so many anchors are heard, or more, else these are no pauses."""

GAP_S = 10.0
"""After a longer silence a tag may be anywhere."""

_SECOND_NS = 1_000_000_000
_MAD_TO_SD = 1.4826


_Carried = Callable[[Ranges, NDArray[np.intp]], list[NDArray[np.intp]] | None]


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Ranges of all tags, one stretch after the other.

    Attributes:
        ranges: in the order of the stretches, each in the order of time; `tag_id` says nothing.
        tag: int (n,), which of the tags each is of.
        row: int (n,), and which of that tag's ranges.
        of: int (n,), the stretch of each, from 0.
        at_rest: bool (s,), of each stretch.
        rise: float64 (n,), the height of the tag above the common one at each range.
    """

    ranges: Ranges
    tag: NDArray[np.intp]
    row: NDArray[np.intp]
    of: NDArray[np.intp]
    at_rest: NDArray[np.bool_]
    rise: NDArray[np.float64]

    def __len__(self) -> int:
        """The number of stretches."""
        return len(self.at_rest)

    def keep(self, wanted: NDArray[np.bool_]) -> Stretches:
        """Those stretches, bool (s,)."""
        rows = np.flatnonzero(wanted[self.of])
        number = np.cumsum(wanted) - 1
        return Stretches(
            self.ranges.take(rows),
            self.tag[rows],
            self.row[rows],
            number[self.of[rows]],
            self.at_rest[wanted],
            self.rise[rows],
        )


def stretches(tags: Sequence[Ranges], anchors: AnchorMap, height: Height | None, model: Model) -> Stretches:
    """Divide what tags recorded into places at rest and stretches of motion.

    Args:
        height: of all tags, where it stays the same.
    """
    tag, row, of, at_rest = [], [], [], list[bool]()
    for number, ranges in enumerate(tags):
        part = _one(ranges, partial(rests_between_jumps, anchors=anchors, height=height, model=model))
        for piece, is_still in part:
            tag.append(np.full(len(piece), number))
            row.append(piece)
            of.append(np.full(len(piece), len(at_rest)))
            at_rest.append(is_still)
    tag_of, row_of = np.concatenate(tag), np.concatenate(row)
    taken = [one.take(row_of[tag_of == number]) for number, one in enumerate(tags)]
    columns = Ranges(
        np.concatenate([one.stamp_ns for one in taken]),
        np.concatenate([one.anchor for one in taken]),
        np.concatenate([one.range_m for one in taken]),
        np.concatenate([one.variance_m2 for one in taken]),
        np.concatenate([one.rx_power_dbm for one in taken]),
    )
    return Stretches(columns, tag_of, row_of, np.concatenate(of), np.array(at_rest), np.zeros(len(columns)))


def _one(ranges: Ranges, carried: _Carried) -> list[tuple[NDArray[np.intp], bool]]:
    """Rows of each stretch of one tag, and whether it rests."""
    rows = np.arange(len(ranges))
    # However long the silences between: pairs that were recorded one after the other, too.
    if _is_sparse(ranges, rows) or _is_still(ranges, rows):
        return [(rows, True)]
    found: list[tuple[NDArray[np.intp], bool]] = []
    edges = np.flatnonzero(np.diff(ranges.stamp_ns) > GAP_S * _SECOND_NS) + 1
    parts = np.split(rows, edges)
    if np.median([len(np.unique(ranges.anchor[part])) for part in parts]) < HEARD_AT_ONCE:
        # So slow that silences say nothing.
        at_places = carried(ranges, rows)
        if at_places is not None:
            return [(piece, True) for piece in at_places]
    for part in parts:
        at_places = None if _is_sparse(ranges, part) or _is_still(ranges, part) else carried(ranges, part)
        found += _parts(ranges, part) if at_places is None else [(piece, True) for piece in at_places]
    return found


def _parts(ranges: Ranges, rows: NDArray[np.intp]) -> list[tuple[NDArray[np.intp], bool]]:
    """A stretch without silence, divided where rests begin and end."""
    if _is_sparse(ranges, rows) or _is_still(ranges, rows):
        return [(rows, True)]
    number = (ranges.stamp_ns[rows] - ranges.stamp_ns[rows[0]]) // round(BIN_S * _SECOND_NS)
    # Whether a bin and the next together hold one place: ranges of each anchor alike over both.
    bins = int(number[-1]) + 1
    starts = np.searchsorted(number, np.arange(bins + 1))
    alike = np.zeros(bins, np.bool_)
    for k in range(bins - 1):
        alike[k] = _is_still(ranges, rows[starts[k] : starts[k + 2]], least=2)
    still = alike | np.concatenate([[False], alike[:-1]])
    edges = np.flatnonzero(np.diff(still)) + 1
    found: list[tuple[NDArray[np.intp], bool]] = []
    moving: list[NDArray[np.intp]] = []
    for run in np.split(np.arange(bins), edges):
        piece = rows[starts[run[0]] : starts[run[-1] + 1]]
        if still[run[0]] and len(run) * BIN_S >= LEAST_S and _is_still(ranges, piece):
            if moving:
                found.append((np.concatenate(moving), False))
                moving = []
            found.append((piece, True))
        elif len(piece):
            moving.append(piece)
    if moving:
        found.append((np.concatenate(moving), False))
    return found


def _is_sparse(ranges: Ranges, rows: NDArray[np.intp]) -> bool:
    """Whether there is no motion to be followed."""
    return float(np.median(np.unique(ranges.anchor[rows], return_counts=True)[1])) < FEW


def _is_still(ranges: Ranges, rows: NDArray[np.intp], least: int = FEW) -> bool:
    """Whether the ranges of most anchors scatter by no more than noise."""
    anchor, value = ranges.anchor[rows], ranges.range_m[rows]
    spread = []
    for one in np.unique(anchor):
        own = value[anchor == one]
        if len(own) >= least:
            spread.append(_MAD_TO_SD * float(np.median(np.abs(own - np.median(own)))))
    # Two anchors may be at a tag's side while it passes them: of three one sees it go.
    return len(spread) >= 3 and float(np.quantile(spread, 0.8)) < STILL_M
