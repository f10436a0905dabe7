"""Splits that never put one configuration on both sides.

Within a configuration both antennas stand still and the error hardly changes: a split by measurement
would test whether a model remembers the place, not whether it corrects a range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Rows to fit on and rows to test on, integer indices."""

    train: NDArray[np.intp]
    test: NDArray[np.intp]


def by_configuration(configurations: NDArray[np.str_], folds: int, seed: int) -> list[Split]:
    """Folds for cross-validation over names of shape (n,): each configuration is tested in exactly one.

    Raises:
        ParameterError: fewer than two folds.
        DatasetError: fewer configurations than folds.
    """
    if folds < 2:
        raise ParameterError(f"{folds} folds", valid="at least 2")
    names = np.unique(configurations)
    if len(names) < folds:
        raise DatasetError(
            f"{len(names)} configurations do not fill {folds} folds",
            valid=f"at least {folds} configurations, or fewer folds",
        )
    order = np.random.default_rng(seed).permutation(len(names))
    splits = []
    for part in np.array_split(order, folds):
        held_out = np.isin(configurations, names[part])
        splits.append(Split(np.flatnonzero(~held_out), np.flatnonzero(held_out)))
    return splits


def thinned(configurations: NDArray[np.str_], most: int, seed: int) -> NDArray[np.intp]:
    """Rows in order, at most `most` of each configuration, drawn without replacement."""
    generator = np.random.default_rng(seed)
    chosen = []
    for name in np.unique(configurations):
        rows = np.flatnonzero(configurations == name)
        if len(rows) > most:
            rows = generator.choice(rows, most, replace=False)
        chosen.append(rows)
    return np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.intp)
