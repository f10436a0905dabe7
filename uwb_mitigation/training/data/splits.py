"""Splits that keep each configuration either in the training part or in the test part.

Within a configuration both antennas are stationary and the error hardly changes. A split by measurement would
therefore test whether the model memorised the placement, not whether it corrects ranges at new placements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Integer indices of the training rows and of the test rows."""

    train: NDArray[np.intp]
    test: NDArray[np.intp]


def by_configuration(configurations: NDArray[np.str_], folds: int, seed: int) -> list[Split]:
    """Return folds for cross-validation over names of shape (n,); each configuration is tested in exactly one fold.

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
    for held_out_indices in np.array_split(order, folds):
        held_out = np.isin(configurations, names[held_out_indices])
        splits.append(Split(np.flatnonzero(~held_out), np.flatnonzero(held_out)))
    return splits


def subsample(configurations: NDArray[np.str_], max_per_configuration: int, seed: int) -> NDArray[np.intp]:
    """Return sorted rows, at most `max_per_configuration` of each configuration, drawn without replacement."""
    generator = np.random.default_rng(seed)
    rows_kept = []
    _, configuration_index = np.unique(configurations, return_inverse=True)
    order = np.argsort(configuration_index, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(configuration_index[order])) + 1):
        if len(rows) > max_per_configuration:
            rows = generator.choice(rows, max_per_configuration, replace=False)
        rows_kept.append(rows)
    return np.sort(np.concatenate(rows_kept)) if rows_kept else np.zeros(0, np.intp)
