"""A short `make radio-demo` and `make firmware-demo`; nodes end with their demo or benchmark."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from compilers import NEEDS_CC

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from uwb_mitigation.mitigation.embedded import toolchain

pytestmark = [pytest.mark.ros, NEEDS_CC]


def run(*arguments: str) -> str:
    command = [sys.executable, "-m", "benchmarks", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_each_anchor_ranges_and_the_demo_succeeds():
    shown = run("radio-demo", "--seconds", "1")
    assert "┘\n" in shown
    rows = [line.strip("│ ").split("│") for line in shown.splitlines() if line.startswith("│")]
    assert [int(row[0]) for row in rows] == [1, 2, 3, 4]
    for _, count, raw, corrected, true in rows:
        assert int(count) > 0
        assert abs(float(raw) - float(true)) < 4.0
        assert abs(float(corrected) - float(true)) < 4.0
    # LOS ranges may need no correction.
    assert any(float(corrected) != float(raw) for *_, raw, corrected, _ in rows)


@pytest.mark.skipif(bool(toolchain.missing_tools()), reason=toolchain.APT)
def test_firmware_demo_ends_with_every_range_equal_to_that_of_the_host():
    shown = run("firmware-demo", "--count", "20")
    assert "20 corrected by the board, 0 lost" in shown
    assert "20 bit-identical to those of the host, 0 different" in shown
    assert "gone" not in shown, "the driver's own end is no loss of the board"


TIMEOUT_S = 240.0


def nodes_of(pid: int) -> list[psutil.Process]:
    """Return the nodes that a process has started."""
    nodes = []
    for child in psutil.Process(pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):  # a compiler may have ended
            if {"uwb_mitigation.commands.entry", "-m"} <= set(child.cmdline()):
                nodes.append(child)
    return nodes


@pytest.mark.parametrize(
    ("program", "number", "code"),
    [("nodes", signal.SIGKILL, -9), ("demo", signal.SIGTERM, 143), ("demo", signal.SIGINT, 130)],
)
def test_nodes_end_with_their_parent_process(program: str, number: signal.Signals, code: int, tmp_path: Path):
    # Each process isolates itself.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
    with (tmp_path / "said").open("wb") as said:
        command = [sys.executable, "-m", "benchmarks", program]
        running = subprocess.Popen(command, env=environment, stdout=said, stderr=subprocess.STDOUT)
    try:
        deadline = time.monotonic() + TIMEOUT_S
        while len(nodes := nodes_of(running.pid)) < 2:
            assert running.poll() is None, (tmp_path / "said").read_text()
            assert time.monotonic() < deadline, "it starts no nodes"
            time.sleep(0.3)
        running.send_signal(number)
        assert running.wait(TIMEOUT_S) == code, (tmp_path / "said").read_text()
        _, left = psutil.wait_procs(nodes, TIMEOUT_S)
        for node in left:
            node.kill()
        assert not left
    finally:
        running.kill()
        running.wait()
