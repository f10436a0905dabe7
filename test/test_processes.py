"""Nodes of a benchmark or demo end with it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

TIMEOUT_S = 240.0


def nodes_of(pid: int) -> list[psutil.Process]:
    """Return the nodes that a process has started."""
    nodes = []
    for child in psutil.Process(pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):  # a compiler may have ended
            if {"uwb_mitigation.commands.entry", "-m"} <= set(child.cmdline()):
                nodes.append(child)
    return nodes


@pytest.mark.ros
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
            time.sleep(0.05)
        running.send_signal(number)
        assert running.wait(TIMEOUT_S) == code, (tmp_path / "said").read_text()
        _, left = psutil.wait_procs(nodes, TIMEOUT_S)
        for node in left:
            node.kill()
        assert not left
    finally:
        running.kill()
        running.wait()
