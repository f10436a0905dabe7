"""Errors of corrections on ranges that they were not fitted to, their comparison, and what it promises for another drive.

Without ground truth, the ranges of each anchor are compared with the positions that the other anchors give: no range judges the
track that it moved. With ground truth, ranges and live positions are compared with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RAW = "raw"

MIN_GAIN = 0.02
"""A more complex correction must reduce the error by at least this share; smaller gains are not significant."""

MAX_INCREASE = 0.02
"""A larger increase of the live position error is harm; a smaller one is not significant."""

BLOCK_S = 10.0
"""Errors of blocks of this duration count as independent: obstacles persist for seconds."""

ONE_SIDED_95 = 1.645
"""Standard deviations below which 5 % of a normal distribution are."""

OUTLIER_SDS = 4.0
"""Larger errors count as this multiple of the scatter of the raw ranges: ranges behind obstacles must not decide alone."""

PROMISED_SHARE = 0.1
"""Share of the gain in residuals without ground truth that is promised for the live position."""

MIN_RANGES = 20
"""With fewer ranges, nothing is compared."""


@dataclass(frozen=True, slots=True)
class Gain:
    """Relative decrease of an error: the estimate, and the lower end of its one-sided 95 % interval; NaN: unknown."""

    mean: float
    low: float

    @property
    def is_significant(self) -> bool:
        """Whether it is large enough for a more complex correction, and not by chance."""
        return self.low > 0.0 and self.mean >= MIN_GAIN


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Errors of corrections on one or more parts of a recording; all arrays have r rows, NaN: unknown.

    Attributes:
        block: int, number of the block of each range.
        residual_m: {`RAW` or correction: error of the range against the reference}, m.
        live_m: {`RAW` or correction: error of the live position}, m; empty without ground truth.
        is_separate: the correction was fitted to another drive.
    """

    block: NDArray[np.int64]
    residual_m: Mapping[str, NDArray[np.float64]]
    live_m: Mapping[str, NDArray[np.float64]]
    is_separate: bool

    def merged(self, second_part: HeldOut, is_first: NDArray[np.bool_]) -> HeldOut:
        """Return the errors of this and another part of a recording; `is_first` shows which ranges are of this part, bool (r,)."""
        order = np.argsort(np.argsort(~is_first, kind="stable"))
        block = np.append(self.block, second_part.block)[order]
        residual_m = {k: np.append(v, second_part.residual_m[k])[order] for k, v in self.residual_m.items()}
        live_m = {k: np.append(v, second_part.live_m[k])[order] for k, v in self.live_m.items()}
        return HeldOut(block, residual_m, live_m, self.is_separate)

    def mae_m(self, name: str) -> float:
        """Return the mean absolute range error, m."""
        return float(np.nanmean(np.abs(self.residual_m[name])))

    def live_rmse_m(self, name: str) -> float:
        """Return the RMSE of the live position, m; NaN: unknown."""
        if name not in self.live_m or not np.isfinite(self.live_m[name]).any():
            return math.nan
        return float(np.sqrt(np.nanmean(self.live_m[name] ** 2)))

    def range_gain(self, name: str, base: str) -> Gain:
        """Return the decrease of the mean absolute range error relative to another correction."""
        before, after = np.abs(self.residual_m[base]), np.abs(self.residual_m[name])
        centre = np.nanmedian(before)
        limit_m = float(centre + OUTLIER_SDS * 1.4826 * np.nanmedian(np.abs(before - centre)))
        return self._gain(np.minimum(before, limit_m), np.minimum(after, limit_m))

    def live_gain(self, name: str, base: str) -> Gain:
        """Return the decrease of the RMSE of the live position; NaN without ground truth."""
        if name not in self.live_m:
            return Gain(math.nan, math.nan)
        gain = self._gain(self.live_m[base] ** 2, self.live_m[name] ** 2)
        return Gain(*(1.0 - math.sqrt(max(1.0 - decrease, 0.0)) for decrease in (gain.mean, gain.low)))

    def refusal(self, name: str, baseline: str) -> str:
        """Return why a correction does not help in comparison with the baseline; empty: it does.

        The live position counts only with ground truth.
        """
        live = self.live_gain(name, baseline).low
        if self.live_m and math.isnan(live):
            return "there are too few live positions to compare"
        if live <= 0.0:
            return f"the live position is not clearly better than with {ranges_text(baseline)}"
        if not self.range_gain(name, baseline).mean >= MIN_GAIN:
            return f"the ranges are not better than with {ranges_text(baseline)}"
        return ""

    def _gain(self, before: NDArray[np.float64], after: NDArray[np.float64]) -> Gain:
        """Return the relative decrease of the mean of n values, with the scatter of the decrease between blocks."""
        is_known = np.isfinite(before) & np.isfinite(after)
        if is_known.sum() < MIN_RANGES:
            return Gain(math.nan, math.nan)
        _, block = np.unique(self.block[is_known], return_inverse=True)
        count, decrease = np.bincount(block), np.bincount(block, (before - after)[is_known])
        mean = decrease.sum() / count.sum()
        blocks = len(count)
        scatter = math.sqrt(float(np.sum((decrease - mean * count) ** 2)) * blocks / max(blocks - 1, 1))
        low = mean - ONE_SIDED_95 * scatter / count.sum()
        level = float(before[is_known].mean())
        return Gain(float(mean) / level, float(low) / level)


def ranges_text(baseline: str) -> str:
    """Return a baseline as part of a sentence."""
    return "raw ranges" if baseline == RAW else f"the {baseline}"


def decisive(error_sets: Sequence[HeldOut]) -> list[HeldOut]:
    """Return the separate drives, or if there are none, all parts."""
    return [errors for errors in error_sets if errors.is_separate] or list(error_sets)


def select(error_sets: Sequence[HeldOut], names: Sequence[str], baseline: str) -> str:
    """Return the simplest correction that no more complex one improves.

    A more complex correction must improve significantly on each separate drive, and without any on the halves of the drive; the
    other parts must not become worse; the simplest one stays the choice, also if it is refused, until one improves on it. With ground truth it must reduce the live position error, or the range error without
    increasing the former: better ranges do not always give better positions. `HeldOut.refusal` must accept it on
    every part, if it accepts any.

    Args:
        error_sets: errors of each drive, or of its halves.
        names: corrections in order of complexity.
        baseline: what is used without a calibration.
    """
    decisive_sets = decisive(error_sets)

    def improves(errors: HeldOut, name: str, base: str) -> bool:
        gain, live = errors.range_gain(name, base), errors.live_gain(name, base)
        if errors not in decisive_sets:
            return gain.mean > 0.0
        if math.isnan(live.mean):
            return gain.is_significant
        return live.is_significant or (gain.is_significant and live.mean > -MAX_INCREASE)

    helpful = [name for name in names if not any(errors.refusal(name, baseline) for errors in error_sets)]
    best = names[0]
    # If none helps, the best one is written on request.
    for name in helpful or names:
        if all(improves(errors, name, best) for errors in error_sets):
            best = name
    return best
