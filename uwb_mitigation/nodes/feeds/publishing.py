"""The publishers of the driver: raw and corrected ranges, ground truth, and the time of a recording."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.nodes.support.lifecycle import ManagedNode
from uwb_mitigation.nodes.support.sensor_ranges import SensorRanges
from uwb_mitigation.radios.wire.messages import Correction
from uwb_mitigation.types.measurement import Cir, RangeMeasurement, Record
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import encode_corrected, encode_range, encode_truth
from uwb_mitigation.types.ros.poses import encode_true_position, prepare_encoders

if TYPE_CHECKING:
    from uwb_mitigation.nodes.mitigator import Mitigator
    from uwb_mitigation.recordings.bag.writer import BagWriter

_NO_CIR = Cir(np.zeros(0, np.int16))
ACKNOWLEDGEMENT_S = 5.0
"""Timeout of the acknowledgement of the last messages of a replay."""


class RangePublisher:
    """Publishes what a source delivers; `node.close` destroys the publishers.

    Args:
        node: the driver.
        consumer: in-process consumer of measurements; `/uwb/range_raw` is then published only if it has subscribers.
        record: path of a bag for the raw ranges; empty: none.
        corrections: the source may deliver ranges that a board has corrected.
        recording: the source delivers ground truth.
    """

    def __init__(
        self, node: ManagedNode, consumer: Mitigator | None, record: str, corrections: bool, recording: bool
    ) -> None:
        self._node = node
        self._consumer = consumer
        self._frame_id: str = node.value("frame_id")
        self._ranges = node.publisher(RangeCir, topics.RANGE_RAW)
        self._bag = self._open_bag(Path(record).expanduser()) if record else None
        if corrections:
            self._corrected = node.publisher(RangeCorrected, topics.RANGE_CORRECTED)
            self._sensor_ranges = SensorRanges(node)
        if recording:
            prepare_encoders()
            self._truths = node.publisher(RangeTruth, topics.RANGE_TRUTH)
            self._true_poses = node.publisher(Odometry, topics.ODOMETRY_TRUTH)
            if node.value("publish_clock"):
                clock = node.create_publisher(ClockMessage, topics.CLOCK, 10)
                self._clock = node.destroy_at_close(clock, node.destroy_publisher)

    @property
    def subscription_count(self) -> int:
        """Number of subscribers of the consumer, or else of raw ranges."""
        if self._consumer is not None:
            return self._consumer.subscription_count()
        return int(self._ranges.get_subscription_count())

    def publish_range(self, measurement: RangeMeasurement) -> None:
        """Publish a range of a radio."""
        measurement = replace(measurement, frame_id=self._frame_id)
        if self._bag is not None:
            self._record(Record(measurement))
        self._publish([measurement])

    def publish_correction(self, correction: Correction) -> None:
        """Publish a range that a board has corrected."""
        c, raw_m = correction, correction.corrected.range_raw_m
        measurement = RangeMeasurement(
            c.stamp_ns, c.tag_id, c.anchor_id, c.sequence, c.device_time, raw_m, _NO_CIR, self._frame_id
        )
        self._corrected.publish(encode_corrected(measurement, c.corrected))
        self._sensor_ranges.publish(c.anchor_id, c.stamp_ns, self._frame_id, c.corrected)

    def publish_records(self, records: Sequence[tuple[Record, int]]) -> None:
        """Publish records of a recording, [(record, stamp_ns), ...], with their ground truth."""
        measurements = []
        for record, stamp_ns in records:
            frame_id = record.measurement.frame_id or self._frame_id
            measurement = replace(record.measurement, stamp_ns=stamp_ns, frame_id=frame_id)
            measurements.append(measurement)
            if self._bag is not None:
                self._record(replace(record, measurement=measurement))
            if record.truth is not None:
                self._truths.publish(encode_truth(measurement, record.truth))
            if record.tag_position is not None:
                true_pose = encode_true_position(
                    record.tag_position, measurement.tag_id, stamp_ns, record.tag_yaw
                )
                self._true_poses.publish(true_pose)
        self._publish(measurements)

    def publish_clock(self, recorded_ns: int) -> None:
        """Publish the time of a recording."""
        self._clock.publish(ClockMessage(clock=Time(nanoseconds=recorded_ns).to_msg()))

    def wait_for_all_acked(self) -> None:
        """Wait until the subscribers have acknowledged all ranges."""
        timeout = Duration(seconds=ACKNOWLEDGEMENT_S)
        self._ranges.wait_for_all_acked(timeout)
        if self._consumer is not None:
            self._consumer.wait_for_all_acked(timeout)

    def _open_bag(self, path: Path) -> BagWriter:
        # Import here: other drivers need no writer of bags.
        from uwb_mitigation.recordings.bag.writer import BagWriter, partial_file

        source = self._node.value("source")
        if os.path.lexists(path):
            raise ParameterError(f"parameter record = {path}: the file exists", valid="another path")
        if (partial := partial_file(path)).exists():
            raise ParameterError(
                f"parameter record = {path}: an unfinished recording exists: {partial}",
                valid="another path, or rename that file",
            )
        origin = {"source": f"driver, source {source}"}
        if source == "simulated":
            origin["simulated"] = "true"
        self._node.destroy_at_close(self, RangePublisher._complete_bag)
        return BagWriter(path, origin)

    def _complete_bag(self) -> None:
        bag, self._bag = self._bag, None
        if bag is None:
            return
        # A node that cannot start, and is respawned, leaves no empty bags.
        error = None if bag.counts else self._node.error
        try:
            bag.__exit__(None if error is None else type(error), error, None)
        except RecordingError as error:
            self._node.get_logger().error(f"the recording is lost: {error}")

    def _record(self, record: Record) -> None:
        """Write a range to the bag; an error, such as a full disk, is logged and ends the recording."""
        assert self._bag is not None
        try:
            self._bag.write(record)
        except RecordingError as error:
            self._bag = None
            self._node.get_logger().error(f"the recording has ended: {error}")

    def _publish(self, measurements: Sequence[RangeMeasurement]) -> None:
        if self._consumer is not None:
            self._consumer.correct(measurements)
            if not self._ranges.get_subscription_count():
                return
        for measurement in measurements:
            # Serialise here: rclpy takes three times as long for its message objects.
            self._ranges.publish(encode_range(measurement))
