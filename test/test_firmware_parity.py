"""The C library, compiled for this computer, equals the numpy oracle and ONNX Runtime on every output bit."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import firmware_models
import numpy as np
import onnxruntime
import pytest

from uwb_mitigation.firmware_export.host import HostFirmware
from uwb_mitigation.measurement import Cir, Encoding
from uwb_mitigation.model import graph
from uwb_mitigation.model.integer import IntegerNetwork
from uwb_mitigation.model.session import session_options
from uwb_mitigation.preprocessing import WINDOW_SIZES, Preprocessing, Scaling

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: apt install gcc")

# Undefined behaviour ends the process, so that a finding cannot pass unseen.
SANITIZED = ("-fsanitize=undefined", "-fno-sanitize-recover=all")


def bits(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, np.float32).view(np.uint32)


def test_oracle_windows_are_not_all_alike():
    weights = firmware_models.random_remnet(157, 3)
    windows = firmware_models.pressing_windows(157, float(weights.activation_scale["input"]), 500)
    assert len(np.unique(IntegerNetwork(weights).predict_m(windows))) > 300


@pytest.mark.parametrize("first_kernel", [3, 5])
@pytest.mark.parametrize("samples", WINDOW_SIZES)
def test_c_equals_oracle_and_onnx_runtime(samples: int, first_kernel: int, tmp_path: Path):
    weights = firmware_models.random_remnet(samples, first_kernel)
    firmware_models.write_remnet(tmp_path, weights)
    windows = firmware_models.pressing_windows(samples, float(weights.activation_scale["input"]), 5000)
    session = onnxruntime.InferenceSession(
        graph.int8_model(weights), session_options(), providers=["CPUExecutionProvider"]
    )

    expected = bits(session.run(None, {"cir": windows[:, None, :]})[0][:, 0])
    checked = windows[: 40_000 // samples]

    assert np.array_equal(bits(IntegerNetwork(weights).predict_m(checked)), expected[: len(checked)])
    # The portable path takes a millisecond for a window of 157: the emulator's tests run all of them.
    computed = HostFirmware(tmp_path, tmp_path).predict_m(checked)
    assert np.array_equal(bits(computed), expected[: len(checked)])


@pytest.mark.parametrize("samples", [9, 12, 23, 40, 81, 156])
@pytest.mark.parametrize("modules", [1, 2, 3])
def test_any_length_and_number_of_modules(samples: int, modules: int, tmp_path: Path):
    weights = firmware_models.random_remnet(samples, 3, modules)
    firmware_models.write_remnet(tmp_path, weights)
    windows = firmware_models.pressing_windows(samples, float(weights.activation_scale["input"]), 40)
    computed = HostFirmware(tmp_path, tmp_path, SANITIZED).predict_m(windows)
    assert np.array_equal(bits(computed), bits(IntegerNetwork(weights).predict_m(windows)))


def test_mlp_equals_its_oracle(tmp_path: Path):
    weights = firmware_models.random_mlp()
    firmware_models.write_mlp(tmp_path, weights)
    windows = firmware_models.pressing_windows(157, float(weights.input_scale), 2000)
    computed = HostFirmware(tmp_path, tmp_path, SANITIZED).predict_m(windows)
    assert np.array_equal(bits(computed), bits(weights.predict_m(windows)))


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> dict[Scaling, HostFirmware]:
    """A small model for each scaling."""
    built = {}
    for scaling in Scaling:
        folder = tmp_path_factory.mktemp(scaling.value)
        identity = firmware_models.identity(scaling=scaling)
        firmware_models.write_remnet(folder, firmware_models.random_remnet(32, 3), identity)
        built[scaling] = HostFirmware(folder, folder, SANITIZED)
    return built


def random_cir(random: np.random.Generator) -> Cir:
    """A CIR that is usable about half of the time; float fields hold binary32 values."""

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
    first = random.choice(
        [math.nan, math.inf, 1e30, -1e30, 3e9, start + random.uniform(0, 120)], p=[0.05] * 5 + [0.75]
    )
    scale = random.choice([1.0, 0.37, 12.5, 0.0, -1.0, math.nan, math.inf], p=[0.5, 0.2, 0.2] + [0.025] * 4)
    preamble = int(random.choice([0, 1, 118, 65535], p=[0.1, 0.2, 0.6, 0.1]))
    return Cir(
        samples,
        encoding,
        start_index=start,
        first_path_index=single(first),
        scale=single(scale),
        preamble_count=preamble,
    )


@pytest.mark.parametrize("scaling", list(Scaling))
def test_preprocessing_gives_the_same_bits_and_the_same_faults(
    scaling: Scaling, firmware: dict[Scaling, HostFirmware]
):
    random = np.random.default_rng(7)
    preprocessing = Preprocessing(32, scaling)
    expected, computed = np.zeros(32, np.float32), np.zeros(32, np.float32)
    faults = set()
    for _ in range(3000):
        cir = random_cir(random)
        fault = preprocessing.apply(cir, expected)
        assert firmware[scaling].preprocess(cir, computed) == fault
        if fault is None:
            assert np.array_equal(bits(computed), bits(expected))
        faults.add(fault)
    assert len(faults) >= 8
    assert None in faults
