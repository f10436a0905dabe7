"""Compare the shipped recipe with baselines on the same splits: `evaluate --cross-validate`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.model.architecture import Mlp, Remnet
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.training import train
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.evaluation import baselines, zero_shot
from uwb_mitigation.training.evaluation.metrics import bootstrap_interval, coverage, mae_after_rejection
from uwb_mitigation.training.evaluation.zero_shot import HeldOut
from uwb_mitigation.training.fit import candidates
from uwb_mitigation.training.fit.candidates import Recipe, linear_bias_m, network_m
from uwb_mitigation.training.fit.fitting import fit
from uwb_mitigation.training.fit.quantisation import calibration_inputs, quantise_network

INNER_FOLDS = 4
"""Folds of the training part, by configuration, for calibrating the intervals."""

REJECTED = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)

NAMES = (
    *("raw", "los_median", "overall_median", "ridge", "ridge_header", "gradient_boosting", "l1_line", "mlp"),
    *("remnet_float", "remnet_int8", "shipped_float", "shipped_int8"),
)
"""The rows of the table in order; the rows of `zero_shot.NAMES` follow."""

NAMES_WITHOUT_CIRS = ("raw", "los_median", "overall_median", "l1_line", "shipped_float")
"""The rows for a recording without CIRs; the last one is the line with its limits."""


class Shares(NamedTuple):
    """Shares of the errors within the 68 % and the 95 % intervals."""

    coverage68: float
    coverage95: float


Coverage = Mapping[str, Shares]
"""{label, or "" for all: shares}."""


@dataclass(frozen=True, slots=True)
class ErrorRow:
    """One row of the table: MAE, m, mean and standard deviation over seeds; `ci95` from the errors of the first seed."""

    name: str
    mae_mean: float
    mae_std: float
    by_label: Mapping[str, float]
    ci95: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of `compare`.

    Attributes:
        rows: rows of the table.
        coverage: coverage of the shipped recipe, over seeds.
        rejection: (share rejected, MAE of the remaining ranges); ranges with the largest variance are rejected first.
        passed_through: share of held-out ranges that the shipped recipe does not correct.
        without_levels: number of ranges that are left out, because baselines need both levels.
        folds, seeds, configurations: parameters of the splits.
        universal_coverage: coverage of `universal_los_offset`; None without a universal model.
    """

    rows: tuple[ErrorRow, ...]
    coverage: Coverage
    rejection: tuple[tuple[float, float], ...]
    passed_through: float
    without_levels: int
    folds: int
    seeds: int
    configurations: int
    universal_coverage: Coverage | None = None

    def as_json(self) -> dict[str, object]:
        """Return the result of `uwb-mitigation evaluate --cross-validate`."""
        universal = self.universal_coverage
        return {
            "split": f"{self.folds} splits by configuration",
            "seeds": self.seeds,
            "configurations": self.configurations,
            "rows": self.rows,
            **self.coverage[""]._asdict(),
            "coverage_by_label": {label: shares for label, shares in self.coverage.items() if label},
            "rejection": [{"rejected": fraction, "mae": mae} for fraction, mae in self.rejection],
            "passed_through": self.passed_through,
            "without_levels": self.without_levels,
            "universal_coverage": universal
            and {label or "all": covered for label, covered in universal.items()},
        }


def compare_models(
    dataset: Dataset,
    recipe: Recipe,
    folds: int,
    seeds: int,
    on_fold: Callable[[], None] = lambda: None,
    universal: Bundle | None = None,
) -> Comparison:
    """Fit every row for each fold and each seed, and test it on held-out configurations.

    `universal` adds a model that is not fitted to the data, if its preprocessing matches.

    Raises:
        DatasetError, ParameterError: see `splits.by_configuration` and `fit`. ImportError: no scikit-learn.
    """
    has_levels = np.isfinite(dataset.rx_power_dbm) & np.isfinite(dataset.first_path_power_dbm)
    without_levels = int((~has_levels).sum()) if has_levels.any() else 0
    dataset = dataset.rows(has_levels) if has_levels.any() else dataset
    held_out = [_hold_out(dataset, recipe, folds, seed, on_fold) for seed in range(seeds)]
    names = NAMES if dataset.has_cirs else NAMES_WITHOUT_CIRS
    errors_by_row = {name: np.array([by_seed.errors[name] for by_seed in held_out]) for name in names}
    universal_coverage = None
    if universal is not None and universal.card.preprocessing == dataset.preprocessing and dataset.has_cirs:
        unknown_site = zero_shot.evaluate_zero_shot(dataset, universal)
        errors_by_row |= {name: error[None] for name, error in unknown_site.errors.items()}
        universal_coverage = _coverage(dataset.labels, "universal_los_offset", [unknown_site])
    labels = list(dict.fromkeys(dataset.labels.tolist()))
    rows = []
    for name, errors in errors_by_row.items():
        maes = np.abs(errors).mean(axis=1)
        by_label = {label: float(np.abs(errors[:, dataset.labels == label]).mean()) for label in labels}
        interval = bootstrap_interval(errors[0], dataset.configurations)
        rows.append(ErrorRow(name, float(maes.mean()), float(maes.std()), by_label, interval))
    final = errors_by_row[names[-1]].ravel()
    variance = np.concatenate([by_seed.variance_m2 for by_seed in held_out])
    return Comparison(
        rows=tuple(rows),
        coverage=_coverage(dataset.labels, names[-1], held_out),
        rejection=tuple((fraction, mae_after_rejection(final, variance, fraction)) for fraction in REJECTED),
        passed_through=float(np.mean([by_seed.passed_through for by_seed in held_out])),
        without_levels=without_levels,
        folds=folds,
        seeds=seeds,
        configurations=len(dataset.names),
        universal_coverage=universal_coverage,
    )


def _coverage(labels: NDArray[np.str_], row: str, held_out: Sequence[HeldOut]) -> Coverage:
    """Return the coverage by label (n,) of the errors of a row, for all seeds."""
    error_m = np.array([by_seed.errors[row] for by_seed in held_out])
    variance_m2 = np.array([by_seed.variance_m2 for by_seed in held_out], np.float64)
    sigmas95 = np.array([by_seed.sigmas95 for by_seed in held_out])

    def shares(rows: NDArray[np.bool_]) -> Shares:
        selected = error_m[:, rows], variance_m2[:, rows]
        return Shares(coverage(*selected, 1.0), coverage(*selected, sigmas95[:, rows]))

    names = ("", *dict.fromkeys(labels.tolist()))
    return {name: shares((labels == name) | (name == "")) for name in names}


def _hold_out(
    dataset: Dataset, recipe: Recipe, folds: int, seed: int, on_fold: Callable[[], None]
) -> HeldOut:
    recipe = replace(recipe, fit=replace(recipe.fit, seed=seed))
    if not dataset.has_cirs:
        recipe = recipe.for_candidate(candidates.LINE)
    errors = {name: dataset.error_m.copy() for name in NAMES}
    variance, sigmas95 = np.empty(len(dataset)), np.empty(len(dataset))
    passed_through = np.zeros(len(dataset), np.bool_)
    for fold in splits.by_configuration(dataset.configurations, folds, seed):
        train_data, test = dataset.rows(fold.train), dataset.rows(fold.test)
        for name, predicted in _baselines(train_data, test, recipe, seed):
            errors[name][fold.test] -= predicted
        card, network = train.fit_with_card(train_data, recipe, INNER_FOLDS)
        linear_bias = linear_bias_m(card.linear_bias, test)
        outputs = [("shipped_float", network_m(network, test.inputs).astype(np.float32))]
        if dataset.has_cirs:
            integers = quantise_network(network, calibration_inputs(train_data, seed), exact=False)
            outputs.append(("shipped_int8", IntegerNetwork(integers).predict_m(test.inputs)))
        for name, output in outputs:
            predicted_m = (linear_bias + output).astype(np.float32)
            correction_m, *others = zero_shot.correct_with_card(test, card, predicted_m)
            errors[name][fold.test] -= correction_m
        variance[fold.test], passed_through[fold.test] = others
        sigmas95[fold.test] = card.interval95_sigmas
        on_fold()
    return HeldOut(errors, variance, sigmas95, passed_through)


def _baselines(
    train_data: Dataset, test: Dataset, recipe: Recipe, seed: int
) -> Iterator[tuple[str, NDArray[np.floating] | float]]:
    yield "los_median", baselines.los_median(train_data)
    yield "overall_median", baselines.overall_median(train_data)
    yield "l1_line", linear_bias_m(candidates.fit_line(train_data), test)
    if not test.has_cirs:
        return
    yield "ridge", baselines.ridge(train_data, header=False)(test)
    yield "ridge_header", baselines.ridge(train_data, header=True)(test)
    yield "gradient_boosting", baselines.gradient_boosting(train_data, seed)(test)
    subset = train_data.rows(splits.subsample(train_data.configurations, candidates.PER_CONFIGURATION, seed))
    options, samples = replace(candidates.NETWORK_ONLY, seed=seed), recipe.architecture.samples
    yield "mlp", network_m(fit(Mlp(samples=samples), subset.inputs, subset.error_m, options), test.inputs)
    network_only = fit(Remnet(samples=samples), subset.inputs, subset.error_m, options)
    yield "remnet_float", network_m(network_only, test.inputs)
    integers = quantise_network(network_only, calibration_inputs(train_data, seed), exact=False)
    yield "remnet_int8", IntegerNetwork(integers).predict_m(test.inputs)
