"""`make firmware-demo`, short: the firmware in an emulated processor, the driver on its port, the host's bits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from uwb_mitigation.demos.firmware_demo import firmware_demo
from uwb_mitigation.firmware_export import toolchain

MISSING = toolchain.missing_tools()
pytestmark = pytest.mark.ros


@pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not found: {toolchain.APT}")
def test_the_demo_ends_by_itself_with_every_range_equal_to_the_hosts():
    command = [sys.executable, "-m", "uwb_mitigation.entry", "firmware-demo", "--count", "20"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "20 corrected by the board, 0 lost" in done.stdout
    assert "20 equal to the host's to the bit, 0 different" in done.stdout
    assert "gone" not in done.stdout + done.stderr, "the driver's own end is no loss of the board"


def test_without_the_tools_the_demo_names_the_line_that_installs_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(name, os.environ.get(name, ""))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(typer.Exit) as end:
        firmware_demo(recording=None, count=1)
    assert end.value.exit_code == 1
    assert "apt install gcc-arm-none-eabi" in " ".join(capsys.readouterr().out.split())
