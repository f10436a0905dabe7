"""Counts, latency and errors of the monitor."""

import math
import re

import pytest
from conftest import REPOSITORY

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from rich.console import Console

from uwb_mitigation.nodes.monitor import RangeStatistics, live_table, summary
from uwb_mitigation.types.measurement import CorrectedBy, CorrectedRange, Status, Truth
from uwb_mitigation.types.ros.codec import MeasurementKey


def printed(table: object, width: int = 100) -> str:
    """Return what a terminal of this width shows."""
    console = Console(width=width, record=True)
    console.print(table)
    return console.export_text()


def corrected(statistics: RangeStatistics, sequence: int, raw: float, out: float, latency_s: float = 0.001):
    result = CorrectedRange(out, raw, raw - out, 0.04, Status.OK, CorrectedBy.HOST, 1)
    key = MeasurementKey(sequence * 100_000_000, 1, 7, sequence)
    statistics.add_corrected(key, result, key.stamp_ns / 1e9 + latency_s)


def test_counts_rate_latency_and_sigma():
    statistics = RangeStatistics()
    for index in range(100):
        statistics.add_raw(index * 100_000_000)
        corrected(statistics, index, 2.2, 1.9, latency_s=(1 + index % 3) / 1000)
    statistics.add_raw(100 * 100_000_000)
    assert (statistics.corrected, statistics.missing, statistics.errors) == (100, 1, {})
    assert statistics.latency_ms(50) == pytest.approx(2.0)
    assert statistics.pairs[7, 1].rate_hz() == pytest.approx(10.0, rel=1e-2)
    assert statistics.pairs[7, 1].corrected.variance_m2 == pytest.approx(0.04)


@pytest.mark.parametrize("late", ["raw", "corrected"])
def test_ranges_before_the_other_topic_are_not_lost(late: str):
    statistics = RangeStatistics()
    for index in range(178):
        if late != "raw" or index >= 37:
            statistics.add_raw(index * 100_000_000)
        if (late != "corrected" or index >= 37) and index != 100:
            corrected(statistics, index, 2.2, 1.9)
    assert statistics.missing == 1
    assert "37 of the " in printed(summary(statistics))


def test_ranges_without_a_mitigator_are_not_called_lost():
    statistics = RangeStatistics()
    statistics.add_raw(0)
    expected = "1 ranges received, 0 corrected, no /uwb/range_corrected: is the mitigator running?"
    assert expected in printed(summary(statistics))


def test_errors_are_absolute_and_grouped_by_label():
    statistics = RangeStatistics()
    for sequence, true_m, label, raw, out in (
        (1, 2.0, "LOS", 2.2, 1.9),
        (2, 3.0, "NLOS", 4.0, 3.5),
        (3, 2.0, "LOS", math.nan, math.nan),
    ):
        statistics.add_truth(MeasurementKey(sequence * 100_000_000, 1, 7, sequence), Truth(true_m, label))
        corrected(statistics, sequence, raw, out)
    assert statistics.errors["LOS"] == pytest.approx([1, 0.2, 0.1])
    assert sum(statistics.errors.values()) == pytest.approx([2, 1.2, 0.6])
    assert statistics.missing == 0  # a board that corrects sends no raw ranges


@pytest.mark.parametrize("width", [80, 60])
def test_table_with_units_fits_the_terminal_and_omits_columns(width: int):
    statistics = RangeStatistics()
    key = MeasurementKey(0, 101, 1, 0)
    result = CorrectedRange(2.923, 3.4, 0.477, 0.069, Status.OK, CorrectedBy.HOST, 1)
    statistics.add_truth(key, Truth(3.0, "NLOS"))
    statistics.add_corrected(key, result, 0.001)
    shown = printed(live_table(statistics, "", width), width)
    words = re.findall(r"[a-zA-Z]+", shown)
    assert {"corrected", "sigma", "true", "status", "OK"} <= set(words)
    assert ("label" in words) == (width == 80)
    if width == 80:
        quote = (REPOSITORY / "docs" / "tutorials" / "first_steps.md").read_text()
        (header,) = re.findall(r"┏[^│]*rate[^│]*┩\n", quote)
        assert header in shown
    statistics.pairs[1, 101].truth = None
    assert "true" not in printed(live_table(statistics, ""))
