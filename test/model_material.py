"""Networks, bundles and measurements for tests of models; all seeded."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import HEAD, Architecture, Remnet
from uwb_mitigation.mitigation.model.bundle import Bundle, ModelCard, save_bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.weights import FloatWeights, Int8Weights
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit.quantisation import quantise_network
from uwb_mitigation.types.measurement import Cir, Encoding, RangeMeasurement, Record, Truth

LINE = LinearBiasModel(*(float(np.float32(value)) for value in (-5.0, -0.0691, -0.0126)))


def random_weights(architecture: Architecture, seed: int = 0) -> FloatWeights:
    """Return the weights of a new network, with nonzero biases and head."""
    generator = np.random.default_rng(seed)
    weight, bias = {}, {}
    for layer in architecture.layers:
        spread = math.sqrt(2 / math.prod(layer.weight_shape[1:]))
        weight[layer.name] = generator.normal(0, spread, layer.weight_shape).astype(np.float32)
        bias[layer.name] = generator.normal(0, 0.1, layer.weight_shape[0]).astype(np.float32)
    weight[HEAD] = generator.normal(0, 0.02, (architecture.features, 1)).astype(np.float32)
    bias[HEAD] = generator.normal(0, 0.1, 1).astype(np.float32)
    return FloatWeights(architecture, weight, bias)


def integer_network(bundle: Bundle) -> IntegerNetwork:
    """Return the expected output of an int8 bundle."""
    return IntegerNetwork(graph.int8_weights(bundle.model, bundle.card.architecture))


def windows(count: int, samples: int, seed: int = 0) -> np.ndarray:
    """Return network inputs with realistic levels and decay, float32 (count, samples)."""
    generator = np.random.default_rng(seed)
    decay = 0.1 + np.exp(-np.arange(samples) / 12)
    return (generator.gamma(2.0, 0.3, (count, samples)) * decay).astype(np.float32)


def random_int8(architecture: Remnet, seed: int = 0, *, exact: bool = True) -> Int8Weights:
    """Return a quantised network. Without `exact`, its scales suit neither the firmware nor all processors."""
    weights = random_weights(architecture, seed)
    return quantise_network(weights, windows(64, architecture.samples, seed), exact=exact)


def card(architecture: Remnet, *, quantised: bool = True, **changes: object) -> ModelCard:
    options: dict[str, object] = {
        "name": "material",
        "architecture": architecture,
        "preprocessing": Preprocessing(architecture.samples, Scaling.PREAMBLE),
        "linear_bias": LINE,
        "quantised": quantised,
        "variance_m2": 0.0625,
        "variance_uncorrected_m2": 0.5,
        "correction_limits_m": (-4.0, 8.0),
        "training": {"data": "none"},
    }
    return ModelCard(**(options | changes))  # type: ignore[arg-type]


def bundle(folder: Path, architecture: Remnet | None = None, *, seed: int = 0, **changes: object) -> Bundle:
    """Write an int8 bundle of random weights to `folder`."""
    architecture = architecture or Remnet(samples=32)
    model = graph.int8_model(random_int8(architecture, seed))
    return save_bundle(folder / "material.onnx", model, card(architecture, **changes))


def cir(seed: int = 0, **changes: object) -> Cir:
    """Return a complex CIR of 1016 samples with the first path at 745.3."""
    generator = np.random.default_rng(seed)
    samples = generator.normal(0, 60, 2 * 1016)
    samples[2 * 745 : 2 * 785] += generator.normal(0, 2500, 80)
    options: dict[str, object] = {
        "samples": samples.clip(-30000, 30000).astype(np.int16),
        "first_path_index": 745.3125,
        "preamble_count": 300,
        "noise_threshold": 1500,
        "rx_power_dbm": -82.0,
        "first_path_power_dbm": -88.0,
        "channel": 2,
        "prf_mhz": 64,
    }
    return Cir(**(options | changes))  # type: ignore[arg-type]


def amplitudes_only(of: Cir, **changes: object) -> Cir:
    """Return the CIR as amplitudes without a preamble count, as some boards send it."""
    magnitude = np.hypot(*of.samples.reshape(-1, 2).astype(float).T).clip(max=32000).astype(np.int16)
    return replace(of, samples=magnitude, encoding=Encoding.MAGNITUDE, preamble_count=0, **changes)  # type: ignore[arg-type]


def window_of(of: Cir, preprocessing: Preprocessing) -> tuple[int, np.ndarray]:
    """Return the fault of a CIR (0: no fault) and its window."""
    (fault,), (window,) = preprocessing.windows_of([RangeMeasurement(0, 1, 2, 0, 0, 3.0, of)])
    return fault, window


def measurement(range_m: float = 3.0, seed: int = 0, **changes: object) -> RangeMeasurement:
    """Return a measurement with `changes` of its CIR."""
    return RangeMeasurement(
        stamp_ns=seed,
        tag_id=1,
        anchor_id=2,
        sequence=seed,
        device_time=seed,
        range_m=range_m,
        cir=cir(seed, **changes),
    )


def record(seed: int = 0, configuration: str = "1", **changes: object) -> Record:
    """Return a measurement with an error of 0.25 m."""
    return Record(measurement(3.25, seed, **changes), Truth(3.0, "LOS", configuration))


def changed(of: Record, cir: Cir | dict[str, object] | None = None, **changes: object) -> Record:
    """Return a record with another CIR, or changes of it, and changes of its measurement."""
    if cir is not None:
        changes["cir"] = cir if isinstance(cir, Cir) else replace(of.measurement.cir, **cir)  # type: ignore[arg-type]
    return replace(of, measurement=replace(of.measurement, **changes))  # type: ignore[arg-type]


class Recorded(list):  # type: ignore[type-arg]
    """A recording in memory."""

    simulated = False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


def dataset(configurations: int = 12, each: int = 20, samples: int = 32, seed: int = 0) -> Dataset:
    """Return a dataset whose error is linear in the levels plus the level of the first inputs."""
    generator = np.random.default_rng(seed)
    count = configurations * each
    names = np.repeat([f"c{number}" for number in range(configurations)], each)
    rx_power = np.repeat(generator.uniform(-95, -78, configurations), each) + generator.normal(0, 0.2, count)
    gap = np.repeat(generator.uniform(3, 15, configurations), each) + generator.normal(0, 0.2, count)
    inputs = windows(count, samples, seed)
    error = -5.1 - 0.069 * rx_power - 0.0126 * gap + 0.3 * inputs[:, :6].mean(axis=1)
    return Dataset(
        Preprocessing(samples),
        inputs,
        rx_power.astype(np.float32),
        (rx_power - gap).astype(np.float32),
        3.0 + error,
        error,
        names,
        np.where(error > 0.5, "NLOS", "LOS"),
    )
