"""Architecture search (paper, section III-B): random search, then a grid around the best result.

Networks are judged on a validation part of the training data; the test part is not used.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.splits import by_configuration
from uwb_mitigation.model import floating
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.paper.jobs import run_jobs
from uwb_mitigation.paper.parts import fingerprint, narrowed
from uwb_mitigation.training.fitting import fit
from uwb_mitigation.training.options import FitOptions

SPACE: Mapping[str, tuple[int, ...]] = {
    "modules": (1, 2, 3, 4),
    "first_kernel": (3, 5, 7),
    "kernel": (3, 5),
    "filters": (4, 8, 12, 16, 24),
}
"""N, k0, kn and F; window lengths K are an argument of `search`."""

VALIDATION_FOLDS = 5
"""Of the training configurations; one fold is the validation part."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One network.

    Attributes:
        mae_m: on the validation part; None if training diverged.
        stage: `random` or `grid`.
    """

    architecture: Remnet
    mae_m: float | None
    stage: str

    @property
    def multiply_accumulates(self) -> int:
        return self.architecture.multiply_accumulates


def front(trials: Sequence[Trial]) -> list[Trial]:
    """Return the Pareto front of MAE and multiply-accumulates, cheapest first."""
    best: list[Trial] = []
    measured = [trial for trial in trials if trial.mae_m is not None]
    for trial in sorted(measured, key=lambda trial: (trial.multiply_accumulates, trial.mae_m)):
        if not best or trial.mae_m < best[-1].mae_m:  # type: ignore[operator]
            best.append(trial)
    return best


def search(
    known: Dataset,
    journal: Path,
    options: FitOptions,
    *,
    random: int,
    grid: int,
    windows: Sequence[int] = (),
    workers: int = 1,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[Trial]:
    """Try `random` networks from `SPACE`, then at most `grid` neighbours of the best one.

    Args:
        known: the training part; one of `VALIDATION_FOLDS` of its configurations validates.
        journal: an interrupted search continues from this file.
        options: of every fit; the seed also draws the networks.
        windows: lengths K; by default that of the data.

    Raises:
        ParameterError: nothing to try, or a window is longer than the data's.
        DatasetError: every network diverged, or there are too few configurations.
    """
    longest = known.preprocessing.samples
    windows = tuple(windows) or (longest,)
    if random < 1 or grid < 0 or max(windows) > longest or min(windows) < 1:
        raise ParameterError(
            f"{random} random trials, {grid} of a grid, windows {windows}",
            valid=f"at least 1, at least 0, 1 to {longest}",
        )
    fold = by_configuration(known.configurations, VALIDATION_FOLDS, seed=0)[0]
    work = _Worker(known.rows(fold.train), known.rows(fold.test), options)
    mark = fingerprint(json.dumps(asdict(options), sort_keys=True), work.train, work.validation)

    def attempt(shapes: Sequence[Remnet], stage: str, begin: float, end: float) -> list[Trial]:
        results = run_jobs(
            work,
            {_name(shape): shape for shape in shapes},
            journal,
            mark,
            cost=lambda shape: shape.multiply_accumulates,
            workers=workers,
            on_progress=lambda share: on_progress(begin + share * (end - begin)),
        )
        return [
            Trial(shape, result["mae_m"], stage)
            for shape, result in zip(shapes, results.values(), strict=True)
        ]

    middle = random / (random + grid)
    drawn = attempt(_draw(random, windows, options.seed), "random", 0.0, middle)
    best = next(iter(sorted((t for t in drawn if t.mae_m is not None), key=lambda t: t.mae_m or 0.0)), None)
    if best is None:
        raise DatasetError("every network diverged", valid="a lower learning rate")
    tried = [trial.architecture for trial in drawn]
    near = [shape for shape in _neighbours(best.architecture) if shape not in tried][:grid]
    return drawn + attempt(near, "grid", middle, 1.0)


def _name(shape: Remnet) -> str:
    return "_".join(f"{key}{value}" for key, value in asdict(shape).items())


def _draw(count: int, windows: Sequence[int], seed: int) -> list[Remnet]:
    """Different networks in random order; all of them if there are at most `count`."""
    every = [
        Remnet(samples, **dict(zip(SPACE, values, strict=True)))
        for samples in windows
        for values in itertools.product(*SPACE.values())
    ]
    order = np.random.default_rng(seed).permutation(len(every))
    return [every[index] for index in order[:count]]


def _neighbours(centre: Remnet) -> list[Remnet]:
    """The grid of one step in each direction along each axis, fewest steps first."""
    axes = []
    for name, values in SPACE.items():
        at = values.index(getattr(centre, name))
        axes.append([(name, values[i], abs(i - at)) for i in range(at - 1, at + 2) if 0 <= i < len(values)])
    grid = sorted(itertools.product(*axes), key=lambda point: sum(step for _, _, step in point))
    return [replace(centre, **{name: value for name, value, _ in point}) for point in grid]


@dataclass(frozen=True, slots=True, eq=False)
class _Worker:
    train: Dataset
    validation: Dataset
    options: FitOptions

    def __call__(self, shape: Remnet) -> dict[str, Any]:
        train, validation = (narrowed(part, shape.samples) for part in (self.train, self.validation))
        try:
            weights = fit(shape, train.inputs, train.error_m, self.options)
        except DatasetError:  # a network that diverges does not end the search
            return {"mae_m": None}
        left = validation.error_m - floating.predict_m(weights, validation.inputs)
        return {"mae_m": float(np.abs(left).mean())}
