"""What an ONNX file of ours may hold, checked from its bytes.

A bundle's graph has a handful of operators, one input and one output, and its weights inside. Anything
else is refused, so that a foreign or hostile file never reaches the runtime.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from uwb_mitigation.model import wire
from uwb_mitigation.model.architecture import HEAD, Architecture, Mlp
from uwb_mitigation.model.weights import weight_shapes

# Field numbers of onnx.proto.
_MODEL_GRAPH, _MODEL_METADATA, _MODEL_FUNCTIONS = 7, 14, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_INPUT, _GRAPH_OUTPUT, _GRAPH_SPARSE = 1, 5, 11, 12, 15
_NODE_OPERATOR, _NODE_ATTRIBUTE, _NODE_DOMAIN = 4, 5, 7
_ATTRIBUTE_TENSOR, _ATTRIBUTE_GRAPH, _ATTRIBUTE_TENSORS, _ATTRIBUTE_GRAPHS = 5, 6, 10, 11
_TENSOR_DIMS, _TENSOR_NAME, _TENSOR_EXTERNAL, _TENSOR_LOCATION = 1, 8, 13, 14
_KEY, _VALUE = 1, 2

_FLOAT_OPERATORS = frozenset({"Conv", "Relu", "Add", "Flatten", "Gemm"})
_OPERATORS = _FLOAT_OPERATORS | {"QuantizeLinear", "DequantizeLinear"}


@dataclass(frozen=True, slots=True)
class Contents:
    """What `read` found.

    Attributes:
        metadata: the model's metadata properties.
        input_shape: of the graph's input; 0 where a dimension is free.
        shapes: {initializer: shape}.
        quantised: whether the graph quantises.
    """

    metadata: Mapping[str, str]
    input_shape: tuple[int, ...]
    shapes: Mapping[str, tuple[int, ...]]
    quantised: bool


def read(data: bytes) -> Contents:
    """Read the outline of an ONNX model.

    Raises:
        WireError: the bytes are no ONNX model, or one that no bundle holds; the message says which.
    """
    model = memoryview(data)
    if any(True for _ in wire.messages(model, _MODEL_FUNCTIONS)):
        raise wire.WireError("the model defines functions of its own")
    metadata = {
        wire.text(entry, _KEY): wire.text(entry, _VALUE) for entry in wire.messages(model, _MODEL_METADATA)
    }
    graphs = list(wire.messages(model, _MODEL_GRAPH))
    if len(graphs) != 1:
        raise wire.WireError(f"it holds {len(graphs)} graphs")
    graph = graphs[0]
    if any(True for _ in wire.messages(graph, _GRAPH_SPARSE)):
        raise wire.WireError("the graph holds sparse tensors")
    operators = {_operator(node) for node in wire.messages(graph, _GRAPH_NODE)}
    if foreign := operators - _OPERATORS:
        raise wire.WireError(f"the graph holds operators that no model of ours has: {sorted(foreign)}")
    inputs = list(wire.messages(graph, _GRAPH_INPUT))
    outputs = list(wire.messages(graph, _GRAPH_OUTPUT))
    if len(inputs) != 1 or len(outputs) != 1:
        raise wire.WireError(f"the graph has {len(inputs)} inputs and {len(outputs)} outputs")
    shapes = {}
    for tensor in wire.messages(graph, _GRAPH_INITIALIZER):
        name = wire.text(tensor, _TENSOR_NAME)
        if any(number in (_TENSOR_EXTERNAL, _TENSOR_LOCATION) for number, _ in wire.fields(tensor)):
            raise wire.WireError(f"tensor {name} lies in another file")
        shapes[name] = tuple(wire.integers(tensor, _TENSOR_DIMS))
    return Contents(metadata, _shape(inputs[0]), shapes, "QuantizeLinear" in operators)


def mismatch(contents: Contents, architecture: Architecture) -> str:
    """How a graph differs from `architecture`: one sentence, or empty where it does not."""
    if contents.input_shape[1:] != (1, architecture.samples):
        return (
            f"the graph reads inputs of shape {contents.input_shape}, "
            f"the metadata promises K = {architecture.samples}"
        )
    for layer, shape in weight_shapes(architecture).items():
        if isinstance(architecture, Mlp) and layer != HEAD:
            shape = shape[::-1]  # a product of matrices reads them so
        found = contents.shapes.get(f"{layer}.weight")
        if found != shape:
            return f"layer {layer} has weights of shape {found}, the metadata promises {shape}"
    return ""


def _operator(node: memoryview) -> str:
    domain = wire.text(node, _NODE_DOMAIN)
    for attribute in wire.messages(node, _NODE_ATTRIBUTE):
        for number, _ in wire.fields(attribute):
            if number in (_ATTRIBUTE_TENSOR, _ATTRIBUTE_GRAPH, _ATTRIBUTE_TENSORS, _ATTRIBUTE_GRAPHS):
                raise wire.WireError("a node carries a tensor or a graph of its own")
    operator = wire.text(node, _NODE_OPERATOR)
    return f"{domain}.{operator}" if domain else operator


def _shape(value: memoryview) -> tuple[int, ...]:
    """ValueInfo.type (2) .tensor_type (1) .shape (2) .dim (1) .dim_value (1)."""
    dimensions = []
    for kind in wire.messages(value, 2):
        for tensor in wire.messages(kind, 1):
            for shape in wire.messages(tensor, 2):
                for dimension in wire.messages(shape, 1):
                    values = list(wire.integers(dimension, 1))
                    dimensions.append(values[-1] if values else 0)
    return tuple(dimensions)
