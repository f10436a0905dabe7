"""Reading bags: joined truth, order, and errors."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import START_NS, STEP_NS, Foreign, numbers, record, write_bag, write_records
from mcap.writer import CompressionType

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.types.ros import codec
from uwb_mitigation.types.ros.poses import encode_odometry
from uwb_mitigation.types.ros.topics import (
    ODOMETRY_TRUTH,
    ODOMETRY_TYPE,
    RANGE_CIR_TYPE,
    RANGE_RAW,
)
from uwb_mitigation.types.tracks import Estimate


@pytest.mark.parametrize("name", ["bag.mcap", "folder"])
def test_records_are_read_back_unchanged(tmp_path: Path, name: str) -> None:
    source = McapRecording(write_bag(tmp_path / name))
    for number, item in enumerate(source):
        expected = record(number)
        assert codec.encode_range(item.measurement) == codec.encode_range(expected.measurement)
        assert item.truth == expected.truth
    assert number == 4
    assert source.skipped == Counter()
    assert source.message_count == 10


def test_reading_from_a_time_includes_it(tmp_path: Path) -> None:
    bag = BagReader(write_bag(tmp_path / "bag.mcap"))
    read = bag.messages([RANGE_RAW], START_NS + 3 * STEP_NS)
    assert [message.sequence for message in read] == [3, 4]


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_every_compression_is_read(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    bag = Foreign(tmp_path / "bag.mcap", compression=compression, use_chunking=chunked).ours()
    for number in range(4):
        bag.range(number)
    assert numbers(McapRecording(bag.finish())) == [0, 1, 2, 3]


@pytest.mark.parametrize("lag", [-5, -1, 0, 1, 5])
def test_truth_is_joined_with_an_earlier_or_later_range(tmp_path: Path, lag: int) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    for number in range(-5, 25):
        # All messages have the same log time, so that the order in the file is used.
        if 0 <= number < 20:
            bag.range(number, log_time_ns=START_NS)
        if 0 <= number - lag < 20:
            bag.truth(number - lag, log_time_ns=START_NS)
    items = list(McapRecording(bag.finish()))
    assert [item.truth.configuration for item in items if item.truth] == [f"place {i}" for i in range(20)]


def test_tag_position_is_read_from_the_bag(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    places = [(1.5, float(number), -0.25) if number != 2 else None for number in range(40)]
    with BagWriter(path, {}) as out:
        for number, place in enumerate(places):
            out.write(replace(record(number), tag_position=place))
        # A frame of another tag, and a truncated message.
        estimate = Estimate(record(3).measurement.stamp_ns, np.ones(3), np.ones(3), np.eye(6))
        complete = encode_odometry(estimate, child_frame_id="base_link")
        for data in (complete, complete[:50]):
            out.write_message(ODOMETRY_TRUTH, ODOMETRY_TYPE, data, estimate.stamp_ns)
    source = McapRecording(path)
    assert [item.tag_position for item in source] == places
    assert source.skipped == {"a message that is not nav_msgs/msg/Odometry": 1}
    again = tmp_path / "again.mcap"
    write_records(again, source)
    assert [item.tag_position for item in McapRecording(again)] == places


def test_ranges_without_truth_are_read_and_truth_without_range_is_counted(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    for number in range(100):
        bag.range(number)
    for number in range(1000, 1050):
        bag.truth(number)
    source = McapRecording(bag.finish())
    items = list(source)
    assert [item.measurement.sequence for item in items] == list(range(100))
    assert all(item.truth is None for item in items)
    assert source.skipped == {"truth without its range": 50}


def test_messages_come_in_the_order_of_their_log_times(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    for group in ([3, 0, 5], [1, 4, 2], [6, 8, 7]):
        for number in group:
            bag.range(number)
        bag.flush()
    assert numbers(McapRecording(bag.finish())) == list(range(9))


def test_files_of_a_folder_follow_each_other_by_number(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    for part in (10, 9, 2):
        bag = Foreign(folder / f"bag_{part}.mcap").ours()
        bag.range(part)
        bag.finish()
    assert numbers(McapRecording(folder)) == [2, 9, 10]
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {storage_identifier: mcap, "
        "relative_file_paths: [../../bag_10.mcap, bag_2.mcap]}"
    )
    assert numbers(McapRecording(folder)) == [10, 2]


@pytest.mark.parametrize(
    ("content", "excerpt"),
    [
        (b"", "empty"),
        (b"\x89MCAP", "not an MCAP file"),
        (b"hello, this is text", "not an MCAP file"),
        (b"SQLite format 3\0", "ros2 bag convert"),
    ],
)
def test_other_file_is_refused(tmp_path: Path, content: bytes, excerpt: str) -> None:
    path = tmp_path / ("bag.db3" if content.startswith(b"SQL") else "bag.mcap")
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=excerpt):
        open_recording(path)


def test_missing_topic_is_reported_with_the_existing_topics(tmp_path: Path) -> None:
    source = McapRecording(write_bag(tmp_path / "bag.mcap"), topic="/uwb/range")
    with pytest.raises(
        RecordingError, match=r"mean '/uwb/range_raw'.*raw \(uwb_mitigation_msgs/msg/RangeCir\)"
    ):
        list(source)


@pytest.mark.parametrize(
    ("channel", "excerpt"),
    [
        ((RANGE_RAW, RANGE_CIR_TYPE, None), "no schema.*RangeCir"),
        ((RANGE_RAW, "std_msgs/msg/String", "string data"), "'std_msgs/msg/String'.*RangeCir"),
        ((RANGE_RAW, RANGE_CIR_TYPE, "float32 range"), "another version .* 'float32 range'"),
    ],
)
def test_topic_of_other_layout_is_refused(
    tmp_path: Path, channel: tuple[str, str, str | None], excerpt: str
) -> None:
    bag = Foreign(tmp_path / "bag.mcap")
    bag.channel(*channel)
    bag.range(0)
    with pytest.raises(RecordingError, match=excerpt) as caught:
        list(McapRecording(bag.finish()))
    assert RANGE_RAW in caught.value.where


def test_close_ends_an_iteration(tmp_path: Path) -> None:
    with McapRecording(write_bag(tmp_path / "bag.mcap", 50)) as source:
        assert len([source.close() for _ in source]) == 1
        source.close()


def test_folder_of_sqlite_files_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    (tmp_path / "folder_0.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(RecordingError, match="ros2 bag convert"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    "text", [" ", "[", "a: b", "rosbag2_bagfile_information: 3", "!!python/object:os.system {}", "[" * 2000]
)
def test_malformed_metadata_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match="not a rosbag2 metadata file"):
        BagReader(tmp_path)
