"""`export-c` and `python -m benchmarks firmware`: results, JSON, and one-line errors."""

from __future__ import annotations

import json
from pathlib import Path

import firmware_models
import pytest
from typer.testing import CliRunner

from benchmarks import cli as benchmarks
from uwb_mitigation.commands import cli
from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.mitigation.embedded import toolchain


def test_export_c_writes_the_header_and_prints_its_path(tmp_path: Path):
    bundle = firmware_models.exact_bundle(tmp_path)
    result = tmp_path / "result.json"
    arguments = ("--model", str(bundle.path), "-o", str(tmp_path / "c"), "--json", str(result))
    done = CliRunner().invoke(cli.app, ["board", "export-c", *arguments])
    assert done.exit_code == 0, done.output
    values = json.loads(result.read_text())
    assert Path(values["header"]).is_file()
    assert values["model_id"] == bundle.model_id
    assert values["k"] == 32


@pytest.mark.skipif(bool(toolchain.missing_tools()), reason=toolchain.APT)
def test_bench_firmware_writes_the_documented_keys(tmp_path: Path):
    bundle = firmware_models.exact_bundle(tmp_path, 8)
    result = tmp_path / "result.json"
    arguments = ["firmware", "--model", str(bundle.path), "--inputs", "20", "--json", str(result)]
    done = CliRunner().invoke(benchmarks.app, arguments)
    assert done.exit_code == 0, done.output
    rows = json.loads(result.read_text())["rows"]
    promised = {"model", "k", "k0", "instructions", "cycles_estimated", "ram_bytes", "flash_bytes"}
    assert [row["kernels"] for row in rows] == ["cortex_m4", "portable"]
    for row in rows:
        assert promised <= row.keys()
        assert (row["mismatches"], row["inputs"]) == (0, 20)
        assert row["instructions"] < row["cycles_estimated"] < 2 * row["instructions"]


def test_missing_tools_are_named_with_the_install_command(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(MissingDependencyError, match=r"qemu-system-arm.*apt install gcc-arm-none-eabi"):
        toolchain.require_tools()
