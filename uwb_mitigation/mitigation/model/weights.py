"""Parameters of a network as NumPy arrays: the result of training, and the content of the graphs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.model.architecture import HEAD, Architecture, Convolution, Dense, Mlp

Number = TypeVar("Number", bound=np.generic)


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


def inputs_of(architecture: Architecture) -> dict[str, tuple[str, ...]]:
    """Return {tensor: the tensors that it is computed from}, in the order of evaluation.

    The output of a layer has the name of the layer, and one input; other tensors are sums of two. The first input is `input`.
    REMNet: `first`, then for each module `moduleN.residual`, `moduleN.sum` (sum of the residual), `moduleN.reduce`,
    `moduleN.skip` and `moduleN` (its output). MLP: its layers. The last one is the output of the head.
    """
    if isinstance(architecture, Mlp):
        names = ["input", *(layer.name for layer in architecture.layers), HEAD]
        return {name: (read,) for read, name in pairwise(names)}
    inputs: dict[str, tuple[str, ...]] = {"first": ("input",)}
    tensor = "first"
    for number in range(1, architecture.modules + 1):
        module = f"module{number}"
        inputs[f"{module}.residual"] = (tensor,)
        inputs[f"{module}.sum"] = f"{module}.residual", tensor
        inputs[f"{module}.reduce"] = inputs[f"{module}.skip"] = (f"{module}.sum",)
        inputs[module] = f"{module}.reduce", f"{module}.skip"
        tensor = module
    return inputs | {HEAD: (tensor,)}


def activation_tensors(architecture: Architecture) -> tuple[str, ...]:
    """Return every tensor that has a scale in int8, in the order of evaluation: `input`, and all except for the head's."""
    return ("input", *inputs_of(architecture))[:-1]


def weighted_sums(
    layer: Convolution | Dense, values: NDArray[Any], weight: NDArray[Any], bias: NDArray[Any]
) -> Any:
    """Return the output of a layer before its ReLU: (n, filters, length out); of a dense layer (n, outputs).

    Args:
        layer: the layer.
        values: its input, (n, inputs, length) or (n, inputs).
        weight: of the layer, in the type of the result.
        bias: of the layer.
    """
    if isinstance(layer, Dense):
        return values @ weight.T + bias
    padded = np.pad(values, ((0, 0), (0, 0), layer.padding))
    windows = np.lib.stride_tricks.sliding_window_view(padded, layer.kernel, axis=2)[:, :, :: layer.stride]
    return np.einsum("ncpk,fck->nfp", windows, weight, optimize=True) + bias[:, None]


def shaped(architecture: Architecture, inputs: NDArray[Number]) -> NDArray[Number]:
    """Return the input of the first layer for windows (n, K): (n, 1, K); of a dense layer (n, K)."""
    return inputs if isinstance(architecture, Mlp) else inputs[:, None, :]


def evaluate(
    architecture: Architecture,
    inputs: Any,
    layer: Callable[[str, Any], Any],
    add: Callable[[str, Any, Any], Any],
) -> dict[str, Any]:
    """Return all activations of a network, {tensor: activation}.

    Args:
        architecture: the network.
        inputs: of the first layer.
        layer: returns the output of a layer for its input; gets the name of the layer.
        add: returns the sum of two tensors; gets the name of the sum.
    """
    values = {"input": inputs}
    for tensor, names in inputs_of(architecture).items():
        if tensor != HEAD:
            operands = [values[name] for name in names]
            values[tensor] = layer(tensor, *operands) if len(operands) == 1 else add(tensor, *operands)
    return values


def _check_shapes(
    architecture: Architecture,
    weight: Mapping[str, NDArray[np.generic]],
    bias: Mapping[str, NDArray[np.generic]],
) -> None:
    for name, weight_shape in architecture.weight_shapes.items():
        bias_shape = (1,) if name == HEAD else weight_shape[:1]
        for parameter, arrays, shape in (("weight", weight, weight_shape), ("bias", bias, bias_shape)):
            if name not in arrays:
                raise ModelError(f"no {parameter} of layer {name}")
            if arrays[name].shape != shape:
                raise ModelError(
                    f"{parameter} of layer {name} has shape {arrays[name].shape}", valid=f"{shape}"
                )
