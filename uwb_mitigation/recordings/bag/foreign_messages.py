"""Messages of ROS 1 and ROS 2 bags in the order of the file, up to a damage, decoded with the types that the bag defines."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.recordings.bag.reader import BagReader

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_Message = tuple[str, int, Any]
"""Topic, time at which it was recorded (ns), and the decoded message."""


def read_messages(path: Path, topics: Collection[str]) -> Iterator[_Message]:
    """Yield the messages of topics. Indexes are not used, because truncated files have none.

    Raises:
        RecordingError: the bag cannot be read, or does not have one of the topics.
        DamagedRecordingError: the bag is damaged, after yielding the messages before.
    """
    databases = sorted(path.glob("*.db3")) if path.is_dir() else [path] if path.suffix == ".db3" else []
    if databases:
        for file in databases:
            yield from _sqlite_messages(file, topics)
    elif path.suffix == ".bag":
        yield from _ros1_messages(path, topics)
    else:
        bag, types = BagReader(path), BagTypes()
        _check_topics(path, topics, bag.topics)
        for message in bag.messages(topics):
            schema = message.channel.schema
            kind, definition = (schema.name, schema.data) if schema else ("", b"")
            yield message.channel.topic, message.log_time_ns, types.decode(kind, definition, message.data)


def _check_topics(path: Path, topics: Collection[str], types: dict[str, str]) -> None:
    if missing := [topic for topic in topics or [""] if topic not in types]:
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())[:40])
        what = f"no topic {missing[0]}" if missing[0] else "the mapping has no topics"
        raise RecordingError(what, where=path, valid=f"the bag has: {listed or 'none'}")


def _damage(path: Path, error: Exception) -> DamagedRecordingError:
    return DamagedRecordingError(f"truncated or corrupt: {error!s:.200}", where=path)


class BagTypes:
    """Decodes messages with the definitions of a bag."""

    def __init__(self, *, ros1: bool = False) -> None:
        self._ros1 = ros1
        self._stores: dict[tuple[str, str | bytes], Typestore] = {}

    def decode(self, type_name: str, definition: str | bytes, data: bytes) -> Any:
        """Return a message; raises errors of various types if the definition or the message is invalid."""
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        name = type_name if "/msg/" in type_name else type_name.replace("/", "/msg/")
        if (store := self._stores.get((name, definition))) is None:
            store = get_typestore(Stores.EMPTY if definition else Stores.ROS2_JAZZY)
            if definition:
                text = definition if isinstance(definition, str) else definition.decode(errors="replace")
                store.register(get_types_from_msg(text, name))
            self._stores[name, definition] = store
        return store.deserialize_ros1(data, name) if self._ros1 else store.deserialize_cdr(data, name)


def _sqlite_messages(path: Path, topics: Collection[str]) -> Iterator[_Message]:
    types = BagTypes()
    try:
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
            # Otherwise SQLite refuses a file that is shorter than its header claims.
            database.execute("PRAGMA writable_schema=ON")
            rows = database.execute("SELECT id, name, type FROM topics")
            names = {key: (name, kind) for key, name, kind in rows}
            _check_topics(path, topics, dict(names.values()))
            tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master")}
            query = "SELECT topic_type, encoded_message_definition FROM message_definitions"
            texts = dict(database.execute(query)) if "message_definitions" in tables else {}
            query = "SELECT topic_id, timestamp, data FROM messages NOT INDEXED"
            for topic_id, stamp_ns, data in database.execute(query):
                # SQLite returns NULL for a row that is cut.
                if topic_id not in names or data is None:
                    raise sqlite3.DatabaseError("a row is incomplete")
                topic, kind = names[topic_id]
                if topic in topics:
                    yield topic, stamp_ns, types.decode(kind, texts.get(kind, ""), data)
    except sqlite3.DatabaseError as error:
        raise _damage(path, error) from error


def _ros1_messages(path: Path, topics: Collection[str]) -> Iterator[_Message]:
    """Read the records of a ROS 1 bag (format 2.0, wiki.ros.org/Bags/Format/2.0)."""
    from rosbags.rosbag1.reader import Header, ReaderError, decompressors, read_uint32

    types, connections = BagTypes(ros1=True), dict[int, tuple[str, str, str]]()
    damage: Exception | None = None
    with path.open("rb") as file:
        if not file.readline(32).startswith(b"#ROSBAG V2.0"):
            raise RecordingError("not a ROS 1 bag of version 2.0", where=path)
        streams: list[BinaryIO] = [file]
        try:
            while streams:
                if not streams[-1].read(1):
                    streams.pop()
                    continue
                streams[-1].seek(-1, 1)
                header = Header.read(streams[-1])
                size = read_uint32(streams[-1])
                data = streams[-1].read(size)
                if is_cut := len(data) < size:
                    damage = damage or ReaderError(f"a record ends after {len(data)} of {size} bytes")
                kind = header.get_uint8("op")
                if kind == 5:
                    # Without compression, the messages at the start of a truncated chunk can be read.
                    streams.append(BytesIO(decompressors[header.get_string("compression")](data)))
                elif is_cut:
                    break
                elif kind == 7:
                    fields = Header.read(BytesIO(len(data).to_bytes(4, "little") + data))
                    described = fields.get_string("type"), fields.get_string("message_definition")
                    connections[header.get_uint32("conn")] = header.get_string("topic"), *described
                elif kind == 2 and (connection := connections[header.get_uint32("conn")])[0] in topics:
                    yield connection[0], header.get_time("time"), types.decode(*connection[1:], data)
        except (ReaderError, KeyError, ValueError, OSError, EOFError, RuntimeError) as error:
            damage = damage or error
    if damage:
        raise _damage(path, damage)
    _check_topics(path, topics, {topic: kind for topic, kind, _ in connections.values()})
