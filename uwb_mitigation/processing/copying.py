"""What processing is measured against: loops that only read and rewrite a bag."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import Writer

from uwb_mitigation.bag.reader import BagReader
from uwb_mitigation.bag.writer import BagWriter
from uwb_mitigation.errors import DamagedRecordingError


def time_library_copy(source: Path, beside: Path) -> float:
    """Wall seconds of copying the bag `source` with the `mcap` library, to a file beside `beside`, removed again."""
    return _timed(source, beside, _copy_with_library)


def time_own_copy(source: Path, beside: Path) -> float:
    """Wall seconds of copying with this package's reader and writer, one message at a time."""
    return _timed(source, beside, _copy_with_ours)


def _timed(source: Path, beside: Path, copy: Callable[[Path, Path], None]) -> float:
    path = beside.with_name(f".{beside.name}.copy.mcap")
    started = time.perf_counter()
    try:
        copy(source, path)
        return time.perf_counter() - started
    finally:
        path.unlink(missing_ok=True)


def _copy_with_ours(source: Path, path: Path) -> None:
    bag = BagReader(source)
    with BagWriter(path, {}, force=True, described=False) as out, suppress(DamagedRecordingError):
        channels: dict[int, int] = {}
        for channel, sequence, log_ns, publish_ns, data in bag.messages():
            number = channels.get(id(channel))
            if number is None:
                number = channels[id(channel)] = out.copy_channel(channel)
            out.write_serialized(number, data, log_ns, publish_ns, sequence)


def _copy_with_library(source: Path, path: Path) -> None:
    with path.open("wb") as stream:
        out = Writer(stream)
        out.start("ros2", "copy")
        for file in BagReader(source).files:
            channels: dict[int, int] = {}
            with file.open("rb") as given, suppress(McapError):
                for schema, channel, message in make_reader(given).iter_messages():
                    number = channels.get(channel.id)
                    if number is None:
                        kind = out.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                        number = out.register_channel(
                            channel.topic, channel.message_encoding, kind, channel.metadata
                        )
                        channels[channel.id] = number
                    out.add_message(
                        number, message.log_time, message.data, message.publish_time, message.sequence
                    )
        out.finish()  # type: ignore[no-untyped-call]
