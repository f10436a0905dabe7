"""`export-c` and `python -m benchmarks firmware`: results for people and for programs, and one clear error on bad input."""

from __future__ import annotations

import json
from pathlib import Path

import firmware_models
import pytest
import typer
from typer.testing import CliRunner

from benchmarks import __main__ as benchmarks
from uwb_mitigation.commands import cli
from uwb_mitigation.errors import MissingDependencyError, ModelError
from uwb_mitigation.firmware_export import toolchain


@pytest.fixture
def app() -> typer.Typer:
    return cli.app


def test_export_c_writes_the_header_and_says_where(app: typer.Typer, tmp_path: Path):
    bundle = firmware_models.exact_bundle(tmp_path)
    result = tmp_path / "result.json"
    arguments = [
        "board",
        "export-c",
        "--model",
        str(bundle.path),
        "-o",
        str(tmp_path / "c"),
        "--json",
        str(result),
    ]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    values = json.loads(result.read_text())
    assert Path(values["header"]).is_file()
    assert values["model_id"] == bundle.model_id
    assert values["k"] == 32


def test_export_c_of_an_absent_model_names_it(app: typer.Typer, tmp_path: Path):
    done = CliRunner().invoke(
        app, ["board", "export-c", "--model", str(tmp_path / "none.onnx"), "-o", str(tmp_path)]
    )
    assert isinstance(done.exception, ModelError)
    assert "none.onnx" in str(done.exception)


@pytest.mark.skipif(bool(toolchain.missing_tools()), reason=toolchain.APT)
def test_bench_firmware_reports_the_promised_keys(tmp_path: Path):
    bundle = firmware_models.exact_bundle(tmp_path, 8)
    result = tmp_path / "result.json"
    arguments = ["firmware", "--model", str(bundle.path), "--inputs", "20", "--json", str(result)]
    done = CliRunner().invoke(benchmarks.app, arguments)
    assert done.exit_code == 0, done.output
    rows = json.loads(result.read_text())["rows"]
    promised = {
        "model",
        "k",
        "k0",
        "instructions",
        "cycles_estimated",
        "ram_bytes",
        "flash_bytes",
        "mismatches",
        "inputs",
    }
    assert [row["kernels"] for row in rows] == ["cortex_m4", "portable"]
    assert all(promised <= row.keys() and row["mismatches"] == 0 and row["inputs"] == 20 for row in rows)


def test_missing_tools_are_named_with_the_line_that_installs_them(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(MissingDependencyError, match=r"qemu-system-arm.*apt install gcc-arm-none-eabi"):
        toolchain.require_tools()
