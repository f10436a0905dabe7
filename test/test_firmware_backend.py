"""The firmware as backend of the mitigator: bit-identical results, and one error without a compiler."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import firmware_models
import model_material
import numpy as np
import pytest
from compilers import NEEDS_CC

from benchmarks.equipment import random_networks
from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.embedded import compiling
from uwb_mitigation.mitigation.embedded.compiled import FirmwareMitigation
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.ros.codec import encode_range

if TYPE_CHECKING:
    from ros_harness import Ros


@NEEDS_CC
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
    for computed, measurement in zip(firmware.correct(measurements), measurements, strict=True):
        assert repr(computed) == repr(mitigation.correct([measurement])[0])
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


@NEEDS_CC
@pytest.mark.ros
def test_mitigator_uses_the_firmware_backend(ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from rclpy.serialization import deserialize_message
    from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

    bundle = firmware_models.strict_bundle(tmp_path)
    compiler, traces = tmp_path / "cc", tmp_path / "compiled"
    compiler.write_text(f'#!/bin/sh\ntouch {traces}\nexec {shutil.which("cc")} "$@"\n')
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
