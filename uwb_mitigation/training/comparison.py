"""Every row that the shipped recipe is measured against, on the same splits: `evaluate --cross-validate`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.evaluation import baselines, lad, splits, zero_shot
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.evaluation.metrics import bootstrap_interval, coverage, kept_mae
from uwb_mitigation.evaluation.splits import Group
from uwb_mitigation.mitigation import Grader
from uwb_mitigation.model import floating
from uwb_mitigation.model.architecture import Mlp, Remnet
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.integer import IntegerNetwork
from uwb_mitigation.training import choosing
from uwb_mitigation.training import recipe as recipes
from uwb_mitigation.training.fitting import fit
from uwb_mitigation.training.quantization import calibration_inputs, quantize
from uwb_mitigation.training.recipe import Recipe

INNER_FOLDS = 4
"""Of the training part, to calibrate intervals with: what calibrates them must be held out too."""

REJECTED = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)

NAMES = (
    "raw",
    "los_median",
    "overall_median",
    "ridge",
    "ridge_header",
    "gradient_boosting",
    "l1_line",
    "mlp",
    "remnet_float",
    "remnet_int8",
    "shipped_float",
    "shipped_int8",
)
"""The rows of the table, in its order; those of `zero_shot.NAMES` stand behind them."""


@dataclass(frozen=True, slots=True)
class ErrorRow:
    """One row of the table: {label: MAE}, m, mean over seeds; the interval is of the first seed's errors."""

    name: str
    mae_mean: float
    mae_std: float
    by_label: Mapping[str, float]
    ci95: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Attributes:
    rows: of the table.
    coverage68, coverage95: shares of the shipped recipe's errors within the intervals it promised, over seeds.
    coverage_by_label: {label: (68 %, 95 %)}.
    rejection: (share rejected, MAE of the rest), the ranges with the largest variance first.
    passed_through: share of held-out ranges that the shipped recipe does not correct.
    group, folds, seeds, configurations: of the splits.
    universal_coverage: {label, or "" for all: shares of the errors of `universal_los_offset` within the intervals that
        were promised (68 %, 95 %)}; None without a universal model.
    """

    rows: tuple[ErrorRow, ...]
    coverage68: float
    coverage95: float
    coverage_by_label: Mapping[str, tuple[float, float]]
    rejection: tuple[tuple[float, float], ...]
    passed_through: float
    group: Group
    folds: int
    seeds: int
    configurations: int
    universal_coverage: Mapping[str, tuple[float, float]] | None = None

    def as_json(self) -> dict[str, object]:
        """The result of `uwb-mitigation evaluate --cross-validate`."""
        return {
            "split": f"{self.folds} splits by {self.group.value}",
            "seeds": self.seeds,
            "configurations": self.configurations,
            "rows": [
                {
                    "name": row.name,
                    "mae_mean": row.mae_mean,
                    "mae_std": row.mae_std,
                    "by_label": dict(row.by_label),
                    "ci95": list(row.ci95),
                }
                for row in self.rows
            ],
            "coverage68": self.coverage68,
            "coverage95": self.coverage95,
            "coverage_by_label": {
                label: {"coverage68": narrow, "coverage95": wide}
                for label, (narrow, wide) in self.coverage_by_label.items()
            },
            "rejection": [{"rejected": share, "mae": mae} for share, mae in self.rejection],
            "passed_through": self.passed_through,
            "universal_coverage": None
            if self.universal_coverage is None
            else {
                label or "all": {"coverage68": narrow, "coverage95": wide}
                for label, (narrow, wide) in self.universal_coverage.items()
            },
        }


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """What one seed's folds left of every measurement: errors by row, and the variance that was promised."""

    errors: Mapping[str, NDArray[np.float64]]
    variance_m2: NDArray[np.float64]
    sigmas95: NDArray[np.float64]
    passed: NDArray[np.bool_]


def run(
    dataset: Dataset,
    recipe: Recipe,
    group: Group,
    folds: int,
    seeds: int,
    on_fold: Callable[[], None] = lambda: None,
    universal: Bundle | None = None,
) -> Comparison:
    """Fit every row anew for each fold and each seed, and test it on configurations that it has not seen; beside
    them, a model that is not fitted to any of the data, where it reads such inputs.

    Raises:
        DatasetError, ParameterError: see `splits.by_group` and `fit`.
        MissingDependencyError: scikit-learn is not installed.
    """
    known = np.isfinite(dataset.rx_power_dbm) & np.isfinite(dataset.first_path_power_dbm)
    dataset = dataset.rows(known) if known.any() else dataset
    held = [_hold_out(dataset, recipe, group, folds, seed, on_fold) for seed in range(seeds)]
    labels = list(dict.fromkeys(dataset.labels.tolist()))
    found = {name: np.array([part.errors[name] for part in held]) for name in NAMES}
    unfitted = None
    if universal is not None and universal.preprocessing == dataset.preprocessing:
        unfitted = zero_shot.run(dataset, universal)
        found |= {name: error[None] for name, error in unfitted.errors.items()}
    rows = []
    for name, errors in found.items():
        maes = np.abs(errors).mean(axis=1)
        rows.append(
            ErrorRow(
                name,
                float(maes.mean()),
                float(maes.std()),
                {label: float(np.abs(errors[:, dataset.labels == label]).mean()) for label in labels},
                bootstrap_interval(errors[0], dataset.configurations),
            )
        )
    final = np.array([part.errors["shipped_int8"] for part in held])
    variance = np.array([part.variance_m2 for part in held])
    wide = variance * np.array([part.sigmas95 for part in held]) ** 2

    def covered(chosen: NDArray[np.bool_]) -> tuple[float, float]:
        left = final[:, chosen]
        return coverage(left, variance[:, chosen], 1.0), coverage(left, wide[:, chosen], 1.0)

    every = covered(np.ones(len(dataset), np.bool_))
    return Comparison(
        tuple(rows),
        *every,
        {label: covered(dataset.labels == label) for label in labels},
        tuple((share, kept_mae(final.ravel(), variance.ravel(), share)) for share in REJECTED),
        float(np.mean([part.passed for part in held])),
        group,
        len(splits.by_group(dataset, group, folds, 0)),
        seeds,
        len(dataset.names),
        None if unfitted is None else _unfitted_coverage(unfitted, dataset),
    )


def _unfitted_coverage(unfitted: zero_shot.ZeroShot, dataset: Dataset) -> dict[str, tuple[float, float]]:
    left, covered = unfitted.errors["universal_los_offset"], {}
    for label in ("", *dict.fromkeys(dataset.labels.tolist())):
        rows = (dataset.labels == label) | (label == "")
        covered[label] = (
            coverage(left[rows], unfitted.variance_m2[rows], 1.0),
            coverage(left[rows], unfitted.variance_m2[rows], unfitted.sigmas95),
        )
    return covered


def _hold_out(
    dataset: Dataset, recipe: Recipe, group: Group, folds: int, seed: int, on_fold: Callable[[], None]
) -> _Held:
    recipe = replace(recipe, fit=replace(recipe.fit, seed=seed))
    errors = {name: dataset.error_m.copy() for name in NAMES}
    variance, sigmas95 = np.empty(len(dataset)), np.empty(len(dataset))
    passed = np.zeros(len(dataset), np.bool_)
    for split in splits.by_group(dataset, group, folds, seed):
        train, test = dataset.rows(split.train), dataset.rows(split.test)
        for name, predicted in _baselines(train, test, recipe, seed):
            errors[name][split.test] -= predicted
        model = recipes.fit_graded(train, recipe, INNER_FOLDS)
        grader = Grader(model.card)
        score = grader.score(
            test.inputs, test.range_m.astype(np.float32), test.rx_power_dbm, test.first_path_power_dbm
        )
        integers = quantize(model.network, calibration_inputs(train, seed), exact=False)
        prior = model.card.prior.predict_m(test.rx_power_dbm, test.first_path_power_dbm)
        for name, network_m in (
            ("shipped_float", floating.predict_m(model.network, test.inputs)),
            ("shipped_int8", IntegerNetwork(integers).predict_m(test.inputs)),
        ):
            predicted = (prior + network_m).astype(np.float32)
            corrects = grader.passes(predicted, score)
            with np.errstate(invalid="ignore"):
                correction, spread = grader.grade(predicted, score)
            errors[name][split.test] -= np.where(corrects, correction, 0.0)
        variance[split.test] = np.where(corrects, spread, model.card.variance_uncorrected_m2)
        sigmas95[split.test] = model.card.interval95_sigmas
        passed[split.test] = ~corrects
        on_fold()
    return _Held(errors, variance, sigmas95, passed)


def _baselines(
    train: Dataset, test: Dataset, recipe: Recipe, seed: int
) -> Iterator[tuple[str, NDArray[np.floating]]]:
    yield "los_median", baselines.los_median(train)(test)
    yield "overall_median", baselines.overall_median(train)(test)
    yield "ridge", baselines.ridge(train, header=False)(test)
    yield "ridge_header", baselines.ridge(train, header=True)(test)
    yield "gradient_boosting", baselines.gradient_boosting(train, seed)(test)
    line = lad.fit_prior(train.configurations, train.rx_power_dbm, train.first_path_power_dbm, train.error_m)
    yield "l1_line", line.predict_m(test.rx_power_dbm, test.first_path_power_dbm)
    part = train.rows(splits.thinned(train.configurations, recipe.per_configuration, seed))
    options = replace(choosing.ALONE, seed=seed)
    samples = recipe.architecture.samples
    perceptron = fit(Mlp(samples=samples), part.inputs, part.error_m, options)
    yield "mlp", floating.predict_m(perceptron, test.inputs)
    alone = fit(Remnet(samples=samples), part.inputs, part.error_m, options)
    yield "remnet_float", floating.predict_m(alone, test.inputs)
    integers = quantize(alone, calibration_inputs(train, seed), exact=False)
    yield "remnet_int8", IntegerNetwork(integers).predict_m(test.inputs)
