"""Find errors in the anchors file with a localisation: a wrong anchor position, or two swapped anchors.

The ranges of such an anchor look like ranges with an offset, but their error depends on the direction to the tag.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.batch.anchor_errors import LARGER, MIN_LOSS_GAIN, MISPLACED_M
from uwb_mitigation.positioning.noise_model import MAD_TO_SD
from uwb_mitigation.training.site.data import SiteData

INDEPENDENT_S = 2.0
"""Range errors of an anchor within this time count as one independent error."""

MIN_GROUPS = 8
"""An anchor with fewer independent errors is not examined."""

MIN_SD_M = 0.1
MAX_RANGES = 2000


@dataclass(frozen=True, slots=True, eq=False)
class _AnchorRanges:
    """The ranges of one anchor.

    Attributes:
        antenna: (n, 3), position of the tag, m. range_m: (n,). tag: int (n,).
        weight: the number of independent errors, divided by n.
    """

    antenna: NDArray[np.float64]
    range_m: NDArray[np.float64]
    tag: NDArray[np.intp]
    weight: float

    def residual_m(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the error of each range to an anchor at `position` minus the median of its tag."""
        error: NDArray[np.float64] = self.range_m - np.linalg.norm(self.antenna - position, axis=1)
        for tag in np.unique(self.tag):
            error[self.tag == tag] -= np.median(error[self.tag == tag])
        return error

    def loss(self, position: NDArray[np.float64], sd_m: float) -> float:
        """Return the negative log likelihood (Cauchy) for an anchor at `position`, with per-tag offsets."""
        return float(self.weight * np.log1p((self.residual_m(position) / sd_m) ** 2).sum())

    def best_displacement(self, position: NDArray[np.float64], sd_m: float) -> NDArray[np.float64]:
        """Return the horizontal displacement from `position` that fits the ranges best, m, shape (3,)."""
        found = least_squares(
            lambda shift: self.residual_m(position + np.append(shift, 0.0)),
            np.zeros(2),
            loss="cauchy",
            f_scale=sd_m,
        )
        return np.append(found.x, 0.0)


def validate_anchor_map(site: SiteData, antenna: NDArray[np.float64], known: NDArray[np.bool_]) -> None:
    """Raise an error if other anchor positions fit the ranges much better.

    Args:
        site: recorded ranges.
        antenna: (r, 3), position of the tag's antenna at each range of the site, m.
        known: bool (r,), whether the position is known and the range is not an outlier.

    Raises:
        DatasetError: names the anchors.
    """
    anchors = site.anchors
    ranges = _by_anchor(site, antenna, known)
    if not ranges:
        return
    spread = np.concatenate(
        [anchor_ranges.residual_m(anchors.position[row]) for row, anchor_ranges in ranges.items()]
    )
    sd_m = max(MIN_SD_M, MAD_TO_SD * float(np.median(np.abs(spread))))
    current_loss = {
        row: anchor_ranges.loss(anchors.position[row], sd_m) for row, anchor_ranges in ranges.items()
    }
    shift = {
        row: anchor_ranges.best_displacement(anchors.position[row], sd_m)
        for row, anchor_ranges in ranges.items()
    }
    gain = {
        row: current_loss[row] - anchor_ranges.loss(anchors.position[row] + shift[row], sd_m)
        for row, anchor_ranges in ranges.items()
    }
    suspects = [
        row
        for row in ranges
        if np.linalg.norm(shift[row]) > MISPLACED_M and _is_better(gain[row], current_loss[row])
    ]
    fix = "the true positions in the anchors file (`uwb-mitigation survey` finds them)"
    best_swap: tuple[float, int, int] | None = None
    for a, b in itertools.combinations(suspects, 2):
        swapped = ranges[a].loss(anchors.position[b], sd_m) + ranges[b].loss(anchors.position[a], sd_m)
        swap_gain = current_loss[a] + current_loss[b] - swapped
        # Two free displacements always fit better than a swap, but only slightly better if the anchors are swapped.
        is_swap = swap_gain > (1.0 - LARGER) * (gain[a] + gain[b])
        if is_swap and (best_swap is None or swap_gain > best_swap[0]):
            best_swap = swap_gain, a, b
    if best_swap is not None:
        first, second = (anchors.anchors[row] for row in best_swap[1:])
        raise DatasetError(
            f"anchors {first} and {second} contradict the localisation: the ranges fit if these anchors are swapped",
            valid=fix,
        )
    if suspects:
        row = max(suspects, key=lambda one: gain[one])
        raise DatasetError(
            f"anchor {anchors.anchors[row]} contradicts the localisation: the ranges fit a position "
            f"{float(np.linalg.norm(shift[row])):.1f} m from that in the anchors file",
            valid=fix,
        )


def _is_better(gain: float, loss: float) -> bool:
    return gain > max(MIN_LOSS_GAIN, LARGER * loss)


def _by_anchor(
    site: SiteData, antenna: NDArray[np.float64], known: NDArray[np.bool_]
) -> dict[int, _AnchorRanges]:
    tag, all_ranges = site.tag, site.ranges
    row, stamp_ns, range_m = all_ranges.anchor, all_ranges.stamp_ns, all_ranges.range_m
    ranges = {}
    for anchor in np.unique(row).tolist():
        own_rows = np.flatnonzero(known & (row == anchor))
        group = stamp_ns[own_rows] // round(INDEPENDENT_S * 1e9)
        independent = len(np.unique(np.stack([group, tag[own_rows]]), axis=1).T) if len(own_rows) else 0
        if independent < MIN_GROUPS:
            continue
        selected = own_rows[:: math.ceil(len(own_rows) / MAX_RANGES)]
        weight = min(1.0, independent / len(selected))
        ranges[anchor] = _AnchorRanges(antenna[selected], range_m[selected], tag[selected], weight)
    return ranges
