"""Shortened pauses, and dates of recordings without one."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from bag_material import START_NS, record

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.recordings.summary import PauseShortener

DAY_NS = 86_400 * 10**9
TODAY_NS = START_NS + 500 * DAY_NS


def moved(pauses: PauseShortener, *stamps_ns: int) -> list[int]:
    records = [replace(record(0), measurement=replace(record(0).measurement, stamp_ns=s)) for s in stamps_ns]
    return [pauses.without(item).measurement.stamp_ns for item in records]


def test_pause_is_shortened_and_later_intervals_are_kept() -> None:
    pauses = PauseShortener(5.0, TODAY_NS)
    times = moved(pauses, START_NS, START_NS + 10**9, START_NS + DAY_NS, START_NS + DAY_NS + 7)
    assert [time - START_NS for time in times] == [0, 10**9, 6 * 10**9, 6 * 10**9 + 7]
    assert (pauses.cut, pauses.cut_s) == (1, pytest.approx(86_400 - 6))


def test_infinite_limit_and_decreasing_stamps_change_nothing() -> None:
    stamps = (START_NS, START_NS + DAY_NS, START_NS + 3)
    assert moved(PauseShortener(math.inf, TODAY_NS), *stamps) == list(stamps)


def test_records_without_a_date_start_at_the_given_date_or_after_dated_records() -> None:
    assert moved(PauseShortener(5.0, TODAY_NS), 0, 10) == [TODAY_NS, TODAY_NS + 10]
    assert moved(PauseShortener(5.0, TODAY_NS), START_NS, 0, 10) == [START_NS, START_NS, START_NS + 10]


@pytest.mark.parametrize("longest", [-1.0, math.nan])
def test_invalid_limit_is_refused(longest: float) -> None:
    with pytest.raises(ParameterError, match="inf cuts none"):
        PauseShortener(longest, 0)
