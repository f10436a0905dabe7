"""Rules of the repository: layers, imports, setup and versions."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY


def test_layers_hold_and_only_nodes_import_rclpy_and_only_training_torch():
    """Check the contracts of pyproject.toml."""
    pytest.importorskip("importlinter", reason="run make setup-training")
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_drawing_of_the_layers_agrees_with_the_contract_and_its_files_exist():
    page = (REPOSITORY / "docs" / "background" / "contributing.md").read_text(encoding="utf-8")
    contract = re.search(r"^layers = \[\n(.*?)^\]", (REPOSITORY / "pyproject.toml").read_text(), re.M | re.S)
    layers = [sorted(re.findall(r"\w+", line)) for line in contract[1].splitlines()]
    assert [sorted(line.split()) for line in re.findall(r"^[1-7] +(.*)$", page, re.M)] == layers
    assert (len(layers), sum(map(len, layers))) == (7, 13)
    paths = re.findall(r"`((?:uwb_mitigation|firmware|docs|msg_defs)/[\w/.]+)`", page)
    assert len(paths) > 10
    assert [path for path in paths if not (REPOSITORY / path).exists()] == []


@pytest.fixture(scope="module")
def imports():
    """The graph of imports in the package, also inside functions; not for type checks."""
    grimp = pytest.importorskip("grimp", reason="run make setup-training")
    return grimp.build_graph("uwb_mitigation", exclude_type_checking_imports=True, cache_dir=None)


def test_modules_have_few_arrows(imports):
    pairs = {
        (one.split(".")[1], other.split(".")[1])
        for one in imports.modules
        if one.count(".") > 1
        for other in imports.find_modules_directly_imported_by(one) - {"uwb_mitigation"}
    }
    assert 40 < len({(one, other) for one, other in pairs if one != other}) <= 56


@pytest.mark.parametrize(
    ("module", "limit"),
    [
        ("radios.serial", 4000),
        ("training.train", 5000),
        ("nodes.viewer", 12000),
        ("nodes.locator", 9000),
        ("commands.calibrate", 14000),
    ],
)
def test_a_module_imports_few_lines(module: str, limit: int, imports):
    """Count the lines of the files that a module imports, directly or not."""
    name = f"uwb_mitigation.{module}"
    places = [REPOSITORY / one.replace(".", "/") for one in {name, *imports.find_upstream_modules(name)}]
    files = [place / "__init__.py" if place.is_dir() else place.with_suffix(".py") for place in places]
    lines = sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)
    assert 1000 < lines <= limit


@pytest.mark.parametrize("machine", ["aarch64", "x86_64"])
@pytest.mark.parametrize("system_ros", [False, True])
def test_setup_stops_on_platforms_without_ros_wheels(machine: str, system_ros: bool, tmp_path: Path):
    program = shutil.copy(REPOSITORY / "setup.sh", tmp_path)
    prefix, tools = tmp_path / "ros", tmp_path / "tools"
    prefix.mkdir()
    tools.mkdir()
    if system_ros:
        (prefix / "setup.sh").touch()
    (tools / "uname").write_text(f"#!/bin/sh\necho {machine}\n")
    (tools / "uname").chmod(0o755)
    for name in ("bash", "dirname"):
        (tools / name).symlink_to(str(shutil.which(name)))
    # Without compilers nothing is installed: the next check stops the setup if this one does not.
    environment = os.environ | {"ROS_PREFIX": str(prefix), "PATH": str(tools), "PYTHON": sys.executable}
    done = subprocess.run([program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert ("x86-64 only" in line) == (machine == "aarch64" and not system_ros)
    assert ("missing tools" in line) == (machine == "x86_64" or system_ros)
    assert not (tmp_path / ".venv").exists()


def test_script_beside_the_clone_imports_the_package(tmp_path: Path):
    (tmp_path / "uwb_mitigation").mkdir()
    subprocess.run([sys.executable, "-c", "from uwb_mitigation import Status"], cwd=tmp_path, check=True)


def test_versions_agree():
    import uwb_mitigation

    version = uwb_mitigation.__version__
    stated = {
        "package.xml": f"<version>{version}</version>",
        "msg_defs/package.xml": f"<version>{version}</version>",
        "setup.py": f'version="{version}"',
        "CITATION.cff": f"\nversion: {version}\n",
    }
    assert [name for name, line in stated.items() if line not in (REPOSITORY / name).read_text()] == []


def test_dockerfile_has_the_commands_of_the_installation_guide():
    guide = (REPOSITORY / "docs" / "guides" / "installation.md").read_text()
    block = guide.partition("## ROS 2 workspace")[2].partition("```bash\n")[2].partition("```")[0]
    commands = [line for line in block.splitlines() if not line.startswith(("mkdir", "git clone"))]
    dockerfile = (REPOSITORY / "Dockerfile").read_text().replace("ENV PIP", "export PIP")
    assert len(commands) > 5
    assert [command for command in commands if command not in dockerfile] == []
