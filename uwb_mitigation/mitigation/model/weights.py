"""Parameters of a network as NumPy arrays: the result of training, and the content of the graphs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.model.architecture import HEAD, Architecture, Mlp


@dataclass(frozen=True, slots=True, eq=False)
class FloatWeights:
    """Parameters in float32.

    Attributes:
        architecture: the network they belong to.
        weight: {layer: (filters, inputs, kernel)}; a dense layer's is (outputs, inputs), the head's (features, 1).
        bias: {layer: (filters,)}; the head's is (1,).
    """

    architecture: Architecture
    weight: Mapping[str, NDArray[np.float32]]
    bias: Mapping[str, NDArray[np.float32]]

    def __post_init__(self) -> None:
        _check_shapes(self.architecture, self.weight, self.bias)


@dataclass(frozen=True, slots=True, eq=False)
class Int8Weights:
    """Integer parameters and their scales.

    Every value is `scale * integer`: weights are symmetric and activations are non-negative, so that no zero point is
    needed. The unit of a bias is that of the accumulator of its layer: scale of the input times scale of the weight.

    Attributes:
        architecture: the network they belong to.
        weight: {layer: int8, shapes as in `FloatWeights`}.
        weight_scale: {layer: (filters,) float32}; the head's is (1,).
        bias: {layer: int32}.
        activation_scale: {tensor: float32}; the tensors have the same names as in `graph.py`.
    """

    architecture: Architecture
    weight: Mapping[str, NDArray[np.int8]]
    weight_scale: Mapping[str, NDArray[np.float32]]
    bias: Mapping[str, NDArray[np.int32]]
    activation_scale: Mapping[str, np.float32]

    def __post_init__(self) -> None:
        _check_shapes(self.architecture, self.weight, self.bias)
        for tensor in activation_tensors(self.architecture):
            scale = self.activation_scale.get(tensor)
            if scale is None or not (np.isfinite(scale) and scale > 0):
                raise ModelError(f"scale {scale} of {tensor}", valid="a finite positive scale")


def activation_tensors(architecture: Architecture) -> tuple[str, ...]:
    """Return every tensor that has a scale in int8, in the order of evaluation.

    The first is `input`. REMNet: `first`, then for each module its convolutions, `moduleN.sum` (sum of the residual)
    and `moduleN` (its output). MLP: its layers. The output of a layer has the name of the layer; a tensor that is not
    the output of a layer is the sum of its `sum_operands`.
    """
    if isinstance(architecture, Mlp):
        return ("input", *(layer.name for layer in architecture.layers))
    names = ["input", "first"]
    for module in range(1, architecture.modules + 1):
        prefix = f"module{module}"
        names += [f"{prefix}.{parameter}" for parameter in ("residual", "sum", "reduce", "skip")]
        names.append(prefix)
    return tuple(names)


def layer_inputs(architecture: Architecture) -> dict[str, str]:
    """Return {layer: its input tensor}, in the order of evaluation."""
    if isinstance(architecture, Mlp):
        tensors = activation_tensors(architecture)
        return dict(zip((*tensors[1:], HEAD), tensors, strict=True))
    reads = {"first": "input"}
    tensor = "first"
    for module in range(1, architecture.modules + 1):
        prefix = f"module{module}"
        reads[f"{prefix}.residual"] = tensor
        reads[f"{prefix}.reduce"] = reads[f"{prefix}.skip"] = f"{prefix}.sum"
        tensor = prefix
    reads[HEAD] = tensor
    return reads


def sum_operands(tensor: str) -> tuple[str, str]:
    """Return the two operands of `moduleN.sum` or `moduleN`."""
    module, _, parameter = tensor.partition(".")
    if not parameter:
        return f"{module}.reduce", f"{module}.skip"
    number = int(module.removeprefix("module"))
    return f"{module}.residual", "first" if number == 1 else f"module{number - 1}"


def weight_shapes(architecture: Architecture) -> dict[str, tuple[int, ...]]:
    """Return {layer: shape of its weights}; outputs first, except for the head."""
    shapes: dict[str, tuple[int, ...]]
    if isinstance(architecture, Mlp):
        shapes = {layer.name: (layer.outputs, layer.inputs) for layer in architecture.layers}
    else:
        shapes = {
            layer.name: (layer.filters, layer.inputs, layer.kernel) for layer in architecture.convolutions
        }
    shapes[HEAD] = (architecture.features, 1)
    return shapes


def _check_shapes(
    architecture: Architecture,
    weight: Mapping[str, NDArray[np.generic]],
    bias: Mapping[str, NDArray[np.generic]],
) -> None:
    for name, weight_shape in weight_shapes(architecture).items():
        bias_shape = (1,) if name == HEAD else weight_shape[:1]
        for parameter, arrays, shape in (("weight", weight, weight_shape), ("bias", bias, bias_shape)):
            if name not in arrays:
                raise ModelError(f"no {parameter} of layer {name}")
            if arrays[name].shape != shape:
                raise ModelError(
                    f"{parameter} of layer {name} has shape {arrays[name].shape}", valid=f"{shape}"
                )
