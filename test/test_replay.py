"""Replay: pace, pause, seek, rate, loop, stop and errors, and the same ranges every time."""

from __future__ import annotations

import itertools
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from bag_material import write_records

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.serialization import serialize_message
from rclpy.time import Time
from ros_harness import PAUSED, Ros
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from uwb_mitigation_msgs.msg import RangeCir

from uwb_mitigation.errors import DamagedRecordingError, UwbMitigationError
from uwb_mitigation.nodes.feeds.replay import ReplayFeed
from uwb_mitigation.nodes.feeds.replay_clock import ReplayClock
from uwb_mitigation.nodes.support.parameter_tables import DRIVER, RESPAWN_FOLDER, help_text
from uwb_mitigation.nodes.support.respawn import unused_path
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import Cir, RangeMeasurement, Record
from uwb_mitigation.types.ros.topics import IMU_TYPE, ODOMETRY_TYPE, TF_TYPE
from uwb_mitigation.types.stamps import to_ns

MS = 1_000_000
COUNT = 400
DEFAULTS = {row.name: row.default for row in DRIVER} | {
    "longest_pause": 100.0,
    "wait_for_subscribers": 0,
    "start_delay": 0.0,
}
SILENT = SimpleNamespace(info=lambda text: None, warning=lambda text, **_: None)


class ListSource:
    """Records at given times, numbered from 0; it may end with an error. It calls `before` before each."""

    name = "list"
    simulated = True

    def __init__(self, stamps_ns: Sequence[int], error: Exception | None = None) -> None:
        self.stamps_ns, self.error = stamps_ns, error
        self.skipped: Counter[str] = Counter()
        self.before = lambda index: None

    def __iter__(self) -> Iterator[Record]:
        for index, stamp_ns in enumerate(self.stamps_ns):
            self.before(index)
            yield Record(RangeMeasurement(stamp_ns, 1, 2, index, 0, 1.0, Cir(np.zeros(0, np.int16))))
        if self.error is not None:
            raise self.error

    def close(self) -> None:
        pass


def steps(count: int, step_ns: int) -> ListSource:
    return ListSource(range(10**18, 10**18 + count * step_ns, step_ns))


class Player:
    """Plays a source; `on_record(player, sequence)` is called for each record, from the playing thread."""

    subscription_count = 0

    def __init__(
        self,
        source: ListSource,
        on_record: Callable[[Player, int], None] = lambda player, sequence: None,
        replay_clock: CountedTime | None = None,
        **options: object,
    ) -> None:
        self.clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.sequences: list[int] = []
        self.recorded: list[int] = []
        self.stamps: list[int] = []
        self.early: list[bool] = []
        self.batches: list[int] = []
        self.clock_times: list[int] = []
        self.ends: list[UwbMitigationError | None] = []
        self.ended = threading.Event()
        self.on_record = on_record
        parameters = (DEFAULTS | options).__getitem__
        self.feed = ReplayFeed(source, self.clock, parameters, SILENT, self, self.end)
        self.feed._clock = replay_clock or self.feed._clock

    def publish_records(self, records: Sequence[tuple[Record, int]]) -> None:
        self.batches.append(len(records))
        self.early.append(self.clock.now().nanoseconds < records[-1][1])
        for record, stamp_ns in records:
            self.sequences.append(record.measurement.sequence)
            self.recorded.append(record.measurement.stamp_ns)
            self.stamps.append(stamp_ns)
            self.on_record(self, record.measurement.sequence)

    def set(self, **values: object) -> None:
        self.feed.apply(values, values.__getitem__)

    def publish_clock(self, time_ns: int) -> None:
        self.clock_times.append(time_ns)

    def end(self, error: UwbMitigationError | None) -> None:
        self.ends.append(error)
        self.ended.set()

    def stop(self) -> None:
        """Stop playing; called from the playing thread."""
        self.feed.stop()
        self.ended.set()

    def play(self) -> Player:
        self.feed.start()
        assert self.ended.wait(240)
        self.feed.stop()
        return self

    @property
    def offsets(self) -> list[int]:
        return [stamp - self.stamps[0] for stamp in self.stamps]


def stop_after(count: int) -> Callable[[Player, int], None]:
    return lambda player, _: player.stop() if len(player.sequences) == count else None


def published_with(player: Player, sequence: int) -> int:
    """Return the number of records after the call with this one: late records are published together."""
    return next(end for end in itertools.accumulate(player.batches) if end > player.sequences.index(sequence))


def test_stamps_keep_the_recorded_intervals_divided_by_the_rate_except_long_pauses():
    stamps = 1_000_000_000, 1_020_000_000, 1_080_000_000, 3_600_000_000_000
    player = Player(ListSource(stamps), rate=2.0, longest_pause=0.1).play()
    assert player.offsets == [0, 10_000_000, 40_000_000, 90_000_000]
    assert player.ends == [None]
    assert not any(player.early)


def test_recorded_stamps_are_kept_and_the_clock_approaches_them():
    stamps = [1_000_000_000, 2_000_000_000]
    player = Player(ListSource(stamps), publish_clock=True).play()
    assert player.stamps == stamps
    assert player.clock_times == sorted(player.clock_times)
    assert (player.clock_times[0], player.clock_times[-1]) == tuple(stamps)
    assert len(player.clock_times) >= 4


class CountedTime:
    """A replay clock that advances by 1 ms when it is read, so that no record is late on a busy computer."""

    time_ns = 0

    def now_ns(self) -> int:
        return self.advance(MS)

    def advance(self, by_ns: int) -> int:
        self.time_ns += by_ns
        return self.time_ns

    def stamp_ns(self, replay_ns: int) -> int:
        return replay_ns


@pytest.mark.parametrize("publish_clock", [True, False])
def test_loop_continues_in_time_and_never_publishes_negative_times(publish_clock: bool):
    source = ListSource([0, 10 * MS, 20 * MS])
    player = Player(source, stop_after(7), CountedTime(), loop=True, publish_clock=publish_clock).play()
    assert player.recorded == [step % 3 * 10 * MS for step in range(7)]
    if publish_clock:
        assert min(player.clock_times) >= 0
    else:
        assert player.offsets == [step * 10 * MS for step in range(7)]


@pytest.mark.parametrize("error", [DamagedRecordingError("torn", where="file:7"), ZeroDivisionError("a bug")])
def test_error_of_the_source_is_reported_after_everything_before_it_was_played(error: Exception, capsys):
    player = Player(ListSource([0, 1], error)).play()
    assert len(player.sequences) == 2
    assert str(error) in str(player.ends[0])
    assert len(player.ends) == 1


def test_stop_during_a_pause_ends_the_thread_and_reports_no_end():
    player = Player(ListSource([0, 3_000_000_000_000]), longest_pause=1e4)
    player.feed.start()
    while not player.sequences:
        time.sleep(0.001)
    player.feed.stop()
    assert "replay" not in [thread.name for thread in threading.enumerate()]
    assert player.ends == []


def test_step_of_the_wall_clock_does_not_affect_a_replay(monkeypatch: pytest.MonkeyPatch):
    step_ns = [0]
    wall_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns() + step_ns[0])
    pace = ReplayClock(Clock(clock_type=ClockType.SYSTEM_TIME))
    began_ns = pace.now_ns()
    stamps = []
    for step, step_s in enumerate((0, 0, -3600, 10_800)):
        step_ns[0] = step_s * 10**9
        stamps.append(pace.stamp_ns(began_ns + step * MS))
    assert 0 < pace.now_ns() - began_ns < 60 * 10**9
    assert stamps[1] - stamps[0] == MS
    assert [round((b - a) / 1e9) for a, b in pairwise(stamps)] == [0, -3600, 14_400]


def test_interruption_between_two_clock_readings_is_no_clock_step(monkeypatch: pytest.MonkeyPatch):
    steady_ns, interrupted_ns = [0], [0]

    def wall_ns() -> int:
        steady_ns[0] += interrupted_ns[0]
        wall = 10**18 + steady_ns[0]
        steady_ns[0] += interrupted_ns[0]
        return wall

    monkeypatch.setattr(time, "monotonic_ns", lambda: steady_ns[0])
    monkeypatch.setattr(time, "time_ns", wall_ns)
    pace = ReplayClock(Clock(clock_type=ClockType.SYSTEM_TIME))
    stamps = []
    for due_ns, interrupted_ns[0] in ((0, 0), (25 * MS, 5 * MS), (50 * MS, 0)):
        stamps.append(pace.stamp_ns(due_ns))
    assert [b - a for a, b in pairwise(stamps)] == [25 * MS, 25 * MS]


def test_source_that_cannot_keep_its_rate_is_reported():
    source, clock = ListSource([each * 1000 for each in range(120)]), CountedTime()
    source.before = lambda index: clock.advance(5 * MS)
    _, level, text, values = Player(source, replay_clock=clock).play().feed.describe()
    assert float(values["behind s"]) > 0.5
    assert level > b"\0"
    assert "simulated" in text
    assert "behind" in text


def test_seek_forwards_skips_records_and_stamps_continue():
    player = Player(
        steps(100, 100 * MS), lambda player, sequence: player.set(seek_to=9.0) if sequence == 3 else None
    ).play()
    before = published_with(player, 3)
    assert player.sequences == [*range(before), *range(90, 100)]
    assert player.stamps == sorted(player.stamps)
    assert player.stamps[-1] - player.stamps[0] < 5000 * MS


def test_seek_does_not_wait_for_the_next_record():
    def skip(player: Player, sequence: int) -> None:
        if sequence == 0:
            player.set(seek_to=120.0)
        if sequence == 2:
            player.stop()

    player = Player(steps(4, 60_000 * MS), skip, longest_pause=30.0).play()
    assert player.sequences == [0, 2]
    assert player.offsets[1] < 10_000 * MS


def test_replay_can_start_anywhere_and_a_loop_then_plays_from_the_start():
    assert Player(steps(20, 10 * MS), seek_to=5.0).play().sequences == []
    player = Player(steps(10, 5 * MS), stop_after(7), seek_to=0.04, loop=True).play()
    assert player.sequences[:7] == [8, 9, 0, 1, 2, 3, 4]


@pytest.mark.parametrize("publish_clock", [False, True])
def test_pause_holds_the_records_and_their_time(publish_clock: bool):
    resumed = threading.Event()

    def resume(player: Player) -> None:
        resumed.set()
        player.set(paused=False)

    def pause(player: Player, sequence: int) -> None:
        if sequence == 1:
            player.set(paused=True)
            threading.Timer(0.3, resume, [player]).start()
        if sequence == 2:
            assert resumed.is_set()

    player = Player(steps(5, 200 * MS), pause, publish_clock=publish_clock).play()
    assert player.sequences == [0, 1, 2, 3, 4]
    assert player.clock_times == sorted(player.clock_times)
    if not publish_clock:
        gaps = np.diff(player.stamps)
        # The remaining wait for the next record continues after the pause.
        assert gaps[1] > 450 * MS
        assert list(gaps[2:]) == [200 * MS] * 2


def test_new_rate_changes_the_later_intervals():
    player = Player(
        steps(30, 50 * MS), lambda player, sequence: player.set(rate=10.0) if sequence == 2 else None
    ).play()
    gaps, before = np.diff(player.stamps), published_with(player, 2)
    assert list(gaps[: before - 1]) == [50 * MS] * (before - 1)
    # The new rate applies to a part of the next interval.
    assert list(gaps[before + 1 :]) == [5 * MS] * (28 - before)
    assert before < 28


def test_late_records_are_published_in_batches_and_in_order():
    second_ns = 10**18 + 10**9
    source = ListSource([10**18, *range(second_ns, second_ns + 499_000, 1000)])
    clock = CountedTime()
    player = Player(source, lambda _, sequence: sequence or clock.advance(1100 * MS), clock).play()
    assert player.sequences == list(range(500))
    assert max(player.batches) > 1
    # The second record is not due yet.
    assert player.batches[0] == 1


@pytest.mark.ros
def test_parameters_pause_seek_and_speed_up_a_running_replay(ros: Ros, tmp_path: Path):
    bag = write_records(tmp_path / "bag.mcap", SimulatedSource(seed=1, count=COUNT, rate_hz=100.0))
    received = ros.collect(RangeCir, "/uwb/range_raw")
    clock = ros.collect(ClockMessage, "/clock")
    driver = ros.start(
        "driver", "source:=mcap", f"path:={bag}", "paused:=true", "publish_clock:=true", "start_delay:=0.2"
    )
    ros.spin_until(lambda: len(clock) > 5)
    assert received == []
    for name, value in (("seek_to", 3.0), ("rate", 5.0), ("paused", False)):
        assert ros.set_parameter("driver", name, value).successful
    assert driver.wait() == 0, driver.output
    ros.spin_until(lambda: len(received) == COUNT // 4)
    assert [m.sequence for m in received] == list(range(300, COUNT))


@pytest.mark.ros
def test_driver_records_its_ranges_and_never_replaces_a_file(ros: Ros, tmp_path: Path):
    path = tmp_path / "live.mcap"
    options = ("wait_for_subscribers:=0", "start_delay:=0.0", f"record:={path}")
    assert ros.start("driver", *options, "count:=40", "simulated_rate:=1000.0").wait() == 0
    with McapRecording(path) as recording:
        recorded = list(recording)
    source = SimulatedSource(count=40, rate_hz=1000.0)
    assert [r.measurement.range_m for r in recorded] == pytest.approx([r.measurement.range_m for r in source])
    assert recording.simulated
    assert all(record.truth for record in recorded)
    second = ros.start("driver", *options, "count:=1")
    assert second.wait() == 1
    assert "the file exists" in second.output


@pytest.mark.ros
def test_respawned_driver_records_to_a_new_file_and_does_not_repeat_a_recording_that_ended(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("respawn", "live_2.mcap"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv(RESPAWN_FOLDER, str(tmp_path / "respawn"))
    options = (
        "wait_for_subscribers:=0",
        "start_delay:=0.0",
        f"record:={tmp_path / 'live.mcap'}",
        "count:=40",
    )
    # The recording has ended, but its bag is not complete.
    program = (
        "import os\n"
        "from uwb_mitigation.nodes.support.spinning import run_node\n"
        "from uwb_mitigation.recordings.bag.writer import BagWriter\n"
        "BagWriter._finish = lambda writer: os._exit(9)\n"
        "run_node('driver')\n"
    )
    given = [word for option in options for word in ("-p", option)]
    assert ros.run([sys.executable, "-c", program, "--ros-args", *given]).wait() == 9
    respawned = ros.start("driver", *options)
    assert respawned.wait() == 0
    assert "record continues after a crash in" in respawned.output
    again = ros.start("driver", *options)
    assert again.wait() == 0
    assert "the recording has ended" in again.output
    assert "replaying" not in again.output
    monkeypatch.delenv(RESPAWN_FOLDER)
    new_launch = ros.start("driver", *options)
    assert new_launch.wait() == 1
    assert "an unfinished recording exists" in new_launch.output
    assert "an existing or unfinished file is refused" in help_text("driver")
    assert {file.name for file in tmp_path.glob("live*")} == {"live.mcap.part", "live_2.mcap", "live_3.mcap"}
    with McapRecording(tmp_path / "live_3.mcap") as recording:
        assert len(list(recording)) == 40
    assert unused_path(Path("/dev/null")) == Path("/dev/null")


def test_time_to_open_a_source_does_not_make_its_first_records_late():
    source, clock = ListSource([0, 10 * MS, 20 * MS]), CountedTime()
    source.before = lambda index: index or clock.advance(300 * MS)
    player = Player(source, replay_clock=clock).play()
    assert player.stamps[0] >= 300 * MS
    assert np.diff(player.stamps).tolist() == [10 * MS] * 2


@pytest.mark.ros
def test_odometry_imu_and_transforms_of_a_recording_are_replayed_with_the_same_shift(
    ros: Ros, tmp_path: Path
):
    bag, records = tmp_path / "robot.mcap", list(SimulatedSource(seed=1, count=60, rate_hz=40.0))
    stamps = [10**18 + record.measurement.stamp_ns for record in records]

    def header(stamp_ns: int, frame: str) -> Header:
        return Header(stamp=Time(nanoseconds=stamp_ns).to_msg(), frame_id=frame)

    def transforms_at(stamp_ns: int, *links: tuple[str, str]) -> TFMessage:
        made = [TransformStamped(header=header(stamp_ns, one), child_frame_id=other) for one, other in links]
        return TFMessage(transforms=made)

    with BagWriter(bag, {"source": "a test", "simulated": "true"}) as writer:

        def write(topic: str, kind: str, message: object, stamp_ns: int) -> None:
            writer.write_message(topic, kind, serialize_message(message), stamp_ns + 3 * MS)

        for record, stamp_ns in zip(records, stamps, strict=True):
            writer.write(replace(record, measurement=replace(record.measurement, stamp_ns=stamp_ns)))
            odometry = Odometry(header=header(stamp_ns + MS, "odom"), child_frame_id="base_link")
            write("/odom", ODOMETRY_TYPE, odometry, stamp_ns)
            write("/imu", IMU_TYPE, Imu(header=odometry.header), stamp_ns)
            links = (("map", "odom"), ("odom", "base_link"))
            write("/tf", TF_TYPE, transforms_at(stamp_ns + MS, *links), stamp_ns)
        write("/tf_static", TF_TYPE, transforms_at(stamps[0], ("base_link", "uwb_antenna")), stamps[9])
        write("/odom2", ODOMETRY_TYPE, Odometry(), stamps[9])
    ranges, odometry = ros.collect(RangeCir, "/uwb/range_raw"), ros.collect(Odometry, "/odom")
    imu, transforms = ros.collect(Imu, "/imu"), ros.collect(TFMessage, "/tf")
    static = ros.collect(TFMessage, "/tf_static")
    ros.start("driver", "source:=mcap", f"path:={bag}", *PAUSED)
    ros.play()
    ros.spin_until(lambda: all(len(messages) == 60 for messages in (ranges, odometry, imu, transforms)))
    shift_ns = to_ns(ranges[0].header.stamp) - stamps[0]
    expected = [stamp_ns + MS + shift_ns for stamp_ns in stamps]
    assert [to_ns(message.header.stamp) for message in odometry] == expected
    assert [to_ns(message.header.stamp) for message in imu] == expected
    (links,) = {tuple((t.header.frame_id, t.child_frame_id) for t in m.transforms) for m in transforms}
    assert links == (("odom", "base_link"),), "the locator of the replay publishes map to odom"
    assert [to_ns(message.transforms[0].header.stamp) for message in transforms] == expected
    assert [t.child_frame_id for message in static for t in message.transforms] == ["uwb_antenna"]
    assert "/odom2" not in dict(ros.node.get_topic_names_and_types())
