"""Errors of the models of a site on held-out segments of the track and held-out anchors, and their selection."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.live_position import LiveError
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.data.splits import Split
from uwb_mitigation.training.fit.candidates import Candidate
from uwb_mitigation.training.fit.selection import MIN_GAIN, held_out_errors, step_counter

SEGMENT_FOLDS, ANCHOR_FOLDS = 4, 2
"""Number of folds over segments of the track and over anchors."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteErrors:
    """Held-out errors of the candidates, {name: shape (n,)}, m.

    Attributes:
        by_segment: on held-out segments of the track. by_anchor: on held-out anchors; empty: there is only one anchor.
    """

    by_segment: Mapping[str, NDArray[np.float64]]
    by_anchor: Mapping[str, NDArray[np.float64]]

    def all_errors(self) -> dict[str, NDArray[np.float64]]:
        """Return the errors on segments followed by those on anchors."""
        return {
            name: np.concatenate([error, self.by_anchor.get(name, error[:0])])
            for name, error in self.by_segment.items()
        }

    def mae(self) -> dict[str, float]:
        """Return {name: MAE}, m."""
        return {name: float(np.abs(error).mean()) for name, error in self.all_errors().items()}

    def select(self, live: Mapping[str, LiveError]) -> str:
        """Return the simplest candidate that no more complex one improves by `MIN_GAIN`, in order of complexity.

        A more complex candidate must reduce the live position error, or the range error without increasing the former.
        """
        mae = self.mae()
        best = first = next(iter(mae))
        for name in mae:
            is_allowed = not live[name].is_worse_than(live[first])
            improves_live = live[name].change_from(live[best]) < -MIN_GAIN
            improves_ranges = mae[name] < (1.0 - MIN_GAIN) * mae[best]
            if is_allowed and (
                improves_live or (improves_ranges and not live[name].is_worse_than(live[best]))
            ):
                best = name
        return best


def held_out_site_errors(
    data: Dataset,
    candidates: Sequence[Candidate],
    seed: int,
    offset_change: Callable[[NDArray[np.intp]], NDArray[np.float64]],
    on_share: Callable[[float], None] = lambda fraction: None,
) -> SiteErrors:
    """Cross-validate models over segments of the track, and over anchors.

    Args:
        data: from `SiteData.to_dataset`, with the offsets subtracted.
        candidates: models in order of complexity.
        seed: seed of the splits and of the fits.
        offset_change: returns for held-out rows the change of each range's offset, shape (n,), m, if the offsets
            are estimated without these rows. Offsets are re-estimated for held-out segments, but not for held-out
            anchors, whose offsets can only be estimated from their own ranges.
        on_share: called with the finished share, 0 to 1.

    Raises:
        DatasetError: one segment cannot be divided.
    """
    assert data.anchors is not None
    segments = _folds(np.array([name.split("/")[0] for name in data.configurations]), SEGMENT_FOLDS, seed)
    anchors = _folds(data.anchors.astype(str), ANCHOR_FOLDS, seed)
    if not segments:
        raise DatasetError(
            "only one segment of ranges, so that no segment can be held out",
            valid="a longer drive, or more positions",
        )
    on_fit = step_counter((len(segments) + len(anchors)) * len(candidates), on_share)

    def prepare(fold: Split) -> Dataset:
        return data.shifted(offset_change(fold.test))

    by_segment = held_out_errors(data, candidates, segments, seed, on_fit, prepare=prepare)
    by_anchor = held_out_errors(data, candidates, anchors, seed, on_fit) if anchors else {}
    return SiteErrors(by_segment, by_anchor)


def _folds(groups: NDArray[np.str_], folds: int, seed: int) -> list[Split]:
    """Return at most `folds` folds over groups, shape (n,); empty for a single group."""
    count = min(folds, len(np.unique(groups)))
    return splits.by_configuration(groups, count, seed) if count >= 2 else []
