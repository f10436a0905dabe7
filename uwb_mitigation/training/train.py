"""Train a float bundle from labelled ranges: select a model, fit it to all data and write it. Used by `train`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, check_name
from uwb_mitigation.mitigation.model import floating, graph
from uwb_mitigation.mitigation.model.bundle import Bundle, ModelCard, load_bundle, save_bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.mitigation.model.weights import FloatWeights
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.evaluation.metrics import ErrorStatistics, mae_by_group
from uwb_mitigation.training.fit import candidates as models
from uwb_mitigation.training.fit import selection as selections
from uwb_mitigation.training.fit.candidates import FittedModel, Recipe, fit_new_model, linear_bias_m
from uwb_mitigation.training.fit.model_card import card_of, ood_bands_of
from uwb_mitigation.training.fit.quantisation import calibration_inputs, quantise_network
from uwb_mitigation.training.fit.selection import NESTED, Selection

AUTO = "auto"
MAX_NAMED = 100
"""If there are more configurations, the card contains their number instead of their names."""

Progress = Callable[[str, float], None]
"""Called with the current step and the finished share of it, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class CrossValidation:
    """Errors on held-out configurations, each of shape (n,), m, in the order of the dataset.

    Attributes:
        errors: for a new model {`raw`, `overall_median`, `l1_line` (if it has a line), `float`, `int8`}; otherwise the
            errors of the selection, and `float`.
        folds, seed: parameters of the splits.
    """

    dataset: Dataset
    errors: Mapping[str, NDArray[np.float64]]
    folds: int
    seed: int

    def statistics(self) -> dict[str, dict[str, float]]:
        """{name: {mae, std, p95}}, m."""
        return {name: asdict(ErrorStatistics.of(error)) for name, error in self.errors.items()}


@dataclass(frozen=True, slots=True, eq=False)
class TrainedBundle:
    """A bundle that was written, and its errors on held-out configurations.

    Attributes:
        selection: None if the recipe was given.
        validation: source of the card's intervals.
        mae_m: MAE of the model, m; nested MAE of the selection if the model was selected.
        baseline_mae_m: {name: MAE of the baseline}, m.
    """

    bundle: Bundle
    selection: Selection | None
    validation: CrossValidation
    mae_m: float
    baseline_mae_m: dict[str, float]

    @property
    def improved(self) -> bool:
        """Whether the model has a smaller MAE than every baseline."""
        return self.mae_m < min(self.baseline_mae_m.values())

    @property
    def prefers_cold_start(self) -> bool:
        """Whether other candidates had to improve on the cold start by `COLD_START_MIN_GAIN`."""
        names = () if self.selection is None else self.selection.errors
        return models.COLD_START in names and models.has_few_configurations(self.validation.dataset)

    def as_json(self) -> dict[str, object]:
        """Return the result of `uwb-mitigation train`."""
        errors, dataset = self.validation.errors, self.validation.dataset
        tested = errors.get("int8", errors["float"])
        groups = mae_by_group(dataset.configurations, errors["raw"], tested)
        return {
            "model_id": self.bundle.model_id,
            "n": len(dataset),
            "skipped": dict(dataset.skipped),
            "improved": self.improved,
            "rows": [{"name": row, **values} for row, values in self.validation.statistics().items()],
            "by_configuration": groups,
            **({} if self.selection is None else {"choice": self.selection}),
        }


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """Input and output of a training.

    Attributes:
        dataset: labelled ranges. name: name of the recording for the card.
        output: path of the bundle.
        folds: number of folds of the cross-validation.
    """

    dataset: Dataset
    name: str
    output: Path
    folds: int
    on_progress: Progress = lambda what, fraction: None


def train_new_model(job: TrainingJob, recipe: Recipe, recipe_name: str = AUTO) -> TrainedBundle:
    """Train a new model: one of `candidates.NEW_MODELS`, or the best of these and the cold start (AUTO).

    Raises:
        ParameterError: unknown model. DatasetError: too few configurations; see also `fitting.fit`.
    """
    check_name("recipe", recipe_name, (AUTO, *models.NEW_MODELS))
    dataset, folds = job.dataset, min(job.folds, len(job.dataset.names))
    # No inner fold of `select_nested` may be empty.
    needed = 2 if recipe_name != AUTO else 4 if job.folds == 2 else 3
    if (count := len(dataset.names)) < needed:
        raise DatasetError(
            f"{count} configuration{'' if count == 1 else 's'}, that is placements of tag and anchor",
            valid=f"{needed} or more, each under a name of its own in `configuration` of the true ranges",
        )
    selection, seed = None, recipe.fit.seed
    if not dataset.has_cirs and recipe_name in (models.LINE_NETWORK, models.NETWORK):
        raise DatasetError(
            "the recording has no CIRs, which networks need", valid=f"--recipe {AUTO}, constant or line"
        )
    universal = load_bundle(default_model_path(dataset.preprocessing.scaling))
    if recipe_name == AUTO:
        selection = _select(job, recipe, universal)
        recipe_name = selection.chosen
    training = dict[str, object]()
    if selection is not None and recipe_name == models.COLD_START:
        errors = {**selection.errors, "float": selection.errors[recipe_name]}
        validation, fitted = CrossValidation(dataset, errors, folds, seed), selection.model
        # The training options of the network are in the card of the universal model.
        recipe = replace(recipe, line=False, network=False)
        training = {
            "started_from": f"{universal.model_id:08x}",
            "chosen": recipe_name,
            "recipe": {"line": False, "network": True},
        }
    else:
        recipe = recipe.for_candidate(recipe_name)
        total = recipe.fit.epochs * (folds + 1)
        on_epoch = selections.step_counter(total, lambda fraction: job.on_progress("training", fraction))
        validation = cross_validate(dataset, recipe, folds, seed, on_epoch, quantised=dataset.has_cirs)
        fitted = fit_new_model(dataset, recipe, seed, on_epoch)
    assert fitted.network is not None
    card = site_card(job.output.stem, recipe, fitted, validation, job.name)
    card = replace(card, needs_cir=dataset.has_cirs, training={**card.training, **training})
    bundle = save_bundle(job.output, graph.float_model(fitted.network), card)
    mae = {row: statistics["mae"] for row, statistics in validation.statistics().items()}
    if selection is None:
        mae_m, constant_mae_m = mae.get("int8", mae["float"]), mae["overall_median"]
    else:
        mae_m, constant_mae_m = (selection.mae()[name] for name in (NESTED, models.CONSTANT))
    baselines = {"raw": mae["raw"]}
    if recipe_name != models.CONSTANT:
        baselines[models.CONSTANT] = constant_mae_m
    return TrainedBundle(bundle, selection, validation, mae_m, baselines)


def _select(job: TrainingJob, recipe: Recipe, universal: Bundle) -> Selection:
    """Select one of the new models or the cold start; without CIRs, one without a network."""
    dataset, candidates = job.dataset, models.new_models(recipe)
    if dataset.has_cirs:
        candidates = models.with_cold_start(candidates, dataset, universal)
    else:
        candidates = [item for item in candidates if not item.trains]
    return selections.select_nested(
        dataset,
        candidates,
        min(job.folds, len(dataset.names)),
        recipe.fit.seed,
        lambda fraction: job.on_progress("choosing", fraction),
        min_gain=selections.COLD_START_MIN_GAIN
        if candidates[0].name == models.COLD_START
        else selections.MIN_GAIN,
    )


def cross_validate(
    dataset: Dataset,
    recipe: Recipe,
    folds: int,
    seed: int,
    on_epoch: Callable[[], None] = lambda: None,
    *,
    quantised: bool = True,
) -> CrossValidation:
    """Cross-validate a new model over configurations.

    Raises:
        DatasetError, ParameterError: see `splits.by_configuration` and `fitting.fit`.
    """
    names = ["raw", "overall_median", *(["l1_line"] if recipe.line else []), "float"]
    errors = {name: dataset.error_m.copy() for name in (*names, *(["int8"] if quantised else []))}
    for fold in splits.by_configuration(dataset.configurations, folds, seed):
        train, test = dataset.rows(fold.train), dataset.rows(fold.test)
        fitted = fit_new_model(train, recipe, recipe.fit.seed, on_epoch)
        assert fitted.network is not None
        linear_m = linear_bias_m(fitted.linear_bias, test)
        # If the linear bias model needs a power that is unknown, the range is passed through.
        is_finite = np.isfinite(linear_m)
        residual = test.error_m - np.where(is_finite, linear_m, 0.0)
        errors["overall_median"][fold.test] -= np.median(train.error_m)
        if recipe.line:
            errors["l1_line"][fold.test] = residual
        errors["float"][fold.test] = residual - is_finite * floating.predict_m(fitted.network, test.inputs)
        if quantised:
            integers = quantise_network(fitted.network, calibration_inputs(train, seed), exact=False)
            errors["int8"][fold.test] = residual - is_finite * IntegerNetwork(integers).predict_m(test.inputs)
    return CrossValidation(dataset, errors, folds, seed)


def fit_with_card(dataset: Dataset, recipe: Recipe, inner_folds: int) -> tuple[ModelCard, FloatWeights]:
    """Fit a new model to the whole dataset; the intervals of the card are from a cross-validation on it.

    Raises:
        DatasetError: see `cross_validate`.
    """
    folds, seed = min(inner_folds, len(dataset.names)), recipe.fit.seed
    validation = cross_validate(dataset, recipe, folds, seed, quantised=False)
    fitted = fit_new_model(dataset, recipe, seed)
    assert fitted.network is not None
    return site_card("", recipe, fitted, validation, ""), fitted.network


def site_card(
    name: str, recipe: Recipe, fitted: FittedModel, validation: CrossValidation, data: str
) -> ModelCard:
    """Return the card of a float model that was fitted to the dataset of `validation`."""
    dataset, network = validation.dataset, fitted.network
    assert network is not None
    options = asdict(recipe.fit) | {"per_configuration": models.PER_CONFIGURATION} if recipe.network else {}
    training = {
        "data": data,
        "configurations": names if len(names := dataset.names) <= MAX_NAMED else len(names),
        "measurements": len(dataset),
        "split": f"{validation.folds} folds by configuration",
        "seed": validation.seed,
        "recipe": {"line": recipe.line, "network": recipe.network} | options,
        "metrics_m": {
            row: {key: round(value, 4) for key, value in statistics.items()}
            for row, statistics in validation.statistics().items()
        },
    }
    residual_m = validation.errors["float"]
    ood_bands = ood_bands_of(dataset) if dataset.has_cirs else None
    return card_of(
        name, network.architecture, dataset, fitted.linear_bias, dataset, residual_m, training, ood_bands
    )
