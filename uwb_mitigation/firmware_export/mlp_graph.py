"""The int8 MLP as an ONNX graph, for ONNX Runtime to be compared with."""

from __future__ import annotations

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from uwb_mitigation.firmware_export.mlp import Int8Mlp
from uwb_mitigation.model.graph import INPUT, IR_VERSION, OPSET, OUTPUT


def mlp_model(weights: Int8Mlp) -> bytes:
    """The serialised graph, in QDQ form: `cir`, float32 (n, K), to `error`, float32 (n, 1), m."""
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []

    def constant(name: str, value: NDArray[np.generic] | np.generic) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def node(operator: str, inputs: list[str], output: str, **attributes: int) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], output, **attributes))
        return output

    def dequantised(
        name: str, integers: NDArray[np.generic], scale: NDArray[np.float32] | np.float32, axis: int
    ) -> str:
        zeros = np.zeros(scale.shape, integers.dtype)
        inputs = [constant(name, integers), constant(f"{name}.scale", scale), constant(f"{name}.zero", zeros)]
        return node("DequantizeLinear", inputs, f"{name}.real", **({"axis": axis} if scale.shape else {}))

    zero = constant("zero", np.uint8(0))
    pair = [constant("input.scale", weights.input_scale), zero]
    node("QuantizeLinear", [INPUT, *pair], "input.quantised")
    value = node("DequantizeLinear", ["input.quantised", *pair], "input.real")
    scale = weights.input_scale
    for number, layer in enumerate(weights.layers, start=1):
        name = f"dense{number}"
        weight = dequantised(f"{name}.weight", np.ascontiguousarray(layer.weight.T), layer.weight_scale, 1)
        bias = dequantised(f"{name}.bias", layer.bias, scale * layer.weight_scale, 0)
        node("Gemm", [value, weight, bias], f"{name}.sum")
        node("Relu", [f"{name}.sum"], f"{name}.relu")
        pair = [constant(f"{name}.scale", layer.output_scale), zero]
        node("QuantizeLinear", [f"{name}.relu", *pair], f"{name}.quantised")
        value = node("DequantizeLinear", [f"{name}.quantised", *pair], f"{name}.real")
        scale = layer.output_scale
    weight = dequantised("head.weight", weights.head_weight[:, None], weights.head_scale, 1)
    bias = dequantised("head.bias", np.array([weights.head_bias], np.int32), scale * weights.head_scale, 0)
    node("Gemm", [value, weight, bias], OUTPUT)
    graph = helper.make_graph(
        nodes,
        "mlp_int8",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["n", weights.samples])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["n", 1])],
        constants,
    )
    model = helper.make_model(
        graph,
        producer_name="uwb_mitigation",
        ir_version=IR_VERSION,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )
    onnx.checker.check_model(model, full_check=True)
    serialised: bytes = model.SerializeToString(deterministic=True)
    return serialised
