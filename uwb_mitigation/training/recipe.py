"""How a bundle is made: the prior, then the network on what the prior leaves, then int8; and how good that is
on configurations that no part of it has seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.evaluation import lad, splits
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.metrics import ErrorStatistics, mae_by_group
from uwb_mitigation.model import floating
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.model.bundle import Card
from uwb_mitigation.model.integer import IntegerNetwork
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training import networks
from uwb_mitigation.training.cards import card_of, familiarity_of
from uwb_mitigation.training.fitting import FitOptions, fit, single_thread
from uwb_mitigation.training.quantization import calibration_inputs, quantize

MOST_NAMED = 100
"""Configurations that a card names one by one; of more it tells how many, as they would outweigh the network."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What `train` does, and what the card records of it.

    Attributes:
        architecture: the network.
        fit: how it is fitted.
        line: fit a line prior; False = the network predicts the whole error.
        network: fit the network; False = it is left as it is initialised, and predicts 0. With neither, the
            prior is a constant.
        per_configuration: at most so many measurements of one configuration are fitted to, so that
            a long recording of one place does not outweigh a short one.
    """

    architecture: Remnet
    fit: FitOptions
    line: bool = True
    per_configuration: int = 20
    network: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class CrossValidation:
    """Errors left on held-out configurations, each float64 (n,), m, in the order of the dataset.

    Attributes:
        errors: {`raw`, `overall_median`, `l1_line`, `float`, `int8`: errors}; the last two are the
            whole recipe. Without a line, `l1_line` is absent.
        folds, seed: of the split.
    """

    dataset: Dataset
    errors: Mapping[str, NDArray[np.float64]]
    folds: int
    seed: int

    def statistics(self) -> dict[str, dict[str, float]]:
        """{name: {mae, std, p95}}, m."""
        return {name: asdict(ErrorStatistics.of(error)) for name, error in self.errors.items()}

    def by_configuration(self, name: str) -> dict[str, tuple[int, float, float]]:
        """{configuration: (n, raw MAE, MAE of `name`)}."""
        return mae_by_group(self.dataset.configurations, self.errors["raw"], self.errors[name])


def cross_validate(
    dataset: Dataset,
    recipe: Recipe,
    folds: int,
    seed: int,
    on_epoch: Callable[[], None] = lambda: None,
    *,
    quantised: bool = True,
) -> CrossValidation:
    """Make the model once for each fold of configurations, without them, and test it on them.

    Raises:
        DatasetError, ParameterError: see `splits.by_configuration` and `fit`.
    """
    names = ("raw", "overall_median", *(("l1_line",) if recipe.line else ()), "float")
    if quantised:
        names = (*names, "int8")
    errors = {name: dataset.error_m.copy() for name in names}
    for split in splits.by_configuration(dataset.configurations, folds, seed):
        part, held_out = dataset.rows(split.train), dataset.rows(split.test)
        prior, network = fit_model(part, recipe, on_epoch)
        left = held_out.error_m - prior_m(prior, held_out)
        errors["overall_median"][split.test] -= np.median(part.error_m)
        if recipe.line:
            errors["l1_line"][split.test] = left
        errors["float"][split.test] = left - floating.predict_m(network, held_out.inputs)
        if quantised:
            integers = quantize(network, calibration_inputs(part, seed), exact=False)
            errors["int8"][split.test] = left - IntegerNetwork(integers).predict_m(held_out.inputs)
    return CrossValidation(dataset, errors, folds, seed)


def fit_model(
    dataset: Dataset, recipe: Recipe, on_epoch: Callable[[], None] = lambda: None
) -> tuple[LinePrior, FloatWeights]:
    """The prior and the network for what it leaves.

    Raises:
        DatasetError: see `fit`.
    """
    prior = LinePrior(0.0)
    if not (recipe.line or recipe.network):
        prior = lad.constant(dataset.configurations, dataset.error_m)
    elif recipe.line:
        prior = lad.fit_prior(
            dataset.configurations,
            dataset.rx_power_dbm,
            dataset.first_path_power_dbm,
            dataset.error_m,
        )
    if not recipe.network:
        with single_thread(recipe.fit.seed):
            return prior, networks.weights_of(networks.build(recipe.architecture, 0))
    part = dataset.rows(splits.thinned(dataset.configurations, recipe.per_configuration, recipe.fit.seed))
    left = part.error_m - prior_m(prior, part)
    # Measurements whose power is unknown have no prior, and are passed through where it is needed.
    known = np.isfinite(left)
    network = fit(recipe.architecture, part.inputs[known], left[known], recipe.fit, on_epoch)
    return prior, network


@dataclass(frozen=True, slots=True, eq=False)
class GradedModel:
    """A float network and a card whose prior, intervals and familiarity belong to it."""

    card: Card
    network: FloatWeights


def fit_graded(
    dataset: Dataset, recipe: Recipe, inner_folds: int, on_epoch: Callable[[], None] = lambda: None
) -> GradedModel:
    """The model of all of the dataset; its intervals are calibrated by cross-validation within it.

    Raises:
        DatasetError: see `cross_validate`.
    """
    folds = min(inner_folds, len(dataset.names))
    validation = cross_validate(dataset, recipe, folds, recipe.fit.seed, on_epoch, quantised=False)
    prior, network = fit_model(dataset, recipe, on_epoch)
    return GradedModel(describe("", recipe, prior, validation, ""), network)


def describe(name: str, recipe: Recipe, prior: LinePrior, validation: CrossValidation, data: str) -> Card:
    """The card of the float model that `recipe` makes of the whole dataset (see `cards`)."""
    dataset = validation.dataset
    training = {
        "data": data,
        "configurations": names if len(names := dataset.names) <= MOST_NAMED else len(names),
        "measurements": len(dataset),
        "split": f"{validation.folds} folds by configuration",
        "seed": validation.seed,
        "recipe": {"line": recipe.line, "network": recipe.network}
        | (asdict(recipe.fit) | {"per_configuration": recipe.per_configuration} if recipe.network else {}),
        "metrics_m": {
            row: {key: round(value, 4) for key, value in statistics.items()}
            for row, statistics in validation.statistics().items()
        },
    }
    left = validation.errors["float"]
    familiarity = familiarity_of(dataset)
    return card_of(name, recipe.architecture, dataset, prior, dataset, left, training, familiarity)


def prior_m(prior: LinePrior, dataset: Dataset) -> NDArray[np.float32]:
    """What the prior predicts of each measurement, m; NaN where it needs a power that is unknown."""
    return prior.predict_m(dataset.rx_power_dbm, dataset.first_path_power_dbm)
