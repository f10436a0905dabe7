"""Exported random networks, and valid, hostile and real measurements, for tests of the firmware."""

import itertools
import math
from dataclasses import replace
from pathlib import Path

import model_material
import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.equipment import random_networks
from benchmarks.firmware import Network, network_of
from benchmarks.paper import published
from uwb_mitigation.mitigation.embedded.export import Golden, golden_windows, write_header
from uwb_mitigation.mitigation.embedded.packing import pack
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.bundle import Bundle, save_bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.ood import Band, OodBands
from uwb_mitigation.mitigation.model.weights import Int8Weights
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.types.measurement import Cir, Encoding, RangeMeasurement

MODEL_ID = 0x1234ABCD
SCALE = ((0.0, 0.25), (32.0, 0.375), (64.0, 1.5), (256.0, 40.0))
"""For the random networks, whose outputs are large."""


def bits(values: ArrayLike) -> NDArray[np.uint32]:
    return np.asarray(values, np.float32).view(np.uint32)


def write_model(folder: Path, weights: Int8Weights, **changes: object) -> Path:
    """Export a network with the card of `model_material` and `changes`."""
    network = pack(weights)
    windows = golden_windows(network)
    golden = Golden(windows, IntegerNetwork(weights).predict_m(windows))
    card = model_material.card(weights.architecture, **({"linear_bias": LinearBiasModel(0.25)} | changes))
    return write_header(folder, network, card, MODEL_ID, golden)


def exact_bundle(
    folder: Path, samples: int = 32, weights: Int8Weights | None = None, **changes: object
) -> Bundle:
    """Return a bundle with exportable scales and a linear bias model that needs levels; by default a random REMNet."""
    weights = weights or random_networks.remnet(samples, 3)
    card = model_material.card(weights.architecture, correction_limits_m=(-500.0, 500.0), **changes)
    return save_bundle(folder / "exact.onnx", graph.int8_model(weights), card)


def strict_bundle(folder: Path, samples: int = 32, scaling: Scaling = Scaling.PREAMBLE) -> Bundle:
    """Bundle whose OOD detector rates random measurements as in distribution, between, and out of distribution."""
    peak, lead = Band(0.5, 3.0, 2.0), Band(-40.0, -12.0, 10.0)
    if scaling is Scaling.MAX:
        preprocessing, bands = Preprocessing(samples, scaling), OodBands(0.125, peak, lead_level_db=lead)
        return exact_bundle(folder, samples, scale=SCALE, ood_bands=bands, preprocessing=preprocessing)
    levels = Band(-90.0, -81.0, 40.0), Band(-5.0, 8.0, 20.0)
    shape = Band(-10.0, 200.0, 50.0), Band(20.0, 101.0, 70.0)
    return exact_bundle(folder, samples, scale=SCALE, ood_bands=OodBands(0.125, peak, *levels, *shape, lead))


def random_cir(random: np.random.Generator) -> Cir:
    """Draw a CIR, about half of them usable; float fields contain binary32 values."""

    def single(value: float) -> float:
        return float(np.float32(value))

    encoding = Encoding(random.integers(0, 2))
    samples = random.integers(-3000, 3000, random.choice([0, 1, 60, 200, 315, 2032])).astype(np.int16)
    if encoding is Encoding.MAGNITUDE and random.random() < 0.9:
        samples = np.abs(samples)
    if random.random() < 0.1:
        samples[:] = 0
    if random.random() < 0.1 and len(samples):
        samples[random.integers(0, len(samples), 30)] = random.choice([32767, -32768, 32766])
    start = int(random.choice([0, 700, -5, 2**31 - 1, -(2**31)]))
    hostile = [math.nan, math.inf, 1e30, -1e30, 3e9]
    first = random.choice([*hostile, start + random.uniform(0, 120)], p=[0.05] * 5 + [0.75])
    limits = [np.nextafter(np.float32(limit), np.float32(1)) for limit in (1e-30, 1e30)]
    odd = [0.0, -1.0, math.nan, math.inf, 1e-30, 1e30, 1e-40, 1e-29, *limits]
    scale = random.choice([1.0, 0.37, 12.5, *odd], p=[0.4, 0.2, 0.2, *[0.2 / len(odd)] * len(odd)])
    preamble = int(random.choice([0, 1, 118, 65535], p=[0.1, 0.2, 0.6, 0.1]))
    floats = {"first_path_index": single(first), "scale": single(scale)}
    return Cir(samples, encoding, start, preamble_count=preamble, **floats)


def random_measurement(random: np.random.Generator) -> RangeMeasurement:
    """Draw a measurement, about half of them hostile."""
    plausible = model_material.cir(int(random.integers(0, 50)))
    cir = random_cir(random) if random.random() < 0.4 else plausible
    powers = random.choice([-80.5, -91.25, -1e4, math.nan, math.inf], 2, p=[0.45, 0.45, 0.04, 0.03, 0.03])
    cir = replace(cir, rx_power_dbm=float(powers[0]), first_path_power_dbm=float(powers[1]))
    range_m = random.choice([3.25, 0.0, -1.0, math.nan, 1e7], p=[0.8, 0.05, 0.05, 0.05, 0.05])
    return RangeMeasurement(1, 2, 3, 4, 5, float(range_m), cir)


PUBLISHED = [*itertools.product((3, 5), published.WINDOWS, (3,)), (0, 157, 0)]
SHAPES = [*PUBLISHED, (3, 9, 1), (3, 12, 2), (3, 23, 3), (3, 40, 2), (3, 81, 3), (3, 156, 1)]
"""First kernel (0: MLP), length and number of modules of each tested network."""


def exported(shape: tuple[int, int, int], folder: Path) -> tuple[Int8Weights, Network, NDArray[np.float32]]:
    """Export a random network of a shape; also return windows that test every rounding."""
    first_kernel, samples, modules = shape
    if first_kernel:
        weights = random_networks.remnet(samples, first_kernel, modules)
    else:
        weights = random_networks.mlp(samples)
    write_model(folder, weights)
    subject = network_of(weights, None, MODEL_ID, graph.int8_model(weights))
    count = 120 if shape in PUBLISHED else 60
    windows = random_networks.rounding_windows(samples, weights.activation_scale["input"], count)
    return weights, subject, windows
