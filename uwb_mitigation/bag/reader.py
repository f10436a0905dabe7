"""Reads the messages of a bag, whatever their type: by topic, by time, in the order of their log times.

A bag is one MCAP file or a rosbag2 folder. Nothing but the indexes and a few chunks is in memory.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterator
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO

from mcap.writer import MCAP0_MAGIC

from uwb_mitigation.bag import schemas
from uwb_mitigation.bag.index import Channel, FileIndex, RawMessage, Span, index_of, messages_of
from uwb_mitigation.bag.rosbag2 import bag_files
from uwb_mitigation.errors import DamagedRecordingError, RecordingError

MAX_PENDING = 256 << 20
"""Bytes of messages held back to bring them into order; beyond, they leave as they are, and are counted."""

_log_time = attrgetter("log_time_ns")


class BagReader:
    """The messages of an MCAP file or rosbag2 folder.

    Args:
        path: the file or folder.

    Attributes:
        files: the files of the bag, in order.
        metadata: the MCAP metadata records, {name: {key: value}}; of several files, the first wins.
        oddities: what was found beside the messages, {kind: count}.

    Raises:
        RecordingError: the path is absent, unreadable, or no MCAP bag; the message says which.
    """

    def __init__(self, path: Path) -> None:
        self.files = bag_files(path)
        self._indexes = [_index(file) for file in self.files]
        self.metadata: dict[str, dict[str, str]] = {}
        self.oddities: Counter[str] = Counter()
        for found in self._indexes:
            self.metadata = found.metadata | self.metadata
            self.oddities += found.oddities

    @property
    def message_count(self) -> int:
        """Messages on all topics, as the files' indexes say."""
        return sum(found.messages for found in self._indexes)

    @property
    def bounds_ns(self) -> tuple[int, int] | None:
        """First and last log time on all topics, as the files' indexes say; None of an empty bag."""
        spans = [span for found in self._indexes for span in found.spans]
        if not spans:
            return None
        return min(span.first_ns for span in spans), max(span.last_ns for span in spans)

    @property
    def topics(self) -> dict[str, str]:
        """The topics of all files, {topic: type}."""
        return {channel.topic: channel.schema.name if channel.schema else "" for channel in self.channels}

    @property
    def channels(self) -> list[Channel]:
        """Those of all files; a topic has several where it is in several files, or was published by several."""
        return [channel for found in self._indexes for channel in found.channels.values()]

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Messages of `topics` (None = all) with start_ns <= log time < stop_ns.

        They come in the order of their log times within a file; files follow one another. What cannot
        be brought into order within `MAX_PENDING` is counted in `oddities`.

        Raises:
            DamagedRecordingError: a file is damaged; every message before the damage has been yielded.
                A chunk that fails its checksum, or that the file ends in, yields none.
        """
        for path, found in zip(self.files, self._indexes, strict=True):
            try:
                with path.open("rb") as stream:
                    yield from self._ordered(stream, path, found, topics, start_ns, stop_ns)
            except OSError as error:  # noqa: PERF203 - once a file
                raise RecordingError(f"cannot be read: {error.strerror}", where=str(path)) from error

    def _ordered(
        self,
        stream: BinaryIO,
        path: Path,
        found: FileIndex,
        topics: Collection[str] | None,
        start_ns: int | None,
        stop_ns: int | None,
    ) -> Iterator[RawMessage]:
        spans = sorted(
            (span for span in found.spans if _overlaps(span, start_ns, stop_ns)),
            key=lambda span: (span.first_ns, span.offset),
        )
        damage = found.damage
        pending: list[RawMessage] = []
        for number, span in enumerate(spans):
            # A damaged chunk may claim any time; those before it in the file are read all the same.
            if (damage and span.offset > damage[0]) or not _may_hold(found, span, topics):
                continue
            try:
                for message in messages_of(stream, found, span):
                    if (
                        (topics is None or message.channel.topic in topics)
                        and (start_ns is None or message.log_time_ns >= start_ns)
                        and (stop_ns is None or message.log_time_ns < stop_ns)
                    ):
                        # Not extend(): what was read before damage inside a run must stay.
                        pending.append(message)  # noqa: PERF401
            except ValueError as error:
                damage = (span.offset, str(error))
            pending.sort(key=_log_time)
            if number + 1 == len(spans):
                break
            ready = bisect_right(pending, spans[number + 1].first_ns, key=_log_time)
            if sum(len(message.data) for message in pending[ready:]) > MAX_PENDING:
                self.oddities["chunks too far out of order to sort"] += 1
                ready = len(pending)
            yield from pending[:ready]
            del pending[:ready]
        yield from pending
        if damage:
            offset, what = damage
            raise DamagedRecordingError(
                f"damaged: {what}",
                where=f"{path}, byte {offset}",
                valid="everything before that byte was read",
            )


def check_channel(channel: Channel, type_name: str, path: Path) -> None:
    """Refuse a channel of the bag at `path` whose messages this package would misread as `type_name`.

    Raises:
        RecordingError: it has no schema, or its type, encoding or fields are others.
    """
    place = f"{path}, topic {channel.topic}"
    if channel.schema is None:
        raise RecordingError("the bag holds no schema for it", where=place, valid=type_name)
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
            valid="record again, or read it with the version that wrote it",
        )


def _index(path: Path) -> FileIndex:
    try:
        with path.open("rb") as stream:
            magic = stream.read(len(MCAP0_MAGIC))
            if not magic:
                raise RecordingError("the file is empty", where=str(path), valid="an MCAP file")
            if magic != MCAP0_MAGIC:
                raise RecordingError(
                    f"not an MCAP file: it starts with {magic.hex(' ')}",
                    where=str(path),
                    valid=f"MCAP starts with {MCAP0_MAGIC.hex(' ')}",
                )
            return index_of(stream)
    except OSError as error:
        raise RecordingError(f"cannot be read: {error.strerror}", where=str(path)) from error


def _overlaps(span: Span, start_ns: int | None, stop_ns: int | None) -> bool:
    return (start_ns is None or span.last_ns >= start_ns) and (stop_ns is None or span.first_ns < stop_ns)


def _may_hold(found: FileIndex, span: Span, topics: Collection[str] | None) -> bool:
    """False where the file's index shows that a span holds none of `topics`, so that it need not be unpacked."""
    if topics is None or not span.channel_ids:
        return True
    channels = [found.channels.get(number) for number in span.channel_ids]
    return any(channel is None or channel.topic in topics for channel in channels)
