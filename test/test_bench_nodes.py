"""Benchmark of the nodes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from ros_harness import Ros

from benchmarks.nodes import RANGES, count_missing

pytestmark = pytest.mark.ros


@pytest.fixture
def own_domain(ros: Ros, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros.domain))


def test_missing_ranges_are_counted_across_a_loop_of_the_bag():
    assert count_missing([5, 6, 7]) == 0
    assert count_missing([5, 6, 9]) == 2
    assert count_missing([RANGES - 2, RANGES - 1, 0, 1]) == 0
    assert count_missing([RANGES - 2, 1]) == 2
    assert count_missing([]) == count_missing([3]) == 0


def test_soak_reports_the_resources_of_the_processes(own_domain: None, tmp_path: Path):
    result = tmp_path / "soak.json"
    command = [sys.executable, "-m", "benchmarks", "soak", "--one-process"]
    command += ["--messages", "1500", "--rate", "1000", "--json", str(result)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    outcome = json.loads(result.read_text())
    assert outcome["received"] >= 1500
    ranges = [look["ranges"] for look in outcome["course"]]
    assert ranges == sorted(set(ranges))
    assert ranges[-1] == outcome["received"]
    assert all(look["threads"] > 0 and look["memory_mb"] > 10 for look in outcome["course"])
    assert str(ranges[0]) in done.stdout
