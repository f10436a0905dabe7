"""Held-out residuals: the ranges of each anchor against a track that was estimated without this anchor.

They need no ground truth. A wrong offset of an anchor cannot hide in them, because its own ranges do not move the track.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.smoother import Smoother
from uwb_mitigation.positioning.tracks import Heights, Ranges, Track, TruePath
from uwb_mitigation.processing.tracking import TagTracks

MIN_OTHERS = 3
"""Other anchors that a track needs."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Medians of absolute held-out residuals, m; NaN: unknown.

    Attributes:
        anchor_id: None = all anchors.
        ranges: the number of residuals.
        raw_m, corrected_m: of measured and of corrected ranges; corrected NaN if the bag has none.
    """

    anchor_id: int | None
    ranges: int
    raw_m: float
    corrected_m: float

    def as_json(self) -> dict[str, float | int | None]:
        values = {"raw_m": self.raw_m, "corrected_m": self.corrected_m}
        return {"anchor_id": self.anchor_id, "ranges": self.ranges} | {
            name: value if np.isfinite(value) else None for name, value in values.items()
        }


def held_out(
    tracks: Sequence[TagTracks],
    anchors: AnchorMap,
    model: Model,
    height: Height | None = None,
    heights: Heights | None = None,
) -> list[HeldOut]:
    """Return the held-out residuals of each anchor, and of all anchors last."""
    raw = [(one.live, one.recording.raw) for one in tracks]
    corrected = [(one.live, one.recording.ranges) for one in tracks if one.recording.corrected]

    def of(row: int, kind: list[tuple[Track, Ranges]]) -> NDArray[np.float64]:
        parts = [_residuals(live, ranges, row, anchors, model, height, heights) for live, ranges in kind]
        return np.concatenate([np.zeros(0), *parts])

    by_anchor = [(of(row, raw), of(row, corrected)) for row in range(len(anchors))]
    every = [np.concatenate(kind) for kind in zip(*by_anchor, strict=True)]
    return [
        HeldOut(identity, len(before), _median(before), _median(after))
        for identity, (before, after) in zip(
            [*(anchor.id for anchor in anchors.anchors), None], [*by_anchor, every], strict=True
        )
    ]


def _residuals(
    initial: Track,
    ranges: Ranges,
    row: int,
    anchors: AnchorMap,
    model: Model,
    height: Height | None,
    heights: Heights | None,
) -> NDArray[np.float64]:
    """Return range minus distance of an anchor's ranges, where the track of the others is known."""
    own = ranges.anchor == row
    if len(np.unique(ranges.anchor[~own])) < MIN_OTHERS or not own.any():
        return np.zeros(0)
    track = Smoother(anchors, model, ranges.take(~own), height=height, heights=heights).fit(initial).track
    position = TruePath(track.stamp_ns, track.position).at(ranges.stamp_ns[own])
    residual: NDArray[np.float64] = ranges.range_m[own] - np.linalg.norm(
        position - anchors.position[row], axis=1
    )
    known: NDArray[np.float64] = residual[np.isfinite(residual)]
    return known


def _median(residual: NDArray[np.float64]) -> float:
    return float(np.median(np.abs(residual))) if len(residual) else float("nan")
