"""The float network in numpy: what calibration looks into, and a check on torch and ONNX Runtime."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.model.architecture import HEAD
from uwb_mitigation.model.weights import FloatWeights, activation_tensors

CHUNK = 256
"""Inputs evaluated at once: bounds the memory."""


def activations(weights: FloatWeights, inputs: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Every activation of the float network, {tensor: (n, channels, length)}, for inputs (n, K)."""
    layers = {layer.name: layer for layer in weights.architecture.convolutions}

    def convolve(name: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
        layer = layers[name]
        padded = np.pad(values, ((0, 0), (0, 0), layer.padding))
        windows = np.lib.stride_tricks.sliding_window_view(padded, layer.kernel, axis=2)
        windows = windows[:, :, :: layer.stride]
        sums = np.einsum("ncpk,fck->nfp", windows, weights.weight[name], optimize=True)
        activation: NDArray[np.float32] = np.maximum(sums + weights.bias[name][:, None], np.float32(0))
        return activation

    values = {"input": inputs[:, None, :]}
    values["first"] = convolve("first", values["input"])
    tensor = "first"
    for module in range(1, weights.architecture.modules + 1):
        prefix = f"module{module}"
        values[f"{prefix}.residual"] = convolve(f"{prefix}.residual", values[tensor])
        values[f"{prefix}.sum"] = values[f"{prefix}.residual"] + values[tensor]
        for branch in (f"{prefix}.reduce", f"{prefix}.skip"):
            values[branch] = convolve(branch, values[f"{prefix}.sum"])
        values[prefix] = values[f"{prefix}.reduce"] + values[f"{prefix}.skip"]
        tensor = prefix
    return values


def predict_m(weights: FloatWeights, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
    """The float network's outputs, (n,), for inputs of shape (n, K), m."""
    last = activation_tensors(weights.architecture)[-1]
    outputs = []
    for start in range(0, len(inputs), CHUNK):
        flat = activations(weights, inputs[start : start + CHUNK])[last]
        outputs.append(flat.reshape(len(flat), -1) @ weights.weight[HEAD][:, 0] + weights.bias[HEAD])
    return np.concatenate(outputs) if outputs else np.zeros(0, np.float32)
