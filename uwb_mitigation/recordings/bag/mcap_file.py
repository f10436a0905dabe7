"""Writes an MCAP file of profile ros2: zstd chunks with all indexes, as `mcap.writer.Writer`, byte by byte.

The library packs each message in a dozen calls and copies each chunk three times, which takes more time than the
compression. Here, messages are packed and copied once; the library packs all records that are not per message.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from typing import BinaryIO

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.well_known import Profile
from mcap.writer import MCAP0_MAGIC

CHUNK_SIZE = 1 << 20
"""A chunk ends after the message with which it exceeds this number of uncompressed bytes."""

_RECORD_HEADER = 9
"""Bytes of opcode and length, which the length does not count."""

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_MESSAGE_FIELDS = _MESSAGE.size - _RECORD_HEADER
_CHUNK = struct.Struct(
    "<BQQQQII4sQ"
)  # opcode, length, times, size, checksum, length of "zstd", "zstd", compressed size
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, size of the entries


class McapFile:
    """Writes the records of one file to a stream.

    Args:
        stream: opened for writing, at its start.
        library: name of this program.
    """

    def __init__(self, stream: BinaryIO, library: str) -> None:
        self._stream = stream
        self._size = 0
        self._pieces: list[bytes] = []
        self._chunk_size = 0
        self._entries: dict[int, list[tuple[int, int]]] = {}
        self._schemas: list[records.McapRecord] = []
        self._channels: list[records.McapRecord] = []
        self._chunks: list[records.ChunkIndex] = []
        self._metadata: list[records.McapRecord] = []
        self._counts: Counter[int] = Counter()
        self._write(MCAP0_MAGIC, _packed(records.Header(Profile.ROS2, library)))

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write a metadata record."""
        content = _packed(records.Metadata(name, data))
        self._metadata.append(records.MetadataIndex(offset=self._size, length=len(content), name=name))
        self._write(content)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Define a message type; return its number."""
        number = len(self._schemas) + 1
        self._define(records.Schema(id=number, name=name, encoding=encoding, data=data), self._schemas)
        return number

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Define a channel; return its number. `schema`: 0 = none."""
        number = len(self._channels) + 1
        channel = records.Channel(
            id=number, topic=topic, message_encoding=encoding, metadata=metadata, schema_id=schema
        )
        self._define(channel, self._channels)
        return number

    def add_message(
        self, channel: int, log_time_ns: int, data: bytes, publish_time_ns: int, sequence: int
    ) -> None:
        """Write a message.

        Raises:
            struct.error: a number is negative or too large.
        """
        length = _MESSAGE_FIELDS + len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, log_time_ns, publish_time_ns)
        if channel not in self._entries:
            self._entries[channel] = []
        self._entries[channel].append((log_time_ns, self._chunk_size))
        self._pieces += (head, data)
        self._chunk_size += length + _RECORD_HEADER
        if self._chunk_size > CHUNK_SIZE:
            self._finish_chunk()

    @property
    def counts(self) -> Counter[int]:
        """Number of messages by channel."""
        return self._counts + Counter({channel: len(entries) for channel, entries in self._entries.items()})

    @property
    def bounds_ns(self) -> tuple[int, int]:
        """First and last log time; 0 without messages."""
        bounds = [(chunk.message_start_time, chunk.message_end_time) for chunk in self._chunks]
        bounds += [self._chunk_bounds()] if self._entries else []
        return min((start for start, _ in bounds), default=0), max((end for _, end in bounds), default=0)

    def _chunk_bounds(self) -> tuple[int, int]:
        times = [time for entries in self._entries.values() for time, _ in entries]
        return min(times), max(times)

    def finish(self) -> None:
        """Write the last chunk and the indexes; does not close the stream."""
        self._finish_chunk()
        self._write(_packed(records.DataEnd(0)))
        first_ns, last_ns = self.bounds_ns
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            metadata_count=len(self._metadata),
            message_start_time=first_ns,
            message_end_time=last_ns,
            schema_count=len(self._schemas),
        )
        groups: tuple[tuple[Opcode, Sequence[records.McapRecord]], ...] = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, []),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        start, summary, offsets = self._size, b"", b""
        for opcode, group in groups:
            content = b"".join(map(_packed, group))
            offsets += _packed(
                records.SummaryOffset(
                    group_opcode=opcode, group_start=start + len(summary), group_length=len(content)
                )
            )
            summary += content
        footer = _packed(
            records.Footer(summary_start=start, summary_offset_start=start + len(summary), summary_crc=0)
        )
        # The checksum covers the footer before the checksum.
        checksum = zlib.crc32(summary + offsets + footer[:-4])
        self._write(summary, offsets, footer[:-4], checksum.to_bytes(4, "little"), MCAP0_MAGIC)

    def _write(self, *contents: bytes) -> None:
        for content in contents:
            self._stream.write(content)
            self._size += len(content)

    def _define(self, record: records.McapRecord, group: list[records.McapRecord]) -> None:
        group.append(record)
        self._pieces.append(_packed(record))
        self._chunk_size += len(self._pieces[-1])

    def _finish_chunk(self) -> None:
        if not self._entries:
            return
        content = b"".join(self._pieces)
        compressed = zstandard.compress(content)
        bounds, checksum, offset = self._chunk_bounds(), zlib.crc32(content), self._size
        length = _CHUNK.size - _RECORD_HEADER + len(compressed)
        sizes = len(content), checksum, 4, b"zstd", len(compressed)
        self._write(_CHUNK.pack(Opcode.CHUNK, length, *bounds, *sizes), compressed)
        index_start, index_offsets = self._size, {}
        for channel, entries in self._entries.items():
            index_offsets[channel] = self._size
            self._counts[channel] += len(entries)
            packed = np.array(entries, "<u8").tobytes()
            length = _INDEX.size - _RECORD_HEADER + len(packed)
            self._write(_INDEX.pack(Opcode.MESSAGE_INDEX, length, channel, len(packed)), packed)
        self._chunks.append(
            records.ChunkIndex(
                message_start_time=bounds[0],
                message_end_time=bounds[1],
                chunk_start_offset=offset,
                chunk_length=index_start - offset,
                message_index_offsets=index_offsets,
                message_index_length=self._size - index_start,
                compression="zstd",
                compressed_size=len(compressed),
                uncompressed_size=len(content),
            )
        )
        self._pieces, self._chunk_size, self._entries = [], 0, {}


def _packed(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()  # type: ignore[no-any-return, no-untyped-call]
