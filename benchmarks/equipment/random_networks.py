"""Random int8 networks of any supported shape, and inputs that test every rounding.

The firmware is measured with them if there is no trained model of a shape, because instructions and memory do not
depend on the values of weights.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.model.architecture import HEAD, Architecture, Mlp, Remnet
from uwb_mitigation.mitigation.model.weights import FloatWeights, Int8Weights
from uwb_mitigation.training.fit.quantisation import quantise_network


def remnet(samples: int, first_kernel: int, modules: int = 3, seed: int = 0) -> Int8Weights:
    """A REMNet with random weights, quantised on random calibration inputs."""
    random = np.random.default_rng([seed, samples, first_kernel, modules])
    architecture = Remnet(samples, first_kernel=first_kernel, modules=modules)
    return _quantised(architecture, random, mean=0.1, head_sd=0.05)


def mlp(samples: int = 157, seed: int = 0) -> Int8Weights:
    """The paper's MLP with random weights, quantised on random calibration inputs."""
    random = np.random.default_rng([seed, samples])
    return _quantised(Mlp(samples), random, mean=0.0, head_sd=0.2)


def _quantised(
    architecture: Architecture, random: np.random.Generator, mean: float, head_sd: float
) -> Int8Weights:
    """Draw weights with a mean, and those of the head with a standard deviation, and quantise them."""
    weight, bias = {}, {}
    for layer in architecture.layers:
        sd = np.sqrt(2 / np.prod(layer.weight_shape[1:]))
        weight[layer.name] = random.normal(mean, sd, layer.weight_shape).astype(np.float32)
        bias[layer.name] = random.normal(0, 0.1, layer.weight_shape[0]).astype(np.float32)
    weight[HEAD] = random.normal(0, head_sd, (architecture.features, 1)).astype(np.float32)
    bias[HEAD] = random.normal(0, 0.1, 1).astype(np.float32)
    calibration = random.gamma(0.5, 0.5, (64, architecture.samples)).astype(np.float32)
    return quantise_network(FloatWeights(architecture, weight, bias), calibration)


def rounding_windows(samples: int, input_scale: np.float32, count: int, seed: int = 1) -> NDArray[np.float32]:
    """Windows, float32 (count, samples): noise at every level, impulses, zeros, saturation, ties of rounding."""
    random = np.random.default_rng([seed, samples])
    levels = np.exp(random.uniform(np.log(2), np.log(600), count))
    windows = random.uniform(0, 1, (count, samples)) * levels[:, None]
    windows[::5] = random.gamma(0.3, 1.0, windows[::5].shape) * levels[::5, None]
    windows[1::5] = random.integers(0, 2, windows[1::5].shape) * 255
    windows[2::5] = random.integers(0, 256, windows[2::5].shape) + 0.5
    windows[3::5] *= random.uniform(size=windows[3::5].shape) < 0.05
    windows[:1], windows[-1:] = 0, 1e6
    scaled: NDArray[np.float32] = (windows * float(input_scale)).astype(np.float32)
    return scaled
