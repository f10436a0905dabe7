"""Reading bags: joined truth, order, errors; damaged and hostile ones up to the damage, in bounded memory."""

import struct
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from bag_material import (
    START_NS,
    STEP_NS,
    Foreign,
    chunk_offsets,
    numbers,
    prefix,
    record,
    write_bag,
    write_records,
)
from mcap.writer import CompressionType, IndexType

from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.recordings.bag.reader import MAX_RECORD, BagReader
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.types.ros import codec, topics
from uwb_mitigation.types.ros.poses import encode_odometry
from uwb_mitigation.types.tracks import Estimate


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
            out.write_message(topics.ODOMETRY_TRUTH, topics.ODOMETRY_TYPE, data, estimate.stamp_ns)
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
    for place in (path, tmp_path):
        with pytest.raises(RecordingError, match=excerpt):
            open_recording(place)


def test_missing_topic_is_reported_with_the_existing_topics(tmp_path: Path) -> None:
    source = McapRecording(write_bag(tmp_path / "bag.mcap"), topic="/uwb/range")
    with pytest.raises(
        RecordingError, match=r"mean '/uwb/range_raw'.*raw \(uwb_mitigation_msgs/msg/RangeCir\)"
    ):
        list(source)


@pytest.mark.parametrize(
    ("channel", "excerpt"),
    [
        ((topics.RANGE_RAW, topics.RANGE_CIR_TYPE, None), "no schema.*RangeCir"),
        ((topics.RANGE_RAW, "std_msgs/msg/String", "string data"), "'std_msgs/msg/String'.*RangeCir"),
        ((topics.RANGE_RAW, topics.RANGE_CIR_TYPE, "float32 range"), "another version .* 'float32 range'"),
    ],
)
def test_topic_of_other_layout_is_refused(tmp_path: Path, channel: tuple[str, str, str | None], excerpt: str):
    bag = Foreign(tmp_path / "bag.mcap")
    bag.channel(*channel)
    bag.range(0)
    with pytest.raises(RecordingError, match=excerpt) as caught:
        list(McapRecording(bag.finish()))
    assert topics.RANGE_RAW in caught.value.where


def test_end_of_the_block_closes_a_recording_and_ends_an_iteration(tmp_path: Path) -> None:
    with McapRecording(write_bag(tmp_path / "bag.mcap", 50)) as source:
        records = iter(source)
        next(records)
    assert list(records) == []
    source.close()


@pytest.mark.parametrize(
    "text", [" ", "[", "a: b", "rosbag2_bagfile_information: 3", "!!python/object:os.system {}", "[" * 1000]
)
def test_malformed_metadata_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match="not a rosbag2 metadata file"):
        BagReader(tmp_path)


def test_truncated_bag_yields_its_complete_messages_and_the_position_of_the_damage(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "complete.mcap", index_types=IndexType.ALL).ours()
    for number in range(12):
        bag.range(number)
        bag.truth(number)
        if number % 3 == 2:
            bag.flush()
    complete = bag.finish().read_bytes()
    ends = {end: 3 * (i + 1) for i, (_, end) in enumerate(chunk_offsets(tmp_path / "complete.mcap"))}
    cut = tmp_path / "cut.mcap"
    for size in [*range(0, len(complete), 37), *ends, *(end - 1 for end in ends)]:
        cut.write_bytes(complete[:size])
        read, error = prefix(cut)
        expected = max((count for end, count in ends.items() if end <= size), default=0)
        assert read == list(range(expected))
        if size < max(ends):
            assert str(cut) in str(error)
        if 8 <= size < max(ends):
            assert isinstance(error, DamagedRecordingError)
            assert "byte " in error.where


@pytest.mark.parametrize("end", [Foreign.finish, Foreign.cut], ids=["complete", "unfinished"])
def test_recording_is_read_by_time_and_in_order(tmp_path: Path, end: Callable[[Foreign], Path]) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    for group in ([4, 5], [0, 1], [3, 2]):
        for number in group:
            bag.range(number)
        bag.flush()
    path = end(bag)
    assert prefix(path)[0] == [0, 1, 2, 3, 4, 5]
    first = next(BagReader(path).messages(start_ns=START_NS + 2 * STEP_NS))
    assert first.log_time_ns == START_NS + 2 * STEP_NS


def test_damaged_index_at_the_end_is_counted_and_loses_no_message(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag.mcap")
    path.write_bytes(path.read_bytes()[:-20])
    source = McapRecording(path)
    assert numbers(source) == [0, 1, 2, 3, 4]
    assert source.skipped == {"index at the end missing or damaged": 1}


def test_every_flipped_bit_in_the_data_is_detected(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "complete.mcap").ours()
    for number in range(8):
        bag.range(number)
        if number % 2:
            bag.flush()
    complete = bag.finish().read_bytes()
    expected = [codec.encode_range(record(number).measurement) for number in range(8)]
    rng = np.random.default_rng(5)
    flipped = tmp_path / "flipped.mcap"
    flips = [
        (at, bit) for chunk in chunk_offsets(tmp_path / "complete.mcap") for at in chunk for bit in range(8)
    ]
    flips += zip(rng.integers(0, len(complete), 300).tolist(), rng.integers(0, 8, 300).tolist(), strict=True)
    for at, bit in flips:
        broken = bytearray(complete)
        broken[at] ^= 1 << bit
        flipped.write_bytes(broken)
        read: list[bytes] = []
        try:
            source = McapRecording(flipped)
            read.extend(codec.encode_range(item.measurement) for item in source)
        except RecordingError:
            assert set(read) <= set(expected)
        else:
            # No message is lost; a flipped time in the header of a chunk may change the order.
            assert sorted(read) == sorted(expected) or source.skipped, f"byte {at}"


def _chunk(size: int, compression: bytes, packed: bytes, checksum: int = 0) -> bytes:
    body = struct.pack("<QQQII", 0, 0, size, checksum, len(compression)) + compression
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


BOMB = zstandard.compress(bytes(MAX_RECORD + 1))


HOSTILE = {
    "chunk above the maximum": _chunk(MAX_RECORD + 1, b"zstd", BOMB),
    "zstd bomb": _chunk(1000, b"zstd", BOMB),
    "huge lz4 chunk": _chunk(2**63, b"lz4", b""),
    "zstd garbage": _chunk(1000, b"zstd", b"\x28\xb5\x2f\xfd\xe0" + b"\xff" * 8),
    "chunk of another size": _chunk(10, b"", bytes(9)),
    "unknown compression": _chunk(10, b"brotli", bytes(9)),
    "message beyond its chunk": _chunk(9, b"", struct.pack("<BQ", 5, 2**40)),
    "empty message record": _chunk(9, b"", struct.pack("<BQ", 5, 0)),
    "record beyond the file": struct.pack("<BQ", 6, 2**63),
    "short message record": struct.pack("<BQ", 5, 3) + bytes(3),
    "short channel record": struct.pack("<BQI", 3, 4, 9),
    "name beyond its record": struct.pack("<BQHII", 3, 10, 1, 2**32 - 1, 0),
    "footer": struct.pack("<BQ", 2, 20) + bytes(20),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_record_is_refused_with_its_offset_and_little_memory(tmp_path: Path, name: str) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    bag.range(0)
    path = bag.cut()
    offset = path.stat().st_size
    path.write_bytes(path.read_bytes() + HOSTILE[name])
    tracemalloc.start()
    read, error = prefix(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert read == [0]
    assert isinstance(error, DamagedRecordingError)
    assert error.where == f"{path}, byte {offset}"
    assert peak < 8 << 20


def test_long_bag_is_written_and_read_in_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    tracemalloc.start()
    with BagWriter(path, {}) as bag:
        for number in range(3000):
            bag.write(record(number, samples=1016))
    read = sum(1 for _ in McapRecording(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert read == 3000
    assert peak < 8 << 20  # the messages are 12 MB
