"""The rules that keep the house in order: layers, generated files, and what an import may pull in."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY

PACKAGE = REPOSITORY / "uwb_mitigation"


def importers(module: str) -> set[str]:
    """The package's top-level entries with a file that imports `module`."""
    pattern = re.compile(rf"^\s*(import|from)\s+{module}\b", re.MULTILINE)
    files = (path for path in PACKAGE.rglob("*.py") if pattern.search(path.read_text(encoding="utf-8")))
    return {path.relative_to(PACKAGE).parts[0] for path in files}


def test_only_nodes_import_rclpy():
    assert importers("rclpy") == {"nodes"}


def test_only_training_imports_torch():
    assert importers("torch") == {"training"}


def test_importing_the_package_and_its_command_line_needs_neither_ros_nor_torch():
    code = (
        "import sys; sys.modules.update(dict.fromkeys(['rclpy', 'torch', 'uwb_mitigation_msgs']))\n"
        "import uwb_mitigation.cli, uwb_mitigation.mitigation, uwb_mitigation.sources.opening\n"
        "import uwb_mitigation.sources.mcap, uwb_mitigation.sources.decaranging"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY)


def run_without(package: str, *words: object) -> subprocess.CompletedProcess[str]:
    """The command line where a package cannot be imported."""
    code = f"import sys; sys.modules['{package}'] = None\nfrom uwb_mitigation.cli import main\nmain()"
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)


def test_the_doctor_comes_even_where_numpy_does_not():
    done = run_without("numpy", "doctor")
    assert done.returncode == 1, done.stderr
    assert "\nnumpy: make setup" in done.stdout
    assert "\nshipped model: make setup" in done.stdout
    assert re.search(r"│ C compiler +│ ok", done.stdout) or shutil.which("cc") is None
    # ONNX Runtime says something of its own before.
    assert re.fullmatch(r"uwb-mitigation: \d+ things are broken", done.stderr.splitlines()[-1])
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("package", "words"),
    [
        ("numpy", ("process", "in.mcap", "-o", "out.mcap")),
        ("onnx", ("export-c", "-o", "/nowhere")),
        ("cobs", ("bench", "link")),
    ],
)
def test_a_command_that_misses_a_package_says_so_in_one_line(package: str, words: tuple[str, ...]):
    done = run_without(package, *words)
    assert done.stderr == f"uwb-mitigation: {package} is not installed (run uwb-mitigation doctor)\n"
    assert done.returncode == 1


def test_a_missing_module_that_no_installation_brings_is_not_explained_away():
    done = run_without("uwb_mitigation.processing.planning", "process", "in.mcap", "-o", "out.mcap")
    assert "Traceback" in done.stderr


def test_a_reader_that_went_away_ends_a_command_silently_with_1():
    read, write = os.pipe()
    os.close(read)
    try:
        command = [sys.executable, "-m", "uwb_mitigation.cli", "--help"]
        done = subprocess.run(command, cwd=REPOSITORY, stdout=write, stderr=subprocess.PIPE, check=False)
    finally:
        os.close(write)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.parametrize("module", ["measurement", "preprocessing", "errors"])
def test_pure_modules_do_no_input_or_output(module: str):
    text = (PACKAGE / f"{module}.py").read_text(encoding="utf-8")
    assert not re.search(r"\b(open\(|Path\b|import (os|sys|io|socket|logging)\b|print\()", text)


def test_parameter_files_and_reference_agree_with_the_tables():
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    from uwb_mitigation.nodes.parameter_files import files

    stale = [path.name for path, text in files().items() if path.read_text(encoding="utf-8") != text]
    assert not stale, "run: python -m uwb_mitigation.nodes.parameter_files"


@pytest.mark.parametrize("goals", [["develp"], ["run", "docs"], [""]])
def test_the_set_up_refuses_a_goal_that_is_none(goals: list[str], tmp_path: Path):
    # A copy: what it would set up is its own folder's.
    program = shutil.copy(REPOSITORY / "bootstrap.py", tmp_path)
    done = subprocess.run([sys.executable, program, *goals], capture_output=True, text=True, check=False)
    told = f"setup: {' '.join(goals)}: no such goal; valid is one of run, develop, docs\n"
    assert (done.returncode, done.stderr) == (1, told)
    assert [path.name for path in tmp_path.iterdir()] == ["bootstrap.py"]


def test_versions_agree():
    import uwb_mitigation

    texts = {
        name: (REPOSITORY / name).read_text() for name in ("package.xml", "msg_defs/package.xml", "setup.py")
    }
    assert f"<version>{uwb_mitigation.__version__}</version>" in texts["package.xml"]
    assert f"<version>{uwb_mitigation.__version__}</version>" in texts["msg_defs/package.xml"]
    assert f'version="{uwb_mitigation.__version__}"' in texts["setup.py"]


def test_every_message_field_says_what_it_is():
    for path in (REPOSITORY / "msg_defs" / "msg").glob("*.msg"):
        for line in Path(path).read_text().splitlines():
            if line.strip() and not line.startswith("#") and "=" not in line.split("#")[0]:
                assert "#" in line, f"{path.name}: {line}"
