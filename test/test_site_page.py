"""All commands of docs/tutorials/your_site.md in order, with emulated boards.

A `bash` block of the page is run unchanged. Its first line may name a terminal (`# terminal: driver`): its
command keeps running until the next block for that terminal.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from compilers import NEEDS_CC
from conftest import REPOSITORY

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from geometry_msgs.msg import PoseWithCovarianceStamped
from ros_harness import Ros

from uwb_mitigation.recordings.recorded_ranges import read_ranges
from uwb_mitigation.types.anchors import load_anchors

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    NEEDS_CC,
]

PAGE = REPOSITORY / "docs" / "tutorials" / "your_site.md"
FENCED = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
TERMINAL = re.compile(r"# terminal: (\w+)\n")
TIMEOUT_S = 240.0


class Terminals:
    """One shell for commands that end, and one for each terminal with a name."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.folder = folder
        self._environment = environment
        self._open: dict[str, subprocess.Popen[bytes]] = {}

    def type(self, text: str) -> None:
        """Run a block; wait for its end unless it names a terminal."""
        named = TERMINAL.match(text)
        name = named.group(1) if named else "first"
        self._interrupt(name)
        if named and not text[named.end() :].strip():
            return
        with (self.folder / f"{name}.log").open("ab") as out:
            shell = subprocess.Popen(
                ["bash", "-e", "-c", text],
                cwd=self.folder,
                env=self._environment,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        if named:
            self._open[name] = shell
            # Wait for the ports, as a reader does.
            deadline = time.monotonic() + TIMEOUT_S
            while "--link board" in text and not (self.folder / "board1").exists():
                assert shell.poll() is None, self._printed()
                assert time.monotonic() < deadline, self._printed()
                time.sleep(0.1)
            return
        try:
            code = shell.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            os.killpg(shell.pid, signal.SIGKILL)
            code = None
        assert code == 0, f"{code} of:\n{text}\n{self._printed()}"

    def wait_for(self, name: str, text: str) -> None:
        """Wait until a terminal has printed a text."""
        deadline = time.monotonic() + TIMEOUT_S
        while text not in (self.folder / f"{name}.log").read_text():
            assert self._open[name].poll() is None, self._printed()
            assert time.monotonic() < deadline, self._printed()
            time.sleep(0.1)

    def _interrupt(self, name: str) -> None:
        """Send SIGINT and wait for the end of the command."""
        shell = self._open.pop(name, None)
        if shell is not None:
            assert shell.poll() is None, f"{name} has ended by itself\n{self._printed()}"
            os.killpg(shell.pid, signal.SIGINT)
            shell.wait(240)

    def close(self) -> None:
        for shell in self._open.values():
            os.killpg(shell.pid, signal.SIGKILL)
            shell.wait(240)

    def _printed(self) -> str:
        return "\n".join(f"--- {log.name}\n{log.read_text()[-3000:]}" for log in self.folder.glob("*.log"))


@pytest.fixture
def terminals(tmp_path: Path, ros: Ros) -> Iterator[Terminals]:
    tools, folder = tmp_path / "tools", tmp_path / "a site"
    tools.mkdir()
    folder.mkdir()
    stand_in = Path(__file__).with_name("ros2_stand_in.py")
    for name, what in (
        ("uwb-mitigation", "-m uwb_mitigation.commands.cli"),
        ("python", ""),
        ("ros2", f'"{stand_in}"'),
    ):
        (tools / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {what} "$@"\n')
        (tools / name).chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tools}:{os.environ['PATH']}",
        "PYTHONPATH": f"{REPOSITORY}:{os.environ.get('PYTHONPATH', '')}",
        "ROS_DOMAIN_ID": str(ros.domain),
        "PYTHONUNBUFFERED": "1",
        "COLUMNS": "160",
        "RECORDED_RANGES": "look 20 first 320 second 50 los 30",
    }
    opened = Terminals(folder, environment)
    yield opened
    opened.close()


def test_commands_of_the_page_lead_from_boards_to_positions(terminals: Terminals, ros: Ros):
    folder = terminals.folder
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    for kind, text in FENCED.findall(PAGE.read_text(encoding="utf-8")):
        if kind == "text":
            # Other blocks quote output.
            if text.startswith("anchors:"):
                (folder / "anchors.yaml").write_text(text)
            continue
        assert kind == "bash", f"who types {kind}? {text}"
        terminals.type(text)
        if "view track" in text:
            terminals.wait_for("viewer", "shows track")
        if "pipeline" in text:
            # Emulated boards in real time range rarely on a busy machine.
            ros.spin_until(lambda: len(poses) > 5, 600.0)
    anchors = load_anchors(folder / "anchors.yaml")
    # The anchors on the page are those that its boards find.
    recorded = read_ranges(folder / "first", anchors)
    assert not recorded.unknown_anchors
    assert {int(row) for tag in recorded.tags for row in tag.raw.anchor} == set(range(len(anchors)))
    shown = "".join(log.read_text() for log in folder.glob("*.log"))
    assert "Residuals of held-out ranges" in shown
    for anchor in anchors.anchors:
        assert f"{anchor.id:016x}" in shown
    # In the flat, not beyond its walls.
    at = poses[-1].pose.pose.position
    assert -1.0 < at.x < 10.0
    assert -1.0 < at.y < 8.0
