"""What processing is measured against: a loop that only reads and rewrites a bag."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import Writer

from uwb_mitigation.bag.reader import BagReader


def time_copy(source: Path, beside: Path) -> float:
    """Wall seconds of copying the bag `source` with the `mcap` library, to a file beside `beside`, removed again."""
    path = beside.with_name(f".{beside.name}.copy.mcap")
    started = time.perf_counter()
    try:
        _copy(source, path)
        return time.perf_counter() - started
    finally:
        path.unlink(missing_ok=True)


def _copy(source: Path, path: Path) -> None:
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
