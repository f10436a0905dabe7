"""Splits that never put one configuration on both sides.

Within a configuration both antennas stand still and the error hardly changes: a split by measurement
would test whether a model remembers the place, not whether it corrects a range.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.evaluation.dataset import Dataset


class Group(str, enum.Enum):
    """What is held out as a whole."""

    CONFIGURATION = "configuration"
    TAG = "tag"
    HALF = "half"


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


def by_group(dataset: Dataset, group: Group, folds: int, seed: int) -> list[Split]:
    """The splits that `group` names; every configuration lies on one side of each.

    CONFIGURATION: `folds` folds of configurations. TAG: each tag location is left out in turn. HALF: the
    anchors in the order of their identities, those of the first half against the others, both ways.

    Raises:
        ParameterError, DatasetError: see `by_configuration`; a tag's or anchor's split needs two of them.
    """
    if group is Group.CONFIGURATION:
        return by_configuration(dataset.configurations, folds, seed)
    ids = dataset.tags if group is Group.TAG else dataset.anchors
    found = np.unique(ids) if ids is not None else np.zeros(0, np.uint64)
    if ids is None or len(found) < 2:
        raise DatasetError(
            f"{len(found)} {'tags' if group is Group.TAG else 'anchors'} do not make a split",
            valid="2 or more",
        )
    parts = found[:, None] if group is Group.TAG else np.array_split(found, 2)
    splits = []
    for part in parts:
        held_out = np.isin(ids, part)
        # Measurements without a configuration's name count as one: they must not lie on both sides.
        apart = ~np.isin(dataset.configurations, np.unique(dataset.configurations[held_out]))
        if not apart.any():
            raise DatasetError("one configuration holds every tag or anchor", valid="named configurations")
        splits.append(Split(np.flatnonzero(apart), np.flatnonzero(held_out)))
    return splits


def thinned(configurations: NDArray[np.str_], most: int, seed: int) -> NDArray[np.intp]:
    """Rows in order, at most `most` of each configuration, drawn without replacement."""
    generator = np.random.default_rng(seed)
    chosen = []
    _, of = np.unique(configurations, return_inverse=True)
    order = np.argsort(of, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(of[order])) + 1):
        if len(rows) > most:
            rows = generator.choice(rows, most, replace=False)
        chosen.append(rows)
    return np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.intp)
