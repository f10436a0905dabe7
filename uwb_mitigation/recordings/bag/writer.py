"""Writes a bag that `ros2 bag`, Foxglove and the `rosbags` library open: MCAP, profile ros2, zstd chunks.

The output is atomic: data goes to a `.part` file, which is renamed at the end
and removed if an error or Ctrl-C ends the writer.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import Writer

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.files import VERSION, partial_path, write_atomically
from uwb_mitigation.recordings.bag import rosbag2
from uwb_mitigation.recordings.bag.reader import Channel, Schema
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.ros import schemas, topics
from uwb_mitigation.types.ros.codec import encode_range, encode_truth
from uwb_mitigation.types.ros.poses import encode_true_position

METADATA_RECORD = "uwb_mitigation"
"""Name of the MCAP metadata record that holds the bag's origin."""

_QOS_KEY = "offered_qos_profiles"
_HASH_KEY = "topic_type_hash"
_NO_SCHEMA = 0


def partial_file(path: Path) -> Path:
    """Return the temporary path of a bag at `path` until the bag is complete."""
    return partial_path(_bag_file(path))


def _bag_file(path: Path) -> Path:
    return path if path.suffix == ".mcap" else path / f"{path.name}_0.mcap"


def check_bag_output(path: Path, *, force: bool = False) -> None:
    """Check that a bag can be created at `path`.

    Raises:
        ParameterError: the bag exists and `force` is not given, or its folder does not exist.
    """
    is_file, folder = path.suffix == ".mcap", path.absolute().parent
    if is_file and not folder.is_dir():
        raise ParameterError("the folder of the output does not exist", where=path, valid=str(folder))
    if not is_file and path.exists() and not path.is_dir():
        raise ParameterError("a file instead of a bag folder", where=path)
    # Without `force`, a broken link is not replaced either.
    occupied = os.path.lexists(_bag_file(path)) or (not is_file and path.is_dir() and any(path.iterdir()))
    if occupied and not force:
        raise ParameterError("exists already", where=path, valid="--force replaces it")


class BagWriter:
    """Writes one bag; a context manager that completes the bag or, on any exception, removes it.

    Args:
        path: one file if it ends in `.mcap`, otherwise a rosbag2 folder.
        metadata: origin of the bag; the version of the package is added. Readers of this package use `source` and
            `simulated` (`true` or `false`).
        force: replace an existing bag.

    Attributes:
        file: the MCAP file.
        counts: messages written, {topic: count}.

    Raises:
        ParameterError: as `check_bag_output`.
        RecordingError: the path cannot be written.
    """

    def __init__(self, path: Path, metadata: Mapping[str, str], *, force: bool = False) -> None:
        self._folder = None if path.suffix == ".mcap" else path
        self.file = _bag_file(path)
        self._partial = partial_file(path)
        self._metadata = {"version": VERSION, **metadata}
        self._own_channels: dict[str, int] = {}
        self._channel_ids: dict[tuple[object, ...], int] = {}
        self._topic_of_channel: dict[int, str] = {}
        self._topics: dict[str, dict[str, Any]] = {}
        self._schemas: dict[Schema, int] = {}
        self._stream: BinaryIO | None = None
        self.counts: Counter[str] = Counter()
        self._bounds_ns: tuple[int, int] | None = None

        check_bag_output(path, force=force)
        self._created_folder = self._folder is not None and not self._folder.exists()
        try:
            with self._translate_os_errors():
                if self._folder is not None:
                    self._folder.mkdir(parents=True, exist_ok=True)
                self._stream = self._partial.open("wb")
                self._mcap = Writer(self._stream)
                self._mcap.start(Profile.ROS2, f"uwb_mitigation {VERSION}")
                self._mcap.add_metadata(METADATA_RECORD, self._metadata)
        except BaseException:
            # Ctrl-C before the `with` block of the caller.
            self._discard()
            raise

    def write(self, record: Record) -> None:
        """Write a measurement to `/uwb/range_raw` and, if known, its truth to `/uwb/range_truth`.

        The true position of the tag is written to `/uwb/odometry_truth`.

        Raises:
            RecordingError: a value does not fit its field, or the bag cannot be written.
        """
        measurement = record.measurement
        stamp_ns, sequence, data = measurement.stamp_ns, measurement.sequence, encode_range(measurement)
        self.write_message(topics.RANGE_RAW, topics.RANGE_CIR_TYPE, data, stamp_ns, sequence)
        if record.truth is not None:
            data = encode_truth(measurement, record.truth)
            self.write_message(topics.RANGE_TRUTH, topics.RANGE_TRUTH_TYPE, data, stamp_ns, sequence)
        if record.tag_position is not None:
            data = encode_true_position(record.tag_position, measurement.tag_id, stamp_ns, record.tag_yaw)
            self.write_message(topics.ODOMETRY_TRUTH, topics.ODOMETRY_TYPE, data, stamp_ns)

    def write_message(
        self, topic: str, type_name: str, data: bytes, stamp_ns: int, sequence: int = 0
    ) -> None:
        """Write a serialised message of a standard type.

        Raises:
            RecordingError: the time is before the epoch, or the bag cannot be written.
        """
        self.write_serialized(self.channel(topic, type_name), data, stamp_ns, stamp_ns, sequence)

    def copy_channel(self, channel: Channel) -> int:
        """Register a channel of another bag; return its number.

        Channels that differ only in their id get the same number, so that the files of one bag share it.
        The recorded QoS is copied in the format of the current rosbag2.
        """
        metadata = channel.metadata | {
            _QOS_KEY: rosbag2.dump(rosbag2.recorded_qos(channel.metadata.get(_QOS_KEY, "")))
        }
        return self._add_channel(replace(channel, metadata=metadata))

    def write_serialized(
        self, channel: int, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int = 0
    ) -> None:
        """Write the bytes of a message unchanged to a channel of `copy_channel` or `channel`.

        Raises:
            RecordingError: a time is negative, or the bag cannot be written.
        """
        try:
            self._mcap.add_message(channel, log_time_ns, data, publish_time_ns, sequence)
        except struct.error as error:
            times = f"{log_time_ns} and {publish_time_ns} ns"
            raise RecordingError(f"times {times} of a message", valid="0 to 2^64 - 1 ns") from error
        except OSError as error:
            raise self._write_error(error) from error
        self.counts[self._topic_of_channel[channel]] += 1
        first_ns, last_ns = self._bounds_ns or (log_time_ns, log_time_ns)
        self._bounds_ns = min(first_ns, log_time_ns), max(last_ns, log_time_ns)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._discard()
            return
        try:
            self._finish()
        except BaseException:
            self._discard()
            raise

    def channel(self, topic: str, type_name: str) -> int:
        """Register a topic of a standard type; return its number."""
        number = self._own_channels.get(topic)
        if number is None:
            schema = Schema(type_name, SchemaEncoding.ROS2, schemas.definition(type_name).encode())
            metadata = {_QOS_KEY: rosbag2.NO_QOS, _HASH_KEY: schemas.type_hash(type_name)}
            number = self._add_channel(Channel(0, topic, MessageEncoding.CDR, metadata, schema))
            self._own_channels[topic] = number
        return number

    def _add_channel(self, channel: Channel) -> int:
        topic, schema, metadata = channel.topic, channel.schema, channel.metadata
        key = (topic, channel.encoding, schema, *sorted(metadata.items()))
        if key in self._channel_ids:
            return self._channel_ids[key]
        with self._translate_os_errors():
            if schema is not None and schema not in self._schemas:
                self._schemas[schema] = self._mcap.register_schema(schema.name, schema.encoding, schema.data)
            schema_id = _NO_SCHEMA if schema is None else self._schemas[schema]
            number = self._mcap.register_channel(topic, channel.encoding, schema_id, metadata)
        self._channel_ids[key], self._topic_of_channel[number] = number, topic
        # A topic may have several channels, of several publishers; rosbag2 lists it once.
        kind, qos = schema.name if schema else "", rosbag2.recorded_qos(metadata[_QOS_KEY])
        description = rosbag2.topic_metadata(topic, kind, metadata.get(_HASH_KEY, ""), qos)
        self._topics.setdefault(topic, description)
        return number

    def _finish(self) -> None:
        bounds_ns = self._bounds_ns or (0, 0)
        document = rosbag2.describe(
            self.file.name, [*self._topics.values()], self.counts, bounds_ns, self._metadata
        )
        with self._translate_os_errors():
            self._mcap.add_metadata("rosbag2", {"serialized_metadata": rosbag2.dump(document)})
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._close()
            self._partial.replace(self.file)
            if self._folder is not None:
                text = rosbag2.dump({"rosbag2_bagfile_information": document})
                write_atomically(self.file.with_name(rosbag2.METADATA_NAME), text, RecordingError)

    def _close(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def _discard(self) -> None:
        with contextlib.suppress(OSError):
            self._close()
        # Do not replace the original error if the file cannot be removed.
        with contextlib.suppress(OSError):
            self._partial.unlink(missing_ok=True)
        if self._created_folder and self._folder is not None:
            with contextlib.suppress(OSError):
                self._folder.rmdir()

    @contextlib.contextmanager
    def _translate_os_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._write_error(error) from error

    def _write_error(self, error: OSError) -> RecordingError:
        self._discard()
        return RecordingError(f"cannot be written: {error.strerror}", where=self.file)
