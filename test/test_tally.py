"""What the monitor adds up."""

from __future__ import annotations

import math

import pytest

from uwb_mitigation.measurement import CorrectedRange, Origin, Status, Truth
from uwb_mitigation.nodes.tally import Tally


def corrected(tally: Tally, key: int, *, raw: float, out: float, at: float = 0.0, latency: float = 0.001):
    made = CorrectedRange(out, raw, raw - out, 0.04, Status.OK, Origin.HOST, 1)
    tally.add_corrected(key, (7, 1), made, at, latency)


def test_what_is_not_answered_is_missing():
    tally = Tally()
    tally.add_raw()
    tally.add_raw()
    corrected(tally, 1, raw=2.0, out=1.5)
    assert tally.missing == 1


def test_errors_are_absolute_and_grouped_by_label():
    tally = Tally()
    tally.add_truth(1, Truth(2.0, "LOS"))
    tally.add_truth(2, Truth(3.0, "NLOS"))
    corrected(tally, 1, raw=2.2, out=1.9)
    corrected(tally, 2, raw=4.0, out=3.5)
    assert tally.errors["LOS"].raw_m == pytest.approx(0.2)
    assert tally.errors["LOS"].corrected_m == pytest.approx(0.1)
    assert tally.total.n == 2
    assert tally.total.corrected_m == pytest.approx(0.6)


def test_a_range_without_truth_counts_but_has_no_error():
    tally = Tally()
    corrected(tally, 1, raw=2.2, out=1.9)
    assert tally.corrected == 1
    assert tally.errors == {}


def test_a_range_that_is_not_a_number_has_no_error():
    tally = Tally()
    tally.add_truth(1, Truth(2.0, "LOS"))
    corrected(tally, 1, raw=math.nan, out=math.nan)
    assert tally.total.n == 0


def test_the_rate_is_that_of_the_last_arrivals():
    tally = Tally()
    for index in range(100):
        corrected(tally, index, raw=1.0, out=1.0, at=index * 0.1)
    assert tally.pairs[(7, 1)].rate_hz() == pytest.approx(10.0)


def test_sigma_is_the_root_of_the_variance():
    tally = Tally()
    corrected(tally, 1, raw=1.0, out=1.0)
    assert tally.pairs[(7, 1)].samples[-1].sigma_m == pytest.approx(0.2)


def test_latency_percentiles_are_in_milliseconds():
    tally = Tally()
    for latency in (0.001, 0.002, 0.003):
        corrected(tally, 1, raw=1.0, out=1.0, latency=latency)
    assert tally.latency_ms(50) == pytest.approx(2.0)


def test_truth_whose_range_never_comes_does_not_pile_up():
    tally = Tally()
    for key in range(50_000):
        tally.add_truth(key, Truth(1.0))
    assert len(tally._truths) <= 10_000


def test_a_summary_of_nothing_tells_no_number_that_is_none():
    pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
    from rich.console import Console

    from uwb_mitigation.nodes.monitor import summary

    console = Console(width=100, record=True)
    console.print(summary(Tally()))
    told = console.export_text()
    assert "0 ranges received" in told
    assert "nan" not in told
