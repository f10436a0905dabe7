"""Training of the linear bias model and of the network."""

from __future__ import annotations

from dataclasses import astuple
from itertools import combinations

import numpy as np
import pytest
from model_material import dataset, windows

from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.mitigation.model import floating
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.training.fit.linear_fit import fit_linear_bias, least_absolute_deviations

SHAPE = Remnet(samples=32)


@pytest.mark.parametrize("seed", range(5))
def test_least_absolute_deviations_is_no_worse_than_any_line_through_points(seed):
    generator = np.random.default_rng(seed)
    design = np.column_stack([np.ones(14), generator.normal(-85, 6, 14), generator.normal(8, 4, 14)])
    target = generator.standard_cauchy(14)
    vertices = [
        np.abs(target - design @ np.linalg.solve(design[list(rows)], target[list(rows)])).sum()
        for rows in combinations(range(14), 3)
    ]
    found = np.abs(target - design @ least_absolute_deviations(design, target)).sum()
    assert found <= min(vertices) * (1 + 1e-6)


def test_configurations_have_equal_weight():
    data = dataset(8, 10)
    rows = np.concatenate([np.arange(80), np.repeat(np.arange(10), 30)])
    once, long = (
        fit_linear_bias(part.configurations, part.rx_power_dbm, part.first_path_power_dbm, part.error_m)
        for part in (data, data.rows(rows))
    )
    assert np.allclose(astuple(once), astuple(long), rtol=1e-3)


def test_without_levels_the_bias_is_the_median_over_configurations():
    names = np.array(["a", "a", "b", "c"])
    unknown = np.full(4, np.nan)
    linear_bias = fit_linear_bias(names, unknown, unknown, np.array([1.0, 2.0, 0.5, 9.0]))
    assert linear_bias == LinearBiasModel(1.5)


def test_linear_bias_model_without_data_is_refused():
    with pytest.raises(DatasetError, match="no measurements"):
        fit_linear_bias(np.array([]), np.array([]), np.array([]), np.array([]))


torch = pytest.importorskip("torch", reason="run `make setup-training`")
from uwb_mitigation.training import train  # noqa: E402
from uwb_mitigation.training.fit.candidates import Recipe, fit_new_model  # noqa: E402
from uwb_mitigation.training.fit.fitting import FitOptions, fit  # noqa: E402


def test_seed_gives_the_same_weights():
    data = dataset(4, 30)
    options = FitOptions(epochs=2, seed=3)
    first, again, other = (
        fit(SHAPE, data.inputs, data.error_m, choice)
        for choice in (options, options, FitOptions(epochs=2, seed=4))
    )
    assert all(np.array_equal(first.weight[name], again.weight[name]) for name in first.weight)
    assert not np.array_equal(first.weight["first"], other.weight["first"])


def test_fitting_does_not_change_the_global_random_state():
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    fit(SHAPE, windows(4, 32), np.zeros(4), FitOptions(epochs=1))
    assert torch.equal(torch.rand(1), expected)


def test_network_learns_a_function_of_its_inputs():
    inputs = windows(400, 32)
    targets = inputs[:, :8].mean(axis=1)
    weights = fit(SHAPE, inputs, targets, FitOptions(epochs=12, learning_rate=2e-3, dropout=0.1))
    left = np.abs(targets - floating.predict_m(weights, inputs)).mean()
    assert left < 0.4 * np.abs(targets - np.median(targets)).mean()


def test_loss_that_diverges_ends_the_training():
    targets = np.full(64, 3e38)
    with pytest.raises(DatasetError, match="in epoch"):
        fit(SHAPE, windows(64, 32) * 1e30, targets, FitOptions(epochs=50, learning_rate=1.0))


def test_inputs_that_are_not_finite_are_refused():
    with pytest.raises(DatasetError, match="all finite"):
        fit(SHAPE, np.full((2, 32), np.nan, np.float32), np.zeros(2), FitOptions())


@pytest.mark.parametrize("change", [{"epochs": 0}, {"learning_rate": 0.0}, {"dropout": 1.0}, {"seed": -1}])
def test_options_out_of_range_are_refused(change):
    with pytest.raises(ParameterError, match=next(iter(change))):
        FitOptions(**change)


RECIPE = Recipe(SHAPE, FitOptions(epochs=1))


@pytest.fixture(scope="module")
def validation() -> train.CrossValidation:
    return train.cross_validate(dataset(12, 20), RECIPE, folds=4, seed=0)


def test_cross_validation_finds_the_line_on_held_out_configurations(validation):
    statistics = validation.statistics()
    assert list(statistics) == ["raw", "overall_median", "l1_line", "float", "int8"]
    assert statistics["l1_line"]["mae"] < 0.25 * statistics["overall_median"]["mae"]
    assert abs(statistics["int8"]["mae"] - statistics["float"]["mae"]) < 0.01


def test_card_contains_the_errors_on_held_out_configurations(validation):
    data = dataset(12, 20)
    fitted = fit_new_model(data, RECIPE.for_candidate("constant"), 0)
    card = train.site_card("name", RECIPE, fitted, validation, "data")
    left = validation.errors["float"]
    deviation = np.interp(np.abs(data.error_m - left), *np.transpose(card.scale))
    # 0.68 x 13 of 12 configurations: the unseen one counts, too.
    assert np.mean(np.abs(left) <= deviation) == pytest.approx(0.68 * 13 / 12, abs=0.01)
    assert np.mean(np.abs(left) <= card.interval95_sigmas * deviation) > 0.95
    assert card.variance_m2 < card.variance_uncorrected_m2
    assert card.training["configurations"] == data.names
    assert card.training["metrics_m"]["raw"]["mae"] == round(float(np.abs(data.error_m).mean()), 4)


def test_measurements_without_levels_do_not_harm_the_network():
    data = dataset(8, 20)
    data.rx_power_dbm[3] = np.nan
    fitted = fit_new_model(data, RECIPE, 0)
    assert fitted.linear_bias.needs_power
    assert np.isfinite(floating.predict_m(fitted.network, data.inputs)).all()
