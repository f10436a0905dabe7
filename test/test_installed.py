"""What `colcon build` has installed, by the conventions of `ros2 run`, `ros2 launch` and `ros2 pkg`.

`make colcon` runs this in the workspace that it has built; elsewhere there is nothing to look at.
"""

from __future__ import annotations

import ast
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
import yaml
from conftest import REPOSITORY

NAME = "uwb_mitigation"
MESSAGES = "uwb_mitigation_msgs"
EXECUTABLES = {"driver", "mitigator", "pipeline", "monitor", "uwb-mitigation"}
NOT_ON_PYPI = {"launch", "launch_ros"}
"""ROS packages that no index of a machine without ROS lists."""


def prefixes() -> list[Path]:
    return [Path(entry) for entry in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if entry]


def prefix_of(package: str) -> Path:
    """The first prefix whose ament index lists the package, as every ROS tool finds it."""
    for prefix in prefixes():
        if (prefix / "share" / "ament_index" / "resource_index" / "packages" / package).is_file():
            return prefix
    pytest.skip(f"{package} is in no sourced workspace: run make colcon")


@pytest.fixture(scope="module")
def prefix() -> Path:
    return prefix_of(NAME)


@pytest.fixture(scope="module")
def share(prefix: Path) -> Path:
    return prefix / "share" / NAME


def files_below(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("folder", ["launch", "params", "models", "udev"])
def test_shared_files_are_those_of_the_sources(share: Path, folder: str):
    assert files_below(share / folder) == {
        name: data for name, data in files_below(REPOSITORY / folder).items() if "__pycache__" not in name
    }


def test_the_firmware_that_a_computer_compiles_is_shared(share: Path):
    library = [*(REPOSITORY / "firmware" / "src").glob("*.[ch]")]
    assert files_below(share / "firmware") == {f"src/{path.name}": path.read_bytes() for path in library}


def test_nothing_else_is_shared(share: Path):
    ours = {path.name for path in share.iterdir() if not path.name.startswith(("package.", "local_setup."))}
    assert ours - {"hook", "colcon-core"} == {"launch", "params", "models", "udev", "firmware"}
    assert (share / "package.xml").read_bytes() == (REPOSITORY / "package.xml").read_bytes()
    for path in (share / "launch").iterdir():
        assert path.name.endswith(".launch.py"), "ros2 launch completes no other names"
    for path in (share / "params").iterdir():
        assert set(yaml.safe_load(path.read_text())["/**"]) == {"ros__parameters"}


def test_the_executables_are_where_ros2_run_looks(prefix: Path):
    found = {path.name: path for path in (prefix / "lib" / NAME).iterdir()}
    assert set(found) == EXECUTABLES
    for path in found.values():
        assert os.access(path, os.X_OK)
        assert path.read_text().startswith("#!")


def installed_environment() -> dict[str, str]:
    return os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "99"}


def wait_until_said(node: subprocess.Popen[bytes], log: Path, words: str) -> None:
    deadline = time.monotonic() + 60
    while words not in log.read_text():
        assert node.poll() is None, log.read_text()
        assert time.monotonic() < deadline, f"no {words!r} in:\n{log.read_text()}"
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("name", "parameter", "words"),
    [
        ("driver", "simulated_rate:=100.0", "replaying"),
        ("mitigator", "backend:=onnxruntime", "correcting with model"),
        ("mitigator", "backend:=firmware", "correcting with model"),
        ("pipeline", "simulated_rate:=100.0", "replaying"),
    ],
)
def test_a_node_starts_where_it_is_installed_and_ends_on_ctrl_c(
    prefix: Path, tmp_path: Path, name: str, parameter: str, words: str
):
    log = tmp_path / "said"
    with log.open("wb") as file:
        node = subprocess.Popen(
            [prefix / "lib" / NAME / name, "--ros-args", "-p", parameter],
            env=installed_environment(),
            cwd=tmp_path,
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    try:
        wait_until_said(node, log, words)
        node.send_signal(signal.SIGINT)
        assert node.wait(20) == 0, log.read_text()
    finally:
        node.kill()
        node.wait()


def test_the_command_line_takes_its_model_from_the_installation(prefix: Path, share: Path, tmp_path: Path):
    code = (
        "import uwb_mitigation, uwb_mitigation.nodes.monitor; from uwb_mitigation.model.shipped import *\n"
        "print(uwb_mitigation.__file__); print(default_model_path())"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    package, model = map(Path, done.stdout.split())
    assert package.is_relative_to(prefix), done.stderr
    assert model.parent == share / "models"
    command = [prefix / "lib" / NAME / "uwb-mitigation", "--version"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_messages_are_installed_as_an_interface_package():
    prefix = prefix_of(MESSAGES)
    sources = files_below(REPOSITORY / "msg_defs" / "msg")
    installed = files_below(prefix / "share" / MESSAGES / "msg")
    assert {name: data for name, data in installed.items() if name.endswith(".msg")} == sources
    index = prefix / "share" / "ament_index" / "resource_index" / "rosidl_interfaces" / MESSAGES
    assert {f"msg/{name}" for name in sources} <= set(index.read_text().split())
    import uwb_mitigation_msgs

    assert Path(uwb_mitigation_msgs.__file__).is_relative_to(prefix)


# What follows holds of the sources, too, and needs no workspace.


CORRECT_WITH_THE_FIRMWARE = """
import uwb_mitigation
from uwb_mitigation.firmware_export.backend import FirmwareMitigation
from uwb_mitigation.firmware_export.compiling import firmware_folder
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.shipped import default_model_path
FirmwareMitigation(load_bundle(default_model_path()))
print(uwb_mitigation.__file__, default_model_path(), firmware_folder(), sep="\\n")
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: apt install gcc")
def test_the_firmware_backend_needs_no_checkout(tmp_path: Path):
    packages = tmp_path / "lib" / "python3" / "site-packages"
    steps = [
        *("build", "-b", tmp_path / "build"),
        *("build_py", "-d", packages),
        *("install_data", "-d", tmp_path),
    ]
    subprocess.run(
        [sys.executable, "setup.py", "-q", *steps], cwd=REPOSITORY, check=True, capture_output=True
    )
    environment = os.environ | {"PYTHONPATH": str(packages), "AMENT_PREFIX_PATH": ""}
    command = [sys.executable, "-c", CORRECT_WITH_THE_FIRMWARE]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(Path(place).is_relative_to(tmp_path) for place in done.stdout.split()), done.stdout


@pytest.mark.parametrize("folder", ["", "msg_defs"])
def test_the_manifest_is_valid(folder: str):
    package = pytest.importorskip("catkin_pkg.package", reason="run make setup-training")
    warnings: list[str] = []
    manifest = package.parse_package(str(REPOSITORY / folder), warnings=warnings)
    manifest.validate(warnings)
    assert warnings == []
    assert manifest.package_format == 3
    assert manifest.licenses == ["Apache-2.0"]
    assert manifest.get_build_type() == ("ament_cmake" if folder else "ament_python")
    assert [group.name for group in manifest.member_of_groups] == (
        ["rosidl_interface_packages"] if folder else []
    )


def imported(paths: Iterable[Path]) -> Iterator[str]:
    """First names of the modules that files import."""
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield node.module.partition(".")[0]


def test_every_ros_package_that_is_imported_is_declared_and_no_other():
    package = pytest.importorskip("catkin_pkg.package", reason="run make setup-training")
    manifest = package.parse_package(str(REPOSITORY))
    declared = {entry.name for entry in manifest.exec_depends}
    index = "share/ament_index/resource_index/packages/*"
    indexed = {path.name for prefix in (*prefixes(), Path(sys.prefix)) for path in prefix.glob(index)}
    assert "rclpy" in indexed, "ROS is not set up: run make setup"
    ros = {*indexed, MESSAGES, *NOT_ON_PYPI} - {NAME}
    sources = [*(REPOSITORY / NAME).rglob("*.py"), *(REPOSITORY / "launch").glob("*.py")]
    used = set(imported(sources)) & ros
    assert used == {name for name in declared if not name.startswith("python3-")}
    tested = set(imported((REPOSITORY / "test").glob("*.py"))) & ros
    assert tested <= declared | {entry.name for entry in manifest.test_depends}


def test_every_interface_that_the_messages_use_is_declared():
    package = pytest.importorskip("catkin_pkg.package", reason="run make setup-training")
    manifest = package.parse_package(str(REPOSITORY / "msg_defs"))
    lines = "\n".join(path.read_text() for path in (REPOSITORY / "msg_defs" / "msg").iterdir()).splitlines()
    used = {line.split("/")[0] for line in lines if "/" in line.split(" ")[0]}
    for depends in (manifest.build_depends, manifest.exec_depends):
        assert used <= {entry.name for entry in depends}
    cmake = (REPOSITORY / "msg_defs" / "CMakeLists.txt").read_text()
    assert all(f"find_package({name} REQUIRED)" in cmake for name in used)
    files = {path.name for path in (REPOSITORY / "msg_defs" / "msg").iterdir()}
    assert all(f'"msg/{name}"' in cmake for name in files)
