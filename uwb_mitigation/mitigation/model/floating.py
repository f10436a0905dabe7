"""The float network in NumPy: activations for calibration, and a reference for PyTorch and ONNX Runtime."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import HEAD, Remnet
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.weights import FloatWeights, evaluate, inputs_of, shaped, weighted_sums

CHUNK = 256
"""Batch size, which limits the memory."""


def activations(weights: FloatWeights, inputs: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Return all activations of the float network for inputs of shape (n, K).

    The result is {tensor: (n, channels, length)}; for an MLP, {tensor: (n, outputs)}.
    """
    architecture = weights.architecture
    layers = {layer.name: layer for layer in architecture.layers}

    def rectified(name: str, values: NDArray[np.float32]) -> Any:
        sums = weighted_sums(layers[name], values, weights.weight[name], weights.bias[name])
        return np.maximum(sums, np.float32(0))

    first = shaped(architecture, inputs)
    return evaluate(architecture, first, rectified, lambda name, a, b: a + b)


def predict_m(weights: FloatWeights, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the outputs of the float network, (n,), m, for inputs of shape (n, K)."""
    (last,) = inputs_of(weights.architecture)[HEAD]
    outputs = []
    for start in range(0, len(inputs), CHUNK):
        flat = activations(weights, inputs[start : start + CHUNK])[last]
        outputs.append(flat.reshape(len(flat), -1) @ weights.weight[HEAD][:, 0] + weights.bias[HEAD])
    return np.concatenate(outputs) if outputs else np.zeros(0, np.float32)


def float_network(source: Bundle) -> FloatWeights:
    """Return the float network of a bundle; an int8 network is dequantised.

    Raises:
        ModelError: it is not a REMNet.
    """
    if not isinstance(source.card.architecture, Remnet):
        raise ModelError("no REMNet to start from", where=source.path, valid="a bundle of `train`")
    if not source.card.quantised:
        return graph.float_weights(source.model, source.card.architecture)
    integers = graph.int8_weights(source.model, source.card.architecture)
    inputs = inputs_of(source.card.architecture)
    weight, bias = {}, {}
    for layer, values in integers.weight.items():
        scale = integers.weight_scale[layer]
        shaped = scale if layer == HEAD else scale[:, None, None]
        weight[layer] = (values * shaped).astype(np.float32)
        unit = integers.activation_scale[inputs[layer][0]] * scale
        bias[layer] = (integers.bias[layer] * unit).astype(np.float32)
    return FloatWeights(source.card.architecture, weight, bias)


def scaled(network: FloatWeights, factor: float) -> FloatWeights:
    """Return a network whose predictions are multiplied by `factor`."""
    weight = {**network.weight, HEAD: network.weight[HEAD] * np.float32(factor)}
    bias = {**network.bias, HEAD: network.bias[HEAD] * np.float32(factor)}
    return replace(network, weight=weight, bias=bias)
