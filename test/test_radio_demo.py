"""A short `make radio-demo`: emulated EVB1000s in the simulated flat, driver and mitigator."""

from __future__ import annotations

import subprocess
import sys

import pytest
from compilers import NEEDS_CC

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

pytestmark = [pytest.mark.ros, NEEDS_CC]


def test_each_anchor_ranges_and_the_demo_succeeds():
    command = [sys.executable, "-m", "benchmarks", "radio-demo", "--seconds", "1"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.endswith("┘\n")
    rows = [line.strip("│ ").split("│") for line in result.stdout.splitlines() if line.startswith("│")]
    assert [int(row[0]) for row in rows] == [1, 2, 3, 4]
    for _, count, raw, corrected, true in rows:
        assert int(count) > 0
        assert abs(float(raw) - float(true)) < 4.0
        assert abs(float(corrected) - float(true)) < 4.0
    # LOS ranges may need no correction.
    assert any(float(corrected) != float(raw) for *_, raw, corrected, _ in rows)
