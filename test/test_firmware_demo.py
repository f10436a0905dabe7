"""A short `make firmware-demo`: bit-identical with the host."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from uwb_mitigation.mitigation.embedded import toolchain

MISSING = toolchain.missing_tools()
pytestmark = pytest.mark.ros


@pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not found: {toolchain.APT}")
def test_demo_ends_with_every_range_equal_to_that_of_the_host():
    command = [sys.executable, "-m", "benchmarks", "firmware-demo", "--count", "20"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "20 corrected by the board, 0 lost" in done.stdout
    assert "20 bit-identical to those of the host, 0 different" in done.stdout
    assert "gone" not in done.stdout + done.stderr, "the driver's own end is no loss of the board"
