"""Division of the ranges of tags into stationary positions and segments of motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.regression import MAD_TO_SD
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Ranges

STILL_M = 0.06
"""Ranges of one pair that scatter less (1.48 x median absolute deviation) are from a tag at rest: the noise of a DW1000 is
2 to 5 cm."""

FEW = 3
"""If the median number of ranges per anchor is smaller, the tag is treated as stationary."""

BIN_S = 1.0
"""Duration of the parts that are compared with the next one: a tag at walking speed moves by much more than `STILL_M`."""

LEAST_S = 4.0
"""Shorter stationary parts belong to the motion around them."""

GAP_S = 10.0
"""After a longer pause a tag may be anywhere."""


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Ranges of all tags, ordered by segment.

    Attributes:
        ranges: in the order of the segments, each in the order of time; `tag_id` is meaningless.
        tag: int (n,), index of the tag of each range.
        row: int (n,), row in the ranges of that tag.
        segment: int (n,), of each range, from 0.
        is_stationary: bool (s,), whether each segment is stationary.
        relative_height: float64 (n,), the height of the tag above the common one at each range.
    """

    ranges: Ranges
    tag: NDArray[np.intp]
    row: NDArray[np.intp]
    segment: NDArray[np.intp]
    is_stationary: NDArray[np.bool_]
    relative_height: NDArray[np.float64]

    def __len__(self) -> int:
        """The number of segments."""
        return len(self.is_stationary)

    def select(self, is_selected: NDArray[np.bool_]) -> Segments:
        """Return only these segments, bool (s,)."""
        return self.select_ranges(is_selected[self.segment])

    def select_ranges(self, is_selected: NDArray[np.bool_]) -> Segments:
        """Return only these ranges, bool (n,), and the segments that contain them."""
        numbers, segment = np.unique(self.segment[is_selected], return_inverse=True)
        ranges, is_stationary = self.ranges.take(is_selected), self.is_stationary[numbers]
        tag, row = self.tag[is_selected], self.row[is_selected]
        return Segments(ranges, tag, row, segment, is_stationary, self.relative_height[is_selected])


def find_segments(tags: Sequence[Ranges]) -> Segments:
    """Divide the ranges of tags into positions at rest and segments of motion.

    A tag may be moved between positions at rest only without ranging, during a pause of more than `GAP_S`.
    """
    tag, row, segment, stationary = [], [], [], list[bool]()
    for number, ranges in enumerate(tags):
        for piece, is_stationary in _segments(ranges):
            tag.append(np.full(len(piece), number))
            row.append(piece)
            segment.append(np.full(len(piece), len(stationary)))
            stationary.append(is_stationary)
    tag_of, row_of = np.concatenate(tag), np.concatenate(row)
    kept_ranges = [tag_ranges.take(row_of[tag_of == number]) for number, tag_ranges in enumerate(tags)]
    columns = Ranges.of_tags(kept_ranges)
    return Segments(
        columns, tag_of, row_of, np.concatenate(segment), np.array(stationary), np.zeros(len(columns))
    )


def _segments(ranges: Ranges) -> list[tuple[NDArray[np.intp], bool]]:
    """Return the rows of each segment of one tag, and whether it is at rest."""
    rows = np.arange(len(ranges))
    # Ignore pauses: pairs may have been recorded one after the other.
    if _is_sparse(ranges, rows) or _is_stationary(ranges, rows):
        return [(rows, True)]
    pieces = np.split(rows, np.flatnonzero(np.diff(ranges.stamp_ns) > GAP_S * NS_PER_S) + 1)
    return [segment for piece in pieces for segment in _split_at_stops(ranges, piece)]


def _split_at_stops(ranges: Ranges, rows: NDArray[np.intp]) -> list[tuple[NDArray[np.intp], bool]]:
    """Divide a segment without gaps at the start and end of stationary parts."""
    if _is_sparse(ranges, rows) or _is_stationary(ranges, rows):
        return [(rows, True)]
    number = (ranges.stamp_ns[rows] - ranges.stamp_ns[rows[0]]) // round(BIN_S * NS_PER_S)
    # Whether the tag has one position in a bin and the next one: the ranges of each anchor are similar.
    bins = int(number[-1]) + 1
    starts = np.searchsorted(number, np.arange(bins + 1))
    is_still = np.zeros(bins, np.bool_)
    for k in range(bins - 1):
        is_still[k] = _is_stationary(ranges, rows[starts[k] : starts[k + 2]], least=2)
    still = is_still | np.concatenate([[False], is_still[:-1]])
    is_stop = np.zeros(bins, np.bool_)
    for run in _runs(still):
        piece = rows[starts[run[0]] : starts[run[-1] + 1]]
        is_long = still[run[0]] and len(run) * BIN_S >= LEAST_S
        is_stop[run] = is_long and _is_stationary(ranges, piece)
    pieces = ((rows[starts[run[0]] : starts[run[-1] + 1]], bool(is_stop[run[0]])) for run in _runs(is_stop))
    return [(piece, is_stationary) for piece, is_stationary in pieces if len(piece)]


def _runs(values: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the indices of each run of equal values."""
    return np.split(np.arange(len(values)), np.flatnonzero(np.diff(values)) + 1)


def _is_sparse(ranges: Ranges, rows: NDArray[np.intp]) -> bool:
    """Return whether there are too few ranges per anchor to track motion."""
    return float(np.median(np.unique(ranges.anchor[rows], return_counts=True)[1])) < FEW


def _is_stationary(ranges: Ranges, rows: NDArray[np.intp], least: int = FEW) -> bool:
    """Return whether the ranges of most anchors scatter only by noise."""
    anchor, value = ranges.anchor[rows], ranges.range_m[rows]
    spread = []
    for row in np.unique(anchor):
        anchor_ranges = value[anchor == row]
        if len(anchor_ranges) >= least:
            spread.append(MAD_TO_SD * float(np.median(np.abs(anchor_ranges - np.median(anchor_ranges)))))
    # While a tag moves, its ranges to two anchors may be constant, but not to three.
    return len(spread) >= 3 and float(np.quantile(spread, 0.8)) < STILL_M
