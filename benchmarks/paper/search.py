"""Search for the hyper-parameters of REMNet with Optuna (paper, section III-B): random search, then a grid around its best network.

Networks are compared on a part of the training data; the test part is not used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import optuna

from benchmarks.paper.results import TRIAL_EPOCHS, Trial
from benchmarks.paper.training import NetworkStack
from uwb_mitigation.mitigation.model.architecture import Architecture, Convolution, Remnet
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit.options import FitOptions

SPACE: Mapping[str, tuple[int, ...]] = {
    "modules": (1, 2, 3, 4),
    "first_kernel": (3, 5, 7),
    "kernel": (3, 5),
    "filters": (4, 8, 16, 32),
}
"""N, k0, kn and F; the paper does not report the values that it searched."""

CHOICE = {"modules": 3, "first_kernel": 5, "kernel": 3, "filters": 16}
"""The paper's choice, which is always the first trial."""

VALIDATION_FOLDS = 5


def multiply_accumulates(shape: Architecture) -> int:
    """Return the multiply-accumulates of one inference, including padding."""
    positions = {layer.name: layer.output_length for layer in shape.layers if isinstance(layer, Convolution)}
    return sum(math.prod(size) * positions.get(name, 1) for name, size in shape.weight_shapes.items())


def search(data: Dataset, trials: int, options: FitOptions) -> list[Trial]:
    """Train `trials` random networks, then as many of the grid of the best one and the next smaller values of k0, kn and F.

    Args:
        data: training part; one of `VALIDATION_FOLDS` of its configurations validates.
        trials: number of networks of each stage; a complete grid has 8.
        options: options of each fit; the seed also draws the networks.

    Raises:
        DatasetError: too few configurations, or the loss diverges.
    """
    fold = splits.by_configuration(data.configurations, VALIDATION_FOLDS, seed=0)[0]
    train, validation = data.rows(fold.train), data.rows(fold.test)
    options = replace(options, epochs=TRIAL_EPOCHS)

    @cache
    def mae_of(shape: Remnet) -> float:
        stack = NetworkStack(shape, 1, options.dropout)
        stack.fit(train, options)
        return stack.maes_m(validation)[0]

    def objective(trial: optuna.Trial) -> tuple[float, float]:
        shape = Remnet(
            data.preprocessing.samples,
            **{name: trial.suggest_categorical(name, values) for name, values in SPACE.items()},
        )
        return mae_of(shape), float(multiply_accumulates(shape))

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        directions=["minimize", "minimize"], sampler=optuna.samplers.RandomSampler(options.seed)
    )
    study.enqueue_trial(CHOICE)
    study.optimize(objective, trials)
    best = min(study.trials, key=lambda trial: trial.values[0]).params
    starts = {name: max(values.index(best[name]) - 1, 0) for name, values in SPACE.items()}
    neighbours = {name: values[starts[name] : starts[name] + 2] for name, values in SPACE.items()}
    neighbours["modules"] = (best["modules"],)
    study.sampler = optuna.samplers.GridSampler(neighbours, options.seed)
    study.optimize(objective, trials)
    front = [trial.number for trial in study.best_trials]
    return [
        Trial(
            stage="random" if trial.number < trials else "grid",
            shape=trial.params,
            parameters=Remnet(data.preprocessing.samples, **trial.params).parameters,
            multiply_accumulates=int(trial.values[1]),
            mae=trial.values[0],
            is_on_front=trial.number in front,
        )
        for trial in study.trials
    ]
