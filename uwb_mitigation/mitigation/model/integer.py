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

from uwb_mitigation.mitigation.model import requantisation
from uwb_mitigation.mitigation.model.architecture import HEAD
from uwb_mitigation.mitigation.model.weights import Int8Weights, evaluate, inputs_of, shaped, weighted_sums

_BATCH = 256
"""Batch size, so that the tensors fit into the cache of the processor."""


class IntegerNetwork:
    """Runs an int8 network in integer arithmetic; simple and slow."""

    def __init__(self, weights: Int8Weights) -> None:
        self.weights = weights
        self._layers = {layer.name: layer for layer in weights.architecture.layers}
        self._inputs = inputs_of(weights.architecture)

    def predict_m(self, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the outputs of the network, float32 (n,), m, for inputs of shape (n, K)."""
        outputs = [
            self.head(self.tensors(inputs[start : start + _BATCH])[self._inputs[HEAD][0]])
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
        first = shaped(architecture, requantisation.saturate(np.rint(quotient)))
        return evaluate(architecture, first, self.apply, self.add)

    def apply(self, name: str, values: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Apply layer `name` and its ReLU."""
        # Products of integers below 2^53 are exact in float64, for which NumPy has fast matrix products.
        exact = (
            array.astype(float) for array in (values, self.weights.weight[name], self.weights.bias[name])
        )
        sums, scale = weighted_sums(self._layers[name], *exact), self.weights.activation_scale
        factor = requantisation.requantisation_scale(
            scale[self._inputs[name][0]], self.weights.weight_scale[name], scale[name]
        )
        return requantisation.requantise(sums, factor.reshape(-1, *[1] * (sums.ndim - 2)))

    def add(self, name: str, first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Compute the sum `name` of its two operands."""
        scale = self.weights.activation_scale
        table = requantisation.sum_table(*(scale[operand] / scale[name] for operand in self._inputs[name]))
        return table[first, second]

    def head(self, values: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the output of the head for the last tensor, float32 (n,), m."""
        flat = values.reshape(len(values), -1).astype(np.int64)
        accumulator = flat @ self.weights.weight[HEAD].astype(np.int64) + self.weights.bias[HEAD]
        factor = self.weights.activation_scale[self._inputs[HEAD][0]] * self.weights.weight_scale[HEAD]
        return np.asarray(accumulator[:, 0].astype(np.float32) * factor, np.float32)
