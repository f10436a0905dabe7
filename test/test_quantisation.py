"""Quantisation: close to float, 7-bit weights, and exact scales."""

from __future__ import annotations

import numpy as np
import pytest
from model_material import random_weights, windows

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.model import floating, graph
from uwb_mitigation.mitigation.model.architecture import HEAD, Remnet
from uwb_mitigation.mitigation.model.bundle import load_bundle, save_bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.requantisation import nudge
from uwb_mitigation.mitigation.model.shipped import SHIPPED, shipped_model_path
from uwb_mitigation.training.fit.quantisation import quantise_network

SHAPE = Remnet(samples=32)


@pytest.mark.parametrize("samples", [157, 32])
def test_int8_is_close_to_float(samples):
    shape = Remnet(samples=samples)
    weights = random_weights(shape)
    integers = quantise_network(weights, windows(200, samples, seed=1), exact=False)
    unseen = windows(200, samples, seed=2)
    expected = floating.predict_m(weights, unseen)
    difference = np.abs(IntegerNetwork(integers).predict_m(unseen) - expected)
    assert difference.mean() < 0.25 * expected.std()


def test_weights_have_seven_bits():
    integers = quantise_network(random_weights(SHAPE), windows(10, 32), exact=False)
    assert all(np.abs(weight).max() == 63 for weight in integers.weight.values())


def test_quantised_integers_are_exact_for_the_firmware():
    integers = quantise_network(random_weights(Remnet(samples=8)), windows(50, 8))
    again = nudge(integers)
    assert dict(again.activation_scale) == dict(integers.activation_scale)
    for name in integers.weight:
        assert np.array_equal(again.weight_scale[name], integers.weight_scale[name])


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_model_is_unchanged_by_the_nudge(name, tmp_path):
    shipped = load_bundle(shipped_model_path(name))
    nudged = nudge(graph.int8_weights(shipped.model, shipped.architecture))
    assert save_bundle(tmp_path / "again.onnx", graph.int8_model(nudged), shipped.card).model == shipped.model


def test_network_with_dead_filters_can_be_quantised():
    weights = random_weights(SHAPE)
    weights.weight["module1.residual"][:] = 0
    weights.bias["module1.residual"][:] = -1
    weights.weight["module2.skip"][5] = 0
    weights.weight[HEAD][:] = 0
    inputs = windows(30, 32)
    integers = quantise_network(weights, inputs, exact=False)
    expected = np.full(30, weights.bias[HEAD][0])
    assert np.allclose(IntegerNetwork(integers).predict_m(inputs), expected, atol=1e-3)


@pytest.mark.parametrize("layer", ["module1.residual", "module2.reduce"])
def test_layer_with_tiny_weights_can_be_quantised_for_all_processors(layer):
    weights = random_weights(Remnet(samples=8))
    weights.weight[layer][:] *= np.float32(1e-7)
    weights.bias[layer][:] *= np.float32(1e-7)
    inputs = windows(50, 8)
    computed = IntegerNetwork(quantise_network(weights, inputs)).predict_m(inputs)
    expected = floating.predict_m(weights, inputs)
    assert np.abs(computed - expected).mean() < 0.25 * expected.std()


@pytest.mark.parametrize(
    "inputs", [np.zeros((0, 32)), np.zeros((4, 31)), np.zeros(32), np.full((2, 32), np.nan)]
)
def test_invalid_calibration_inputs_are_refused(inputs):
    with pytest.raises(DatasetError, match="calibration inputs"):
        quantise_network(random_weights(SHAPE), inputs.astype(np.float32))
