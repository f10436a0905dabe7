"""The int8 network in NumPy: the reference for testing ONNX Runtime and the firmware.

It computes with integers and rounds exactly like the MLAS kernels of ONNX Runtime:
a convolution requantises its int32 accumulator with `rint(float32(acc) * s)`, `s = fl(fl(sx sw) / sy)`;
a sum is `rint(fma(a, ra, fl(b rb)))` with `ra = fl(sa / sy)`; all to uint8, half to even, saturating; the
head's output is `float32(acc) * fl(sx sw)`. ONNX Runtime computes sums differently on ARM and on processors
without a fused multiply-add. The quantiser chooses scales for which all three sums are equal (see `nudge`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.model.architecture import HEAD, Convolution, Mlp, Remnet
from uwb_mitigation.mitigation.model.requantisation import (
    requantisation_scale,
    requantise,
    saturate,
    sum_table,
)
from uwb_mitigation.mitigation.model.weights import (
    Int8Weights,
    activation_tensors,
    layer_inputs,
    sum_operands,
)

_BATCH = 256
"""Batch size, so that the tensors fit into the cache of the processor."""


class IntegerNetwork:
    """Runs an int8 network in integer arithmetic; simple and slow."""

    def __init__(self, weights: Int8Weights) -> None:
        self.weights = weights
        self._layers = {}
        if isinstance(weights.architecture, Remnet):
            self._layers = {layer.name: layer for layer in weights.architecture.convolutions}
        self._reads = layer_inputs(weights.architecture)

    def predict_m(self, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the outputs of the network, float32 (n,), m, for inputs of shape (n, K)."""
        outputs = [
            self.head(self.tensors(inputs[start : start + _BATCH])[self._reads[HEAD]])
            for start in range(0, max(len(inputs), 1), _BATCH)
        ]
        return np.concatenate(outputs)

    def tensors(self, inputs: NDArray[np.float32]) -> dict[str, NDArray[np.uint8]]:
        """Return all activations for inputs of shape (n, K).

        The result is {tensor: uint8 (n, channels, length)}; for an MLP, {tensor: uint8 (n, outputs)}.
        """
        architecture = self.weights.architecture
        with np.errstate(over="ignore"):  # An infinite quotient saturates like any large one.
            quotient = np.divide(inputs, self.weights.activation_scale["input"], dtype=np.float32)
        integers = saturate(np.rint(quotient))
        values = {"input": integers if isinstance(architecture, Mlp) else integers[:, None, :]}
        for tensor in activation_tensors(architecture)[1:]:
            if tensor not in self._reads:
                values[tensor] = self.add(tensor, values)
            elif isinstance(architecture, Mlp):
                values[tensor] = self.connect(tensor, values[self._reads[tensor]])
            else:
                values[tensor] = self.convolve(tensor, values[self._reads[tensor]])
        return values

    def accumulate(self, name: str, values: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return the accumulators of convolution `name`, including bias, (n, filters, length out)."""
        layer: Convolution = self._layers[name]
        padded = np.pad(values.astype(np.int32), ((0, 0), (0, 0), layer.padding))
        windows = np.lib.stride_tricks.sliding_window_view(padded, layer.kernel, axis=2)
        windows = windows[:, :, :: layer.stride]
        weight = self.weights.weight[name].astype(np.int32)
        # Products of integers below 2^53 are exact in float64, for which NumPy has fast matrix products.
        sums = np.einsum("ncpk,fck->nfp", windows.astype(float), weight.astype(float), optimize=True)
        total: NDArray[np.int32] = sums.astype(np.int32) + self.weights.bias[name][:, None]
        return total

    def requantisation(self, name: str) -> NDArray[np.float32]:
        """Return the factors from accumulator to output of layer `name`, float32 (filters,)."""
        scale = self.weights.activation_scale
        return requantisation_scale(scale[self._reads[name]], self.weights.weight_scale[name], scale[name])

    def convolve(self, name: str, values: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Apply convolution `name` and its ReLU."""
        return requantise(self.accumulate(name, values), self.requantisation(name)[:, None])

    def connect(self, name: str, values: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Apply dense layer `name` and its ReLU: (n, inputs) to (n, outputs)."""
        # Exact in float64, as in `accumulate`.
        sums = values.astype(float) @ self.weights.weight[name].T.astype(float) + self.weights.bias[name]
        return requantise(sums, self.requantisation(name))

    def add(self, name: str, values: dict[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Compute the sum `name` of its two operands."""
        scale = self.weights.activation_scale
        first, second = sum_operands(name)
        table = sum_table(scale[first] / scale[name], scale[second] / scale[name])
        return table[values[first], values[second]]

    def head(self, values: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the output of the head for the last tensor, float32 (n,), m."""
        flat = values.reshape(len(values), -1).astype(np.int64)
        accumulator = flat @ self.weights.weight[HEAD].astype(np.int64) + self.weights.bias[HEAD]
        factor = self.weights.activation_scale[self._reads[HEAD]] * self.weights.weight_scale[HEAD]
        output: NDArray[np.float32] = accumulator[:, 0].astype(np.float32) * factor
        return output
