"""All commands of docs/tutorials/your_site.md in order, with emulated boards.

A `bash` block of the page is run unchanged. Its first line may name a terminal (`# terminal: driver`): its
command keeps running until the next block for that terminal.
"""

import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from compilers import NEEDS_CC
from conftest import REPOSITORY

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from geometry_msgs.msg import PoseWithCovarianceStamped
from ros_harness import Process, Ros

from uwb_mitigation.recordings.recorded_ranges import read_ranges
from uwb_mitigation.types.anchors import load_anchors

pytestmark = [pytest.mark.ros, pytest.mark.slow, NEEDS_CC]

PAGE = REPOSITORY / "docs" / "tutorials" / "your_site.md"
FENCED = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
TERMINAL = re.compile(r"# terminal: (\w+)\n")


class Terminals:
    """One shell for commands that end, and one for each terminal with a name."""

    def __init__(self, ros: Ros) -> None:
        self._ros = ros
        self.open: dict[str, Process] = {}
        self.logs: list[Path] = []

    def type(self, text: str) -> None:
        """Run a block; wait for its end unless it names a terminal, whose command is interrupted."""
        named = TERMINAL.match(text)
        name = named.group(1) if named else "first"
        if earlier := self.open.pop(name, None):
            assert earlier.exit_code() is None, f"{name} has ended by itself\n{earlier.output}"
            os.killpg(earlier.pid, signal.SIGINT)
            earlier.wait()
        if named and not text[named.end() :].strip():
            return
        shell = self.open[name] = self._ros.run(["setsid", "bash", "-e", "-c", text])
        self.logs.append(shell.log)
        if not named:
            assert shell.wait() == 0, f"{text}\n{shell.output}"
            del self.open[name]
        # Wait for the ports, as a reader does.
        while "--link board" in text and not Path("board1").exists():
            assert shell.exit_code() is None, shell.output
            time.sleep(0.1)

    def close(self) -> None:
        for shell in self.open.values():
            os.killpg(shell.pid, signal.SIGKILL)
            shell.wait()


@pytest.fixture
def terminals(tmp_path: Path, ros: Ros, monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminals]:
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
    monkeypatch.setenv("PATH", str(tools), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY), prepend=os.pathsep)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("RECORDED_RANGES", "look 20 first 320 second 50 los 30")
    monkeypatch.chdir(folder)
    opened = Terminals(ros)
    yield opened
    opened.close()


def test_commands_of_the_page_lead_from_boards_to_positions(terminals: Terminals, ros: Ros):
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    for kind, text in FENCED.findall(PAGE.read_text(encoding="utf-8")):
        if kind == "text":
            # Other blocks quote output.
            if text.startswith("anchors:"):
                Path("anchors.yaml").write_text(text)
            continue
        assert kind == "bash", f"who types {kind}? {text}"
        terminals.type(text)
        if "view track" in text:
            terminals.open["viewer"].wait_for_output("shows track")
        if "pipeline" in text:
            # Emulated boards in real time range rarely on a busy machine.
            ros.spin_until(lambda: len(poses) > 5, 600.0)
    anchors = load_anchors(Path("anchors.yaml"))
    # The anchors on the page are those that its boards find.
    recorded = read_ranges(Path("first"), anchors)
    assert not recorded.unknown_anchors
    assert {int(row) for tag in recorded.tags for row in tag.raw.anchor} == set(range(len(anchors)))
    shown = "".join(log.read_text() for log in terminals.logs)
    assert "Residuals of held-out ranges" in shown
    for anchor in anchors.anchors:
        assert f"{anchor.id:016x}" in shown
    # In the flat, not beyond its walls.
    at = poses[-1].pose.pose.position
    assert -1.0 < at.x < 10.0
    assert -1.0 < at.y < 8.0
