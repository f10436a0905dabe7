"""Which scales to quantise activations with: the choices, compared on data of the training part alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.model.integer import IntegerNetwork
from uwb_mitigation.model.weights import FloatWeights, Int8Weights
from uwb_mitigation.training.quantization import MSE, quantize

CHOICES: Mapping[str, float | None] = {
    "max": 100.0,
    "p99.99": 99.99,
    "p99.9": 99.9,
    "p99": 99.0,
    "mse": MSE,
}
"""{name: percentile of `quantize`}."""

CALIBRATION_INPUTS = 512
CHECKED_INPUTS = 1024


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Attributes:
    mae_m: {choice: MAE of the int8 network on training inputs that it was not calibrated on, m}.
    best: the choice with the least; the first of equals.
    network: quantised with it, exact for the firmware.
    """

    mae_m: Mapping[str, float]
    best: str
    network: Int8Weights


def compare(
    weights: FloatWeights, inputs: NDArray[np.float32], targets: NDArray[np.floating], seed: int
) -> Calibration:
    """Quantise with every choice and keep the best, from inputs (n, K) and targets (n,) of the training part.

    Raises:
        DatasetError: there are fewer than two inputs.
        ModelError: see `quantize`.
    """
    if len(inputs) < 2:
        raise DatasetError(f"{len(inputs)} inputs to calibrate and to check on", valid="at least 2")
    order = np.random.default_rng(seed).permutation(len(inputs))
    count = min(CALIBRATION_INPUTS, len(inputs) // 2)
    seen, checked = inputs[order[:count]], order[count : count + CHECKED_INPUTS]
    errors = {}
    for name, percentile in CHOICES.items():
        network = IntegerNetwork(quantize(weights, seen, percentile, exact=False))
        left = targets[checked] - network.predict_m(inputs[checked])
        errors[name] = float(np.abs(left).mean())
    best = min(errors, key=lambda name: errors[name])
    return Calibration(errors, best, quantize(weights, seen, CHOICES[best]))
