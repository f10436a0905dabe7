"""The networks, training of the linear bias model, of a network and of the universal model."""

import json
from dataclasses import astuple
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from command_line import succeed
from model_material import card, dataset, random_weights, windows

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.mitigation.model import floating, graph
from uwb_mitigation.mitigation.model.architecture import Mlp, Remnet
from uwb_mitigation.mitigation.model.bundle import Session, load_bundle, save_bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.training.fit.linear_fit import fit_linear_bias, least_absolute_deviations
from uwb_mitigation.training.fit.quantisation import quantise_network

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
    assert fit_linear_bias(names, unknown, unknown, np.array([1.0, 2.0, 0.5, 9.0])) == LinearBiasModel(1.5)


torch = pytest.importorskip("torch", reason="run `make setup-training`")
from uwb_mitigation.training import train  # noqa: E402
from uwb_mitigation.training.fit.candidates import Recipe, fit_new_model  # noqa: E402
from uwb_mitigation.training.fit.fitting import FitOptions, fit  # noqa: E402
from uwb_mitigation.training.fit.networks import Network, weights_of  # noqa: E402


def test_seed_gives_the_same_weights():
    data = dataset(4, 30)
    options = FitOptions(epochs=2, seed=3)
    first, again, other = (
        fit(SHAPE, data.inputs, data.error_m, choice)
        for choice in (options, options, FitOptions(epochs=2, seed=4))
    )
    assert all(np.array_equal(first.weight[name], again.weight[name]) for name in first.weight)
    assert not np.array_equal(first.weight["first"], other.weight["first"])


def test_network_learns_a_function_of_its_inputs():
    inputs = windows(400, 32)
    targets = inputs[:, :8].mean(axis=1)
    weights = fit(SHAPE, inputs, targets, FitOptions(epochs=12, learning_rate=2e-3, dropout=0.1))
    left = np.abs(targets - floating.predict_m(weights, inputs)).mean()
    assert left < 0.4 * np.abs(targets - np.median(targets)).mean()


UNKNOWN = np.full((2, 32), np.nan, np.float32)
DIVERGING = windows(64, 32) * 1e30, np.full(64, 3e38), FitOptions(epochs=50, learning_rate=1.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (partial(fit_linear_bias, *[np.array([])] * 4), "no measurements"),
        (partial(fit, SHAPE, UNKNOWN, np.zeros(2), FitOptions()), "all finite"),
        (partial(fit, SHAPE, *DIVERGING), "in epoch"),
        *((partial(FitOptions, **{name: value}), name) for name, value in {
            "epochs": 0, "learning_rate": 0.0, "dropout": 1.0, "seed": -1,
        }.items()),
        *((partial(Mlp, **options), "MLP") for options in (
            {"samples": 0}, {"hidden": ()}, {"hidden": (0,)}, {"hidden": (1,) * 7},
        )),
    ],
)  # fmt: skip
def test_data_options_and_shapes_that_cannot_be_trained_are_refused(make: partial, message: str):
    with pytest.raises(UwbMitigationError, match=message):
        make()


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


@pytest.mark.parametrize(
    "shape",
    [
        Remnet(157),
        Remnet(128, first_kernel=5),
        Remnet(8),
        Remnet(33, kernel=5, filters=8, modules=2),
        Remnet(5, kernel=1, modules=4),
        Remnet(1, kernel=7, first_kernel=9),
        Mlp(32),
    ],
)
def test_torch_and_numpy_compute_the_same(shape):
    network, inputs = Network(shape, 0.5).eval(), windows(20, shape.samples)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(0.0, 0.1, generator=generator)
        computed = network(torch.from_numpy(inputs)).numpy()
    assert np.allclose(floating.predict_m(weights_of(network), inputs), computed, atol=1e-5)


@pytest.mark.parametrize("quantised", [True, False])
@pytest.mark.parametrize("shape", [Mlp(16, (12, 8)), Remnet(16)])
def test_bundle_loads_and_runs(tmp_path, shape, quantised):
    weights = random_weights(shape)
    integers = quantise_network(weights, windows(50, 16), exact=False)
    model = graph.int8_model(integers) if quantised else graph.float_model(weights)
    save_bundle(tmp_path / "mlp.onnx", model, card(shape, quantised=quantised))
    bundle = load_bundle(tmp_path / "mlp.onnx")
    assert bundle.card.architecture == shape
    inputs = windows(20, 16, 3)
    expected = (
        IntegerNetwork(integers).predict_m(inputs) if quantised else floating.predict_m(weights, inputs)
    )
    assert np.allclose(Session(bundle).predict_m(inputs), expected, atol=0 if quantised else 1e-5)
    if not quantised:
        read = graph.float_weights(bundle.model, shape)
        assert all(np.array_equal(weights.weight[name], read.weight[name]) for name in weights.weight)


def test_command_writes_both_bundles_with_the_error_by_condition(tmp_path: Path) -> None:
    words = "--samples 8 --scaling max --blocks 1 --radio dw3000 --workers 1"
    succeed(f"train-universal -o a.onnx --float b.onnx {words} --json a.json", folder=tmp_path)
    made, floating = (load_bundle(tmp_path / name) for name in ("a.onnx", "b.onnx"))
    assert (made.card.quantised, floating.card.quantised) == (True, False)
    assert made.card.preprocessing.scaling is Scaling.MAX
    assert made.card.source == "DW3000 STS"
    assert "experimental, no real recording was available" in made.card.origin
    assert not made.card.ood_bands.needs_levels
    assert made.card.ood_bands.lead_level_db is not None
    result = json.loads((tmp_path / "a.json").read_text())
    assert result["model_id"] == made.model_id
    assert result["simulated"]
    held_out = result["held_out"]
    assert list(held_out) == ["raw", "constant", "line in levels", "float", "int8"]
    assert all(set(row) == {"all", "LOS", "NLOS", "NDP NLOS"} for row in held_out.values())
    assert held_out["raw"]["LOS"]["mae"] < held_out["raw"]["NDP NLOS"]["mae"]
    mae_m = {row: by["all"]["mae"] for row, by in held_out.items()}
    assert mae_m["line in levels"] < mae_m["constant"] < mae_m["raw"]
