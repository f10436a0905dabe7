"""The natively compiled C library, also as backend of the mitigator, equals numpy and ONNX Runtime bit by bit."""

from __future__ import annotations

import platform
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import firmware_models
import model_material
import numpy as np
import pytest
from compilers import NEEDS_CC
from firmware_models import bits

from benchmarks.equipment import random_networks
from uwb_mitigation.errors import MissingDependencyError, UwbMitigationError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.embedded import compiling
from uwb_mitigation.mitigation.embedded.compiled import CompiledFirmware, FirmwareMitigation, link
from uwb_mitigation.mitigation.embedded.compiling import BOARD, CORRECTION, firmware_folder, run_tool
from uwb_mitigation.mitigation.embedded.export import export_bundle
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import HEAD
from uwb_mitigation.mitigation.model.bundle import save_bundle
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.ros.codec import encode_range

if TYPE_CHECKING:
    from ros_harness import Ros

pytestmark = NEEDS_CC

# Undefined behaviour ends the process, so that it is always detected.
SANITIZED = ("-O1", "-fsanitize=undefined", "-fno-sanitize-recover=all")


@pytest.mark.parametrize("shape", firmware_models.SHAPES, ids=str)
def test_c_and_reference_equal_onnx_runtime(shape: tuple[int, int, int], tmp_path: Path):
    weights, subject, windows = firmware_models.exported(shape, tmp_path)
    expected = bits(subject.expect(windows))
    assert np.array_equal(bits(IntegerNetwork(weights).predict_m(windows)), expected)
    flags = () if shape in firmware_models.PUBLISHED else SANITIZED
    assert np.array_equal(bits(CompiledFirmware(tmp_path, tmp_path, flags).predict_m(windows)), expected)


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("sign", [-1, 1])
def test_overflowing_prediction_is_a_model_error_as_in_the_mitigator(sign: int, tmp_path: Path):
    weights = random_networks.remnet(16, 3)
    scales = {**weights.weight_scale, HEAD: np.array([1e31], np.float32)}
    model = graph.int8_model(replace(weights, weight_scale=scales))
    largest = LinearBiasModel(sign * float(np.finfo(np.float32).max))
    card = model_material.card(weights.architecture, linear_bias=largest, correction_limits_m=(-500.0, 500.0))
    bundle = save_bundle(tmp_path / "huge.onnx", model, card)
    export_bundle(bundle, tmp_path)
    firmware, mitigation = CompiledFirmware(tmp_path, tmp_path, SANITIZED), Mitigation(bundle)
    measurement = model_material.measurement()
    expected = mitigation.correct([measurement])[0]
    # The output of this network is large and negative: one product overflows, the other is finite.
    assert expected.status is (Status.MODEL_ERROR if sign < 0 else Status.OUT_OF_DISTRIBUTION)
    computed = firmware.correct(measurement.range_m, measurement.cir)
    assert computed == (expected.range_m, 0.0, expected.variance_m2, int(expected.status))


def build_program(name: str, export: Path, flags: Sequence[str] = ()) -> str:
    """Compile a program of `firmware/test/` with the model in `export`."""
    sources = {"fuzz_link": BOARD, "fuzz_radio": "uwb_[dt]*.c"}.get(name, CORRECTION)
    return str(link(firmware_folder() / "test" / f"{name}.c", export, export / name, flags, sources))


ADDRESS_SANITIZED = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def test_golden_vectors_pass_under_the_sanitizers_and_detect_a_changed_weight(tmp_path: Path):
    header = firmware_models.write_model(tmp_path, random_networks.remnet(64, 5))
    assert "0 of 8 golden vectors wrong" in run_tool([build_program("golden", tmp_path, ADDRESS_SANITIZED)])
    text = header.read_text()
    start = text.index("{\n", text.index("uwb_module1_residual_weights[")) + 2
    first = text[start : text.index(",", start)].strip()
    header.write_text(text[:start] + text[start:].replace(first, str(int(first) ^ 32), 1))
    with pytest.raises(UwbMitigationError, match="exit 1"):
        run_tool([build_program("golden", tmp_path)])


@pytest.mark.parametrize("scaling", list(Scaling))
def test_arbitrary_cirs_pass_the_sanitizers(scaling: Scaling, tmp_path: Path):
    firmware_models.write_model(
        tmp_path,
        random_networks.remnet(16, 3),
        preprocessing=Preprocessing(16, scaling),
        linear_bias=model_material.LINE,
        correction_limits_m=(-1e4, 1e4),
    )
    seen = run_tool([build_program("fuzz_correct", tmp_path, ADDRESS_SANITIZED), "4000", "1"])
    statuses = {int(line.split()[1].rstrip(":")) for line in seen.splitlines()}
    assert {0, 4, 5, 6, 7, 9, 12, 14} <= statuses


def test_arbitrary_bytes_to_a_board_pass_the_sanitizers(tmp_path: Path):
    firmware_models.write_model(tmp_path, random_networks.remnet(16, 3))
    run_tool([build_program("fuzz_link", tmp_path, ADDRESS_SANITIZED), "1000", "1"])


def test_arbitrary_frames_and_registers_of_a_radio_yield_no_false_range(tmp_path: Path):
    words = run_tool([build_program("fuzz_radio", tmp_path, ADDRESS_SANITIZED), "300", "1"]).split()
    ranged, refused = (int(words[position]) for position in (0, 2))
    assert ranged > 1000
    assert refused > 5000


@pytest.mark.skipif(shutil.which("cmake") is None, reason="no CMake: apt install cmake")
def test_plain_cmake_builds_the_library_and_passes_its_test(tmp_path: Path):
    firmware_models.write_model(tmp_path, random_networks.remnet(16, 3))
    build = tmp_path / "build"
    run_tool(["cmake", "-S", str(firmware_folder()), "-B", str(build), f"-DUWB_MODEL_DIR={tmp_path}"])
    run_tool(["cmake", "--build", str(build)])
    run_tool(["ctest", "--test-dir", str(build)])


@pytest.mark.parametrize(
    "flags",
    [
        ("-ffast-math",),
        ("-O2", "-Ofast"),
        ("-U__FLT_EVAL_METHOD__", "-D__FLT_EVAL_METHOD__=1"),
        ("-U__FLT_EVAL_METHOD__", "-D__FLT_EVAL_METHOD__=2"),
        pytest.param(
            ("-m32", "-mno-sse", "-mfpmath=387"),
            marks=pytest.mark.skipif(platform.machine() != "x86_64", reason="an option of gcc for x86"),
        ),
    ],
)
def test_flags_that_change_float_results_are_refused(flags: tuple[str, ...]):
    source = firmware_folder() / "src"
    run_tool(["cc", "-fsyntax-only", "-x", "c", str(source / "uwb_target.h")])
    arithmetic = ("preprocess.c", "correct.c", "network.c") if flags == ("-ffast-math",) else ()
    for name in ("target.h", *arithmetic):
        with pytest.raises(UwbMitigationError, match=r"wider type|-ffast-math"):
            run_tool(["cc", "-fsyntax-only", "-x", "c", str(source / f"uwb_{name}"), *flags])


@pytest.mark.parametrize("options", [{}, {"samples": 8}, {"scaling": Scaling.MAX}, None], ids=str)
def test_firmware_equals_the_ranges_of_onnx_runtime(options: dict | None, tmp_path: Path):
    """Without options: the MLP."""
    if options is None:
        mlp = random_networks.mlp()
        bundle = firmware_models.exact_bundle(tmp_path, weights=mlp, scale=firmware_models.SCALE)
    else:
        bundle = firmware_models.strict_bundle(tmp_path, **options)
    random = np.random.default_rng(8)
    measurements = [firmware_models.random_measurement(random) for _ in range(600)]
    measurements = [replace(one, tag_id=n % 3, anchor_id=n % 5) for n, one in enumerate(measurements)]
    offsets = Offsets(0.22, {1: 0.1, 2: 0.3}, {1: -0.05, 2: 0.0}, {(2, 3): 2.5})
    firmware, mitigation = FirmwareMitigation(bundle, offsets), Mitigation(bundle, offsets)
    statuses = set()
    for computed, expected in zip(
        firmware.correct(measurements), mitigation.correct(measurements), strict=True
    ):
        assert repr(computed) == repr(expected)
        statuses.add(computed.status)
    assert statuses >= {Status.NO_CIR, Status.BAD_CIR, Status.OUT_OF_DISTRIBUTION}
    assert any(status.is_corrected for status in statuses)


def test_missing_compiler_is_named_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingDependencyError, match="apt install gcc"):
        FirmwareMitigation(firmware_models.exact_bundle(tmp_path))


@pytest.mark.parametrize("words", ["", "  ", "cc", "cc -O2 -g"])
def test_cc_may_be_empty_or_contain_options(words: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("CC", words)
    monkeypatch.setattr(compiling.shutil, "which", lambda name: {"cc": "/usr/bin/cc"}.get(name))
    assert compiling.c_compiler() == tuple(words.split() or ["cc"])
    monkeypatch.setattr(compiling.shutil, "which", lambda name: {"gcc": "/usr/bin/gcc"}.get(name))
    monkeypatch.delenv("CC")
    assert compiling.c_compiler() == ("gcc",)


@pytest.mark.ros
def test_mitigator_uses_the_firmware_backend(ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from rclpy.serialization import deserialize_message
    from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

    bundle = firmware_models.strict_bundle(tmp_path)
    compiler, traces = tmp_path / "cc", tmp_path / "compiled"
    compiler.write_text(f'#!/bin/sh\ntouch {traces}\nexec {shutil.which("cc")} "$@" -O0\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    measurements = [model_material.measurement(1.0 + seed / 4, seed) for seed in range(20)]
    publisher = ros.node.create_publisher(RangeCir, "/uwb/range_raw", 50)
    corrected = ros.collect(RangeCorrected, "/uwb/range_corrected")
    ros.start("mitigator", f"model:={bundle.path}", "backend:=firmware").wait_for_output("correcting with")
    questions = [deserialize_message(encode_range(each), RangeCir) for each in measurements]
    ros.find_each_other(publisher, questions[0], corrected)
    for question in questions:
        publisher.publish(question)
    ros.spin_until(lambda: len(corrected) == len(measurements))
    assert traces.exists()
    expected = Mitigation(bundle).correct(measurements)
    assert [m.range for m in corrected] == [np.float32(each.range_m) for each in expected]
    assert [m.variance for m in corrected] == [np.float32(each.variance_m2) for each in expected]
    assert [m.status for m in corrected] == [each.status for each in expected]
