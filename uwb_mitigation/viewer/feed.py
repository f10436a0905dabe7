"""From messages to a scene: what live topics and recordings share.

Ranges come as CDR bytes, the rest as message objects; those of rclpy and of rosbags have the same fields.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Any

import numpy as np

from uwb_mitigation.bag.codec import Key, decode_corrected, decode_range, decode_truth
from uwb_mitigation.errors import RecordingError
from uwb_mitigation.measurement import CorrectedRange, RangeMeasurement
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.viewer.scene import AnchorPlace, Pose, Report, Sample, Scene, Trace, Truths

CHI2_95 = 5.991
"""Squared radius of the 95 % ellipse of two dimensions."""

ANCHORS_NAMESPACE = "anchors"
"""Of the markers that are anchors, among those of `/uwb/anchors`; their texts are the anchors' ids."""

MAX_WITHOUT_TRUTH = 1000
"""Corrected ranges that a later truth can still be joined with."""

LONGEST_ID = 20
"""Digits of the largest of 64 bits."""


class Feed:
    """Puts messages into a scene, under the lock that its pages hold while they draw.

    Attributes:
        malformed: messages that could not be read.
    """

    def __init__(self, scene: Scene, lock: Lock) -> None:
        self.malformed = 0
        self._scene = scene
        self._lock = lock
        self._truths = Truths()
        self._without_truth: OrderedDict[Key, Sample] = OrderedDict()

    def set_clock(self, clock: Callable[[], float]) -> None:
        """Measure ages with another clock, s."""
        self._scene.clock = clock

    def clear(self) -> None:
        """Forget what came, but for the anchors."""
        self._truths = Truths()
        self._without_truth.clear()
        with self._lock:
            self._scene.clear()

    def report(self, name: str, report: Report) -> None:
        with self._lock:
            self._scene.add_report(name, report)

    def range_raw(self, data: bytes) -> None:
        try:
            measurement = decode_range(data)
        except RecordingError:
            self.malformed += 1
            return
        self.measurement(measurement)

    def measurement(self, measurement: RangeMeasurement) -> None:
        trace = Trace.of(measurement.cir, measurement.stamp_ns / 1e9)
        if trace is not None:
            with self._lock:
                self._scene.add_trace((measurement.anchor_id, measurement.tag_id), trace)

    def range_truth(self, data: bytes) -> None:
        try:
            key, truth = decode_truth(data)
        except RecordingError:
            self.malformed += 1
            return
        sample = self._without_truth.pop(key, None)
        if sample is None:
            self._truths.add(key, truth)
            return
        with self._lock:
            self._scene.set_truth(sample, truth)

    def range_corrected(self, data: bytes) -> None:
        try:
            key, corrected = decode_corrected(data)
        except RecordingError:
            self.malformed += 1
            return
        self.corrected(key, corrected)

    def corrected(self, key: Key, corrected: CorrectedRange) -> None:
        truth = self._truths.take(key)
        sample = Sample.of(key.stamp_ns / 1e9, corrected, truth)
        with self._lock:
            self._scene.add_sample((key.anchor_id, key.tag_id), sample)
            self._scene.add_error(sample)
        if truth is None:
            self._without_truth[key] = sample
            if len(self._without_truth) > MAX_WITHOUT_TRUTH:
                self._without_truth.popitem(last=False)

    def pose(self, tag: str, message: Any) -> None:
        """A geometry_msgs/PoseWithCovarianceStamped or a nav_msgs/Odometry."""
        position = message.pose.pose.position
        if not all(math.isfinite(value) for value in (position.x, position.y)):
            self.malformed += 1
            return
        covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)[:2, :2]
        pose = Pose(_seconds(message.header.stamp), position.x, position.y, position.z, _ellipse(covariance))
        with self._lock:
            self._scene.add_pose(tag, pose)

    def true_position(self, message: Any) -> None:
        """A nav_msgs/Odometry whose child frame is the tag."""
        place = message.pose.pose.position
        if math.isfinite(place.x + place.y):
            with self._lock:
                self._scene.add_true_position(str(message.child_frame_id), place.x, place.y)

    def markers(self, message: Any) -> None:
        """A visualization_msgs/MarkerArray: its anchors are taken."""
        found: dict[int, AnchorPlace] = {}
        for marker in message.markers:
            place = marker.pose.position
            if marker.ns != ANCHORS_NAMESPACE or not math.isfinite(place.x + place.y):
                continue
            if marker.text.isascii() and marker.text.isdigit() and len(marker.text) <= LONGEST_ID:
                found[int(marker.text)] = AnchorPlace(place.x, place.y, place.z)
        if found:
            with self._lock:
                self._scene.set_anchors(found)

    def anchors(self, anchors: AnchorMap) -> None:
        """Those of an anchors file."""
        places = {anchor.id: AnchorPlace(*anchor.position, anchor.name) for anchor in anchors.anchors}
        with self._lock:
            self._scene.set_anchors(places)

    def diagnostics(self, message: Any) -> None:
        """A diagnostic_msgs/DiagnosticArray."""
        with self._lock:
            for status in message.status:
                # rclpy gives an octet as bytes, rosbags as a number.
                level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
                report = Report(level, str(status.message), self._scene.clock())
                self._scene.add_report(str(status.name), report)


def _ellipse(covariance: np.ndarray[Any, Any]) -> tuple[float, float, float]:
    """The 95 % ellipse of a 2 by 2 covariance: half axes and angle of the larger; NaN where it is none."""
    if not np.isfinite(covariance).all():
        return math.nan, math.nan, math.nan
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    if values[0] < 0:
        return math.nan, math.nan, math.nan
    smaller, larger = np.sqrt(CHI2_95 * values)
    return float(larger), float(smaller), math.atan2(vectors[1, 1], vectors[0, 1])


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
