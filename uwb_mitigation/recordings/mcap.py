"""Measurements from an MCAP bag: raw ranges with their CIRs, joined with the ground truth if the bag contains it.

The truth consists of the true range and of the tag's position (`/uwb/odometry_truth`, at the stamp of the range).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.types.measurement import RangeMeasurement, Record, Truth
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import MeasurementKey, decode_range, decode_truth, measurement_key
from uwb_mitigation.types.ros.poses import decode_true_position
from uwb_mitigation.types.source import Source

JOIN_WINDOW = 32
"""Maximum number of exchanges between a range and its truth; it limits the memory for pending ranges."""


class McapRecording(Source):
    """The measurements in an MCAP file or a rosbag2 folder; implements `types.source.Source`.

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
        if not self._closed:
            bag.require(self._topic)

    def close(self) -> None:
        """End an iteration at its next message; files are open only while iterating."""
        self._closed = True

    def _join(self, bag: BagReader) -> Iterator[Record]:
        """Pair ranges with their truths, which may come before or after them; in the order of the ranges."""
        pending: deque[tuple[MeasurementKey, RangeMeasurement]] = deque()
        truths: dict[MeasurementKey, Truth] = {}
        poses: dict[tuple[int, int], tuple[Any, ...]] = {}
        types = {self._topic: topics.RANGE_CIR_TYPE, topics.RANGE_TRUTH: topics.RANGE_TRUTH_TYPE}
        has_poses = bag.topics.get(topics.ODOMETRY_TRUTH) == topics.ODOMETRY_TYPE
        if has_poses:
            types[topics.ODOMETRY_TRUTH] = ""

        def oldest_is_complete() -> bool:
            key, _ = pending[0]
            return key in truths and (not has_poses or (key.stamp_ns, key.tag_id) in poses)

        def pop_oldest() -> Record:
            key, oldest = pending.popleft()
            return Record(oldest, truths.pop(key, None), *poses.get((key.stamp_ns, key.tag_id), ()))

        try:
            for message in bag.checked_messages(types):
                if self._closed:
                    break
                try:
                    if message.channel.topic == self._topic:
                        measured = decode_range(message.data)
                        pending.append((measurement_key(measured), measured))
                    elif message.channel.topic == topics.RANGE_TRUTH:
                        key, truth = decode_truth(message.data)
                        truths[key] = truth
                    elif position := decode_true_position(message.data):
                        poses[position[:2]] = position[2:]
                except RecordingError as error:
                    self.skipped[error.what] += 1
                if len(truths) > 2 * JOIN_WINDOW:
                    del truths[next(iter(truths))]
                    self.skipped["truth without its range"] += 1
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
