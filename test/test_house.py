"""Rules of the repository: layers, imports, setup and versions."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from compilers import NEEDS_CC
from conftest import REPOSITORY

from uwb_mitigation.mitigation.embedded.compiling import compile_objects, run_tool

PACKAGE = REPOSITORY / "uwb_mitigation"


def test_layers_hold_and_only_nodes_import_rclpy_and_only_training_torch():
    """Check the contracts of pyproject.toml."""
    pytest.importorskip("importlinter", reason="run make setup-training")
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_drawing_of_the_layers_agrees_with_the_contract_and_its_files_exist():
    page = (REPOSITORY / "docs" / "background" / "contributing.md").read_text(encoding="utf-8")
    drawn = [sorted(line.split()) for line in re.findall(r"^[1-7] +(.*)$", page, re.M)]
    contract = re.search(r"^layers = \[\n(.*?)^\]", (REPOSITORY / "pyproject.toml").read_text(), re.M | re.S)
    layers = [sorted(re.findall(r"\w+", line)) for line in contract[1].splitlines()]
    assert drawn == layers
    assert (len(layers), sum(map(len, layers))) == (7, 13)
    paths = re.findall(r"`((?:uwb_mitigation|firmware|docs|msg_defs)/[\w/.]+)`", page)
    assert len(paths) > 10
    assert [path for path in paths if not (REPOSITORY / path).exists()] == []


@cache
def imported_files(path: Path) -> set[Path]:
    """Return the files of the package that a file imports, also inside functions; not for type checks."""
    files, waiting = set[Path](), list[ast.AST](ast.parse(path.read_text(encoding="utf-8")).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            waiting += node.orelse
            continue
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom):
            names = [str(node.module), *(f"{node.module}.{name}" for name in names)]
        for place in (REPOSITORY / name.replace(".", "/") for name in names if name.startswith(PACKAGE.name)):
            files |= {file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()}
        waiting += ast.iter_child_nodes(node)
    return files - {PACKAGE / "__init__.py"}


def test_modules_have_few_arrows():
    arrows = {
        (path.relative_to(PACKAGE).parts[0], file.relative_to(PACKAGE).parts[0])
        for path in PACKAGE.rglob("*.py")
        if path.parent != PACKAGE
        for file in imported_files(path)
    }
    assert 40 < len({(one, other) for one, other in arrows if one != other}) <= 56


@pytest.mark.parametrize(
    ("module", "limit"),
    [
        ("radios/serial", 4000),
        ("training/train", 5000),
        ("nodes/viewer", 12000),
        ("nodes/locator", 9000),
        ("commands/calibrate", 14000),
    ],
)
def test_a_module_imports_few_lines(module: str, limit: int):
    """Count the lines of the files that a module imports, directly or not."""
    seen, waiting = set[Path](), {PACKAGE / f"{module}.py"}
    while waiting:
        seen.add(path := waiting.pop())
        waiting |= imported_files(path) - seen
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in seen)
    assert 1000 < lines <= limit


@NEEDS_CC
@pytest.mark.parametrize("folder", ["firmware/src", "benchmarks/equipment/dw1000_model/chip"])
def test_modules_of_the_firmware_do_not_call_each_other_in_circles(folder: str):
    sources = REPOSITORY / folder
    objects = compile_objects(("cc",), (f"-I{sources}",), tuple(sorted(sources.glob("*.c"))))
    symbols = {
        path: [line.split() for line in run_tool(["nm", "-gP", path]).splitlines()] for path in objects
    }
    owner = {name: path for path in objects for name, kind, *_ in symbols[path] if kind != "U"}
    TopologicalSorter(
        {
            path: {owner[name] for name, kind, *_ in symbols[path] if kind == "U" and name in owner}
            for path in objects
        }
    ).prepare()


def test_importing_the_package_and_its_command_line_needs_neither_ros_nor_torch():
    code = (
        "import sys; sys.modules.update(dict.fromkeys(['rclpy', 'torch', 'uwb_mitigation_msgs']))\n"
        "import uwb_mitigation.commands.cli, uwb_mitigation.mitigation.correction, uwb_mitigation.recordings.formats\n"
        "import uwb_mitigation.recordings.mcap, uwb_mitigation.recordings.decaranging"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY)


def run_without(package: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Run the command line without a package."""
    code = (
        f"import sys; sys.modules['{package}'] = None\nfrom uwb_mitigation.commands.cli import main\nmain()"
    )
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("package", "words"),
    [("numpy", ("process", "in.mcap", "-o", "out.mcap")), ("onnx", ("board", "export-c", "-o", "/nowhere"))],
)
def test_missing_package_is_reported_in_one_line(package: str, words: tuple[str, ...]):
    done = run_without(package, *words)
    assert done.stderr == f"uwb-mitigation: {package} is not installed (run uwb-mitigation doctor)\n"
    assert done.returncode == 1


def test_training_without_torch_names_the_install_command(tmp_path):
    done = run_without("torch", "train", "--data", "simulated:ranges=60", "-o", tmp_path / "x.onnx")
    assert done.returncode == 1
    assert "make setup-training" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("module", ["types/measurement", "mitigation/preprocessing", "errors"])
def test_pure_modules_do_no_input_or_output(module: str):
    text = (PACKAGE / f"{module}.py").read_text(encoding="utf-8")
    assert not re.search(r"\b(open\(|Path\b|import (os|sys|io|socket|logging)\b|print\()", text)


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
