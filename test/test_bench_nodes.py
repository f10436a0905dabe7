"""The bench of the nodes: what it counts, what it tells, and that its subjects run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from ros_harness import Ros

from benchmarks.cli import nodes_result
from benchmarks.nodes import RANGES, RATES_HZ, Figures, Latency, missing_between

pytestmark = pytest.mark.ros


@pytest.fixture
def own_domain(ros: Ros, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros.domain))


def test_ranges_that_are_missing_are_counted_across_the_bags_end():
    assert missing_between([5, 6, 7]) == 0
    assert missing_between([5, 6, 9]) == 2
    assert missing_between([RANGES - 2, RANGES - 1, 0, 1]) == 0
    assert missing_between([RANGES - 2, 1]) == 2
    assert missing_between([]) == missing_between([3]) == 0


def figures(rate_hz: float, p99: float) -> Figures:
    latency = {rate: Latency(100.0, p99, 2 * p99) for rate in RATES_HZ}
    return Figures([rate_hz, 2 * rate_hz, 3 * rate_hz], latency, 50.0, 90.0, 70.0)


def test_the_result_has_the_documented_keys_and_ratios_of_medians():
    of = {"relay": figures(1000, 300.0), "mitigator": figures(800, 400.0), "pipeline": figures(2000, 200.0)}
    result = json.loads(json.dumps(nodes_result(of)))
    assert result["ratios"] == {
        "mitigator_rate_over_relay": 0.8,
        "pipeline_rate_over_mitigator": 2.5,
        "added_p99_us_at_500_hz": 100.0,
    }
    assert result["relay"]["max_lossless_rate_hz"] == 2000
    assert set(result["relay"]["latency_us"]) == {"100", "500", "1000"}
    assert set(result["relay"]["latency_us"]["500"]) == {"p50", "p99", "max"}
    assert result["relay"]["cpu_us_per_message"] == 50.0


def test_a_soak_tells_what_the_processes_took(own_domain: None, tmp_path: Path):
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


def test_without_ros_the_bench_says_what_is_missing(tmp_path: Path):
    (tmp_path / "rclpy.py").write_text("raise ModuleNotFoundError('no rclpy here', name='rclpy')\n")
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "nodes"],
        env={"PYTHONPATH": f"{tmp_path}:{Path(__file__).parent.parent}", "COLUMNS": "160"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 1
    assert "ROS 2 is not set up" in done.stderr
    assert "Traceback" not in done.stderr
