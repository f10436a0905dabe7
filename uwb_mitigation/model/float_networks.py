"""The float network that a bundle stands for, to be fitted further, scaled or silenced. Needs no torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uwb_mitigation.errors import ModelError
from uwb_mitigation.model import graph
from uwb_mitigation.model.architecture import HEAD, Remnet
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.weights import FloatWeights, layer_inputs


def float_network(source: Bundle) -> FloatWeights:
    """The float network that an int8 bundle stands for; of a float bundle its own.

    Raises:
        ModelError: it is no REMNet.
    """
    if not isinstance(source.architecture, Remnet):
        raise ModelError("no REMNet to start from", where=str(source.path), valid="a bundle of `train`")
    if not source.quantised:
        return graph.float_weights(source.model, source.architecture)
    integers = graph.int8_weights(source.model, source.architecture)
    reads = layer_inputs(source.architecture)
    weight, bias = {}, {}
    for layer, values in integers.weight.items():
        scale = integers.weight_scale[layer]
        shaped = scale if layer == HEAD else scale[:, None, None]
        weight[layer] = (values * shaped).astype(np.float32)
        unit = integers.activation_scale[reads[layer]] * scale
        bias[layer] = (integers.bias[layer] * unit).astype(np.float32)
    return FloatWeights(source.architecture, weight, bias)


def scaled(network: FloatWeights, factor: float) -> FloatWeights:
    """The network that predicts `factor` times as much; with 0 it predicts nothing."""
    weight = {**network.weight, HEAD: network.weight[HEAD] * np.float32(factor)}
    bias = {**network.bias, HEAD: network.bias[HEAD] * np.float32(factor)}
    return replace(network, weight=weight, bias=bias)
