"""`uwb-mitigation doctor`: a sound installation passes, and whatever is broken shows, with what mends it."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace

import command_line
import numpy as np
import pytest
from conftest import REPOSITORY
from serial.tools import list_ports
from typer.testing import CliRunner

from uwb_mitigation import installation
from uwb_mitigation.cli import app
from uwb_mitigation.errors import ModelError, not_imported
from uwb_mitigation.firmware_export import compiling
from uwb_mitigation.installation import Finding, State
from uwb_mitigation.model import bundle
from uwb_mitigation.model.runtime import Session

NEEDED = ["Python", *installation.LIBRARIES, "shipped model", "rclpy", "messages"]


@pytest.fixture(autouse=True)
def no_ports(monkeypatch: pytest.MonkeyPatch):
    """No port of the computer that runs the tests has a say."""
    monkeypatch.setattr(list_ports, "comports", list)


def findings() -> dict[str, Finding]:
    return {finding.name: finding for finding in installation.examine()}


def test_everything_that_is_installed_to_run_is_looked_at():
    """Except what shows the result, and what others bring."""
    lines = [
        line
        for part in ("runtime.in", "viewer.in")
        for line in (REPOSITORY / "requirements" / part).read_text().splitlines()
    ]
    required = {line.partition(">")[0] for line in lines if line and not line.startswith(("#", "-"))}
    assert set(installation.LIBRARIES) == required


def test_a_sound_installation_passes(tmp_path: Path):
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    result = CliRunner().invoke(app, ["doctor", "--json", str(tmp_path / "result.json")])
    told = json.loads((tmp_path / "result.json").read_text())
    assert result.exit_code == 0, result.output
    assert told["ok"]
    states = {entry["name"]: entry["state"] for entry in told["findings"]}
    assert {name: states[name] for name in NEEDED} == dict.fromkeys(NEEDED, "ok")


@pytest.mark.parametrize(("distribution", "library"), installation.LIBRARIES.items())
def test_a_library_that_is_installed_and_cannot_be_imported_is_broken(
    monkeypatch: pytest.MonkeyPatch, distribution: str, library: installation.Library
):
    monkeypatch.setitem(sys.modules, library.module, None)
    found = installation.examine_library(distribution, library)
    assert found.state is State.BROKEN
    assert library.module in found.detail
    assert found.fix


@pytest.mark.parametrize("distribution", ["numpy", "cobs"])
def test_a_library_that_is_not_installed_is_broken_where_nothing_works_without_it(
    monkeypatch: pytest.MonkeyPatch, distribution: str
):
    def absent(name: str):
        raise PackageNotFoundError(name)

    library = installation.LIBRARIES[distribution]
    monkeypatch.setitem(sys.modules, library.module, None)
    monkeypatch.setattr(installation.metadata, "version", absent)
    found = installation.examine_library(distribution, library)
    assert (found.state, found.fix != "") == (State.OPTIONAL if library.purpose else State.BROKEN, True)


def test_a_missing_module_is_named_by_what_is_installed_for_it():
    modules = [
        "numpy",
        "serial.tools",
        "yaml",
        "lz4",
        "cobs.cobs",
        "rclpy.node",
        "uwb_mitigation.nothing",
        "",
    ]
    told = [not_imported(ModuleNotFoundError(name=module)) for module in modules]
    known = ["numpy", "pyserial", "pyyaml", "lz4", "cobs"]
    assert [error.what for error in told[:5]] == [f"{name} is not installed" for name in known]
    assert "ROS 2 is not set up" in told[5].what
    assert told[6:] == [None, None]


def test_a_library_that_is_too_old_is_told_from_one_that_is_absent():
    told = not_imported(ImportError("cannot import name 'AfterValidator' from 'pydantic'", name="pydantic"))
    assert told.what == "pydantic cannot be used: cannot import name 'AfterValidator' from 'pydantic'"


@pytest.mark.parametrize("module", ["rclpy", "uwb_mitigation_msgs"])
def test_a_ros_that_cannot_be_loaded_is_broken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: str):
    (tmp_path / f"{module}.py").write_text("raise ImportError('librcl.so is not there')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    code = installation.ASK_RCLPY if module == "rclpy" else installation.ASK_MESSAGES
    found = installation.attempt(module, lambda: installation.ask_child(code), "mend it")
    assert found == Finding(module, State.BROKEN, "ImportError: librcl.so is not there", "mend it")


def test_a_python_that_is_not_supported_is_broken(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "version_info", (3, 9, 1))
    finding = installation.attempt("Python", installation.python_version, "another one")
    assert finding == Finding("Python", State.BROKEN, "3.9.1: 3.10 to 3.13 are supported", "another one")


def test_a_model_that_is_damaged_is_broken(monkeypatch: pytest.MonkeyPatch):
    def damaged(path: Path):
        raise ModelError("damaged", where=str(path))

    monkeypatch.setattr(bundle, "load_bundle", damaged)
    assert findings()["shipped model"].state is State.BROKEN
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 1
    assert "damaged" in result.output


def test_arithmetic_that_differs_by_one_bit_is_broken(monkeypatch: pytest.MonkeyPatch):
    honest = Session.predict_batch_m

    def off_by_one_bit(self, windows):
        outputs = honest(self, windows)
        outputs[3:4].view(np.uint32)[0] ^= 1
        return outputs

    monkeypatch.setattr(Session, "predict_batch_m", off_by_one_bit)
    assert "1 of 8 golden vectors differently" in findings()["shipped model"].detail


def test_a_middleware_that_is_not_there_is_broken(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_of_nobody")
    found = findings()["rclpy"]
    assert found.state is State.BROKEN
    assert "rmw_of_nobody" in found.detail


@pytest.mark.parametrize(
    ("vendor", "allowed", "state"),
    [(0x2341, True, State.OK), (0x2341, False, State.BROKEN), (None, False, State.OPTIONAL)],
)
def test_a_board_that_may_not_be_opened_is_broken(
    monkeypatch: pytest.MonkeyPatch, vendor: int | None, allowed: bool, state: State
):
    port = SimpleNamespace(device="/dev/ttyACM7", vid=vendor, description="Nano 33 BLE")
    monkeypatch.setattr(list_ports, "comports", lambda: [port])
    monkeypatch.setattr(installation.os, "access", lambda path, mode: allowed)
    (finding,) = installation.examine_ports()
    assert (finding.name, finding.state) == ("/dev/ttyACM7", state)
    assert ("dialout" in finding.fix) is not allowed


def test_optional_tools_that_are_absent_break_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def absent(distribution: str):
        raise PackageNotFoundError(distribution)

    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(installation.metadata, "version", absent)
    monkeypatch.setattr(installation, "UDEV_FOLDERS", (tmp_path,))
    found = {f.name: f for f in (*installation.examine_udev_rule(), *installation.examine_tools())}
    for name in ("torch", "C compiler", "arm-none-eabi-gcc", "qemu-system-arm", "udev rule"):
        assert found[name].state is State.OPTIONAL
        assert found[name].detail
        assert found[name].fix


@pytest.mark.parametrize(("words", "state"), [("", "ok"), ("cc -O2", "ok"), ("nocc -O2", "optional")])
def test_the_compiler_is_the_one_that_the_backend_runs(
    monkeypatch: pytest.MonkeyPatch, words: str, state: str
):
    monkeypatch.setenv("CC", words)
    monkeypatch.setattr(compiling.shutil, "which", lambda name: {"cc": "/usr/bin/cc"}.get(name))
    found = {finding.name: finding for finding in installation.examine_tools()}["C compiler"]
    assert found.state.value == state
    assert found.detail == ((words or "cc") if state == "ok" else "mitigator with backend:=firmware")


def test_what_does_not_answer_is_broken(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(installation, "CHILD_TIMEOUT_S", 0.2)
    found = installation.attempt("rclpy", lambda: installation.ask_child("import time; time.sleep(60)"), "")
    assert (found.state, found.detail) == (State.BROKEN, "did not answer within 0.2 s")


@pytest.mark.parametrize(("count", "told"), [(1, "1 thing is broken"), (2, "2 things are broken")])
def test_how_much_is_broken_is_said_on_standard_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, count: int, told: str
):
    broken = [Finding("thing", State.BROKEN, "gone", "mend it")] * count
    monkeypatch.setattr(installation, "examine", lambda: iter([*broken, Finding("other", State.OK, "1.0")]))
    done = command_line.run("doctor", folder=tmp_path)
    assert (done.returncode, done.stderr) == (1, f"uwb-mitigation: {told}\n")
    assert done.stdout.endswith(f"{', '.join(['thing'] * count)}:\n    mend it\n")


def test_a_long_place_is_shown_whole_on_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch):
    place = "/home/somebody/" + "a_folder_with_a_name/" * 6 + "msg"
    monkeypatch.setattr(installation, "examine", lambda: iter([Finding("messages", State.OK, place)]))
    shown = CliRunner().invoke(app, ["doctor"], env={"COLUMNS": "80"}).output
    assert max(map(len, shown.splitlines())) <= 80
    cells = [line.split("│")[3].strip() for line in shown.splitlines() if line.startswith("│")]
    assert "".join(cells) == place


def test_the_udev_rule_is_found_where_it_was_copied_to(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(installation, "UDEV_FOLDERS", (tmp_path / "absent", tmp_path))
    (offered,) = installation.examine_udev_rule()
    source = Path(shlex.split(offered.fix)[2])
    (tmp_path / source.name).write_bytes(source.read_bytes())
    (found,) = installation.examine_udev_rule()
    assert found == Finding("udev rule", State.OK, str(tmp_path / source.name))


def test_what_mends_survives_a_paste_from_any_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """All that can be broken is, in an installation by `make setup`."""
    home = tmp_path / "jürgen's robot; touch oops"
    (home / ".venv").mkdir(parents=True)
    (home / ".venv" / "environment.sh").write_text("")
    (home / "udev").mkdir()
    port = SimpleNamespace(device="/dev/ttyACM7", vid=1, description="Nano 33 BLE")
    monkeypatch.setattr(list_ports, "comports", lambda: [port])
    monkeypatch.setattr(installation.os, "access", lambda path, mode: False)
    monkeypatch.setattr(sys, "prefix", str(home / ".venv"))
    monkeypatch.setattr(installation, "__file__", str(home / "uwb_mitigation" / "installation.py"))
    monkeypatch.setattr(installation, "default_model_path", lambda: home / "models" / "m.onnx")
    monkeypatch.setattr(installation, "UDEV_FOLDERS", (tmp_path / "etc",))

    def broken(*arguments: object):
        raise RuntimeError("broken")

    for look in (
        "python_version",
        "library_version",
        "compare_model",
        "ask_child",
        "find_tool",
        "c_compiler",
    ):
        monkeypatch.setattr(installation, look, broken)
    fixes = {finding.name: finding.fix for finding in installation.examine() if finding.fix}
    assert {*installation.LIBRARIES, "rclpy", "messages", "udev rule", "/dev/ttyACM7"} <= set(fixes)
    for fix in fixes.values():
        subprocess.run(["sh", "-n", "-c", fix], check=True)
        places = [word for word in shlex.split(fix) if "robot" in word]
        assert all(word.startswith(str(home)) for word in places), fix


def test_ros_is_found_by_sourcing_what_sets_it_up(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    script = tmp_path / "jürgen's ros" / "setup.sh"
    script.parent.mkdir()
    script.write_text("export ROS_OF_THE_SYSTEM=rmw_of_the_system")
    monkeypatch.setattr(installation, "_setup_scripts", lambda: [tmp_path / "absent", script])
    found = installation.examine_ros("rclpy", "import os; print(os.environ['ROS_OF_THE_SYSTEM'])")
    assert found.state is State.OK
    assert found.detail == "rmw_of_the_system, once its script is sourced"
    assert shlex.split(found.fix) == [".", str(script)]


def test_where_there_is_no_ros_the_nodes_are_what_is_absent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(installation, "ROS_PREFIX", tmp_path / "absent")
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    monkeypatch.setattr(installation, "__file__", str(tmp_path / "lib" / "p" / "s" / "u" / "installation.py"))
    found = installation.examine_ros("rclpy", "import nothing_of_this_name")
    assert (found.state, found.fix) == (State.OPTIONAL, "")
