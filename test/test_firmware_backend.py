"""The firmware's C as the mitigator's backend: the same bits, and one clear error without a compiler."""

from __future__ import annotations

import shutil
from pathlib import Path

import firmware_models
import numpy as np
import pytest

from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.firmware_export.backend import FirmwareMitigation
from uwb_mitigation.mitigation import Mitigation


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: apt install gcc")
def test_the_firmware_gives_the_corrected_ranges_of_onnx_runtime(tmp_path: Path):
    bundle = firmware_models.choosy_bundle(tmp_path)
    random = np.random.default_rng(8)
    measurements = [firmware_models.random_measurement(random) for _ in range(400)]
    firmware, host = FirmwareMitigation(bundle), Mitigation(bundle)
    for computed, measurement in zip(firmware.correct_batch(measurements), measurements, strict=True):
        assert repr(computed) == repr(host.correct(measurement))


def test_without_a_compiler_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingDependencyError, match="apt install gcc"):
        FirmwareMitigation(firmware_models.exact_bundle(tmp_path))
