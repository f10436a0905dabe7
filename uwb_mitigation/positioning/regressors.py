"""What beside offsets may make ranges long: a network's predictions, a line in received power."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

NETWORK_SD = 0.03
"""How far the universal network's predictions may be from what the site's errors are, as a factor around 1. Little: a
predictor that errs itself draws a free factor below 1, and what it then leaves goes into the offsets."""

SLOPE_SD = 0.1
"""m/dB."""


@dataclass(frozen=True, slots=True, eq=False)
class Regressors:
    """What beside offsets may make a range long, of all ranges of all tags, one tag after the other.

    Attributes:
        names: of the columns.
        rows: float64 (r, k); 0 where not known.
        mean, sd: float64 (k,), what is known before.
        alike: int (r,), ranges that should err about as much have the same number, from 0.
    """

    names: tuple[str, ...]
    rows: NDArray[np.float64]
    mean: NDArray[np.float64]
    sd: NDArray[np.float64]
    alike: NDArray[np.intp]

    @classmethod
    def one(cls, name: str, row: NDArray[np.float64], mean: float, sd: float) -> Regressors:
        """A single one, float64 (r,), of ranges that all err alike."""
        return cls((name,), row[:, None], np.array([mean]), np.array([sd]), np.zeros(len(row), np.intp))

    @classmethod
    def none(cls, ranges: int) -> Regressors:
        """No such thing."""
        return cls((), np.zeros((ranges, 0)), np.zeros(0), np.zeros(0), np.zeros(ranges, np.intp))

    def take(self, index: NDArray[np.intp]) -> Regressors:
        """Those of the ranges at `index`."""
        return replace(self, rows=self.rows[index], alike=self.alike[index])
