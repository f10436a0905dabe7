"""Least squares of ranges whose errors persist: what a pair errs by for two seconds, and white noise beside it.

Random effects: each group of ranges shares an error of its own, of unknown variance, which takes nothing from what
changes within the group, and leaves of the group's mean no more than one range of it (Searle, Casella, McCulloch,
Variance Components, 1992, section 3.3). Both variances come from what is left, by medians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.scatter import scatter_of

LEAST_M = 0.01
"""Of each deviation."""


def normal_equations(
    rows: NDArray[np.float64],
    left_m: NDArray[np.float64],
    group: NDArray[np.intp],
    alike: NDArray[np.intp],
    model: Model,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The normal matrix (q, q) and right side (q,) of n ranges, robust against outliers among ranges and among groups.

    Args:
        rows: float64 (n, q), what each range grows by with each unknown.
        left_m: float64 (n,), what is not explained yet.
        group: int (n,), whose errors persist together.
        alike: int (n,), ranges that should err about as much have the same number, from 0.
    """
    order = np.argsort(group, kind="stable")
    rows, left_m, group, alike = rows[order], left_m[order], group[order], alike[order]
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    count = np.diff(np.append(starts, len(group)))
    of = np.repeat(np.arange(len(starts)), count)
    kinds = int(alike.max(initial=0)) + 1

    def mean(
        values: NDArray[np.float64], weight: NDArray[np.float64], total: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        found: NDArray[np.float64] = np.add.reduceat((values.T * weight).T, starts) / total[:, None]
        return found

    middle = np.array([np.median(part) for part in np.split(left_m, starts[1:])])
    within = left_m - middle[of]
    # Of n values around their own median: n - 1 are left.
    several = count[of] > 1
    larger = np.sqrt(count / np.maximum(count - 1.0, 1.0))[of]
    if several.any():
        white = scatter_of((within * larger)[several], alike[several], kinds)
    else:
        white = np.full(kinds, LEAST_M)
    white = np.maximum(white, LEAST_M)
    weight = model.weight(within / white[alike]) / white[alike] ** 2
    total = np.add.reduceat(weight, starts)
    both = np.concatenate([rows, left_m[:, None]], axis=1)
    shared = mean(both, weight, total)
    apart = both - shared[of]
    scaled = apart * weight[:, None]
    kind = np.array([int(np.median(part)) for part in np.split(alike, starts[1:])])
    spread = scatter_of(shared[:, -1], kind, kinds)[kind]
    persists = np.sqrt(np.maximum(spread**2 - 1.0 / total, LEAST_M**2))
    variance = persists**2 + 1.0 / total
    of_group = model.weight(shared[:, -1] / np.sqrt(variance)) / variance
    outer = scaled.T @ apart + (shared * of_group[:, None]).T @ shared
    return outer[:-1, :-1], outer[:-1, -1]
