"""A short `make radio-demo` and `make firmware-demo`."""

from __future__ import annotations

import subprocess
import sys

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
