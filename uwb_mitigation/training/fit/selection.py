"""Model selection: choose the simplest candidate that no more complex one improves by 2 % on held-out data."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.data.splits import Split
from uwb_mitigation.training.fit.candidates import Candidate, FittedModel

MIN_GAIN = 0.02
"""A more complex candidate must reduce the error by at least this share; smaller gains are not significant."""

COLD_START_MIN_GAIN = 0.10
"""Required gain with few configurations, where only large differences are significant."""

NESTED = "selection (nested)"
"""Name of the errors of the selection procedure, on configurations that neither a fit nor the selection used."""


def step_counter(total: int, on_share: Callable[[float], None]) -> Callable[[], None]:
    """Return a callback for each of `total` steps; it calls `on_share` with the finished share."""
    numbers = itertools.count(1)
    return lambda: on_share(next(numbers) / total)


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The chosen candidate and the evidence for it.

    Attributes:
        chosen: name of the candidate.
        errors: {candidate, `raw` or NESTED: held-out errors}, m.
        model: the chosen candidate, fitted to all of the data.
        folds: number of folds. configurations: number of configurations in the data.
    """

    chosen: str
    errors: Mapping[str, NDArray[np.float64]]
    model: FittedModel
    folds: int
    configurations: int

    def mae(self) -> dict[str, float]:
        """Return {name: MAE of the held-out errors}, m."""
        return {name: float(np.abs(error).mean()) for name, error in self.errors.items()}

    def as_json(self) -> dict[str, object]:
        """Return the content of `train --json`."""
        return {
            "chosen": self.chosen,
            "rows": [{"name": name, "mae": mae} for name, mae in self.mae().items()],
        }


def select_simplest(errors: Mapping[str, NDArray[np.float64]], min_gain: float = MIN_GAIN) -> str:
    """Return the first candidate, in order of preference, that no later one improves by the share `min_gain`."""
    best, best_mae = "", np.inf
    for name, error in errors.items():
        mae = float(np.abs(error).mean())
        if not best or mae < (1 - min_gain) * best_mae:
            best, best_mae = name, mae
    return best


def held_out_errors(
    data: Dataset,
    candidates: Sequence[Candidate],
    folds: Iterable[Split],
    seed: int,
    on_fit: Callable[[], None],
) -> dict[str, NDArray[np.float64]]:
    """Cross-validate each candidate; return its errors on the test rows of all folds, {name: shape (n,)}.

    Rows that are in no test part keep their raw errors.
    """
    errors = {candidate.name: data.error_m.copy() for candidate in candidates}
    for fold in folds:
        train, test = data.rows(fold.train), data.rows(fold.test)
        for candidate in candidates:
            errors[candidate.name][fold.test] -= candidate.fit(train, seed).correction_m(test)
            on_fit()
    return errors


def select_nested(
    data: Dataset,
    candidates: Sequence[Candidate],
    folds: int,
    seed: int,
    on_share: Callable[[float], None] = lambda fraction: None,
    *,
    min_gain: float = MIN_GAIN,
) -> Selection:
    """Select by cross-validation over configurations; estimate the error of the selection by nested cross-validation.

    Raises:
        DatasetError, ParameterError: see `splits.by_configuration` and the fits.
    """
    inner_folds = max(2, folds - 2)
    on_fit = step_counter(folds * len(candidates) * (1 + inner_folds), on_share)
    names = [candidate.name for candidate in candidates]
    errors = {name: data.error_m.copy() for name in ("raw", *names, NESTED)}
    for fold in splits.by_configuration(data.configurations, folds, seed):
        outer = held_out_errors(data, candidates, [fold], seed, on_fit)
        train = data.rows(fold.train)
        inner = splits.by_configuration(train.configurations, inner_folds, seed)
        inner_choice = select_simplest(held_out_errors(train, candidates, inner, seed, on_fit), min_gain)
        for name in names:
            errors[name][fold.test] = outer[name][fold.test]
        errors[NESTED][fold.test] = outer[inner_choice][fold.test]
    chosen = select_simplest({name: errors[name] for name in names}, min_gain)
    if untrained := [item.name for item in candidates if not item.trains]:
        fallback = select_simplest({name: errors[name] for name in untrained}, min_gain)
        # The error on the folds that were used for the selection is optimistic; the nested error is not.
        if select_simplest({fallback: errors[fallback], chosen: errors[NESTED]}, min_gain) == fallback:
            chosen = fallback
    (candidate,) = (item for item in candidates if item.name == chosen)
    return Selection(chosen, errors, candidate.fit(data, seed), folds, len(data.names))
