"""Measurements of one tag, for the method `add` of the estimators."""

from __future__ import annotations

import math
from typing import NamedTuple

MAX_VALUE = 1e5
"""Ranges and heights (m) and their variances (m^2) beyond this are invalid."""


class TagRange(NamedTuple):
    """A range.

    Attributes:
        stamp_ns: its time.
        anchor: row of the anchor in the map.
        range_m: m.
        variance_m2: of its error, m^2; NaN: unknown.
        is_corrected: whether a model corrected it.
    """

    stamp_ns: int
    anchor: int
    range_m: float
    variance_m2: float = math.nan
    is_corrected: bool = False

    @property
    def is_valid(self) -> bool:
        """Whether the range can be used; false for NaN, but a variance of NaN is valid."""
        return 0.0 <= self.range_m <= MAX_VALUE and not self.variance_m2 > MAX_VALUE


class TagHeight(NamedTuple):
    """A height of the tag in the anchors' frame, at the time of the latest range.

    Attributes:
        height_m: m.
        variance_m2: m^2, positive.
    """

    height_m: float
    variance_m2: float

    @property
    def is_valid(self) -> bool:
        """Whether the height can be used; false for NaN."""
        return abs(self.height_m) <= MAX_VALUE and 0.0 < self.variance_m2 <= MAX_VALUE
