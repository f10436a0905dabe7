"""By how much errors scatter that are not outliers: of all, or of each kind of ranges that err alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAD_TO_SD = 1.4826
LEAST_ALIKE = 20
"""Errors that tell by how much such ranges err."""


def scatter_of(error_m: NDArray[np.float64], alike: NDArray[np.intp], kinds: int) -> NDArray[np.float64]:
    """Of each kind the deviation from 0, float64 (kinds,), m: 1.48 times the median of errors (n,) without sign.

    Args:
        alike: int (n,), the kind of each. Where one has fewer than `LEAST_ALIKE`, that of all counts.
    """
    found = np.full(kinds, MAD_TO_SD * float(np.median(np.abs(error_m))))
    for kind in range(kinds):
        own = error_m[alike == kind]
        if len(own) >= LEAST_ALIKE:
            found[kind] = MAD_TO_SD * float(np.median(np.abs(own)))
    return found
