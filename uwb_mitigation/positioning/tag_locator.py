"""The public locator: positions of tags from measurements and corrected ranges."""

from __future__ import annotations

import math

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import Area, Height
from uwb_mitigation.positioning.multi_tag import MultiTagEstimator
from uwb_mitigation.types.anchors import AnyAnchors, as_anchors
from uwb_mitigation.types.measurement import CorrectedRange, RangeMeasurement
from uwb_mitigation.types.tracks import Estimate


class TagLocator:
    """Estimates position and velocity of each tag from its ranges, as the node `locator` does. Not thread-safe.

    Args:
        anchors: positions of the anchors: a map, {id: (x, y, z)} in m, or the path of a file.
        height_m: height of the tags' antennas in the anchors' frame, if it is constant; None: estimate it.
        height_sd_m: standard deviation of this height.
        area: (lower corner, upper corner) of the box that contains the tags, x, y, z in m; None: unknown.

    Raises:
        ParameterError: a number is not finite or out of its range.
    """

    def __init__(
        self,
        anchors: AnyAnchors,
        *,
        height_m: float | None = None,
        height_sd_m: float = 0.1,
        area: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    ) -> None:
        height = None if height_m is None else Height(height_m, height_sd_m)
        box = None if area is None else Area(*area)
        self._estimator = MultiTagEstimator(EstimatorConfig(as_anchors(anchors), height=height, area=box))

    def add(self, measurement: RangeMeasurement, corrected: CorrectedRange | None = None) -> Estimate | None:
        """Update with a range, in the order of the stamps.

        Args:
            measurement: gives tag, anchor and stamp; without `corrected`, also the range.
            corrected: the corrected range with its variance.

        Returns:
            The position of the tag at the stamp of the measurement, in m in the anchors' frame, with its covariance; None: it
            is still unknown or ambiguous, or the range was skipped (`warnings` gives the reason).

        Raises:
            ParameterError: `measurement` or `corrected` is of another type.
        """
        if not isinstance(measurement, RangeMeasurement):
            raise ParameterError(
                f"measurement = {measurement!r:.60}", valid="a RangeMeasurement: record.measurement"
            )
        if not isinstance(corrected, CorrectedRange | None):
            raise ParameterError(
                f"corrected = {corrected!r:.60}", valid="what Mitigation.correct returns, or None"
            )
        key = measurement.tag_id, measurement.anchor_id, measurement.stamp_ns
        if corrected is None:
            result = self._estimator.add(*key, measurement.range_m, math.nan, False)
        else:
            is_corrected = corrected.status.is_corrected
            result = self._estimator.add(*key, corrected.range_m, corrected.variance_m2, is_corrected)
        return None if result is None else result[1]

    def warnings(self) -> list[str]:
        """Return current warnings, such as unknown anchors or a poor geometry; empty: none."""
        return self._estimator.warnings()
