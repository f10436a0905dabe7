"""Reading bags: truth joined, order kept, damage reported where it is, and no trust in any byte."""

from __future__ import annotations

import struct
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from uwb_mitigation.bag import codec, container, schemas
from uwb_mitigation.bag.reader import BagReader
from uwb_mitigation.bag.topics import RANGE_CIR_TYPE, RANGE_RAW, RANGE_TRUTH, RANGE_TRUTH_TYPE
from uwb_mitigation.bag.writer import BagWriter
from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.measurement import Cir, RangeMeasurement, Truth
from uwb_mitigation.sources.mcap import McapRecording
from uwb_mitigation.sources.opening import open_recording
from uwb_mitigation.sources.source import Record

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000


def record(number: int, samples: int = 20, noise: int = 0) -> Record:
    values = np.random.default_rng(noise + number).integers(-900, 900, 2 * samples).astype(np.int16)
    measurement = RangeMeasurement(
        START_NS + number * STEP_NS, 7, 3, number, number, 4.5, Cir(values, preamble_count=200), "antenna"
    )
    return Record(measurement, Truth(4.0, "LOS", f"place {number}"))


def write_bag(path: Path, count: int = 5, simulated: str = "false") -> Path:
    with BagWriter(path, {"source": "a test", "simulated": simulated}) as bag:
        for number in range(count):
            bag.write(record(number))
    return path


class Foreign:
    """A bag such as another recorder might write, message by message."""

    def __init__(self, path: Path, **options: object) -> None:
        self.path = path
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, **options)
        self._writer.start("ros2", "another recorder")
        self._channels: dict[str, int] = {}

    def channel(
        self,
        topic: str,
        type_name: str,
        schema: str | None,
        *,
        encoding: str = "cdr",
        language: str = "ros2msg",
    ) -> None:
        number = 0
        if schema is not None:
            number = self._writer.register_schema(type_name, language, schema.encode())
        self._channels[topic] = self._writer.register_channel(topic, encoding, number, {})

    def ours(self) -> Foreign:
        self.channel(RANGE_RAW, RANGE_CIR_TYPE, schemas.definition(RANGE_CIR_TYPE))
        self.channel(RANGE_TRUTH, RANGE_TRUTH_TYPE, schemas.definition(RANGE_TRUTH_TYPE))
        return self

    def add(self, topic: str, log_time_ns: int, data: bytes) -> None:
        self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns)

    def range(self, number: int) -> None:
        measurement = record(number).measurement
        self.add(RANGE_RAW, measurement.stamp_ns, codec.encode_range(measurement))

    def truth(self, number: int) -> None:
        known = record(number)
        assert known.truth is not None
        self.add(RANGE_TRUTH, known.measurement.stamp_ns, codec.encode_truth(known.measurement, known.truth))

    def flush(self) -> None:
        self._writer.flush()

    def finish(self) -> Path:
        self._writer.finish()
        self._stream.close()
        return self.path

    def cut(self) -> Path:
        self._writer.flush()
        self._stream.close()
        return self.path


def numbers(source: McapRecording) -> list[int]:
    return [item.measurement.sequence for item in source]


def prefix(path: Path) -> tuple[list[int], RecordingError | None]:
    """What is read of a bag, and the error that ends it; any other exception fails the test."""
    read: list[int] = []
    try:
        for item in McapRecording(path):
            assert item.measurement.frame_id == "antenna"
            read.append(item.measurement.sequence)
    except RecordingError as error:
        return read, error
    return read, None


@pytest.mark.parametrize("name", ["bag.mcap", "folder"])
def test_records_come_back_as_they_were_written(tmp_path: Path, name: str) -> None:
    source = McapRecording(write_bag(tmp_path / name))
    for number, item in enumerate(source):
        expected = record(number)
        assert codec.encode_range(item.measurement) == codec.encode_range(expected.measurement)
        assert item.truth == expected.truth
    assert number == 4
    assert source.skipped == Counter()
    assert source.message_count == 10


def test_a_recording_can_be_read_again(tmp_path: Path) -> None:
    source = McapRecording(write_bag(tmp_path / "bag.mcap"))
    assert numbers(source) == numbers(source) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("flag", "simulated"), [("true", True), ("false", False)])
def test_a_simulated_bag_says_so(tmp_path: Path, flag: str, simulated: bool) -> None:
    source = McapRecording(write_bag(tmp_path / "bag.mcap", simulated=flag))
    assert source.simulated is simulated
    assert ("(simulated)" in source.name) is simulated


def test_bounds_on_time_include_the_start_and_not_the_stop(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag.mcap")
    source = McapRecording(path, start_ns=START_NS + STEP_NS, stop_ns=START_NS + 3 * STEP_NS)
    assert numbers(source) == [1, 2]


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_every_compression_is_read(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    bag = Foreign(tmp_path / "bag.mcap", compression=compression, use_chunking=chunked).ours()
    for number in range(4):
        bag.range(number)
    assert numbers(McapRecording(bag.finish())) == [0, 1, 2, 3]


def test_a_bag_of_rosbags_is_read(tmp_path: Path) -> None:
    with RosbagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection(RANGE_RAW, RANGE_CIR_TYPE, typestore=schemas.typestore())
        for number in range(3):
            measurement = record(number).measurement
            bag.write(connection, measurement.stamp_ns, codec.encode_range(measurement))
    assert numbers(McapRecording(tmp_path / "bag")) == [0, 1, 2]


@pytest.mark.parametrize("lag", [-5, -1, 0, 1, 5])
def test_truth_finds_its_range_before_or_after_it(tmp_path: Path, lag: int) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    for number in range(-5, 25):
        for write, which in ((bag.range, number), (bag.truth, number - lag)):
            if 0 <= which < 20:
                # One log time for all, so that the file's order is what counts.
                known = record(which)
                data = (
                    codec.encode_range(known.measurement)
                    if write == bag.range
                    else codec.encode_truth(known.measurement, known.truth)
                )
                bag.add(RANGE_RAW if write == bag.range else RANGE_TRUTH, START_NS, data)
    items = list(McapRecording(bag.finish()))
    assert [item.truth.configuration for item in items if item.truth] == [f"place {i}" for i in range(20)]


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


def test_chunks_of_other_topics_are_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    bag.channel("/camera", "sensor_msgs/msg/Image", "uint8[] data")
    bag.range(0)
    bag.flush()
    for _ in range(5):
        bag.add("/camera", START_NS, bytes(100))
        bag.flush()
    bag.range(1)
    path = bag.finish()
    unpacked = []
    read_span = container.read_span

    def counting(*arguments: object) -> Iterator[container.RawMessage]:
        unpacked.append(arguments)
        return read_span(*arguments)

    monkeypatch.setattr("uwb_mitigation.bag.reader.read_span", counting)
    assert numbers(McapRecording(path)) == [0, 1]
    assert len(unpacked) == 2


def test_a_bag_cut_anywhere_yields_what_is_whole_and_says_where(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "whole.mcap", index_types=IndexType.ALL).ours()
    for number in range(12):
        bag.range(number)
        bag.truth(number)
        if number % 3 == 2:
            bag.flush()
    whole = bag.finish().read_bytes()
    ends = {span.end: 3 * (i + 1) for i, span in enumerate(_spans(tmp_path / "whole.mcap"))}
    cut = tmp_path / "cut.mcap"
    for size in [*range(0, len(whole), 37), *ends, *(end - 1 for end in ends)]:
        cut.write_bytes(whole[:size])
        read, error = prefix(cut)
        expected = max((count for end, count in ends.items() if end <= size), default=0)
        assert read == list(range(expected))
        if size < max(ends):
            assert error is not None
            assert str(cut) in str(error)
        if 8 <= size < max(ends):
            assert isinstance(error, DamagedRecordingError)
            assert "byte " in error.where


def _spans(path: Path) -> list[container.Span]:
    with path.open("rb") as stream:
        return container.survey(stream).spans


def test_a_recording_that_was_never_finished_is_read_to_its_end(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    for number in range(6):
        bag.range(number)
    read, error = prefix(bag.cut())
    assert read == list(range(6))
    assert isinstance(error, DamagedRecordingError)


def test_an_unfinished_recording_is_read_by_time_and_in_order(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    for group in ([4, 5], [0, 1], [2, 3]):
        for number in group:
            bag.range(number)
        bag.flush()
    path = bag.cut()
    assert prefix(path)[0] == [0, 1, 2, 3, 4, 5]
    later = McapRecording(path, stop_ns=START_NS + 2 * STEP_NS)
    assert [item.measurement.sequence for _, item in zip(range(2), later, strict=False)] == [0, 1]


def test_a_damaged_chunk_does_not_cost_those_before_it(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    bag.range(0)
    bag.flush()
    bag.range(1)
    path = bag.finish()
    content = bytearray(path.read_bytes())
    spans = _spans(path)
    content[spans[1].offset + 9 : spans[1].offset + 25] = bytes(16)  # claims to be the earliest
    content[spans[1].end - 5] ^= 1
    path.write_bytes(content)
    read, error = prefix(path)
    assert read == [0]
    assert error is not None
    assert error.where == f"{path}, byte {spans[1].offset}"


def test_a_damaged_index_at_the_end_is_counted_and_costs_no_message(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag.mcap")
    path.write_bytes(path.read_bytes()[:-20])
    source = McapRecording(path)
    assert numbers(source) == [0, 1, 2, 3, 4]
    assert source.skipped == {"index at the end missing or damaged": 1}


def test_no_flipped_bit_goes_unnoticed_in_the_data(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "whole.mcap").ours()
    for number in range(8):
        bag.range(number)
        if number % 2:
            bag.flush()
    whole = bag.finish().read_bytes()
    expected = [codec.encode_range(record(number).measurement) for number in range(8)]
    rng = np.random.default_rng(5)
    flipped = tmp_path / "flipped.mcap"
    for at in rng.integers(0, len(whole), 1500):
        broken = bytearray(whole)
        broken[at] ^= 1 << int(rng.integers(8))
        flipped.write_bytes(broken)
        read: list[bytes] = []
        try:
            source = McapRecording(flipped)
            read.extend(codec.encode_range(item.measurement) for item in source)
        except RecordingError:
            assert set(read) <= set(expected)
        else:
            # Nothing is lost: at worst a flipped time in a chunk's header changes the order.
            assert sorted(read) == sorted(expected) or source.skipped, f"byte {at}"


@pytest.mark.parametrize(
    ("content", "told"),
    [(b"", "empty"), (b"\x89MCAP", "not an MCAP file"), (b"hello, this is text", "not an MCAP file")],
)
def test_what_is_no_mcap_file_is_refused(tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "bag.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match=told):
        McapRecording(tmp_path / "bag.mcap")


def test_an_absent_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such file"):
        McapRecording(tmp_path / "absent.mcap")


def test_an_absent_topic_is_told_with_those_that_are_there(tmp_path: Path) -> None:
    source = McapRecording(write_bag(tmp_path / "bag.mcap"), topic="/other")
    with pytest.raises(
        RecordingError, match=r"no topic /other.*range_raw \(uwb_mitigation_msgs/msg/RangeCir\)"
    ):
        list(source)


def test_a_bag_without_a_message_on_the_topic_is_empty(tmp_path: Path) -> None:
    path = Foreign(tmp_path / "bag.mcap").ours().finish()
    assert list(McapRecording(path)) == []


@pytest.mark.parametrize(
    ("channel", "told"),
    [
        ((RANGE_RAW, RANGE_CIR_TYPE, None), "no schema.*RangeCir"),
        ((RANGE_RAW, "std_msgs/msg/String", "string data"), "'std_msgs/msg/String'.*RangeCir"),
        ((RANGE_RAW, RANGE_CIR_TYPE, "float32 range"), "another version .* 'float32 range'"),
    ],
)
def test_a_topic_that_would_be_misread_is_refused(
    tmp_path: Path, channel: tuple[str, str, str | None], told: str
) -> None:
    bag = Foreign(tmp_path / "bag.mcap")
    bag.channel(*channel)
    bag.range(0)
    with pytest.raises(RecordingError, match=told) as caught:
        list(McapRecording(bag.finish()))
    assert RANGE_RAW in caught.value.where


@pytest.mark.parametrize("options", [{"encoding": "json"}, {"language": "jsonschema"}])
def test_another_encoding_is_refused(tmp_path: Path, options: dict[str, str]) -> None:
    bag = Foreign(tmp_path / "bag.mcap")
    bag.channel(RANGE_RAW, RANGE_CIR_TYPE, schemas.definition(RANGE_CIR_TYPE), **options)
    bag.range(0)
    with pytest.raises(RecordingError, match="json"):
        list(McapRecording(bag.finish()))


def test_messages_that_do_not_decode_are_counted_by_kind(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    whole = codec.encode_range(record(1).measurement)
    bag.range(0)
    for broken in (whole[:50], whole[:60], b"\0\0" + whole[2:], whole + bytes(9), b""):
        bag.add(RANGE_RAW, START_NS + 1, broken)
    bag.range(2)
    source = McapRecording(bag.finish())
    assert numbers(source) == [0, 2]
    assert source.skipped == {
        "message ends early": 3,
        "message in big-endian CDR": 1,
        "message longer than its type": 1,
    }


def _chunk(size: int, compression: bytes, packed: bytes, checksum: int = 0) -> bytes:
    body = struct.pack("<QQQII", 0, 0, size, checksum, len(compression)) + compression
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


BOMB = zstandard.compress(bytes(container.MAX_CHUNK + 1))


@pytest.mark.parametrize(
    ("record_bytes", "told"),
    [
        (_chunk(container.MAX_CHUNK + 1, b"zstd", BOMB), "ceiling"),
        (_chunk(1000, b"zstd", BOMB), "claims"),
        (_chunk(2**63, b"lz4", b""), "ceiling"),
        (_chunk(1000, b"zstd", b"\x28\xb5\x2f\xfd\xe0" + b"\xff" * 8), "chunk"),
        (_chunk(10, b"", bytes(9)), "promises"),
        (_chunk(10, b"brotli", bytes(9)), "unknown compression"),
        (_chunk(9, b"", struct.pack("<BQ", 5, 2**40)), "claims"),
        (_chunk(9, b"", struct.pack("<BQ", 5, 0)), "message record of 0"),
        (struct.pack("<BQ", 6, 2**63), "claims"),
        (struct.pack("<BQ", 5, 3) + bytes(3), "at least 22"),
        (struct.pack("<BQI", 3, 4, 9), "field"),
        (struct.pack("<BQHII", 3, 10, 1, 2**32 - 1, 0), "field of 4294967295"),
        (struct.pack("<BQ", 2, 20) + bytes(20), "FOOTER"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_hostile_record_is_refused_with_its_offset_and_little_memory(
    tmp_path: Path, record_bytes: bytes, told: str
) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    bag.range(0)
    path = bag.cut()
    offset = path.stat().st_size
    path.write_bytes(path.read_bytes() + record_bytes)
    tracemalloc.start()
    read, error = prefix(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert read == [0]
    assert isinstance(error, DamagedRecordingError)
    assert told in error.what
    assert error.where == f"{path}, byte {offset}"
    assert peak < 8 << 20


def test_a_long_bag_is_written_and_read_in_little_memory(tmp_path: Path) -> None:
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


def test_closing_ends_an_iteration(tmp_path: Path) -> None:
    with McapRecording(write_bag(tmp_path / "bag.mcap", 200)) as source:
        read = []
        for item in source:
            read.append(item)
            source.close()
            source.close()
    assert len(read) < 200


@pytest.mark.parametrize("name", ["old.db3", "folder"])
def test_a_sqlite_bag_is_refused_with_the_command_that_converts_it(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
        (path / "folder_0.db3").write_bytes(b"SQLite format 3\0")
    else:
        path.write_bytes(b"SQLite format 3\0")
    with pytest.raises(RecordingError, match="ros2 bag convert"):
        open_recording(path)


@pytest.mark.parametrize(
    "text", ["", "[", "a: b", "rosbag2_bagfile_information: 3", "!!python/object:os.system {}", "[" * 2000]
)
def test_a_malformed_metadata_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match="not a rosbag2 metadata file"):
        BagReader(tmp_path)


def test_a_recording_is_told_by_its_content_where_its_name_says_nothing(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag.mcap").rename(tmp_path / "recording")
    assert isinstance(open_recording(path), McapRecording)


def test_what_no_source_reads_is_refused_with_what_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing to see")
    for path in (tmp_path / "notes.txt", tmp_path / "absent"):
        with pytest.raises(RecordingError, match=r"MCAP bag.*DecaRanging"):
            open_recording(path)
