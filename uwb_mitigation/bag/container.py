"""The structure of one MCAP file, read as if an enemy had written it (https://mcap.dev/spec).

`survey` walks the records and finds where messages are, without decompressing any; `read_span` yields
the messages of one place. Neither needs the file's own index, so a recording that was cut is read up to
the cut; every length has a ceiling, and nothing is allocated by a length that the file does not hold.
Malformed bytes surface as ValueError inside this module's callers in `reader`, who know the file's name.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

MAX_CHUNK = 256 << 20
"""Ceiling of a chunk, compressed or not, and of one message: 300 times what rosbag2 writes."""

MAX_DEFINITION = 4 << 20
"""Ceiling of one schema, channel or metadata record."""

MAX_DEFINITIONS = 64 << 20
"""Ceiling of all of them together."""

RUN_SIZE = 1 << 20
"""Messages outside chunks are read in runs of about this many bytes."""

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK_TIMES = struct.Struct("<QQ")
_INDEX = struct.Struct("<HI")
_DATA_END_SIZE = 4

_UNEXPECTED = {Opcode.HEADER, Opcode.FOOTER, Opcode.STATISTICS, Opcode.SUMMARY_OFFSET}
_UNEXPECTED |= {Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX}
_KNOWN = frozenset(int(opcode) for opcode in Opcode)


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


@dataclass(slots=True)
class Span:
    """A chunk, or a run of messages outside chunks: what is read at a time.

    Attributes:
        offset, end: bytes of the file.
        first_ns, last_ns: log times of the messages within, as the file claims.
        channel_ids: who is in it; empty = not known.
        chunk: whether the span is one compressed record.
        torn: whether the file ends inside that record.
    """

    offset: int
    end: int
    first_ns: int
    last_ns: int
    chunk: bool
    torn: bool = False
    channel_ids: set[int] = field(default_factory=set)


@dataclass(slots=True)
class Survey:
    """What one file holds.

    Attributes:
        spans: where messages are, in the order of the file.
        schemas, channels: by id, from outside chunks; those inside join as chunks are read.
        metadata: the metadata records by name.
        messages: how many messages the spans hold, as far as the file says.
        damage: (byte offset, what is wrong) of the first damage; None = intact to the end.
        complete: whether the summary repeated the channels, so that all are known before a chunk is read.
        oddities: what was found beside, {kind: count}.
    """

    spans: list[Span] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: int = 0
    damage: tuple[int, str] | None = None
    complete: bool = False
    oddities: Counter[str] = field(default_factory=Counter)
    _definition_bytes: int = 0

    def define(self, opcode: int, body: bytes) -> None:
        """Take in a schema, channel or metadata record; the first of an id or name stays.

        Raises:
            ValueError: it is malformed, or all of them together are larger than `MAX_DEFINITIONS`.
        """
        cursor = _Cursor(body)
        if opcode == Opcode.METADATA:
            name, entries = cursor.string(), cursor.string_map()
            new = name not in self.metadata
            self.metadata.setdefault(name, entries)
        elif opcode == Opcode.SCHEMA:
            (number,) = cursor.unpack("<H")
            schema = Schema(cursor.string(), cursor.string(), cursor.take(*cursor.unpack("<I")))
            new = number not in self.schemas
            self.schemas.setdefault(number, schema)
        else:
            number, schema_id = cursor.unpack("<HH")
            topic, encoding, entries = cursor.string(), cursor.string(), cursor.string_map()
            new = number not in self.channels
            channel = Channel(number, topic, encoding, entries, self.schemas.get(schema_id))
            self.channels.setdefault(number, channel)
        cursor.finish()
        if new:
            self._definition_bytes += len(body)
            if self._definition_bytes > MAX_DEFINITIONS:
                raise ValueError(f"schemas and channels of more than {MAX_DEFINITIONS} bytes together")


def survey(stream: BinaryIO) -> Survey:
    """Walk the records of a file whose magic has been checked."""
    found = Survey()
    size = stream.seek(0, 2)
    offset = len(MCAP0_MAGIC)
    while True:
        try:
            opcode, end = _record_at(stream, offset, size)
            if opcode == Opcode.DATA_END:
                # Another length is another kind of record, its opcode flipped: data would be lost unnoticed.
                if end - offset - _RECORD.size != _DATA_END_SIZE:
                    raise ValueError("a record that ends the data, but of the wrong length")
                break
            _take_in(stream, found, opcode, offset, end)
        except ValueError as error:
            found.damage = (offset, str(error))
            _note_torn_chunk(stream, found, offset, size)
            return found
        offset = end
    try:
        _read_summary(stream, found, end, size)
    except ValueError:
        # Every message comes before the summary; it only repeats and indexes.
        found.oddities["index at the end missing or damaged"] += 1
    return found


def read_span(stream: BinaryIO, found: Survey, span: Span) -> Iterator[RawMessage]:
    """The messages of one span, in the order of the file.

    Of a torn chunk, those that stand before the tear; its checksum cannot be tested.

    Raises:
        ValueError: the span is damaged. A whole chunk's checksum is tested before its first message.
    """
    stream.seek(span.offset)
    data = _read(stream, span.end - span.offset)
    if span.chunk:
        data = _decompress(data[_RECORD.size :], torn=span.torn)
    position, size = 0, len(data)
    channels = found.channels
    while position < size:
        if span.torn and not _whole_record(data, position):
            return
        if size - position < _RECORD.size:
            raise ValueError("a record inside is cut off")
        opcode, length = _RECORD.unpack_from(data, position)
        position += _RECORD.size
        end = position + length
        if end > size:
            raise ValueError(f"a record inside claims {length} bytes where {size - position} are left")
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                raise ValueError(f"a message record of {length} bytes")
            channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, position)
            channel = channels.get(channel_id)
            if channel is None:
                raise ValueError(f"a message on channel {channel_id}, which is not defined")
            yield RawMessage(channel, sequence, log_time, publish_time, data[position + _MESSAGE.size : end])
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            found.define(opcode, data[position:end])
        elif span.chunk:
            raise ValueError(f"a record of kind {opcode:#04x} inside a chunk")
        position = end


def _note_torn_chunk(stream: BinaryIO, found: Survey, offset: int, size: int) -> None:
    """A recorder that was killed leaves its last chunk torn: what was packed before the tear is still good."""
    stream.seek(offset)
    head = stream.read(_RECORD.size + _CHUNK_TIMES.size)
    if len(head) < _RECORD.size + _CHUNK_TIMES.size:
        return
    opcode, length = _RECORD.unpack_from(head)
    if opcode == Opcode.CHUNK and length <= MAX_CHUNK and offset + _RECORD.size + length > size:
        first, last = _CHUNK_TIMES.unpack_from(head, _RECORD.size)
        found.spans.append(Span(offset, size, first, last, chunk=True, torn=True))


def _whole_record(data: bytes, position: int) -> bool:
    if len(data) - position < _RECORD.size:
        return False
    _, length = _RECORD.unpack_from(data, position)
    return bool(position + _RECORD.size + length <= len(data))


def _take_in(stream: BinaryIO, found: Survey, opcode: int, offset: int, end: int) -> None:
    """Note what one record before the summary tells; the stream stands behind its length."""
    length = end - offset - _RECORD.size
    if opcode == Opcode.CHUNK:
        first, last = _CHUNK_TIMES.unpack(_read(stream, _CHUNK_TIMES.size, length))
        if length > MAX_CHUNK:
            raise ValueError(f"a chunk of {length} bytes, more than the ceiling of {MAX_CHUNK}")
        found.spans.append(Span(offset, end, first, last, True))
    elif opcode == Opcode.MESSAGE_INDEX:
        channel_id, array = _INDEX.unpack(_read(stream, _INDEX.size, length))
        if array != length - _INDEX.size or array % 16:
            raise ValueError("a message index of inconsistent length")
        found.messages += array // 16
        if found.spans:
            found.spans[-1].channel_ids.add(channel_id)
    elif opcode == Opcode.MESSAGE:
        _, _, log_time, _ = _MESSAGE.unpack(_read(stream, _MESSAGE.size, length))
        if length > MAX_CHUNK:
            raise ValueError(f"a message of {length} bytes, more than the ceiling of {MAX_CHUNK}")
        found.messages += 1
        run = found.spans[-1] if found.spans else None
        if run and not run.chunk and run.end == offset and end - run.offset <= RUN_SIZE:
            run.end, run.first_ns, run.last_ns = end, min(run.first_ns, log_time), max(run.last_ns, log_time)
        else:
            found.spans.append(Span(offset, end, log_time, log_time, False))
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
        found.define(opcode, _read_definition(stream, length))
    elif opcode == Opcode.HEADER and offset == len(MCAP0_MAGIC):
        pass
    elif opcode in _UNEXPECTED:
        raise ValueError(f"a {Opcode(opcode).name} record where messages are expected")
    elif opcode not in _KNOWN:
        found.oddities["record of unknown kind"] += 1


def _read_summary(stream: BinaryIO, found: Survey, offset: int, size: int) -> None:
    """Definitions that only the summary repeats: those of topics without a message, for one."""
    while True:
        opcode, end = _record_at(stream, offset, size)
        length = end - offset - _RECORD.size
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            found.define(opcode, _read_definition(stream, length))
            found.complete = True
        elif opcode == Opcode.STATISTICS:
            (found.messages,) = struct.unpack("<Q", _read(stream, 8, length))
        elif opcode == Opcode.FOOTER:
            stream.seek(end)
            if stream.read(len(MCAP0_MAGIC) + 1) != MCAP0_MAGIC:
                raise ValueError("no magic at the end")
            return
        offset = end


def _record_at(stream: BinaryIO, offset: int, size: int) -> tuple[int, int]:
    """Opcode and end of the record at `offset`; leaves the stream behind its length."""
    if offset == size:
        raise ValueError("the file ends here, without the record that ends the data")
    stream.seek(offset)
    head = stream.read(_RECORD.size)
    if len(head) < _RECORD.size:
        raise ValueError("the file ends inside a record")
    opcode, length = _RECORD.unpack(head)
    end = offset + _RECORD.size + length
    if end > size:
        raise ValueError(f"a record claims {length} bytes where {size - offset - _RECORD.size} are left")
    return opcode, end


def _read(stream: BinaryIO, size: int, available: int | None = None) -> bytes:
    if available is not None and available < size:
        raise ValueError(f"a record of {available} bytes where at least {size} are needed")
    data = stream.read(size)
    if len(data) < size:
        raise ValueError("the file ends inside a record")
    return data


def _read_definition(stream: BinaryIO, length: int) -> bytes:
    if length > MAX_DEFINITION:
        raise ValueError(f"a definition of {length} bytes, more than the ceiling of {MAX_DEFINITION}")
    return _read(stream, length)


def _decompress(record: bytes, *, torn: bool) -> bytes:
    """The records inside a chunk record; of a torn one, as far as they can be unpacked.

    Raises:
        ValueError: it is malformed, of unknown compression, larger than it says, or fails its checksum.
    """
    cursor = _Cursor(record)
    _, _, size, checksum = cursor.unpack("<QQQI")
    compression = cursor.string()
    length = cursor.unpack("<Q")[0]
    packed = cursor.rest() if torn else cursor.take(length)
    cursor.finish()
    if size > MAX_CHUNK:
        raise ValueError(f"a chunk that unpacks to {size} bytes, more than the ceiling of {MAX_CHUNK}")
    if compression not in _UNPACKERS:
        raise ValueError(f"a chunk of unknown compression {compression[:32]!r}, not zstd, lz4 or none")
    try:
        # One byte more than promised, so that a chunk that holds more is found out.
        data = _UNPACKERS[compression](packed, size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise ValueError(f"a chunk that does not unpack: {error}") from error
    if torn:
        return data
    if len(data) != size:
        raise ValueError(f"a chunk that does not unpack to the {size} bytes it promises")
    if checksum and zlib.crc32(data) != checksum:
        raise ValueError("a chunk that fails its checksum")
    return data


def _unpack_zstd(packed: bytes, limit: int) -> bytes:
    # As a stream: the one-shot call allocates what the frame's own header claims, and gives nothing of a torn frame.
    return zstandard.ZstdDecompressor().stream_reader(packed, closefd=False).read(limit)


_UNPACKERS: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda packed, limit: packed[:limit],
    "zstd": _unpack_zstd,
    "lz4": lambda packed, limit: lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=limit),
}


class _Cursor:
    """Reads the fields of one record, none beyond its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise ValueError(f"a field of {size} bytes in a record with {len(self._data) - self._at} left")
        self._at += size
        return self._data[self._at - size : self._at]

    def rest(self) -> bytes:
        return self.take(len(self._data) - self._at)

    def unpack(self, layout: str) -> tuple[int, ...]:
        return struct.unpack(layout, self.take(struct.calcsize(layout)))

    def string(self) -> str:
        return self.take(*self.unpack("<I")).decode()

    def string_map(self) -> dict[str, str]:
        inner = _Cursor(self.take(*self.unpack("<I")))
        entries = {}
        while inner._at < len(inner._data):
            key = inner.string()
            entries[key] = inner.string()
        return entries

    def finish(self) -> None:
        if self._at != len(self._data):
            raise ValueError(f"a record with {len(self._data) - self._at} bytes too many")
