"""Conversion of an int8 network to the firmware's arrays: layouts, integer constants, range checks.

The layouts are documented in `firmware/src/uwb_mitigation.h` and `uwb_kernels.h`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.model import requantisation
from uwb_mitigation.mitigation.model.architecture import HEAD, Mlp, Remnet
from uwb_mitigation.mitigation.model.weights import Int8Weights, inputs_of

FILTERS = 16
FIRST_KERNELS = (3, 5)
SAMPLES = range(8, 158)
MODULES = range(1, 4)

_BLOCK = 8
_POSITION_ORDER = [0, 2, 4, 6, 1, 3, 5, 7]
_POSITION_SHIFT = 21
_MAX_WEIGHT = 63
_REMEDY = "quantise with `requantisation.nudge`, which moves scales by a few ulps"


class Channels(NamedTuple):
    """int32 (n,) each: the constants of `Requantisation`."""

    bias: NDArray[np.int32]
    multiplier: NDArray[np.int32]
    offset: NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class PackedModule:
    """Weights and requantisation of one residual reduction module."""

    residual_weights: NDArray[np.int32]
    residual: Channels
    residual_sum: requantisation.Sum
    reduce_weights: NDArray[np.int16]
    reduce: Channels
    skip: Channels
    output_sum: requantisation.Sum


@dataclass(frozen=True, slots=True, eq=False)
class PackedLayer:
    """Weights and requantisation of one fully connected layer."""

    weights: NDArray[np.int8]
    channels: Channels
    inputs: int
    outputs: int


@dataclass(frozen=True, slots=True, eq=False)
class PackedNetwork:
    """Network part of `uwb_model`: a REMNet has `modules`, an MLP has `layers`."""

    samples: int
    input_scale: np.float32
    head_weights: NDArray[np.int16]
    head_bias: int
    head_scale: np.float32
    first_kernel: int = 0
    first_weights: NDArray[np.int16] = field(default_factory=lambda: np.zeros((0, 0), np.int16))
    first: Channels | None = None
    modules: tuple[PackedModule, ...] = ()
    layers: tuple[PackedLayer, ...] = ()


def pack(weights: Int8Weights) -> PackedNetwork:
    """Return the packed network.

    Raises:
        ModelError: the firmware has no kernels for its shape, or a layer has no exact integer
            constants; the message names the layer and channel.
    """
    shape, scale = weights.architecture, weights.activation_scale
    layers = (
        _packed_layers(weights, shape) if isinstance(shape, Mlp) else _packed_convolutions(weights, shape)
    )
    return PackedNetwork(
        samples=shape.samples,
        input_scale=scale["input"],
        head_bias=_head_bias(weights.weight[HEAD].T, weights.bias[HEAD]),
        head_scale=np.float32(scale[inputs_of(shape)[HEAD][0]] * weights.weight_scale[HEAD][0]),
        **layers,
    )


def _packed_convolutions(weights: Int8Weights, shape: Remnet) -> dict[str, Any]:
    """Return the fields of `PackedNetwork` that only a REMNet has, and the head."""
    _check_shape(shape)
    scale, inputs = weights.activation_scale, inputs_of(shape)

    def total(name: str) -> requantisation.Sum:
        exact = requantisation.solve_sum(
            *(np.float32(scale[operand] / scale[name]) for operand in inputs[name])
        )
        if exact is None:
            raise ModelError("the sum has no exact integer form", where=name, valid=_REMEDY)
        return exact

    first = np.pad(weights.weight["first"][:, 0], ((0, 0), (0, 1))).astype(np.int16)
    modules = []
    for number in range(1, shape.modules + 1):
        name = f"module{number}"
        reduce = weights.weight[f"{name}.reduce"]
        taps = np.stack(
            [reduce[..., 0], reduce[..., 2], reduce[..., 1], weights.weight[f"{name}.skip"][..., 0]], -1
        )
        modules.append(
            PackedModule(
                _packed_taps(f"{name}.residual", weights.weight[f"{name}.residual"]),
                _channels(weights, f"{name}.residual"),
                total(f"{name}.sum"),
                _channel_pairs(taps).astype(np.int16).reshape(-1),
                _channels(weights, f"{name}.reduce"),
                _channels(weights, f"{name}.skip"),
                total(name),
            )
        )
    return {
        "head_weights": _head_words(_head_in_blocks(weights.weight[HEAD], shape)),
        "first_kernel": shape.first_kernel,
        "first_weights": first,
        "first": _channels(weights, "first"),
        "modules": tuple(modules),
    }


def _check_shape(shape: Remnet) -> None:
    """Raise ModelError if the firmware has no kernels for the shape."""
    for name, value, valid in (
        ("filters", shape.filters, (FILTERS,)),
        ("kernel", shape.kernel, (3,)),
        ("first_kernel", shape.first_kernel, FIRST_KERNELS),
        ("samples", shape.samples, SAMPLES),
        ("modules", shape.modules, MODULES),
    ):
        if value not in valid:
            raise ModelError(
                f"the firmware has no kernels for {name} = {value}",
                valid=" or ".join(map(str, valid)) if len(valid) < 3 else f"{valid[0]} to {valid[-1]}",
            )


def _packed_layers(weights: Int8Weights, shape: Mlp) -> dict[str, Any]:
    """Return the fields of `PackedNetwork` that only an MLP has, and the head; inputs and outputs are padded to multiples of 8."""
    layers = []
    for dense in shape.layers:
        outputs, inputs = (-(-size // 8) * 8 for size in (dense.outputs, dense.inputs))
        missing = outputs - dense.outputs
        padded = np.pad(weights.weight[dense.name], ((0, missing), (0, inputs - dense.inputs)))
        quads = padded.reshape(outputs // 4, 4, inputs // 4, 4).transpose(0, 2, 1, 3)
        layers.append(
            PackedLayer(
                _share_words(quads.reshape(-1, 2)),
                Channels(*(np.pad(values, (0, missing)) for values in _channels(weights, dense.name))),
                inputs,
                outputs,
            )
        )
    head = np.pad(weights.weight[HEAD][:, 0], (0, -shape.features % 8))
    return {"head_weights": _head_words(head), "layers": tuple(layers)}


def _channels(weights: Int8Weights, name: str) -> Channels:
    """Return the requantisation of a layer; raises ModelError if it has no exact integer form."""
    scale, bias = weights.activation_scale, weights.bias[name]
    (read,) = inputs_of(weights.architecture)[name]
    scales = requantisation.requantisation_scale(scale[read], weights.weight_scale[name], scale[name])
    low, high = requantisation.accumulator_range(weights.weight[name], bias)
    constants = np.empty((3, len(bias)), np.int32)
    for channel, scale in enumerate(scales):
        constant = requantisation.solve_requantisation(
            scale, int(low[channel]), int(high[channel]), int(bias[channel])
        )
        if constant is None:
            raise ModelError(
                f"channel {channel} has no exact integer requantisation (scale {scale!r}, "
                f"accumulators {low[channel]} to {high[channel]})",
                where=name,
                valid=_REMEDY,
            )
        constants[:, channel] = constant.bias, constant.multiplier, constant.offset
    return Channels(*constants)


def _packed_taps(name: str, weight: NDArray[np.int8]) -> NDArray[np.int32]:
    """Convert (filters, inputs, 3) to the words of `uwb_conv_residual.S`, int32 (filters * inputs * 2,).

    Raises:
        ModelError: weights with which the packed sums could overflow.
    """
    before, centre, after = np.moveaxis(weight.astype(np.int32), -1, 0)
    if np.abs([before, centre, after]).max() > _MAX_WEIGHT:
        raise ModelError("weights of more than 7 bits", where=name, valid=f"-{_MAX_WEIGHT} to {_MAX_WEIGHT}")
    return np.stack([centre, after + (before << _POSITION_SHIFT)], -1).reshape(-1)


def _channel_pairs(weight: NDArray[np.int8]) -> NDArray[np.int8]:
    """Convert (filters, inputs, taps) to pairs (filters * inputs / 2 * taps, 2)."""
    filters, inputs, taps = weight.shape
    pairs: NDArray[np.int8] = (
        weight.reshape(filters, inputs // 2, 2, taps).transpose(0, 1, 3, 2).reshape(-1, 2)
    )
    return pairs


def _share_words(pairs: NDArray[np.int8]) -> NDArray[np.int8]:
    """Interleave pairs (n, 2), n even: bytes p0 q0 p1 q1 of each two pairs, int8 (2 n,)."""
    return np.ascontiguousarray(pairs.reshape(-1, 2, 2).transpose(0, 2, 1)).reshape(-1)


def _head_in_blocks(weight: NDArray[np.int8], shape: Remnet) -> NDArray[np.int8]:
    """Return the head's weights in the order of the words of the last module, padded with zeros."""
    length = shape.lengths[-1]
    blocks = -(-length // _BLOCK)
    padded = np.pad(weight[:, 0].reshape(FILTERS, length), ((0, 0), (0, -length % _BLOCK)))
    return np.asarray(padded.reshape(FILTERS, blocks, _BLOCK)[..., _POSITION_ORDER].swapaxes(0, 1), np.int8)


def _head_words(weight: NDArray[np.int8]) -> NDArray[np.int16]:
    """Return pairs for `uwb_dot.S`, in which the first weight is multiplied."""
    factors = np.array([1 << (_POSITION_SHIFT - 16), 1], np.int16)
    return (weight.reshape(-1, 2) * factors).reshape(-1)


def _head_bias(weight: NDArray[np.int8], bias: NDArray[np.int32]) -> int:
    low, high = requantisation.accumulator_range(weight, bias)
    # Up to 2^23 the conversion to float is exact.
    if int(low[0]) < -(2**23) or int(high[0]) >= 2**23:
        raise ModelError(
            f"accumulators from {low[0]} to {high[0]}", where=HEAD, valid="magnitudes below 2^23"
        )
    return int(bias[0])
