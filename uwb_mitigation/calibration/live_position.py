"""Position errors of the locator at a site, with raw and with corrected ranges.

The locator estimates the common offset, so that better ranges do not always give better positions. A calibration is
accepted by this error, on held-out segments. Without ground truth the reference is the track of the joint solution: the
change is an estimate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.site_data import SiteData
from uwb_mitigation.calibration.solution import SiteSolution
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.robot_estimator import live_track
from uwb_mitigation.positioning.online.tag_estimator import EstimatorConfig
from uwb_mitigation.types.tracks import Heights, Ranges, TruePath

RAW = "raw"

FILTERS = (NoiseModel(), NoiseModel(offset_sd=1e-3))
"""Models of the filters: that of the locator, and one that does not estimate a common offset, like a plain EKF."""

MAX_INCREASE = 0.02
"""A larger increase of the live position error is harm; a smaller one is not significant."""

MIN_POSITIONS = 20
"""With fewer positions, no error is computed."""


@dataclass(frozen=True, slots=True)
class LiveError:
    """RMSE of the live position, m: of the locator, and of a filter that does not estimate a common offset; NaN: unknown."""

    locator_m: float
    plain_m: float

    def change_from(self, before: LiveError) -> float:
        """Return the change of the locator's error relative to another one: -0.1 is 10 % less."""
        return self.locator_m / before.locator_m - 1.0

    def is_worse_than(self, before: LiveError) -> bool:
        """Return whether the error of either filter increases significantly."""
        limit = 1.0 + MAX_INCREASE
        return self.locator_m > limit * before.locator_m or self.plain_m > limit * before.plain_m


def live_errors(
    site: SiteData,
    solution: SiteSolution,
    residuals_m: Mapping[str, NDArray[np.float64]],
    variances_m2: Mapping[str, NDArray[np.float64]],
) -> dict[str, LiveError]:
    """Return the live position errors with raw ranges, and with each set of corrected ranges.

    Args:
        site: recorded ranges.
        solution: reference positions.
        residuals_m: {name: errors of the corrected ranges of `solution.rows`, shape (n,)}, m.
        variances_m2: {name: variances of these ranges, shape (n,)}, m^2.

    Returns:
        {`RAW` or name: error}. Errors are compared at the times at which all have a position.
    """
    pair_offset = solution.offsets.lookup(
        np.array([tag.tag_id for tag in site.tags], np.uint64)[site.tag],
        np.array([anchor.id for anchor in site.anchors.anchors], np.uint64)[site.ranges.anchor],
    ).astype(np.float64)
    ranges = {RAW: site.ranges}
    for name, residual_m in residuals_m.items():
        range_m = site.ranges.range_m - pair_offset
        range_m[solution.rows] = solution.true_m + residual_m
        variance_m2 = np.full(len(range_m), float(np.median(variances_m2[name])))
        variance_m2[solution.rows] = variances_m2[name]
        ranges[name] = replace(site.ranges, range_m=np.maximum(range_m, 0.0), variance_m2=variance_m2)
    errors = {
        name: [_errors(site, solution, model, corrected) for model in FILTERS]
        for name, corrected in ranges.items()
    }
    is_common = np.isfinite([error for pair in errors.values() for error in pair]).all(axis=0)
    if int(is_common.sum()) < MIN_POSITIONS:
        return dict.fromkeys(errors, LiveError(math.nan, math.nan))
    return {
        name: LiveError(*(math.sqrt(float(np.mean(error[is_common] ** 2))) for error in pair))
        for name, pair in errors.items()
    }


def _errors(
    site: SiteData, solution: SiteSolution, model: NoiseModel, corrected: Ranges
) -> NDArray[np.float64]:
    """Return the error of the live position at each range, m, shape (r,); NaN: no position, or no reference."""
    error, prior = np.full(len(corrected), np.nan), solution.prior
    reference = np.full((len(corrected), 3), np.nan)
    reference[solution.rows] = solution.antenna_position
    for number in range(len(site.tags)):
        rows = np.flatnonzero(site.tag == number)
        ranges = corrected.take(rows)
        heights = None
        if site.height_m is not None:
            heights = Heights(ranges.stamp_ns, site.height_m[rows], np.full(len(rows), prior.height_sd_m**2))
        config = EstimatorConfig(site.anchors, model, prior.height, prior.area, heights)
        track = live_track(config, ranges)
        has_reference = np.isfinite(reference[rows]).all(axis=1)
        if not len(track) or not has_reference.any():
            continue
        path = TruePath(ranges.stamp_ns[has_reference], reference[rows[has_reference]])
        index = np.searchsorted(track.stamp_ns, ranges.stamp_ns, side="right").clip(1) - 1
        has_position = track.stamp_ns[index] == ranges.stamp_ns
        difference = track.position[index] - path.position_at(ranges.stamp_ns)
        axes = slice(0, 3 if prior.height is None and heights is None else 2)
        error[rows[has_position]] = np.linalg.norm(difference[:, axes], axis=1)[has_position]
    return error
