"""Random int8 networks, inputs that press on every rounding, and bundles of them, for the firmware's tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uwb_mitigation.firmware_export.export import golden_windows, write_header
from uwb_mitigation.firmware_export.header import Golden, Identity
from uwb_mitigation.firmware_export.mlp import PAPER_LAYERS, Int8Dense, Int8Mlp, nudge_mlp
from uwb_mitigation.firmware_export.packing import pack_mlp, pack_remnet
from uwb_mitigation.firmware_export.requantisation import nudge
from uwb_mitigation.model.architecture import HEAD, Remnet
from uwb_mitigation.model.integer import IntegerNetwork
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.model.weights import FloatWeights, Int8Weights
from uwb_mitigation.preprocessing import Scaling
from uwb_mitigation.training.quantization import quantize


def identity(
    scaling: Scaling = Scaling.PREAMBLE,
    prior: LinePrior | None = None,
    limits_m: tuple[float, float] = (-4.0, 4.0),
) -> Identity:
    return Identity("random", 0x1234ABCD, scaling, prior or LinePrior(0.25), limits_m, 0.0625, 0.25)


def random_remnet(samples: int, first_kernel: int, modules: int = 3, seed: int = 0) -> Int8Weights:
    random = np.random.default_rng([seed, samples, first_kernel, modules])
    architecture = Remnet(samples, first_kernel=first_kernel, modules=modules)
    weight, bias = {}, {}
    for layer in architecture.convolutions:
        fan_in = layer.inputs * layer.kernel
        shape = (layer.filters, layer.inputs, layer.kernel)
        weight[layer.name] = random.normal(0.1, np.sqrt(2 / fan_in), shape).astype(np.float32)
        bias[layer.name] = random.normal(0, 0.1, layer.filters).astype(np.float32)
    weight[HEAD] = random.normal(0, 0.05, (architecture.features, 1)).astype(np.float32)
    bias[HEAD] = random.normal(0, 0.1, 1).astype(np.float32)
    calibration = random.gamma(0.5, 0.5, (64, samples)).astype(np.float32)
    return nudge(quantize(FloatWeights(architecture, weight, bias), calibration))


def random_mlp(samples: int = 157, seed: int = 0) -> Int8Mlp:
    random = np.random.default_rng([seed, samples])
    layers, inputs, input_scale = [], samples, np.float32(0.011)
    values = random.integers(0, 256, (256, samples))
    scale = input_scale
    for outputs in PAPER_LAYERS:
        weight = random.integers(-63, 64, (outputs, inputs)).astype(np.int8)
        bias = random.integers(-20000, 20000, outputs).astype(np.int32)
        weight_scale = random.uniform(0.001, 0.003, outputs).astype(np.float32)
        reals = np.maximum(values @ weight.T.astype(int) + bias, 0) * (scale * weight_scale)
        output_scale = np.float32(np.percentile(reals, 99) / 255)
        values = np.clip(np.rint(reals / output_scale), 0, 255).astype(int)
        layers.append(Int8Dense(weight, bias, weight_scale, output_scale))
        inputs, scale = outputs, output_scale
    head = random.integers(-63, 64, inputs).astype(np.int8)
    return nudge_mlp(Int8Mlp(input_scale, tuple(layers), head, -1234, np.float32(0.002)))


def pressing_windows(samples: int, input_scale: float, count: int, seed: int = 1) -> np.ndarray:
    """Windows: noise at every level, impulses, zeros, saturation, ties of the input's rounding."""
    random = np.random.default_rng([seed, samples])
    levels = np.exp(random.uniform(np.log(2), np.log(600), count))
    windows = random.uniform(0, 1, (count, samples)) * levels[:, None]
    windows[::5] = random.gamma(0.3, 1.0, windows[::5].shape) * levels[::5, None]
    windows[1::5] = random.integers(0, 2, windows[1::5].shape) * 255
    windows[2::5] = random.integers(0, 256, windows[2::5].shape) + 0.5
    sparse = windows[3::5]
    sparse[random.uniform(size=sparse.shape) < 0.95] = 0
    windows[0], windows[-1] = 0, 1e6
    return (windows * input_scale).astype(np.float32)


def write_remnet(folder: Path, weights: Int8Weights, card: Identity | None = None) -> Path:
    network = pack_remnet(weights)
    windows = golden_windows(network)
    return write_header(
        folder, network, card or identity(), Golden(windows, IntegerNetwork(weights).predict_m(windows))
    )


def write_mlp(folder: Path, weights: Int8Mlp, card: Identity | None = None) -> Path:
    network = pack_mlp(weights)
    windows = golden_windows(network)
    return write_header(folder, network, card or identity(), Golden(windows, weights.predict_m(windows)))
