"""`uwb-mitigation doctor`: a complete installation passes, and broken parts are found."""

from __future__ import annotations

import json
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import REPOSITORY
from serial.tools import list_ports
from typer.testing import CliRunner

from uwb_mitigation.commands import doctor
from uwb_mitigation.commands.cli import app
from uwb_mitigation.errors import not_imported
from uwb_mitigation.model.runtime import Session


@pytest.fixture(autouse=True)
def no_ports(monkeypatch: pytest.MonkeyPatch):
    """The ports of the computer that runs the tests do not count."""
    monkeypatch.setattr(list_ports, "comports", list)


def states() -> dict[str, str]:
    return {finding.name: finding.state for finding in doctor.examine()}


def test_every_required_library_is_checked():
    lines = [
        line
        for part in ("runtime.in", "viewer.in")
        for line in (REPOSITORY / "requirements" / part).read_text().splitlines()
    ]
    required = {line.partition(">")[0] for line in lines if line and not line.startswith(("#", "-"))}
    assert {name for names in doctor.LIBRARIES.values() for name in names} == required


def test_a_complete_installation_passes(tmp_path: Path):
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    result = CliRunner().invoke(app, ["doctor", "--json", str(tmp_path / "result.json")])
    written = json.loads((tmp_path / "result.json").read_text())
    assert result.exit_code == 0, result.output
    assert written["ok"]
    assert {entry["state"] for entry in written["findings"]} <= {"ok", "optional"}


def test_a_library_that_cannot_be_imported_is_broken_unless_it_is_optional_and_missing(monkeypatch):
    for module in ("numpy", "mcap", "bokeh"):
        monkeypatch.setitem(sys.modules, module, None)
    installed = doctor.metadata.distributions
    monkeypatch.setattr(
        doctor.metadata, "distributions", lambda name: [] if name == "bokeh" else installed(name=name)
    )
    found = states()
    assert (found["numpy"], found["mcap"], found["bokeh"]) == ("broken", "broken", "optional")


@pytest.mark.parametrize("module", ["rclpy", "uwb_mitigation_msgs"])
def test_ros_that_cannot_be_loaded_is_broken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: str):
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    (tmp_path / f"{module}.py").write_text("raise ImportError('librcl.so is missing')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert states()["ROS 2"] == "broken"
    assert CliRunner().invoke(app, ["doctor"]).exit_code == 1


def test_arithmetic_that_differs_by_one_bit_is_broken(monkeypatch: pytest.MonkeyPatch):
    predict = Session.predict_m

    def off_by_one_bit(self, windows):
        outputs = predict(self, windows)
        outputs[3:4].view(np.uint32)[0] ^= 1
        return outputs

    monkeypatch.setattr(Session, "predict_m", off_by_one_bit)
    assert states()["shipped model"] == "broken"


@pytest.mark.parametrize(
    ("vendor", "allowed", "state"),
    [(0x2341, True, "ok"), (0x2341, False, "broken"), (None, False, None)],
)
def test_a_usb_port_without_permission_is_broken(monkeypatch, vendor, allowed, state):
    port = SimpleNamespace(device="/dev/ttyACM7", vid=vendor, description="Nano 33 BLE")
    monkeypatch.setattr(list_ports, "comports", lambda: [port])
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: allowed)
    assert states().get("/dev/ttyACM7") == state


def test_missing_tools_are_optional(monkeypatch: pytest.MonkeyPatch):
    def missing(distribution: str):
        raise PackageNotFoundError(distribution)

    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    monkeypatch.setattr(doctor.metadata, "version", missing)
    monkeypatch.setattr(doctor.metadata, "distributions", lambda name: [])
    found = states()
    assert {found[name] for name in ("torch", *doctor._TOOLS)} == {"optional"}


def test_the_error_of_a_missing_module_names_the_distribution():
    modules = ["numpy", "serial.tools", "yaml", "rclpy.node", "uwb_mitigation.nothing", ""]
    errors = [not_imported(ModuleNotFoundError(name=module)) for module in modules]
    assert [error.what for error in errors[:3]] == [
        f"{name} is not installed" for name in ("numpy", "pyserial", "pyyaml")
    ]
    assert errors[3] is not None
    assert errors[4:] == [None, None]
