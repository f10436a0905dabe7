"""The integer reference equals ONNX Runtime bit by bit for all sizes and kinds of inputs."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import onnxruntime
import pytest
from model_material import integer_network, random_int8, windows

from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import Session, load_bundle, session_options
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.requantisation import neon_sum_table, sum_table
from uwb_mitigation.mitigation.model.shipped import SHIPPED, default_model_path, shipped_model_path
from uwb_mitigation.mitigation.model.weights import layer_inputs, sum_operands


def hostile_inputs(samples: int, seed: int) -> np.ndarray:
    """Return plausible, flat, saturating, sparse, tiny, zero and huge windows."""
    generator = np.random.default_rng(seed)
    sparse = generator.random((60, samples)) * (generator.random((60, samples)) < 0.05)
    rows = [
        windows(200, samples, seed),
        generator.random((60, samples)),
        generator.random((60, samples)) * 50,
        sparse * 20,
        generator.random((20, samples)) * 1e-3,
        np.zeros((1, samples)),
        np.full((1, samples), 3e38),
        np.tile([0.0, 1e9], (1, samples))[:, :samples],
    ]
    return np.concatenate(rows).astype(np.float32)


@pytest.mark.parametrize("first_kernel", [3, 5])
@pytest.mark.parametrize("samples", [157, 128, 64, 32, 16, 8])
def test_it_equals_onnx_runtime(samples, first_kernel):
    shape = Remnet(samples=samples, first_kernel=first_kernel)
    weights = random_int8(shape, seed=samples)
    inputs = hostile_inputs(samples, seed=first_kernel)
    runtime = onnxruntime.InferenceSession(
        graph.int8_model(weights), session_options(), providers=["CPUExecutionProvider"]
    )
    computed = runtime.run(None, {"cir": inputs[:, None, :]})[0][:, 0]
    assert np.array_equal(computed, IntegerNetwork(weights).predict_m(inputs))


def test_shipped_network_equals_onnx_runtime():
    shipped = load_bundle(default_model_path())
    session, reference = Session(shipped), integer_network(shipped)
    inputs = np.concatenate([windows(1500, 157, 4), hostile_inputs(157, 5)])
    expected = reference.predict_m(inputs)
    assert np.array_equal(session.predict_m(inputs), expected)
    single = np.concatenate([session.predict_m(row[None]) for row in inputs[-500:]])
    assert np.array_equal(single, expected[-500:])


@pytest.mark.parametrize("name", SHIPPED)
def test_every_sum_of_a_shipped_model_is_equal_on_x86_and_arm(name):
    weights = integer_network(load_bundle(shipped_model_path(name))).weights
    scale = weights.activation_scale
    sums = [tensor for tensor in scale if tensor not in ("input", *layer_inputs(weights.architecture))]
    assert len(sums) == 2 * weights.architecture.modules
    for tensor in sums:
        ratios = [np.float32(scale[operand] / scale[tensor]) for operand in sum_operands(tensor)]
        with_fma = sum_table(*ratios)
        assert np.array_equal(neon_sum_table(*ratios), with_fma), tensor
        assert np.array_equal(sum_table(*ratios, fused=False), with_fma), tensor


def test_sum_is_rounded_as_by_a_fused_multiply_add():
    first, second = np.float32(0.87686104), np.float32(0.5873151)
    exact = Fraction(float(first)) * 47 + Fraction(float(np.float32(second * np.float32(135))))
    fused = float(np.rint(np.float32(float(exact))))
    separate = float(np.rint(first * np.float32(47) + second * np.float32(135)))
    assert fused != separate
    assert sum_table(first, second)[47, 135] == fused
