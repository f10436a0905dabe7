"""Reads the messages of a bag by topic and time, in the order of their log times.

A bag is one MCAP file or a rosbag2 folder. The `mcap` library parses the records; lengths that a file claims are
checked before memory is allocated for them. A file without a valid index is scanned once, so that a truncated
recording is read up to the damage. Only the indexes and a few chunks are in memory.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap import records
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.writer import MCAP0_MAGIC

from uwb_mitigation.errors import DamagedRecordingError, RecordingError, did_you_mean
from uwb_mitigation.files import os_errors
from uwb_mitigation.recordings.bag.rosbag2 import bag_files
from uwb_mitigation.types.ros import schemas

MAX_RECORD = 256 << 20
"""Maximum size of a record, and of an uncompressed chunk, in bytes: 300 times what rosbag2 writes."""

MAX_PENDING = 256 << 20
"""Maximum size of the messages that are held back to sort them, in bytes."""

BAD_INDEX = "index at the end missing or damaged"
"""Kind of warning in `BagReader.warnings`; the messages are complete."""

_LIBRARY_ERRORS = (ValueError, McapError, struct.error)
_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_log_time = attrgetter("log_time_ns")


@dataclass(frozen=True, slots=True)
class Schema:
    """A message type as the file defines it."""

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic in the file; `schema` is None if the file contains none for it."""

    id: int
    topic: str
    encoding: str
    metadata: dict[str, str]
    schema: Schema | None


class RawMessage(NamedTuple):
    """A serialised message."""

    channel: Channel
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class _Chunk(NamedTuple):
    """Where a chunk is, the times of its messages, and their channels (empty: unknown)."""

    offset: int
    first_ns: int
    last_ns: int
    channel_ids: frozenset[int]


@dataclass(slots=True)
class _FileIndex:
    """What one file contains.

    Attributes:
        chunks: empty if the messages are not in chunks.
        schemas, channels: by id.
        metadata: metadata records by name.
        messages: number of messages.
        bounds_ns: first and last log time of messages that are not in chunks; None without such messages.
        damage: (byte offset, description) of the first known damage, or None.
        warnings: {kind: count}.
    """

    chunks: list[_Chunk] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: int = 0
    bounds_ns: tuple[int, int] | None = None
    damage: tuple[int, str] | None = None
    warnings: Counter[str] = field(default_factory=Counter)

    def define(self, record: records.McapRecord) -> None:
        """Add a schema, channel or metadata record; the first of an id or name is kept."""
        if isinstance(record, records.Schema):
            self.schemas.setdefault(record.id, Schema(record.name, record.encoding, record.data))
        elif isinstance(record, records.Channel) and record.id not in self.channels:
            schema = self.schemas.get(record.schema_id)
            self.channels[record.id] = Channel(
                record.id, record.topic, record.message_encoding, record.metadata, schema
            )
        elif isinstance(record, records.Metadata):
            self.metadata.setdefault(record.name, record.metadata)

    def messages_of(self, record: records.McapRecord, topics: Collection[str] | None) -> list[RawMessage]:
        """Return the messages of `topics` in a chunk or message record, and add what the record defines.

        The library unpacks each field of a message in a call of its own, which takes ten times as long.

        Raises:
            ValueError, McapError, struct.error: the record is damaged, or a channel is not defined.
        """
        if isinstance(record, records.Message):
            times = record.log_time, record.publish_time
            messages = [RawMessage(self._channel(record.channel_id), record.sequence, *times, record.data)]
            return [message for message in messages if topics is None or message.channel.topic in topics]
        if not isinstance(record, records.Chunk):
            self.define(record)
            return []
        data, messages, start = _decompress(record), [], 0
        while start < len(data):
            opcode, length = _RECORD.unpack_from(data, start)
            content, start = start + _RECORD.size, start + _RECORD.size + length
            if start > len(data):
                raise McapError("a record ends beyond its chunk")
            if opcode == Opcode.MESSAGE:
                channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, content)
                channel = self.channels.get(channel_id) or self._channel(channel_id)
                if topics is None or channel.topic in topics:
                    message = data[content + _MESSAGE.size : start]
                    messages.append(RawMessage(channel, sequence, log_time, publish_time, message))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definition = BytesIO(data[content - _RECORD.size : start])
                self.define(next(StreamReader(definition, skip_magic=True).records))
        return messages

    def _channel(self, number: int) -> Channel:
        if number not in self.channels:
            raise ValueError(f"a message on channel {number}, which is not defined")
        return self.channels[number]

    def may_contain(self, chunk: _Chunk, topics: Collection[str] | None) -> bool:
        """Whether a chunk may contain messages of `topics`, so that it must be decompressed."""
        if topics is None or not chunk.channel_ids:
            return True
        channels = [self.channels.get(number) for number in chunk.channel_ids]
        return any(channel is None or channel.topic in topics for channel in channels)


class BagReader:
    """The messages of an MCAP file or rosbag2 folder.

    Args:
        path: the file or folder.

    Attributes:
        files: the files of the bag, in order.
        metadata: the MCAP metadata records, {name: {key: value}}; the first file takes precedence.
        warnings: warnings, {kind: count}.

    Raises:
        RecordingError: the path is missing, unreadable, or not an MCAP bag.
    """

    def __init__(self, path: Path) -> None:
        self.files, self._path = bag_files(path), path
        self._indexes = [_index(file) for file in self.files]
        self.metadata: dict[str, dict[str, str]] = {}
        self.warnings: Counter[str] = Counter()
        for index in self._indexes:
            self.metadata = index.metadata | self.metadata
            self.warnings += index.warnings

    @property
    def message_count(self) -> int:
        """Number of messages on all topics, from the indexes of the files."""
        return sum(index.messages for index in self._indexes)

    @property
    def bounds_ns(self) -> tuple[int, int] | None:
        """First and last log time on all topics, from the indexes of the files; None if the bag is empty."""
        bounds = [index.bounds_ns for index in self._indexes if index.bounds_ns is not None]
        bounds += [(chunk.first_ns, chunk.last_ns) for index in self._indexes for chunk in index.chunks]
        return (min(first for first, _ in bounds), max(last for _, last in bounds)) if bounds else None

    @property
    def topics(self) -> dict[str, str]:
        """The topics of all files, {topic: type}."""
        return {channel.topic: channel.schema.name if channel.schema else "" for channel in self.channels}

    @property
    def channels(self) -> list[Channel]:
        """Channels of all files; a topic has one for each file and publisher."""
        return [channel for index in self._indexes for channel in index.channels.values()]

    def require(self, topic: str) -> None:
        """Raise RecordingError if the bag does not have a topic."""
        if topic not in self.topics:
            listed = ", ".join(f"{name} ({kind})" for name, kind in sorted(self.topics.items()))
            valid, suggestion = f"the bag contains: {listed or 'no topic'}", did_you_mean(topic, self.topics)
            raise RecordingError(f"no topic {topic}", where=self._path, valid=valid, suggestion=suggestion)

    def messages(self, topics: Collection[str] | None = None, start_ns: int = -1) -> Iterator[RawMessage]:
        """Yield the messages of `topics` (None: all) whose log time is not before `start_ns`.

        They are in the order of their log times within a file; files follow one another. A file with
        messages outside chunks is read in its own order.

        Raises:
            DamagedRecordingError: a file is damaged; every message before the damage has been yielded. A chunk
                that is truncated or fails its checksum yields none.
        """
        for path, index in zip(self.files, self._indexes, strict=True):
            with os_errors(RecordingError, "cannot be read", path), _BoundedFile(path) as file:
                read = _read_in_file_order if index.bounds_ns else self._read_in_time_order
                for message in read(file, index, topics, start_ns):
                    if message.log_time_ns >= start_ns:
                        yield message

    def checked_messages(self, types: Mapping[str, str]) -> Iterator[RawMessage]:
        """Yield the messages of topics, {topic: type}, and check their channels; empty: any type.

        Raises:
            RecordingError: see `messages` and `check_channel`.
        """
        checked: set[int] = set()
        for message in self.messages(types):
            # The reader keeps references to its channels, so that an id() identifies one channel of one file.
            if id(message.channel) not in checked:
                if expected := types[message.channel.topic]:
                    check_channel(message.channel, expected, self._path)
                checked.add(id(message.channel))
            yield message

    def _read_in_time_order(
        self, file: _BoundedFile, index: _FileIndex, topics: Collection[str] | None, start_ns: int
    ) -> Iterator[RawMessage]:
        selected = (c for c in index.chunks if c.last_ns >= start_ns and index.may_contain(c, topics))
        chunks = sorted(selected, key=lambda chunk: (chunk.first_ns, chunk.offset))
        damage = index.damage
        pending: list[RawMessage] = []
        for number, chunk in enumerate(chunks):
            # The header of a damaged chunk may claim any time: chunks before it in the file are still read.
            if damage and chunk.offset > damage[0]:
                continue
            try:
                pending += index.messages_of(file.chunk(chunk.offset), topics)
            except _LIBRARY_ERRORS as error:
                damage = chunk.offset, _describe_error(error)
            pending.sort(key=_log_time)
            if number + 1 == len(chunks):
                break
            ready = bisect_right(pending, chunks[number + 1].first_ns, key=_log_time)
            if sum(len(message.data) for message in pending[ready:]) > MAX_PENDING:
                self.warnings["chunks too far out of order to sort"] += 1
                ready = len(pending)
            yield from pending[:ready]
            del pending[:ready]
        yield from pending
        if damage:
            raise _damage_error(file.path, *damage)


def check_channel(channel: Channel, type_name: str, path: Path) -> None:
    """Check that the messages of a channel of the bag at `path` can be decoded as `type_name`.

    Raises:
        RecordingError: its schema is missing, or its type, encoding or fields differ.
    """
    place = f"{path}, topic {channel.topic}"
    if channel.schema is None:
        raise RecordingError("the bag contains no schema for this topic", where=place, valid=type_name)
    if channel.schema.name.replace("/msg/", "/") != type_name.replace("/msg/", "/"):
        raise RecordingError(f"messages of type {channel.schema.name!r}", where=place, valid=type_name)
    if channel.encoding != "cdr" or channel.schema.encoding != "ros2msg":
        raise RecordingError(
            f"messages in {channel.encoding!r}, defined in {channel.schema.encoding!r}",
            where=place,
            valid="'cdr', defined in 'ros2msg'",
        )
    differs = schemas.difference(channel.schema.data.decode(errors="replace"), type_name)
    if differs:
        raise RecordingError(
            f"another version of {type_name}: {differs}",
            where=place,
            valid="record again, or read it with the version of uwb_mitigation that wrote it",
        )


class _BoundedFile:
    """An MCAP file as the stream that the library reads from.

    A read beyond the end of the file or `MAX_RECORD` is an error instead of a short read or a large allocation.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("rb")
        self.size = self._file.seek(0, 2)
        self.seek(0)

    def __enter__(self) -> _BoundedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def seek(self, offset: int) -> None:
        self.position = offset
        self._file.seek(min(offset, self.size))

    def read(self, length: int) -> bytes:
        if not 0 <= length <= min(self.size - self.position, MAX_RECORD):
            raise McapError(
                f"{length} bytes are expected but only {max(self.size - self.position, 0)} remain"
            )
        self.position += length
        return self._file.read(length)

    def record(self, offset: int) -> records.McapRecord:
        """Read the record at a byte offset, or the first one after it of a known kind.

        Raises:
            ValueError, McapError, struct.error: it is damaged, or larger than `MAX_RECORD`.
        """
        self.seek(offset)
        reader = StreamReader(self, skip_magic=True, emit_chunks=True, record_size_limit=MAX_RECORD)  # type: ignore[arg-type]
        return next(reader.records)

    def chunk(self, offset: int) -> records.Chunk:
        """Read the chunk at a byte offset.

        Raises:
            ValueError, McapError, struct.error: it is damaged, or larger than `MAX_RECORD`.
        """
        chunk = self.record(offset)
        if not isinstance(chunk, records.Chunk):
            raise McapError("no chunk where the index has one")
        return chunk


def _decompress(chunk: records.Chunk) -> bytes:
    """Decompress a chunk. The library alone would allocate any size that a compressed frame claims."""
    size = chunk.uncompressed_size
    if size > MAX_RECORD:
        raise McapError(f"a chunk of {size} bytes uncompressed, more than the maximum of {MAX_RECORD}")
    if chunk.compression not in _DECOMPRESSORS:
        raise McapError(f"a chunk of unknown compression {chunk.compression[:32]!r}, not zstd, lz4 or none")
    try:
        # One byte more than claimed, so that a chunk that contains more is detected.
        data = _DECOMPRESSORS[chunk.compression](chunk.data, size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise McapError(f"a chunk that cannot be decompressed: {error}") from error
    if len(data) != size:
        raise McapError(f"a chunk that does not have the {size} bytes that it claims")
    # 0: no checksum.
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise McapError("a chunk that fails its checksum")
    return data


_DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda data, limit: data[:limit],
    "zstd": lambda data, limit: zstandard.ZstdDecompressor().stream_reader(data).read(limit),
    "lz4": lambda data, limit: lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit),
}


def _index(path: Path) -> _FileIndex:
    with os_errors(RecordingError, "cannot be read", path), _BoundedFile(path) as file:
        magic = file.read(min(file.size, MAGIC_SIZE))
        if not magic:
            raise RecordingError("the file is empty", where=path, valid="an MCAP file")
        if magic != MCAP0_MAGIC:
            raise RecordingError(
                f"not an MCAP file: it starts with {magic.hex(' ')}",
                where=path,
                valid="uwb-mitigation data import converts other formats to MCAP",
            )
        try:
            return _summary(file) or _scan(file)
        except _LIBRARY_ERRORS:
            index = _scan(file)
            index.warnings[BAD_INDEX] += index.damage is None
            return index


def _summary(file: _BoundedFile) -> _FileIndex | None:
    """Read the index at the end of a file; None if the file has none, or none of all of its messages.

    Raises:
        ValueError, McapError, struct.error: the index is damaged.
    """
    footer = file.record(max(file.size - FOOTER_SIZE - MAGIC_SIZE, 0))
    if not isinstance(footer, records.Footer) or file.read(MAGIC_SIZE) != MCAP0_MAGIC:
        raise McapError("no footer")
    if footer.summary_start == 0:
        return None
    file.seek(footer.summary_start)
    data = file.read(file.size - footer.summary_start)
    # The checksum covers the footer before the checksum; 0: no checksum.
    if footer.summary_crc not in (0, zlib.crc32(data[: -MAGIC_SIZE - 4])):
        raise McapError("the index fails its checksum")
    index = _FileIndex()
    statistics: records.Statistics | None = None
    for record in StreamReader(BytesIO(data), skip_magic=True).records:
        if isinstance(record, records.ChunkIndex):
            times, ids = (record.message_start_time, record.message_end_time), record.message_index_offsets
            index.chunks.append(_Chunk(record.chunk_start_offset, *times, frozenset(ids)))
        elif isinstance(record, records.MetadataIndex):
            index.define(file.record(record.offset))
        elif isinstance(record, records.Statistics):
            statistics = record
        else:
            index.define(record)
    if statistics is None:
        return None
    index.messages = statistics.message_count
    counted = statistics.chunk_count, statistics.channel_count, statistics.schema_count
    complete = counted == (len(index.chunks), len(index.channels), len(index.schemas))
    return index if complete and (index.chunks or not index.messages) else None


def _scan(file: _BoundedFile) -> _FileIndex:
    """Build the index from the records themselves; every chunk is decompressed once."""
    index = _FileIndex()
    offset = MAGIC_SIZE
    try:
        while not isinstance(record := file.record(offset), records.DataEnd):
            if isinstance(record, records.Footer):
                raise McapError("the data ends without its end record")
            messages = index.messages_of(record, None)
            if messages:
                index.messages += len(messages)
                times = [message.log_time_ns for message in messages]
                bounds = min(times), max(times)
                if isinstance(record, records.Chunk):
                    ids = frozenset(message.channel.id for message in messages)
                    index.chunks.append(_Chunk(offset, *bounds, ids))
                else:
                    file_bounds = index.bounds_ns or bounds
                    index.bounds_ns = min(file_bounds[0], bounds[0]), max(file_bounds[1], bounds[1])
            offset = file.position
    except _LIBRARY_ERRORS as error:
        index.damage = (offset, _describe_error(error))
    return index


def _read_in_file_order(
    file: _BoundedFile, index: _FileIndex, topics: Collection[str] | None, start_ns: int
) -> Iterator[RawMessage]:
    """Yield the messages of a file in which some are not in chunks."""
    offset, end = MAGIC_SIZE, index.damage[0] if index.damage else file.size
    while offset < end and not isinstance(record := file.record(offset), records.DataEnd):
        offset = file.position
        yield from index.messages_of(record, topics)
    if index.damage:
        raise _damage_error(file.path, *index.damage)


def _damage_error(path: Path, offset: int, what: str) -> DamagedRecordingError:
    return DamagedRecordingError(
        f"damaged: {what}", where=f"{path}, byte {offset}", valid="all messages before this byte were read"
    )


def _describe_error(error: Exception) -> str:
    """The library gives no reason for a record that is shorter than its fields."""
    return "a field ends beyond its record" if isinstance(error, (EndOfFile, struct.error)) else str(error)
