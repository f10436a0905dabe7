"""Convert REMNet or its baseline to an ONNX graph, float32 or int8, and read the weights from the graph.

Both graphs have the input `cir`, float32 (n, 1, K), and the output `error`, float32 (n, 1), m. The int8 graph is
written with QuantizeLinear and DequantizeLinear around float operators, in the pattern that ONNX
Runtime fuses into QLinearConv, QLinearAdd and QGemm. Activations are uint8 with zero point 0, so that
padding is zero and the saturation is the ReLU; weights are int8 with zero point 0.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.model.architecture import HEAD, Architecture, Convolution, Mlp, Remnet
from uwb_mitigation.mitigation.model.weights import FloatWeights, Int8Weights, activation_tensors, inputs_of

INPUT = "cir"
OUTPUT = "error"

Number = TypeVar("Number", bound=np.generic)

# The oldest versions that support all operators of these graphs; every current ONNX Runtime reads them.
OPSET = 13
IR_VERSION = 7


class _Graph:
    """Collects nodes and initializers."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: NDArray[np.generic]) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def node(self, operator: str, inputs: list[str], output: str, **attributes: object) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], output, **attributes))
        return output

    def model(self, architecture: Architecture, name: str) -> bytes:
        graph = helper.make_graph(
            self.nodes,
            name,
            [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["n", 1, architecture.samples])],
            [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["n", 1])],
            self.constants,
        )
        model = helper.make_model(
            graph,
            producer_name="uwb_mitigation",
            ir_version=IR_VERSION,
            opset_imports=[helper.make_opsetid("", OPSET)],
        )
        onnx.checker.check_model(model, full_check=True)
        # Deterministic bytes, so that the same training gives the same model id.
        return bytes(model.SerializeToString(deterministic=True))


def float_model(weights: FloatWeights) -> bytes:
    """Return the serialised float32 graph."""
    graph = _Graph()

    def parameters(layer: str) -> list[str]:
        return [
            graph.constant(f"{layer}.weight", _as_written(layer, weights.weight[layer])),
            graph.constant(f"{layer}.bias", weights.bias[layer]),
        ]

    _write(graph, weights.architecture, parameters, lambda tensor, value: value)
    return graph.model(weights.architecture, weights.architecture.kind)


def int8_model(weights: Int8Weights) -> bytes:
    """Return the serialised int8 graph in QDQ form."""
    graph = _Graph()
    zero = graph.constant("zero_uint8", np.uint8(0))
    for tensor in activation_tensors(weights.architecture):
        graph.constant(f"{tensor}.scale", np.float32(weights.activation_scale[tensor]))
    input_scale = {
        layer: np.float32(weights.activation_scale[inputs[0]])
        for layer, inputs in inputs_of(weights.architecture).items()
    }
    if isinstance(weights.architecture, Remnet):
        # With the same scale before and after Flatten, the runtime flattens the integers.
        graph.constant("flat.scale", input_scale[HEAD])

    def parameters(layer: str) -> list[str]:
        scale = weights.weight_scale[layer]
        accumulator = input_scale[layer] * scale
        # The head has one scale for the tensor; other layers have one for each filter.
        if layer == HEAD:
            scale, accumulator = scale[0], accumulator[0]
        written = _as_written(layer, weights.weight[layer])
        dense = layer != HEAD and written.ndim == 2
        names = []
        for parameter, integers, unit, along in (
            ("weight", written, scale, int(dense)),
            ("bias", weights.bias[layer], accumulator, 0),
        ):
            axis = {} if layer == HEAD else {"axis": along}
            names.append(
                graph.node(
                    "DequantizeLinear",
                    [
                        graph.constant(f"{layer}.{parameter}", integers),
                        graph.constant(f"{layer}.{parameter}.scale", unit),
                        graph.constant(f"{layer}.{parameter}.zero", np.zeros(np.shape(unit), integers.dtype)),
                    ],
                    f"{layer}.{parameter}.dequantised",
                    **axis,
                )
            )
        return names

    reader_counts: dict[str, Callable[[], int]] = {}

    def quantised(tensor: str, value: str) -> str:
        """Quantise `value` when it is first used, and add a dequantisation for each reader."""
        pair = [f"{tensor}.scale", zero]
        if tensor not in reader_counts:
            graph.node("QuantizeLinear", [value, *pair], f"{tensor}.quantised")
            reader_counts[tensor] = itertools.count(1).__next__
        reader = reader_counts[tensor]()
        return graph.node("DequantizeLinear", [f"{tensor}.quantised", *pair], f"{tensor}.dequantised{reader}")

    _write(graph, weights.architecture, parameters, quantised)
    return graph.model(weights.architecture, f"{weights.architecture.kind}_int8")


def float_weights(model: bytes, architecture: Architecture) -> FloatWeights:
    """Return the weights of a graph that `float_model` wrote.

    Raises:
        ModelError: an initializer is absent or of another shape or type.
    """
    constants = _constants(model)
    layers = list(architecture.weight_shapes)
    return FloatWeights(
        architecture,
        {name: _as_written(name, _take(constants, f"{name}.weight", np.float32)) for name in layers},
        {name: _take(constants, f"{name}.bias", np.float32) for name in layers},
    )


def int8_weights(model: bytes, architecture: Architecture) -> Int8Weights:
    """Return the integers and scales of a graph that `int8_model` wrote.

    Raises:
        ModelError: an initializer is absent or of another shape or type.
    """
    constants = _constants(model)
    layers = list(architecture.weight_shapes)
    return Int8Weights(
        architecture,
        {name: _as_written(name, _take(constants, f"{name}.weight", np.int8)) for name in layers},
        {name: np.atleast_1d(_take(constants, f"{name}.weight.scale", np.float32)) for name in layers},
        {name: _take(constants, f"{name}.bias", np.int32) for name in layers},
        {
            tensor: np.float32(_take(constants, f"{tensor}.scale", np.float32))
            for tensor in activation_tensors(architecture)
        },
    )


def _constants(model: bytes) -> dict[str, NDArray[np.generic]]:
    try:
        graph = onnx.load_model_from_string(model).graph
        return {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    except Exception as error:  # protobuf's errors are not part of the API of onnx
        raise ModelError(f"not an ONNX graph: {error}") from error


def _take(constants: dict[str, NDArray[np.generic]], name: str, kind: type[Number]) -> NDArray[Number]:
    array = constants.get(name)
    if array is None or array.dtype != kind:
        problem = "absent" if array is None else f"of type {array.dtype}"
        raise ModelError(f"initializer {name} is {problem}", valid=np.dtype(kind).name)
    return array.astype(kind, copy=False)


def _as_written(layer: str, weight: NDArray[Number]) -> NDArray[Number]:
    """Convert weights to the layout of the graph, or back: dense layers are transposed, inputs first."""
    return np.ascontiguousarray(weight.T) if layer != HEAD and weight.ndim == 2 else weight


def _write(
    graph: _Graph,
    architecture: Architecture,
    parameters: Callable[[str], list[str]],
    read: Callable[[str, str], str],
) -> None:
    """Write the nodes of a network. `read(tensor, value)` returns the name of the value that readers of `tensor` use."""
    is_mlp = isinstance(architecture, Mlp)
    layers = {layer.name: layer for layer in architecture.layers}
    values = {"input": graph.node("Flatten", [INPUT], "flat", axis=1) if is_mlp else INPUT}
    for tensor, names in inputs_of(architecture).items():
        operands = [read(name, values.get(name, name)) for name in names]
        if tensor == HEAD:
            (last,) = operands
        elif len(operands) == 2:
            graph.node("Add", operands, tensor)
        else:
            shape, layer = {}, layers[tensor]
            if isinstance(layer, Convolution):
                shape = {
                    "kernel_shape": [layer.kernel],
                    "strides": [layer.stride],
                    "pads": list(layer.padding),
                }
            inputs = [*operands, *parameters(tensor)]
            sums = graph.node("Gemm" if is_mlp else "Conv", inputs, f"{tensor}.accumulated", **shape)
            graph.node("Relu", [sums], tensor)
    if not is_mlp:
        last = read("flat", graph.node("Flatten", [last], "flat", axis=1))
    graph.node("Gemm", [last, *parameters(HEAD)], OUTPUT)
