"""Playing a source at its pace: order, times, pauses, looping, stopping and errors."""

from __future__ import annotations

import time
from itertools import pairwise

import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from players import ListSource, Player, stop_after
from rclpy.clock import Clock, ClockType

from uwb_mitigation.errors import DamagedRecordingError
from uwb_mitigation.nodes import clocks


def offsets(player: Player) -> list[int]:
    return [stamp - player.stamps[0] for stamp in player.stamps]


def test_records_come_in_order_and_the_end_is_told_once():
    player = Player(ListSource([5, 10, 20])).play()
    assert player.recorded == [5, 10, 20]
    assert player.ends == [None]


def test_stamps_keep_the_recorded_distances_divided_by_the_rate():
    player = Player(ListSource([1_000_000_000, 1_020_000_000, 1_080_000_000]), rate=2.0).play()
    assert offsets(player) == [0, 10_000_000, 40_000_000]


def test_a_record_is_never_published_before_its_stamp():
    source = ListSource([0, 30_000_000, 60_000_000])
    player = Player(source)
    early = []
    publish = player.publish
    player.playback._publish = lambda records: (
        early.append(player.clock.now().nanoseconds < records[-1][1]),
        publish(records),
    )
    player.play()
    assert early == [False, False, False]


def test_a_long_pause_is_cut():
    player = Player(ListSource([0, 3_600_000_000_000]), longest_pause_s=0.05).play()
    assert offsets(player) == [0, 50_000_000]


def test_recorded_stamps_stay_and_the_clock_leads_up_to_them():
    stamps = [1_000_000_000, 2_000_000_000]
    player = Player(ListSource(stamps), recorded_stamps=True).play()
    assert player.stamps == stamps
    assert player.clock_times == sorted(player.clock_times)
    assert player.clock_times[0] == stamps[0]
    assert player.clock_times[-1] == stamps[1]
    assert len(player.clock_times) >= 4


def test_a_loop_goes_on_in_time():
    player = Player(ListSource([0, 10_000_000, 20_000_000]), stop_after(7), loop=True).play()
    # A record that was late already came in one call with the seventh.
    assert offsets(player)[:7] == [step * 10_000_000 for step in range(7)]


def test_damage_is_told_after_everything_before_it_was_played():
    damage = DamagedRecordingError("torn", where="file:7")
    player = Player(ListSource([0, 1], damage)).play()
    assert len(player.sequences) == 2
    assert player.ends == [damage]


def test_a_stop_during_a_pause_ends_the_thread_and_tells_no_end():
    player = Player(ListSource([0, 3_000_000_000_000]), longest_pause_s=1e4)
    player.playback.start()
    while not player.sequences:
        pass
    player.playback.stop()
    assert not player.playback._thread.is_alive()
    assert player.ends == []


def test_the_clock_of_a_recording_that_starts_at_zero_is_never_negative():
    player = Player(ListSource([0, 30_000_000]), stop_after(5), loop=True, recorded_stamps=True).play()
    assert player.clock_times
    assert min(player.clock_times) >= 0


def test_a_source_that_fails_in_no_foreseen_way_ends_the_playing_with_an_error(capsys):
    class Broken(ListSource):
        def __iter__(self):
            yield from super().__iter__()
            raise ZeroDivisionError("a bug")

    player = Player(Broken([0, 1])).play()
    assert len(player.sequences) == 2
    (error,) = player.ends
    assert "a bug" in str(error)
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_a_wall_clock_that_is_set_neither_stops_nor_hurries_a_replay(monkeypatch: pytest.MonkeyPatch):
    step_ns = [0]
    wall_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns() + step_ns[0])
    pace = clocks.Pace(Clock(clock_type=ClockType.SYSTEM_TIME))
    began_ns = pace.now_ns()
    due_ns = [began_ns + each * 1_000_000 for each in range(4)]
    stamps = []
    for due, step_s in zip(due_ns, (0, 0, -3600, 10_800), strict=True):
        step_ns[0] = step_s * 10**9
        stamps.append(pace.stamp_ns(due))
    assert 0 < pace.now_ns() - began_ns < 60 * 10**9, "the pace is another clock's"
    assert stamps[1] - stamps[0] == 1_000_000, "stamps are as far apart as what they are of"
    steps_s = [round((b - a) / 1e9) for a, b in pairwise(stamps)]
    assert steps_s == [0, -3600, 14_400], "stamps are on the clock as it is set"


def test_a_process_held_up_between_two_clocks_does_not_take_one_for_set(monkeypatch: pytest.MonkeyPatch):
    steady_ns, held_up_ns = [0], [0]

    def wall_ns() -> int:
        steady_ns[0] += held_up_ns[0]
        wall = 10**18 + steady_ns[0]
        steady_ns[0] += held_up_ns[0]
        return wall

    monkeypatch.setattr(time, "monotonic_ns", lambda: steady_ns[0])
    monkeypatch.setattr(time, "time_ns", wall_ns)
    pace = clocks.Pace(Clock(clock_type=ClockType.SYSTEM_TIME))
    stamps = []
    for due_ns, held_up_ns[0] in ((0, 0), (25_000_000, 5_000_000), (50_000_000, 0)):
        stamps.append(pace.stamp_ns(due_ns))
    assert [b - a for a, b in pairwise(stamps)] == [25_000_000, 25_000_000]


def test_how_late_a_source_is_that_cannot_keep_its_rate_is_known():
    class Slow(ListSource):
        def __iter__(self):
            for record in super().__iter__():
                time.sleep(0.005)
                yield record

    player = Player(Slow([each * 1000 for each in range(60)])).play()
    assert player.playback.late_ns > 100_000_000
