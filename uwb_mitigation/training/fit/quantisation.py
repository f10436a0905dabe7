"""Quantise float weights to int8 with scales from calibration inputs. This module does not import torch.

Weights are quantised symmetrically per filter and limited to 7 bits: two products of an unsigned and a signed byte
then fit the 16-bit sums of processors without VNNI, so that all processors give the same result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ModelError
from uwb_mitigation.mitigation.model import floating, graph
from uwb_mitigation.mitigation.model.architecture import HEAD
from uwb_mitigation.mitigation.model.bundle import Bundle, save_bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.requantisation import nudge
from uwb_mitigation.mitigation.model.weights import FloatWeights, Int8Weights, inputs_of
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset

WEIGHT_LIMIT = 63
"""Largest magnitude of an integer weight: 7 bits."""

MIN_SCALE_RATIO = 2.0**-12
"""Minimum ratio of the scales of a sum's operands: below 2^-14 of the result's scale, ONNX Runtime on ARM differs."""

CALIBRATION_PER_CONFIGURATION = 40
"""Number of inputs per configuration for computing the scales of the activations."""


def calibration_inputs(dataset: Dataset, seed: int) -> NDArray[np.float32]:
    """Return inputs of every configuration for `quantise_network`."""
    rows = splits.subsample(dataset.configurations, CALIBRATION_PER_CONFIGURATION, seed)
    return dataset.inputs[rows]


def quantise_network(
    weights: FloatWeights, calibration: NDArray[np.float32], *, exact: bool = True
) -> Int8Weights:
    """Quantise a network to int8.

    Args:
        weights: float network.
        calibration: inputs from which the scales are computed, float32 (n, K).
        exact: move scales by a few ulps where the integer arithmetic of the firmware needs it for bit-exact
            results (see `nudge`). Takes seconds and does not affect the accuracy.

    Raises:
        DatasetError: there are no calibration inputs, or they are not finite or of another length.
        ModelError: no scales allow exact integer arithmetic.
    """
    architecture = weights.architecture
    if calibration.ndim != 2 or calibration.shape[1] != architecture.samples or not len(calibration):
        raise DatasetError(
            f"calibration inputs of shape {calibration.shape}",
            valid=f"at least one of {architecture.samples} samples",
        )
    if not np.isfinite(calibration).all():
        raise DatasetError("calibration inputs with values that are not finite")
    weight_scale = {name: _weight_scale(name, weight) for name, weight in weights.weight.items()}
    inputs = inputs_of(architecture)
    scale = _activation_scales(_peaks(weights, calibration), weight_scale, inputs)
    integers, biases = {}, {}
    limits = np.iinfo(np.int32)
    for name, weight in weights.weight.items():
        # The first axis of the weights is the outputs; the head has one scale.
        unit = weight_scale[name].reshape(-1, *[1] * (weight.ndim - 1))
        rounded = np.clip(np.rint(weight / unit), -WEIGHT_LIMIT, WEIGHT_LIMIT)
        integers[name] = rounded.astype(np.int8)
        bias = np.rint(weights.bias[name].astype(float) / (scale[inputs[name][0]] * weight_scale[name]))
        biases[name] = np.clip(bias, limits.min, limits.max).astype(np.int32)
    quantised = Int8Weights(architecture, integers, weight_scale, biases, scale)
    return nudge(quantised) if exact else quantised


def check(source: Bundle) -> None:
    """Check the arguments of `quantise_bundle` before data is read; raises the same errors."""
    if source.card.quantised:
        raise ModelError("already quantised", where=source.path, valid="the float bundle it was made of")
    if not source.card.needs_cir:
        raise ModelError(
            "there is no network to quantise", where=source.path, valid="the bundle without quantisation"
        )


def quantise_bundle(source: Bundle, dataset: Dataset, output: Path) -> tuple[Bundle, NDArray[np.float32]]:
    """Quantise a float bundle with the data that it was trained on, and write it.

    Returns:
        The bundle, and its differences from float on the n calibration inputs, m, float32 (n,).

    Raises:
        ModelError: it is quantised already; see also `quantise_network`.
    """
    check(source)
    inputs = calibration_inputs(dataset, seed=0)
    network = graph.float_weights(source.model, source.card.architecture)
    integers = quantise_network(network, inputs)
    difference = np.abs(IntegerNetwork(integers).predict_m(inputs) - floating.predict_m(network, inputs))
    card = replace(source.card, name=output.stem, quantised=True)
    return save_bundle(output, graph.int8_model(integers), card), difference


def _weight_scale(name: str, weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return one scale for each filter; the head has one output."""
    peak = np.atleast_1d(np.abs(weight).max(axis=None if name == HEAD else tuple(range(1, weight.ndim))))
    # A filter of zeros has no peak and works with any scale: use that of the other filters.
    peak = np.where(peak > 0, peak, peak.max() if peak.any() else 1.0)
    return (peak / WEIGHT_LIMIT).astype(np.float32)


def _peaks(weights: FloatWeights, calibration: NDArray[np.float32]) -> dict[str, float]:
    """Return the value of each activation that maps to the largest integer: the maximum over chunks."""
    peaks: dict[str, float] = {}
    for start in range(0, len(calibration), floating.CHUNK):
        chunk = calibration[start : start + floating.CHUNK]
        for tensor, values in floating.activations(weights, chunk).items():
            peaks[tensor] = max(peaks.get(tensor, 0.0), float(values.max()))
    return peaks


def _activation_scales(
    peaks: Mapping[str, float],
    weight_scale: Mapping[str, NDArray[np.float32]],
    inputs: Mapping[str, tuple[str, ...]],
) -> dict[str, np.float32]:
    """Return scales at which 255 represents the peaks, or more where integer arithmetic requires it.

    It requires that a step of a convolution's output is at least 16 steps of its accumulator, that the scales of a sum's
    operands add up to at most twice its own scale, and that their ratio is at least `MIN_SCALE_RATIO`. This affects only
    tensors that are rarely active and operands that never peak together.
    """
    scale: dict[str, np.float32] = {}
    for tensor, peak in peaks.items():
        target = max(peak, 1e-6) / 255
        if tensor in weight_scale:
            target = max(target, 17 * float(scale[inputs[tensor][0]]) * float(weight_scale[tensor].max()))
        elif tensor != "input":
            first, second = inputs[tensor]
            least = MIN_SCALE_RATIO * float(max(scale[first], scale[second]))
            scale |= {name: np.float32(max(float(scale[name]), least)) for name in (first, second)}
            target = max(target, 0.501 * (float(scale[first]) + float(scale[second])))
        scale[tensor] = np.float32(target)
    return scale
