"""Which of several models is taken: the simplest that no richer one betters on what was held out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

MUST_GAIN = 0.02
"""A richer candidate is chosen where it lowers the error by at least this share: less is the luck of the folds."""


def preferred(errors: Mapping[str, NDArray[np.float64]], must_gain: float) -> str:
    """The first of candidates, in order of preference, that no later one betters by the share `must_gain`."""
    best, best_mae = "", np.inf
    for name, error in errors.items():
        mae = float(np.abs(error).mean())
        if not best or mae < (1 - must_gain) * best_mae:
            best, best_mae = name, mae
    return best
