"""Files that `colcon build` installs, by the conventions of `ros2 run`, `ros2 launch` and `ros2 pkg`.

`make colcon` runs this in its workspace; elsewhere these tests are skipped.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest
from compilers import NEEDS_CC
from conftest import REPOSITORY

from uwb_mitigation.commands.doctor import LIBRARIES, MODULES

NAME = "uwb_mitigation"
MESSAGES = "uwb_mitigation_msgs"
SETUP = (REPOSITORY / "setup.py").read_text()
EXECUTABLES = set(re.findall(r'"([\w-]+) = uwb_mitigation\.commands\.entry:', SETUP))
NOT_ON_PYPI = {"launch", "launch_ros", "tf2_msgs"}
"""ROS packages that are not in an ament index without ROS."""


def prefixes() -> list[Path]:
    return [Path(entry) for entry in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if entry]


def prefix_of(package: str) -> Path:
    """Return the first prefix whose ament index contains the package."""
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
    # A launch writes bytecode next to the launch file.
    found = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


@pytest.mark.parametrize(
    "folder", ["launch", "params", "config", "models", "udev", "rviz", "foxglove", "plotjuggler"]
)
def test_shared_files_are_those_of_the_sources(share: Path, folder: str):
    assert files_below(share / folder) == files_below(REPOSITORY / folder)


def test_firmware_sources_for_the_host_are_installed(share: Path):
    library = [path for part in ("src", "native") for path in (REPOSITORY / "firmware" / part).glob("*.[ch]")]
    expected = {f"{path.parent.name}/{path.name}": path.read_bytes() for path in library}
    assert files_below(share / "firmware") == expected


def test_executables_are_in_the_folder_of_ros2_run(prefix: Path):
    found = {path.name: path for path in (prefix / "lib" / NAME).iterdir()}
    assert set(found) == EXECUTABLES
    for path in found.values():
        assert os.access(path, os.X_OK)
        assert path.read_text().startswith("#!")


def test_command_is_in_the_path_of_a_sourced_workspace(prefix: Path):
    place = shutil.which("uwb-mitigation", path=f"{prefix / 'bin'}")
    done = subprocess.run([place, "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("name", "parameter", "words"),
    [
        ("driver", "simulated_rate:=100.0", "replaying"),
        ("mitigator", "backend:=onnxruntime", "correcting with model"),
        ("mitigator", "backend:=firmware", "correcting with model"),
        ("pipeline", "simulated_rate:=100.0", "replaying"),
    ],
)
def test_installed_node_starts_and_ends(prefix: Path, tmp_path: Path, name: str, parameter: str, words: str):
    start_and_end([prefix / "lib" / NAME / name, "--ros-args", "-p", parameter], words, tmp_path)


def start_and_end(command: list[str | Path], words: str, folder: Path) -> None:
    """Start a node, wait until it prints `words`, and end it with SIGINT."""
    from ros_harness import domain

    with domain(folder) as ros:
        node = ros.run([*map(str, command)])
        node.wait_for_output(words)
        assert node.signal(signal.SIGINT) == 0, node.output


def test_messages_are_installed_as_an_interface_package():
    prefix = prefix_of(MESSAGES)
    sources = files_below(REPOSITORY / "msg_defs" / "msg")
    installed = files_below(prefix / "share" / MESSAGES / "msg")
    assert {name: data for name, data in installed.items() if name.endswith(".msg")} == sources
    index = prefix / "share" / "ament_index" / "resource_index" / "rosidl_interfaces" / MESSAGES
    assert {f"msg/{name}" for name in sources} <= set(index.read_text().split())
    import uwb_mitigation_msgs

    assert Path(uwb_mitigation_msgs.__file__).is_relative_to(prefix)


# The following tests check the sources and need no workspace.


def test_colcon_build_without_the_messages_names_the_right_command(tmp_path: Path):
    environment = os.environ | {"COLCON": "1", "AMENT_PREFIX_PATH": str(tmp_path)}
    command = [sys.executable, "setup.py", "-q", "build", "-b", str(tmp_path / "build")]
    place = {"cwd": REPOSITORY, "env": environment, "capture_output": True}
    refused = subprocess.run(command, **place, text=True, check=False)
    assert refused.returncode == 1
    (line,) = refused.stderr.splitlines()[-1:]
    problem, _, build = line.partition("; run: ")
    assert problem == "uwb_mitigation_msgs is missing"
    assert shlex.split(build) == ["colcon", "build", "--base-paths", ".", str(REPOSITORY / "msg_defs")]
    manifest = tmp_path / "share" / MESSAGES / "package.xml"
    manifest.parent.mkdir(parents=True)
    manifest.touch()
    subprocess.run(command, **place, check=True)


def without(absent: Iterable[str], name: str) -> list[str]:
    """Return the command that runs an executable without some libraries."""
    code = (
        f"import sys; sys.path.insert(0, {str(REPOSITORY)!r})\n"
        f"sys.modules.update(dict.fromkeys({sorted(absent)!r}))\n"
        f"from uwb_mitigation.commands import entry; entry.{name}()"
    )
    return [sys.executable, "-c", code]


@pytest.mark.parametrize(
    ("name", "needed", "words"),
    [
        ("driver", {"pyyaml", "rosbags", "pyserial"}, "replaying"),
        ("mitigator", {"pyyaml", "onnxruntime"}, "correcting with model"),
    ],
)
def test_node_runs_without_optional_packages(tmp_path: Path, name: str, needed: set[str], words: str):
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    needless = {library for libraries in LIBRARIES.values() for library in libraries} - needed - {"numpy"}
    absent = {MODULES.get(library, library) for library in needless}
    options = ["--ros-args", "-p", "source:=simulated"] if name == "driver" else []
    start_and_end([*without(absent, name), *options], words, tmp_path)


REMEDY = "is not installed (run uwb-mitigation doctor)"


@pytest.mark.parametrize(
    ("words", "absent", "excerpt"),
    [
        ("mitigator", "onnxruntime", f"onnxruntime {REMEDY}"),
        ("driver", "serial", f"pyserial {REMEDY}"),
        ("monitor", "rich", f"rich {REMEDY}"),
        ("mitigator", "rclpy", "ROS 2 is not set up: rclpy is missing"),
        ("mitigator", "uwb_mitigation_msgs", "ROS 2 is not set up: uwb_mitigation_msgs is missing"),
        ("command_line process in.mcap -o out.mcap", "numpy", f"numpy {REMEDY}"),
        ("command_line board export-c -o c", "onnx", f"onnx {REMEDY}"),
        ("command_line train --data simulated:ranges=60 -o x.onnx", "torch", "run `make setup-training`"),
    ],
)
def test_missing_dependency_is_reported_in_one_line(tmp_path: Path, words: str, absent: str, excerpt: str):
    name, *arguments = words.split()
    command = [*without([absent], name), *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert excerpt in line


PLACES = """
import uwb_mitigation
from uwb_mitigation.mitigation.embedded.compiling import firmware_folder
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
print(uwb_mitigation.__file__, load_bundle(default_model_path()).path, firmware_folder(), sep="\\n")
"""
CORRECT_WITH_THE_FIRMWARE = """
from uwb_mitigation.mitigation.embedded.compiled import FirmwareMitigation
FirmwareMitigation(load_bundle(default_model_path()))
"""


@NEEDS_CC
def test_models_and_firmware_backend_need_no_checkout(tmp_path: Path):
    """In a prefix, and in the folder of `pip --target`, where packages are next to `share`."""
    prefix, target = tmp_path / "prefix", tmp_path / "target"
    packages = prefix / "lib/python3/site-packages"
    steps = ("build", "-b", tmp_path / "build", "build_py", "-d", packages, "install_data", "-d", prefix)
    command = [sys.executable, "setup.py", "-q", *steps]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)
    shutil.copytree(packages, target)
    shutil.copytree(prefix / "share", target / "share")
    for folder, path, code in (
        (prefix, packages, PLACES + CORRECT_WITH_THE_FIRMWARE),
        (target, target, PLACES),
    ):
        environment = os.environ | {"PYTHONPATH": str(path), "AMENT_PREFIX_PATH": ""}
        command = [sys.executable, "-c", code]
        done = subprocess.run(
            command, env=environment, cwd=folder, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        places = done.stdout.split()
        assert all(Path(place).is_relative_to(folder) for place in places), places


def imported(paths: Iterable[Path]) -> set[str]:
    texts = (path.read_text(encoding="utf-8") for path in paths)
    return {name for text in texts for name in re.findall(r"^ *(?:from|import) (\w+)", text, re.MULTILINE)}


def test_every_ros_package_that_is_imported_is_declared_and_no_other():
    package = pytest.importorskip("catkin_pkg.package", reason="run make setup-training")
    manifest = package.parse_package(str(REPOSITORY))
    declared = {entry.name for entry in manifest.exec_depends}
    index = "share/ament_index/resource_index/packages/*"
    indexed = {path.name for prefix in (*prefixes(), Path(sys.prefix)) for path in prefix.glob(index)}
    assert "rclpy" in indexed, "ROS is not set up: run make setup"
    ros = {*indexed, MESSAGES, *NOT_ON_PYPI} - {NAME}
    sources = [*(REPOSITORY / NAME).rglob("*.py"), *(REPOSITORY / "launch").glob("*.py")]
    used = imported(sources) & ros
    assert used == {name for name in declared if not name.startswith(("python-", "python3-"))}
    tested = imported((REPOSITORY / "test").glob("*.py")) & ros
    assert tested <= declared | {entry.name for entry in manifest.test_depends}
