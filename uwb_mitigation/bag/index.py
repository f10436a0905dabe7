"""What one MCAP file holds and where, and the messages of one place in it; the format is the `mcap` library's.

The index at the end of a file is believed where its checksum is right. Otherwise the file is walked record by
record, so that a recording that was cut is read up to the cut. The library believes any length that a file states,
takes a short read for a whole record and passes over what it does not know: so lengths are tested here before it
sees a record, and messages, whose lengths are walked in any case, are cut out on the way.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.writer import MCAP0_MAGIC

MAX_CHUNK = 256 << 20
"""Ceiling of a chunk, compressed or not, of one message, and of the index: 300 times what rosbag2 writes."""

MAX_DEFINITION = 4 << 20
"""Ceiling of one schema, channel or metadata record."""

MAX_DEFINITIONS = 64 << 20
"""Ceiling of all of them together."""

RUN_SIZE = 1 << 20
"""Messages outside chunks are read in runs of about this many bytes."""

BAD_INDEX = "index at the end missing or damaged"
"""An oddity: the messages are all there."""

_RECORD = struct.Struct("<BQ")
_INDEX = struct.Struct("<HI")
_MESSAGE = struct.Struct("<HIQQ")
_FOOTER_FIELDS = 20
_DATA_END_FIELDS = 4

_DEFINITIONS: dict[int, Callable[[ReadDataStream], records.McapRecord]] = {
    Opcode.SCHEMA: records.Schema.read,
    Opcode.CHANNEL: records.Channel.read,
    Opcode.METADATA: records.Metadata.read,
}
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_MALFORMED = (ValueError, McapError, struct.error)
"""What the library raises on bytes that are no MCAP."""


@dataclass(frozen=True, slots=True)
class Schema:
    """A message type as the file defines it."""

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic in the file; `schema` is None where the file holds none for it."""

    id: int
    topic: str
    encoding: str
    metadata: dict[str, str]
    schema: Schema | None


class RawMessage(NamedTuple):
    """A message as it lies in the file."""

    channel: Channel
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class Span(NamedTuple):
    """A chunk, or a run of messages outside chunks: what is read at a time.

    Attributes:
        offset, end: bytes of the file.
        first_ns, last_ns: log times of the messages within.
        chunk: whether the span is one compressed record.
        channel_ids: who is in it; empty = not known.
    """

    offset: int
    end: int
    first_ns: int
    last_ns: int
    chunk: bool
    channel_ids: frozenset[int] = frozenset()


@dataclass(slots=True)
class FileIndex:
    """What one file holds.

    Attributes:
        spans: where messages are.
        schemas, channels: by id; the first of an id stays.
        metadata: the metadata records by name; the first of a name stays.
        messages: how many messages the spans hold.
        damage: (byte offset, what is wrong) of the first damage; None = none is known before messages are read.
        oddities: what was found beside, {kind: count}.
    """

    spans: list[Span] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: int = 0
    damage: tuple[int, str] | None = None
    oddities: Counter[str] = field(default_factory=Counter)
    _definition_bytes: int = 0

    def define(self, record: records.McapRecord) -> None:
        """Take in a schema, channel or metadata record.

        Raises:
            ValueError: all of them together are larger than `MAX_DEFINITIONS`.
        """
        size = 0
        if isinstance(record, records.Schema) and record.id not in self.schemas:
            self.schemas[record.id] = Schema(record.name, record.encoding, record.data)
            size = len(record.data)
        elif isinstance(record, records.Channel) and record.id not in self.channels:
            self.channels[record.id] = Channel(
                record.id,
                record.topic,
                record.message_encoding,
                record.metadata,
                self.schemas.get(record.schema_id),
            )
            size = sum(map(len, record.metadata.values()))
        elif isinstance(record, records.Metadata) and record.name not in self.metadata:
            self.metadata[record.name] = record.metadata
            size = sum(map(len, record.metadata.values()))
        self._definition_bytes += size
        if self._definition_bytes > MAX_DEFINITIONS:
            raise ValueError(f"schemas and channels of more than {MAX_DEFINITIONS} bytes together")


def index_of(stream: BinaryIO) -> FileIndex:
    """What a file holds whose first magic has been checked."""
    size = stream.seek(0, 2)
    oddities: Counter[str] = Counter()
    try:
        found = _summary(stream, size)
        if found is not None:
            return found
    except _MALFORMED:
        oddities[BAD_INDEX] += 1
    found = _walked(stream, size)
    if found.damage is None:
        found.oddities += oddities
    return found


def messages_of(stream: BinaryIO, found: FileIndex, span: Span) -> Iterator[RawMessage]:
    """The messages of one span, in the order of the file.

    Raises:
        ValueError: the span is damaged. A chunk's checksum is tested before its first message.
    """
    try:
        if span.end - span.offset > MAX_CHUNK:
            raise ValueError(
                f"a chunk of {span.end - span.offset} bytes, more than the ceiling of {MAX_CHUNK}"
            )
        data = _read(stream, span.offset, span.end)
        if span.chunk:
            if data[0] != Opcode.CHUNK:
                raise ValueError("no chunk where the index has one")
            data = _unpacked(records.Chunk.read(ReadDataStream(BytesIO(data[_RECORD.size :]))))
        at, size, channels = 0, len(data), found.channels
        while at < size:
            opcode, length = _RECORD.unpack_from(data, at)
            at, end = at + _RECORD.size, at + _RECORD.size + length
            if end > size:
                raise ValueError(f"a record inside claims {length} bytes where {size - at} are left")
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE.size:
                    raise ValueError(f"a message record of {length} bytes")
                number, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(data, at)
                channel = channels.get(number)
                if channel is None:
                    raise ValueError(f"a message on channel {number}, which is not defined")
                yield RawMessage(channel, sequence, log_ns, publish_ns, data[at + _MESSAGE.size : end])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                found.define(_DEFINITIONS[opcode](ReadDataStream(BytesIO(data[at:end]))))
            else:
                raise ValueError(f"a record of kind {opcode:#04x} inside a chunk")
            at = end
    except (McapError, struct.error) as error:
        raise ValueError(_told(error)) from error


def _summary(stream: BinaryIO, size: int) -> FileIndex | None:
    """The index at the end; None where it is whole but does not tell where every message is.

    Raises:
        ValueError, McapError, struct.error: it is missing or damaged.
    """
    tail = _RECORD.size + _FOOTER_FIELDS + MAGIC_SIZE
    end = _read(stream, size - tail, size)
    if _RECORD.unpack_from(end) != (Opcode.FOOTER, _FOOTER_FIELDS) or not end.endswith(MCAP0_MAGIC):
        raise ValueError("no footer")
    footer = records.Footer.read(ReadDataStream(BytesIO(end[_RECORD.size :])))
    if footer.summary_start == 0:
        return None
    if size - footer.summary_start > MAX_CHUNK:
        raise ValueError("an index beyond the ceiling")
    data = _read(stream, footer.summary_start, size)
    # The checksum covers the footer up to itself; 0 = there is none.
    if footer.summary_crc not in (0, zlib.crc32(data[: -MAGIC_SIZE - 4])):
        raise ValueError("an index that fails its checksum")
    found = FileIndex()
    statistics = None
    for record in StreamReader(BytesIO(data), skip_magic=True).records:
        if isinstance(record, records.ChunkIndex):
            start, end_of_chunk = record.chunk_start_offset, record.chunk_start_offset + record.chunk_length
            times, ids = (record.message_start_time, record.message_end_time), record.message_index_offsets
            found.spans.append(Span(start, end_of_chunk, *times, True, frozenset(ids)))
        elif isinstance(record, records.MetadataIndex):
            found.define(_definition(stream, Opcode.METADATA, record.offset, record.offset + record.length))
        elif isinstance(record, records.Statistics):
            statistics = record
        else:
            found.define(record)
    if statistics is None:
        return None
    found.messages = statistics.message_count
    told = (statistics.chunk_count, statistics.channel_count, statistics.schema_count)
    held = (len(found.spans), len(found.channels), len(found.schemas))
    whole = told == held and (found.spans or not found.messages)
    return found if whole else None


def _walked(stream: BinaryIO, size: int) -> FileIndex:
    """The same from the records themselves; every chunk is unpacked once."""
    found = FileIndex()
    offset = MAGIC_SIZE
    while True:
        try:
            opcode, end = _record_at(stream, offset, size)
            if opcode == Opcode.DATA_END:
                # Another length is another kind of record, its opcode flipped: data would be lost unnoticed.
                if end - offset - _RECORD.size != _DATA_END_FIELDS:
                    raise ValueError("a record that ends the data, but of the wrong length")
                return found
            _take_in(stream, found, opcode, offset, end)
        except _MALFORMED as error:
            found.damage = (offset, _told(error))
            return found
        offset = end


def _take_in(stream: BinaryIO, found: FileIndex, opcode: int, offset: int, end: int) -> None:
    """Note what one record before the index tells."""
    length = end - offset - _RECORD.size
    if opcode in _DEFINITIONS:
        found.define(_definition(stream, opcode, offset, end))
    elif opcode == Opcode.CHUNK:
        within = [
            (message.log_time_ns, message.channel.id)
            for message in messages_of(stream, found, Span(offset, end, 0, 0, True))
        ]
        if within:
            times, ids = zip(*within, strict=True)
            found.spans.append(Span(offset, end, min(times), max(times), True, frozenset(ids)))
            found.messages += len(within)
    elif opcode == Opcode.MESSAGE:
        if not _MESSAGE.size <= length <= MAX_CHUNK:
            raise ValueError(f"a message record of {length} bytes, not {_MESSAGE.size} to {MAX_CHUNK}")
        body = offset + _RECORD.size
        _, _, log_ns, _ = _MESSAGE.unpack(_read(stream, body, body + _MESSAGE.size))
        found.messages += 1
        run = found.spans[-1] if found.spans else None
        if run and not run.chunk and run.end == offset and end - run.offset <= RUN_SIZE:
            first, last = min(run.first_ns, log_ns), max(run.last_ns, log_ns)
            found.spans[-1] = Span(run.offset, end, first, last, False)
        else:
            found.spans.append(Span(offset, end, log_ns, log_ns, False))
    elif opcode == Opcode.MESSAGE_INDEX:
        _, array = _INDEX.unpack(_read(stream, offset + _RECORD.size, offset + _RECORD.size + _INDEX.size))
        if array != length - _INDEX.size or array % 16:
            raise ValueError("a message index of inconsistent length")
    elif opcode not in _KNOWN:
        found.oddities["record of unknown kind"] += 1
    elif opcode != Opcode.ATTACHMENT and not (opcode == Opcode.HEADER and offset == MAGIC_SIZE):
        raise ValueError(f"a {Opcode(opcode).name} record where messages are expected")


def _record_at(stream: BinaryIO, offset: int, size: int) -> tuple[int, int]:
    """Opcode and end of the record at `offset`, which lies within the file."""
    if offset == size:
        raise ValueError("the file ends here, without the record that ends the data")
    opcode, length = _RECORD.unpack(_read(stream, offset, offset + _RECORD.size))
    end = offset + _RECORD.size + length
    if end > size:
        raise ValueError(f"a record claims {length} bytes where {size - offset - _RECORD.size} are left")
    return opcode, end


def _definition(stream: BinaryIO, opcode: int, offset: int, end: int) -> records.McapRecord:
    if end - offset > MAX_DEFINITION:
        raise ValueError(f"a definition of {end - offset} bytes, more than the ceiling of {MAX_DEFINITION}")
    data = _read(stream, offset, end)
    body = ReadDataStream(BytesIO(data[_RECORD.size :]))
    record = _DEFINITIONS[opcode](body)
    if data[0] != opcode or body.count != len(data) - _RECORD.size:
        raise ValueError("a definition whose fields do not fill its record")
    return record


def _read(stream: BinaryIO, offset: int, end: int) -> bytes:
    """Bytes of the file; callers have compared `end` with a ceiling."""
    if offset < 0:
        raise ValueError("the file ends inside a record")
    stream.seek(offset)
    data = stream.read(end - offset)
    if len(data) < end - offset:
        raise ValueError("the file ends inside a record")
    return data


def _unpacked(chunk: records.Chunk) -> bytes:
    """The records in a chunk; the library would allocate whatever a packed frame claims.

    Raises:
        ValueError: unknown compression, beyond the ceiling, not of the size it states, or a wrong checksum.
    """
    size = chunk.uncompressed_size
    if size > MAX_CHUNK:
        raise ValueError(f"a chunk that unpacks to {size} bytes, more than the ceiling of {MAX_CHUNK}")
    if chunk.compression not in _UNPACKERS:
        raise ValueError(f"a chunk of unknown compression {chunk.compression[:32]!r}, not zstd, lz4 or none")
    try:
        # One byte more than promised, so that a chunk that holds more is found out.
        data = _UNPACKERS[chunk.compression](chunk.data, size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise ValueError(f"a chunk that does not unpack: {error}") from error
    if len(data) != size:
        raise ValueError(f"a chunk that does not unpack to the {size} bytes it promises")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):  # 0 = there is none
        raise ValueError("a chunk that fails its checksum")
    return data


_UNPACKERS: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda packed, limit: packed[:limit],
    "zstd": lambda packed, limit: zstandard.ZstdDecompressor().stream_reader(packed).read(limit),
    "lz4": lambda packed, limit: lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=limit),
}


def _told(error: Exception) -> str:
    """The library's own words are of a field, or none, where a record is shorter than its fields."""
    return "a field ends beyond its record" if isinstance(error, (EndOfFile, struct.error)) else str(error)
