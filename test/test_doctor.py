"""`uwb-mitigation doctor`: a complete installation passes, and broken parts are found."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from serial.tools import list_ports
from typer.testing import CliRunner

from uwb_mitigation.commands import doctor
from uwb_mitigation.commands.cli import app
from uwb_mitigation.mitigation.model.bundle import Session


@pytest.fixture(autouse=True)
def no_ports(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(list_ports, "comports", list)


def states() -> dict[str, str]:
    return {finding.name: finding.state for finding in doctor.examine()}


def test_library_that_cannot_be_imported_is_broken_unless_it_is_optional_and_missing(monkeypatch):
    for module in ("numpy", "mcap", "bokeh", "h5py"):
        monkeypatch.setitem(sys.modules, module, None)
    installed = doctor.metadata.distributions
    missing = ("bokeh", "h5py")
    monkeypatch.setattr(
        doctor.metadata, "distributions", lambda name: [] if name in missing else installed(name=name)
    )
    found = states()
    assert [found[name] for name in ("numpy", "mcap")] == ["broken"] * 2
    assert [found[name] for name in missing] == ["optional"] * 2


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
    ("vendor", "allowed", "state"), [(0x2341, True, "ok"), (0x2341, False, "broken"), (None, False, None)]
)
def test_usb_port_without_permission_is_broken(monkeypatch, vendor, allowed, state):
    port = SimpleNamespace(device="/dev/ttyACM7", vid=vendor, description="Nano 33 BLE")
    monkeypatch.setattr(list_ports, "comports", lambda: [port])
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: allowed)
    monkeypatch.setattr(doctor, "_check", lambda name, *_: doctor.Finding(name, "ok", ""))
    assert states().get("/dev/ttyACM7") == state
