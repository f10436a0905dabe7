"""A recording is made playable: no long pauses, and a date."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from bag_material import START_NS, record

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.sources.inventory import PauseShortener

DAY_NS = 86_400 * 10**9
TODAY_NS = START_NS + 500 * DAY_NS


def moved(pauses: PauseShortener, *stamps_ns: int) -> list[int]:
    records = [replace(record(0), measurement=replace(record(0).measurement, stamp_ns=s)) for s in stamps_ns]
    return [pauses.without(item).measurement.stamp_ns for item in records]


def test_a_pause_is_cut_to_the_longest_and_what_follows_keeps_its_spacing() -> None:
    pauses = PauseShortener(5.0, TODAY_NS)
    times = moved(pauses, START_NS, START_NS + 10**9, START_NS + DAY_NS, START_NS + DAY_NS + 7)
    assert [time - START_NS for time in times] == [0, 10**9, 6 * 10**9, 6 * 10**9 + 7]
    assert (pauses.cut, pauses.cut_s) == (1, pytest.approx(86_400 - 6))


def test_an_infinite_pause_cuts_none_and_time_that_runs_backwards_stays() -> None:
    stamps = (START_NS, START_NS + DAY_NS, START_NS + 3)
    assert moved(PauseShortener(math.inf, TODAY_NS), *stamps) == list(stamps)


def test_what_bears_no_date_begins_on_the_given_one_or_behind_what_has_one() -> None:
    assert moved(PauseShortener(5.0, TODAY_NS), 0, 10) == [TODAY_NS, TODAY_NS + 10]
    assert moved(PauseShortener(5.0, TODAY_NS), START_NS, 0, 10) == [START_NS, START_NS, START_NS + 10]


@pytest.mark.parametrize("longest", [-1.0, math.nan])
def test_a_pause_that_cannot_be_is_refused(longest: float) -> None:
    with pytest.raises(ParameterError, match="inf cuts none"):
        PauseShortener(longest, 0)
