"""Damaged and hostile bags: complete messages are read, the error has a position, and memory is bounded."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from bag_material import START_NS, STEP_NS, Foreign, chunk_offsets, numbers, prefix, record, write_bag
from mcap.writer import IndexType

from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.recordings.bag.reader import MAX_RECORD, BagReader
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.types.ros import codec


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
        assert read == list(range(len(read)))
        assert len(read) == expected
        if size < max(ends):
            assert error is not None
            assert str(cut) in str(error)
        if 8 <= size < max(ends):
            assert isinstance(error, DamagedRecordingError)
            assert "byte " in error.where


def test_unfinished_recording_is_read_by_time_and_in_order(tmp_path: Path) -> None:
    bag = Foreign(tmp_path / "bag.mcap").ours()
    for group in ([4, 5], [0, 1], [2, 3]):
        for number in group:
            bag.range(number)
        bag.flush()
    path = bag.cut()
    assert prefix(path)[0] == [0, 1, 2, 3, 4, 5]
    first = next(BagReader(path).messages(start_ns=START_NS + 2 * STEP_NS))
    assert first.log_time_ns == START_NS + 2 * STEP_NS


@pytest.mark.parametrize("shift", [-(2**40), -7, 3, 2**40])
def test_false_index_is_reported_and_allocates_little_memory(tmp_path: Path, shift: int) -> None:
    path = write_bag(tmp_path / "bag.mcap")
    content = bytearray(path.read_bytes())
    ((offset, _),) = chunk_offsets(path)
    footer = len(content) - 37
    (start,) = struct.unpack_from("<Q", content, footer + 9)
    at = content.index(struct.pack("<Q", offset), start)
    struct.pack_into("<Q", content, at, (offset + shift) % 2**64)
    struct.pack_into("<I", content, footer + 25, zlib.crc32(content[start : footer + 25]))
    path.write_bytes(content)
    tracemalloc.start()
    read, error = prefix(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert read == []
    assert isinstance(error, DamagedRecordingError)
    assert peak < 8 << 20


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
