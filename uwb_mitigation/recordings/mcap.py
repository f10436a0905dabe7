"""Measurements from an MCAP bag: raw ranges with their CIRs, joined with the ground truth if the bag contains it.

The truth consists of the true range and of the tag's position (`/uwb/odometry_truth`, at the stamp of the range).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path

from uwb_mitigation.errors import RecordingError, did_you_mean
from uwb_mitigation.recordings.bag.reader import BagReader, check_channel
from uwb_mitigation.types.measurement import RangeMeasurement, Record, Truth
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import MeasurementKey, decode_range, decode_truth, measurement_key
from uwb_mitigation.types.ros.poses import decode_true_position
from uwb_mitigation.types.source import Source

JOIN_WINDOW = 32
"""Maximum number of exchanges between a range and its truth; it limits the memory for pending ranges."""


class McapRecording(Source):
    """The measurements in an MCAP file or a rosbag2 folder; implements `sources.source.Source`.

    Args:
        path: an MCAP file, or a folder with `metadata.yaml` or `*.mcap`.
        topic: topic of the raw ranges, type `uwb_mitigation_msgs/msg/RangeCir`.

    Attributes:
        message_count: number of messages on all topics, from the bag's index.

    Raises:
        RecordingError: the path is missing or not an MCAP bag. Iterating raises it if the bag does not contain
            the topic, or if its type, schema or field layout is not supported.
    """

    def __init__(self, path: Path, *, topic: str = topics.RANGE_RAW) -> None:
        self._path = path
        self._topic = topic
        self._closed = False
        bag = BagReader(path)
        self.message_count = bag.message_count
        simulated_text = bag.metadata.get("uwb_mitigation", {}).get("simulated", "")
        self.simulated = {"true": True, "false": False}.get(simulated_text)
        self.name = f"MCAP bag {path}" + (" (simulated)" if self.simulated else "")
        self.skipped: Counter[str] = Counter()

    def __iter__(self) -> Iterator[Record]:
        self.skipped = Counter()
        self._closed = False
        bag = BagReader(self._path)
        try:
            yield from self._join(bag)
        finally:
            self.skipped.update(bag.warnings)
        if not self._closed and self._topic not in bag.topics:
            listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.topics.items()))
            raise RecordingError(
                f"no topic {self._topic}",
                where=str(self._path),
                valid=f"the bag contains: {listed or 'no topic'}",
                suggestion=did_you_mean(self._topic, bag.topics),
            )

    def close(self) -> None:
        """End an iteration at its next message; files are open only while iterating."""
        self._closed = True

    def _join(self, bag: BagReader) -> Iterator[Record]:
        """Pair ranges with their truths, which may come before or after them; in the order of the ranges."""
        pending: deque[tuple[MeasurementKey, RangeMeasurement]] = deque()
        truths: dict[MeasurementKey, Truth] = {}
        poses: dict[tuple[int, int], TruePose] = {}
        has_poses = bag.topics.get(topics.ODOMETRY_TRUTH) == topics.ODOMETRY_TYPE

        def oldest_is_complete() -> bool:
            key, _ = pending[0]
            return key in truths and (not has_poses or (key.stamp_ns, key.tag_id) in poses)

        def pop_oldest() -> Record:
            key, oldest = pending.popleft()
            return Record(oldest, truths.pop(key, None), *poses.get((key.stamp_ns, key.tag_id), (None, None)))

        try:
            for item in self._decoded(bag):
                if isinstance(item, RangeMeasurement):
                    pending.append((measurement_key(item), item))
                elif len(item) == 2:
                    truths[item[0]] = item[1]
                    if len(truths) > 2 * JOIN_WINDOW:
                        del truths[next(iter(truths))]
                        self.skipped["truth without its range"] += 1
                else:
                    poses[item[:2]] = item[2:]
                    if len(poses) > 2 * JOIN_WINDOW:
                        del poses[next(iter(poses))]
                while pending and (len(pending) > JOIN_WINDOW or oldest_is_complete()):
                    yield pop_oldest()
        except RecordingError:
            while pending:
                yield pop_oldest()
            raise
        while pending and not self._closed:
            yield pop_oldest()
        if truths:
            self.skipped["truth without its range"] += len(truths)

    def _decoded(
        self, bag: BagReader
    ) -> Iterator[RangeMeasurement | tuple[MeasurementKey, Truth] | TruePosition]:
        checked_channels: set[int] = set()
        types = {self._topic: topics.RANGE_CIR_TYPE, topics.RANGE_TRUTH: topics.RANGE_TRUTH_TYPE}
        if bag.topics.get(topics.ODOMETRY_TRUTH) == topics.ODOMETRY_TYPE:
            types[topics.ODOMETRY_TRUTH] = topics.ODOMETRY_TYPE
        for message in bag.messages(types):
            if self._closed:
                return
            topic = message.channel.topic
            # The bag keeps references to its channels, so that an id() identifies one channel of one file.
            if id(message.channel) not in checked_channels and topic != topics.ODOMETRY_TRUTH:
                check_channel(message.channel, types[topic], self._path)
                checked_channels.add(id(message.channel))
            try:
                if topic == self._topic:
                    yield decode_range(message.data)
                elif topic == topics.RANGE_TRUTH:
                    yield decode_truth(message.data)
                elif (decoded := decode_true_position(message.data)) is not None:
                    yield decoded
            except RecordingError as error:
                self.skipped[error.what] += 1


TruePosition = tuple[int, int, tuple[float, float, float], float | None]
"""Stamp and tag of a true position, the position, and its yaw."""

TruePose = tuple[tuple[float, float, float], float | None]
"""A true position and yaw."""
