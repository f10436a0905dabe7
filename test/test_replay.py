"""Replay: pause, seek, rate and loop while it plays, and the same ranges every time."""

from __future__ import annotations

import itertools
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from players import ListSource, Player, stop_after
from ros_harness import PAUSED, Ros
from rosgraph_msgs.msg import Clock as ClockMessage
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.bag.writer import BagWriter
from uwb_mitigation.sources.simulated import SimulatedSource

MS = 1_000_000
COUNT = 400


def steps(count: int, step_ns: int) -> ListSource:
    return ListSource(range(10**18, 10**18 + count * step_ns, step_ns))


def published_with(player: Player, sequence: int) -> int:
    """How many records had come when the call with this one ended: what is late comes together."""
    ends = itertools.accumulate(player.batches)
    return next(end for end in ends if end > player.sequences.index(sequence))


def test_a_seek_forwards_leaves_records_out_and_stamps_go_on():
    player = Player(
        steps(100, 100 * MS), lambda player, sequence: player.playback.seek(9.0) if sequence == 3 else None
    ).play()
    before = published_with(player, 3)
    assert player.sequences == [*range(before), *range(90, 100)]
    assert player.stamps == sorted(player.stamps)
    assert player.stamps[-1] - player.stamps[0] < 5000 * MS


def test_a_seek_backwards_plays_again():
    seeks = iter([True])

    def back(player: Player, sequence: int) -> None:
        if sequence == 5 and next(seeks, False):
            player.playback.seek(0.02)

    player = Player(steps(8, 10 * MS), back).play()
    before = published_with(player, 5)
    assert player.sequences == [*range(before), *range(2, 8)]
    assert player.stamps == sorted(player.stamps)


def test_a_replay_can_start_anywhere_and_ends_at_once_beyond_the_end():
    assert Player(steps(20, 10 * MS), from_s=0.15).play().sequences == [15, 16, 17, 18, 19]
    assert Player(steps(20, 10 * MS), from_s=5.0).play().sequences == []


def test_a_loop_plays_from_the_start_after_a_seek():
    player = Player(steps(10, 5 * MS), stop_after(7), from_s=0.04, loop=True).play()
    # A record that was late already came in one call with the seventh.
    assert player.sequences[:7] == [8, 9, 0, 1, 2, 3, 4]


def test_a_pause_holds_the_records_and_their_time():
    resumed = threading.Event()

    def resume(player: Player) -> None:
        resumed.set()
        player.playback.paused = False

    def pause(player: Player, sequence: int) -> None:
        if sequence == 1:
            player.playback.paused = True
            threading.Timer(0.3, resume, [player]).start()
        if sequence == 2:
            assert resumed.is_set()

    player = Player(steps(5, 200 * MS), pause).play()
    assert player.sequences == [0, 1, 2, 3, 4]
    gaps = np.diff(player.stamps)
    # The rest of the wait for the next record comes after the pause.
    assert gaps[1] > 450 * MS
    assert list(gaps[2:]) == [200 * MS] * 2


def test_a_seek_does_not_wait_for_the_record_that_was_next():
    def skip(player: Player, sequence: int) -> None:
        if sequence == 0:
            player.playback.seek(120.0)

        if sequence == 2:
            player.stop()

    player = Player(steps(4, 60_000 * MS), skip, longest_pause_s=30.0).play()
    assert player.sequences == [0, 2]
    first, second = player.stamps
    assert second - first < 10_000 * MS


def test_the_clock_stands_still_in_a_pause():
    class Watched(Player):
        def tell_time(self, time_ns: int) -> None:
            super().tell_time(time_ns)
            if self.clock_times.count(time_ns) == 5:
                self.playback.paused = False

    def pause(player: Player, sequence: int) -> None:
        if sequence == 1:
            player.playback.paused = True

    player = Watched(steps(3, 100 * MS), pause, recorded_stamps=True).play()
    assert player.sequences == [0, 1, 2], "a clock that goes on ends no pause here"
    assert player.clock_times == sorted(player.clock_times)


def test_another_rate_changes_the_distances_from_there_on():
    def faster(player: Player, sequence: int) -> None:
        if sequence == 2:
            player.playback.rate = 10.0

    player = Player(steps(12, 50 * MS), faster).play()
    gaps = np.diff(player.stamps)
    assert list(gaps[:2]) == [50 * MS] * 2
    assert list(gaps[4:]) == [5 * MS] * 7


def test_late_records_come_several_at_once_and_in_order():
    def delay(player: Player, sequence: int) -> None:
        if sequence == 0:
            time.sleep(0.02)

    player = Player(steps(500, 1000), delay).play()
    assert player.sequences == list(range(500))
    assert max(player.batches) > 1
    assert player.batches[0] == 1


@pytest.fixture(scope="session")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "simulated.mcap"
    source = SimulatedSource(seed=1, count=COUNT, rate_hz=100.0)
    with BagWriter(path, {"source": source.name, "simulated": "true"}) as writer:
        for record in source:
            writer.write(record)
    return path


@pytest.mark.ros
def test_the_same_bag_gives_the_same_corrected_ranges_twice(ros: Ros, bag: Path):
    def play(rate: str) -> list[tuple]:
        received = ros.collect(RangeCorrected, "/uwb/range_corrected")
        pipeline = ros.start(
            "pipeline",
            "source:=mcap",
            f"path:={bag}",
            f"rate:={rate}",
            "publish_clock:=true",
            *PAUSED,
        )
        ros.play()
        assert pipeline.wait() == 0, pipeline.output
        ros.spin_until(lambda: len(received) == COUNT)
        # The next one must not be taken for this one.
        ros.spin_until(lambda: ros.node.count_publishers("/uwb/range_corrected") == 0)
        return [
            (m.header.stamp.sec, m.header.stamp.nanosec, m.sequence, m.range, m.variance, m.status)
            for m in received
        ]

    assert play("8.0") == play("40.0")


@pytest.mark.ros
def test_a_running_replay_is_paused_sought_and_sped_up_by_parameters(ros: Ros, bag: Path):
    received = ros.collect(RangeCir, "/uwb/range_raw")
    clock = ros.collect(ClockMessage, "/clock")
    driver = ros.start(
        "driver", "source:=mcap", f"path:={bag}", "paused:=true", "publish_clock:=true", "start_delay:=0.2"
    )
    ros.spin_until(lambda: len(clock) > 5)
    assert received == []
    assert ros.set_parameter("driver", "seek_to", 3.0).successful
    assert ros.set_parameter("driver", "rate", 5.0).successful
    assert ros.set_parameter("driver", "paused", False).successful
    assert driver.wait() == 0, driver.output
    ros.spin_until(lambda: len(received) == COUNT // 4)
    assert [m.sequence for m in received] == list(range(300, COUNT))
