"""The networks: parameter counts of Table 1 of the paper, and equal results in torch, numpy and ONNX."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest
from model_material import card, random_weights, windows

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.mitigation.model import floating, graph
from uwb_mitigation.mitigation.model.architecture import HEAD, Mlp, Remnet
from uwb_mitigation.mitigation.model.bundle import Session, load_bundle, save_bundle, session_options
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.weights import FloatWeights
from uwb_mitigation.training.fit.quantisation import quantise_network

torch = pytest.importorskip("torch", reason="training is not set up: run make setup-training")

from uwb_mitigation.training.fit.networks import build_network  # noqa: E402


def weights_of(shape: Mlp | Remnet) -> FloatWeights:
    if isinstance(shape, Remnet):
        return random_weights(shape)
    generator = np.random.default_rng(0)
    weight = {
        layer.name: generator.normal(0, (2 / layer.inputs) ** 0.5, (layer.outputs, layer.inputs))
        for layer in shape.layers
    }
    weight[HEAD] = generator.normal(0, 0.3, (shape.features, 1))
    bias = {layer.name: generator.normal(0, 0.1, layer.outputs) for layer in shape.layers}
    bias[HEAD] = generator.normal(0, 0.1, 1)
    return FloatWeights(
        shape,
        {name: values.astype(np.float32) for name, values in weight.items()},
        {name: values.astype(np.float32) for name, values in bias.items()},
    )


@pytest.mark.parametrize(
    ("shape", "count"),
    [(Remnet(157), 5905), (Remnet(128), 5841), (Remnet(32), 5649), (Remnet(8), 5601), (Mlp(), 54_401)],
)
def test_network_has_the_papers_parameters(shape, count):
    module = build_network(shape, 0.5)
    assert shape.parameters == sum(values.numel() for values in module.parameters()) == count


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
    weights = weights_of(shape)
    inputs = windows(20, shape.samples)
    with torch.no_grad():
        computed = build_network(shape, 0.5, weights).eval()(torch.from_numpy(inputs)).numpy()
    assert np.allclose(floating.predict_m(weights, inputs), computed, atol=1e-5)


@pytest.mark.parametrize("shape", [Mlp(157), Mlp(8, (5,)), Mlp(33, (64, 7, 9))])
def test_int8_mlp_equals_onnx_runtime_on_every_bit(shape):
    weights = quantise_network(weights_of(shape), windows(100, shape.samples), exact=False)
    session = onnxruntime.InferenceSession(
        graph.int8_model(weights), session_options(), providers=["CPUExecutionProvider"]
    )
    inputs = np.concatenate([windows(500, shape.samples, 1), windows(500, shape.samples, 2) * 9])
    inputs[0], inputs[1] = 0, 1e30
    computed = session.run(None, {"cir": inputs[:, None, :]})[0][:, 0]
    assert np.array_equal(computed, IntegerNetwork(weights).predict_m(inputs))


@pytest.mark.parametrize("quantised", [True, False])
@pytest.mark.parametrize("shape", [Mlp(16, (12, 8)), Remnet(16)])
def test_bundle_loads_and_runs(tmp_path, shape, quantised):
    weights = weights_of(shape)
    integers = quantise_network(weights, windows(50, 16), exact=False)
    model = graph.int8_model(integers) if quantised else graph.float_model(weights)
    save_bundle(tmp_path / "mlp.onnx", model, card(shape, quantised=quantised))
    bundle = load_bundle(tmp_path / "mlp.onnx")
    assert bundle.architecture == shape
    inputs = windows(20, 16, 3)
    expected = (
        IntegerNetwork(integers).predict_m(inputs) if quantised else floating.predict_m(weights, inputs)
    )
    computed = Session(bundle).predict_m(inputs)
    assert np.allclose(computed, expected, atol=0 if quantised else 1e-5)
    if not quantised:
        read = graph.float_weights(bundle.model, shape)
        assert all(np.array_equal(weights.weight[name], read.weight[name]) for name in weights.weight)


@pytest.mark.parametrize("options", [{"samples": 0}, {"hidden": ()}, {"hidden": (0,)}, {"hidden": (1,) * 7}])
def test_invalid_mlp_is_refused(options):
    with pytest.raises(ParameterError, match="MLP"):
        Mlp(**options)
