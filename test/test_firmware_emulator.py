"""The Cortex-M4 kernels in an emulated processor equal ONNX Runtime bit by bit, within their budgets.

The emulator counts instructions exactly. It does not model wait states, caches and power.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import command_line
import firmware_models
import numpy as np
import pytest
from firmware_models import bits

from benchmarks.equipment import emulator, random_networks
from benchmarks.firmware import CLOCK_HZ
from benchmarks.paper import published
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.embedded import toolchain
from uwb_mitigation.mitigation.embedded.export import export_bundle
from uwb_mitigation.mitigation.embedded.toolchain import Kernels, Target
from uwb_mitigation.mitigation.model import requantisation
from uwb_mitigation.mitigation.model.bundle import Bundle, load_bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.shipped import default_model_path, shipped_model_path
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.types.measurement import RangeMeasurement, Record
from uwb_mitigation.types.offsets import Offsets

MISSING = toolchain.missing_tools()
pytestmark = pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not found: {toolchain.APT}")

TIMES_THE_PAPER = {157: 9.0, 128: 9.0, 64: 9.0, 32: 9.0, 16: 8.5}
"""Minimum rate at 64 MHz, estimated, k0 = 3."""


@pytest.mark.parametrize("shape", firmware_models.SHAPES, ids=str)
def test_kernels_equal_onnx_runtime_within_the_budgets(shape: tuple[int, int, int], tmp_path: Path):
    _, subject, windows = firmware_models.exported(shape, tmp_path)
    image = toolchain.compile_image(tmp_path, tmp_path, Target.QEMU_MPS2)
    result = emulator.run_windows(image, windows)
    assert not result.records["status"].any()
    assert np.array_equal(bits(result.records["output_m"]), bits(subject.expect(windows)))
    assert result.stack_bytes <= 512
    if shape not in firmware_models.PUBLISHED:
        return
    if subject.network == "mlp":
        assert result.instructions <= 75_000
        return
    assert result.arena_bytes <= 10_600
    assert emulator.measure_size(tmp_path, tmp_path).flash_bytes <= 27_000
    first_kernel, samples, _ = shape
    if samples in TIMES_THE_PAPER and (first_kernel == 3 or samples in (157, 16)):
        cycles = emulator.estimate_cycles(image, emulator.count_executed(image, windows[0]))
        paper_hz = published.MODELS["remnet", samples].board[0]
        slower = 0.98 if first_kernel == 5 else 1.0
        assert CLOCK_HZ / cycles >= slower * TIMES_THE_PAPER[samples] * paper_hz


@pytest.mark.parametrize("kernels", list(Kernels))
def test_packed_sums_do_not_overflow_with_the_largest_weights_and_inputs(tmp_path: Path, kernels: Kernels):
    weights = random_networks.remnet(32, 3)
    largest = np.full((16, 16, 3), 63, np.int8)
    largest[1::4] = -63
    largest[2::4, :, 1] = -63
    largest[3::4, :, ::2] = -63
    extreme = {**weights.weight, "module1.residual": largest, "module2.residual": -largest}
    bias = {**weights.bias, "first": np.full(16, 100_000, np.int32)}
    weights = requantisation.nudge(replace(weights, weight=extreme, bias=bias))
    windows = np.full((1, 32), 1e4, np.float32)
    reference = IntegerNetwork(weights)
    assert (reference.tensors(windows)["first"] == 255).all(), "the test needs the largest inputs"
    firmware_models.write_model(tmp_path, weights)
    image = toolchain.compile_image(tmp_path, tmp_path, Target.QEMU_MPS2, kernels)
    result = emulator.run_windows(image, windows)
    assert np.array_equal(bits(result.records["output_m"]), bits(reference.predict_m(windows)))


def check_corrections(
    bundle: Bundle, measurements: Sequence[RangeMeasurement], folder: Path, offset_m: float = 0.0
) -> set[int]:
    """Compare the corrections of the board with those of the mitigator; return the statuses."""
    export_bundle(bundle, folder)
    image = toolchain.compile_image(folder, folder, Target.QEMU_MPS2)
    result = emulator.run_measurements(
        image, measurements, bundle.card.architecture.samples, offset_m=offset_m
    )
    assert result.model_id == bundle.model_id
    corrected = Mitigation(bundle, Offsets(offset_m)).correct(measurements)
    faults, windows = bundle.card.preprocessing.windows_of(measurements)
    for expected, fault, window, row in zip(corrected, faults, windows, result.records, strict=True):
        assert row["range_status"] == int(expected.status)
        values = [expected.range_m, expected.correction_m, expected.variance_m2]
        computed = [row["range_m"], row["correction_m"], row["variance_m2"]]
        assert np.array_equal(bits(np.array(computed)), bits(np.array(values)))
        if not fault:
            assert np.array_equal(bits(row["window"]), bits(window))
    return set(result.records["range_status"].tolist())


@pytest.mark.parametrize("is_strict", [False, True], ids=["any CIR", "with an OOD detector"])
def test_good_and_hostile_measurements_are_corrected_as_by_the_mitigator(is_strict: bool, tmp_path: Path):
    bundle_in = firmware_models.strict_bundle if is_strict else firmware_models.exact_bundle
    random = np.random.default_rng(3)
    measurements = [firmware_models.random_measurement(random) for _ in range(500)]
    assert check_corrections(bundle_in(tmp_path), measurements, tmp_path, 0.22 * is_strict) >= {0, 1, 2, 3}


@pytest.mark.parametrize(
    "shipped",
    [default_model_path(), shipped_model_path("evk1000_apartment"), default_model_path(Scaling.MAX)],
    ids=lambda path: path.stem,
)
def test_real_logs_are_corrected_as_by_the_mitigator(
    shipped: Path, apartment_reading: list[Record], tmp_path: Path
):
    measurements = [record.measurement for record in apartment_reading[::10]]
    assert 0 in check_corrections(load_bundle(shipped), measurements, tmp_path)


def test_image_of_the_dwm1001_dev_fits_and_is_written_as_hex(tmp_path: Path):
    done = command_line.run("board build-image -o radio.hex --json image.json", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "image.json").read_text())
    assert result["flash_bytes"] < 48 << 10
    assert result["ram_bytes"] < 48 << 10, "the rest of 64 kB is the stack's"
    lines = (tmp_path / "radio.hex").read_text().splitlines()
    assert lines[0].startswith(":10000000")
    assert lines[-1] == ":00000001FF"
    for line in lines:
        assert sum(bytes.fromhex(line[1:])) % 256 == 0
