"""The session: what ONNX Runtime makes of our graphs, and that one input or many make no difference."""

from __future__ import annotations

from collections import Counter

import numpy as np
import onnx
import onnxruntime
import pytest
from model_material import bundle, card, random_weights, windows

from uwb_mitigation.errors import ModelError
from uwb_mitigation.model import floating, graph
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.model.bundle import Session, save_bundle, session_options
from uwb_mitigation.model.shipped import default_model_path


def test_the_int8_graph_fuses_to_integer_operators(tmp_path):
    model = bundle(tmp_path, Remnet())
    options = session_options()
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    onnxruntime.InferenceSession(model.model, options, providers=["CPUExecutionProvider"])
    nodes = Counter(node.op_type for node in onnx.load(tmp_path / "optimised.onnx").graph.node)
    assert nodes == {
        "QuantizeLinear": 1,
        "Transpose": 2,
        "QLinearConv": 10,
        "QLinearAdd": 6,
        "Flatten": 1,
        "QGemm": 1,
    }


def test_a_batch_has_the_bits_of_single_inputs(tmp_path):
    session = Session(bundle(tmp_path, Remnet(samples=64)))
    inputs = windows(300, 64, seed=3)
    single = np.concatenate([session.predict_m(row[None]) for row in inputs])
    assert np.array_equal(session.predict_m(inputs), single)


@pytest.mark.parametrize("samples", [157, 8])
def test_the_float_graph_computes_what_numpy_computes(tmp_path, samples):
    shape = Remnet(samples=samples)
    weights = random_weights(shape)
    model = save_bundle(tmp_path / "float.onnx", graph.float_model(weights), card(shape, quantised=False))
    inputs = windows(50, samples)
    assert np.allclose(Session(model).predict_m(inputs), floating.predict_m(weights, inputs), atol=1e-5)


def test_a_graph_that_onnx_runtime_refuses_is_a_model_error(tmp_path):
    good = bundle(tmp_path)
    broken = onnx.load_model_from_string(good.model)
    del broken.metadata_props[:]
    broken.graph.node[0].input[0] = "nowhere"
    with pytest.raises(ModelError) as caught:
        save_bundle(tmp_path / "broken.onnx", broken.SerializeToString(), good.card)
    assert caught.value.where.endswith("broken.onnx")


def test_the_shipped_model_is_found_beside_an_installation(tmp_path, monkeypatch):
    folder = tmp_path / "share" / "uwb_mitigation" / "models"
    folder.mkdir(parents=True)
    (folder / "universal.onnx").touch()
    module = tmp_path / "lib/python3.12/site-packages/uwb_mitigation/model/shipped.py"
    monkeypatch.setattr("uwb_mitigation.model.shipped.__file__", str(module))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert default_model_path() == folder / "universal.onnx"
