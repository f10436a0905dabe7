"""The executables without ROS: help, and signals during imports."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY

from uwb_mitigation.nodes.support.parameter_tables import TABLES

# Short sleeps: a signal that arrives just before a sleep is handled after it.
LOADING = "import time\nprint('loading', flush=True)\nwhile True:\n    time.sleep(0.1)\n"


def run(executable: str, *words: str, path: Path | None = None) -> subprocess.Popen[str]:
    """Start an executable or a benchmark; modules in `path` replace installed ones."""
    start = ["-c", f"from uwb_mitigation.commands.entry import {executable}; {executable}()"]
    if executable == "benchmarks":
        start = ["-m", "benchmarks", "radio-demo"]
    modules = os.pathsep.join(str(entry) for entry in (path, REPOSITORY) if entry is not None)
    return subprocess.Popen(
        [sys.executable, *start, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONPATH": modules},
    )


@pytest.mark.parametrize(
    ("node", "tables"),
    [("driver", ["driver"]), ("pipeline", ["driver", "mitigator", "locator"]), ("monitor", [])],
)
def test_help_lists_every_parameter_without_ros(node: str, tables: list[str], tmp_path: Path):
    (tmp_path / "rclpy.py").write_text("raise ModuleNotFoundError('no rclpy here', name='rclpy')\n")
    process = run(node, "--help", path=tmp_path)
    output, _ = process.communicate(timeout=240)
    assert process.returncode == 0, output
    assert f"usage: {node} " in output
    assert all(f"\n  {row.name}:=" in output for table in tables for row in TABLES[table])


@pytest.mark.parametrize("node", ["monitor", "mitigator"])
def test_arguments_that_ros_cannot_parse_are_an_error_without_a_traceback(node: str):
    pytest.importorskip("rclpy")
    process = run(node, "--ros-args", "-r", "uwb/range_raw:=/a//b")
    output, _ = process.communicate(timeout=240)
    assert (process.returncode, "Traceback" in output) == (1, False), output
    assert "check what follows --ros-args, and the environment" in output


@pytest.mark.parametrize(("words", "code"), [([], 1), (["--help"], 0)])
def test_module_without_a_node_names_the_nodes_in_one_line(words: list[str], code: int):
    command = [sys.executable, "-m", "uwb_mitigation.commands.entry", *words]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == code
    (line,) = (done.stdout if code == 0 else done.stderr).splitlines()
    assert "driver, mitigator, locator" in line


@pytest.mark.parametrize(
    ("executable", "number", "loaded"),
    [
        ("driver", signal.SIGINT, "rclpy"),
        ("driver", signal.SIGTERM, "rclpy"),
        ("driver", signal.SIGINT, "serial"),
        ("command_line", signal.SIGINT, "typer"),
        ("benchmarks", signal.SIGINT, "typer"),
    ],
)
def test_signal_during_an_import_ends_the_process(
    executable: str, number: signal.Signals, loaded: str, tmp_path: Path
):
    """`serial` is imported when the node starts."""
    if loaded == "serial":
        pytest.importorskip("rclpy")
    (tmp_path / f"{loaded}.py").write_text(LOADING)
    process = run(executable, path=tmp_path)
    assert process.stdout.readline() == "loading\n"
    process.send_signal(number)
    output, _ = process.communicate(timeout=240)
    assert (process.returncode, output) == (128 + number, "")


def test_interrupted_exec_keeps_the_exit_code(tmp_path: Path):
    """Python libraries declare classes with exec() of a text; `python -m` then ends with the signal."""
    (tmp_path / "program.py").write_text(
        "import os, signal, sys, time\n"
        "def main():\n"
        "    try:\n"
        "        exec('os.kill(os.getpid(), signal.SIGINT); time.sleep(30)')\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(130)\n"
        "if __name__ == '__main__':\n"
        "    from uwb_mitigation.commands.entry import run_program\n"
        "    run_program('program', 'main')\n"
    )
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{REPOSITORY}"}
    done = subprocess.run([sys.executable, "-m", "program"], env=environment, timeout=240, check=False)
    assert done.returncode == 130
