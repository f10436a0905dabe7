"""The paper's baseline, an MLP of dense layers, in int8: its parameters and its arithmetic.

Scales and rounding are those of REMNet's integer reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.firmware_export.requantisation import (
    accumulator_range,
    nudge_weight_scale,
    requantisation_scale,
)

PAPER_LAYERS = (240, 64, 16)
"""Hidden layers that give the paper's 54,401 parameters at K = 157."""


@dataclass(frozen=True, slots=True, eq=False)
class Int8Dense:
    """A dense layer with ReLU.

    Attributes:
        weight: int8 (outputs, inputs).
        bias: int32 (outputs,), in units of the accumulator.
        weight_scale: float32 (outputs,).
        output_scale: of its uint8 output.
    """

    weight: NDArray[np.int8]
    bias: NDArray[np.int32]
    weight_scale: NDArray[np.float32]
    output_scale: np.float32


@dataclass(frozen=True, slots=True, eq=False)
class Int8Mlp:
    """Dense layers, then a head of one output.

    Attributes:
        input_scale: of the uint8 input.
        layers: in the order of evaluation; at least one.
        head_weight: int8 (inputs,).
        head_bias: in units of the accumulator.
        head_scale: of the head's weights.
    """

    input_scale: np.float32
    layers: tuple[Int8Dense, ...]
    head_weight: NDArray[np.int8]
    head_bias: int
    head_scale: np.float32

    def __post_init__(self) -> None:
        if not self.layers:
            raise ModelError("an MLP without layers", valid="at least one before the head")
        outputs = self.layers[0].weight.shape[1]
        for number, layer in enumerate(self.layers, start=1):
            if layer.weight.ndim != 2 or layer.weight.shape[1] != outputs:
                raise ModelError(
                    f"dense{number} has weights of shape {layer.weight.shape}", valid=f"(n, {outputs})"
                )
            outputs = layer.weight.shape[0]
        if self.head_weight.shape != (outputs,):
            raise ModelError(f"head has weights of shape {self.head_weight.shape}", valid=f"({outputs},)")

    @property
    def samples(self) -> int:
        return int(self.layers[0].weight.shape[1])

    def predict_m(self, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Outputs, float32 (n,), for inputs (n, K)."""
        values = np.clip(np.rint(inputs / self.input_scale), 0, 255).astype(np.int64)
        scale = self.input_scale
        for layer in self.layers:
            accumulator = (values @ layer.weight.astype(np.int64).T + layer.bias).astype(np.float32)
            factor = requantisation_scale(scale, layer.weight_scale, layer.output_scale)
            values = np.clip(np.rint(accumulator * factor), 0, 255).astype(np.int64)
            scale = layer.output_scale
        total = (values @ self.head_weight.astype(np.int64) + self.head_bias).astype(np.float32)
        result: NDArray[np.float32] = total * np.float32(scale * self.head_scale)
        return result


def nudge_mlp(weights: Int8Mlp) -> Int8Mlp:
    """`weights` with scales moved by a few ulps, so that every layer has exact integer constants."""
    layers = []
    scale = weights.input_scale
    for layer in weights.layers:
        low, high = accumulator_range(layer.weight, layer.bias)
        moved = nudge_weight_scale(scale, layer.weight_scale, layer.output_scale, low, high)
        layers.append(replace(layer, weight_scale=moved))
        scale = layer.output_scale
    return replace(weights, layers=tuple(layers))
