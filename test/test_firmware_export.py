"""The C header: errors, and exact floats; `export-c` and `python -m benchmarks firmware`."""

import json
import re
from dataclasses import replace
from pathlib import Path

import firmware_models
import model_material
import numpy as np
import pytest
from command_line import succeed

from benchmarks.equipment import random_networks
from uwb_mitigation.errors import MissingDependencyError, ModelError
from uwb_mitigation.mitigation.embedded import toolchain
from uwb_mitigation.mitigation.embedded.export import export_bundle, format_number
from uwb_mitigation.mitigation.embedded.packing import pack
from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import load_bundle, save_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path


def test_floats_read_back_to_the_same_bits():
    random = np.random.default_rng(0)
    patterns = random.integers(0, 2**32, 20_000, np.uint32).view(np.float32)
    for value in [*patterns[np.isfinite(patterns)], np.float32(0), np.float32(-0.0), np.float32(1e-45)]:
        text = format_number(value)
        assert re.fullmatch(r"-?\d+(\.\d+)?(e[+-]\d+)?f", text)
        assert re.search(r"[.e]", text), "an integer with the suffix f is no C"
        assert np.float32(text[:-1]).view(np.uint32) == value.view(np.uint32)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0.1, 1e300])
def test_value_that_is_not_a_finite_float32_is_refused(value: float):
    with pytest.raises(ModelError, match="float32"):
        format_number(value)


def test_shipped_model_is_exported_with_its_identity(tmp_path: Path):
    bundle, result = load_bundle(default_model_path()), tmp_path / "result.json"
    succeed("board export-c --json result.json -o new/folder", folder=tmp_path)
    values = json.loads(result.read_text())
    assert (values["model_id"], values["k"]) == (bundle.model_id, 157)
    text = (tmp_path / values["header"]).read_text()
    assert f"0x{bundle.model_id:08x}u" in text
    assert format_number(bundle.card.linear_bias.per_rx_power) in text


def test_missing_tools_are_named_with_the_install_command(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(MissingDependencyError, match=r"qemu-system-arm.*apt install gcc-arm-none-eabi"):
        toolchain.require_tools()


def test_float_bundle_is_refused_with_the_remedy(tmp_path: Path):
    architecture = Remnet(samples=32)
    model = graph.float_model(model_material.random_weights(architecture))
    bundle = save_bundle(tmp_path / "float.onnx", model, model_material.card(architecture, quantised=False))
    with pytest.raises(ModelError, match="quantise"):
        export_bundle(bundle, tmp_path)
    assert not (tmp_path / "uwb_model.h").exists()


@pytest.mark.parametrize(
    ("architecture", "names"),
    [
        (Remnet(samples=32, filters=8), "filters = 8 .*16"),
        (Remnet(samples=32, first_kernel=7), "first_kernel = 7 .*3 or 5"),
        (Remnet(samples=7, modules=1), "samples = 7 .*8 to 157"),
        (Remnet(samples=158), "samples = 158 .*8 to 157"),
        (Remnet(samples=32, modules=4), "modules = 4 .*1 to 3"),
        (Remnet(samples=32, kernel=5), "kernel = 5"),
    ],
)
def test_shapes_without_kernels_are_refused(architecture: Remnet, names: str):
    with pytest.raises(ModelError, match=names):
        pack(model_material.random_int8(architecture))


def test_weights_and_scales_without_exact_integers_are_refused_by_layer():
    weights = random_networks.remnet(16, 3)
    larger = weights.weight["module1.residual"].copy()
    larger[3, 2, 1] = -64
    cases = [({"weight": weights.weight | {"module1.residual": larger}}, r"module1\.residual.*7 bits")]
    unit = weights.activation_scale["module2.skip"] / weights.activation_scale["module2.sum"]
    # By 1/64, every 64th accumulator is a tie, and ties go to even.
    for ratio in (1 / 64, 1, 0, 1e-12, np.nan):
        scales = weights.weight_scale["module2.skip"].copy()
        scales[5] = unit * np.float32(ratio)
        cases.append(({"weight_scale": weights.weight_scale | {"module2.skip": scales}}, "skip.*channel 5"))
    third = {"module1.sum": weights.activation_scale["first"] / np.float32(3)}
    cases.append(({"activation_scale": weights.activation_scale | third}, r"module1\.sum"))
    for changes, problem in cases:
        with pytest.raises(ModelError, match=problem):
            pack(replace(weights, **changes))


def test_hostile_name_cannot_end_a_c_comment(tmp_path: Path):
    weights = random_networks.remnet(16, 3)
    name = '*/ #include "/etc/passwd" /*\n'
    text = firmware_models.write_model(tmp_path, weights, name=name).read_text()
    assert "passwd" in text.splitlines()[0]
    assert text.splitlines()[0].count("*/") == 1
