"""Convert messages to a scene, for live topics and for recordings.

Ranges are decoded by this package, all others are message objects; those of rclpy and of rosbags have the same fields.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.positioning.determination import UNIQUE
from uwb_mitigation.positioning.geometry import horizontal_ellipse
from uwb_mitigation.recordings.bag.anchor_markers import parse_markers
from uwb_mitigation.types.measurement import CorrectedRange, RangeMeasurement, Truth
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.ros.codec import (
    MeasurementKey,
    decode_corrected,
    decode_range,
    decode_truth,
    measurement_key,
)
from uwb_mitigation.types.stamps import NS_PER_S, to_ns
from uwb_mitigation.types.tracks import Estimate
from uwb_mitigation.viewer.histories import BoundedDict, Sample, Trace
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import DEFAULT_TAG, NodeStatus, Pose, Scene

MAX_TRUTHS, MAX_WITHOUT_TRUTH = 10_000, 1000
"""Truths and CIRs without corrected ranges, and corrected ranges without truths, that are kept."""

DECODERS: dict[str, Callable[[bytes], Any]] = {
    topics.RANGE_RAW: decode_range,
    topics.RANGE_TRUTH: decode_truth,
    topics.RANGE_CORRECTED: decode_corrected,
}

MAX_HEADING_VARIANCE = 1.0
"""If the variance of the heading is larger, rad^2, the heading is unknown."""


class SceneUpdater:
    """Adds messages to a scene; `add`, with the lock that its pages hold while they draw.

    Attributes:
        malformed: number of messages that could not be decoded.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.malformed = scene, 0
        self._adders: dict[str, Callable[[str, Any], None]] = {
            topics.RANGE_RAW: lambda _, measurement: self.measurement(measurement),
            topics.RANGE_TRUTH: lambda _, decoded: self.truth(*decoded),
            topics.RANGE_CORRECTED: lambda _, decoded: self.corrected(*decoded),
            topics.POSE: self._pose,
            topics.ODOMETRY: self._pose,
            topics.POSE_SMOOTHED: partial(self._position, TrackKind.SMOOTHED),
            topics.ODOMETRY_TRUTH: lambda _, m: self._position(TrackKind.TRUE, str(m.child_frame_id), m),
            topics.ANCHORS: lambda _, message: self.markers(message),
            topics.DIAGNOSTICS: lambda _, message: self._diagnostics(message),
        }
        self._forget()

    def clear(self) -> None:
        """Remove everything except the anchors."""
        self._forget()
        with self.scene.lock:
            self.scene.clear()

    def _forget(self) -> None:
        """Remove what waits for another message of its range."""
        self._truths: BoundedDict[MeasurementKey, Truth] = BoundedDict(MAX_TRUTHS)
        self._gaps_db: BoundedDict[MeasurementKey, float] = BoundedDict(MAX_TRUTHS)
        self._without_truth: BoundedDict[MeasurementKey, Sample] = BoundedDict(MAX_WITHOUT_TRUTH)

    def report(self, name: str, report: NodeStatus) -> None:
        with self.scene.lock:
            self.scene.set_node_status(name, report)

    def add_encoded(self, topic: str, data: bytes) -> None:
        """Decode and add a range."""
        try:
            message = DECODERS[topic](data)
        except RecordingError:
            message = None
        self.add(topic, message)

    def add(self, topic: str, message: Any, tag: str = DEFAULT_TAG) -> None:
        """Add a message of a topic without its namespace and tag; None: it could not be decoded."""
        if message is None:
            self.malformed += 1
            return
        with self.scene.lock:
            self._adders[topic](tag, message)

    def measurement(self, measurement: RangeMeasurement) -> None:
        trace = Trace.from_cir(measurement.cir)
        if trace is not None:
            self._gaps_db.add(measurement_key(measurement), measurement.cir.power_gap_db)
            self.scene.add_trace((measurement.anchor_id, measurement.tag_id), trace)

    def truth(self, key: MeasurementKey, truth: Truth) -> None:
        if (sample := self._without_truth.pop(key, None)) is None:
            self._truths.add(key, truth)
        else:
            self.scene.set_truth(sample, truth)

    def corrected(self, key: MeasurementKey, corrected: CorrectedRange) -> None:
        truth = self._truths.pop(key, None)
        sd_m = math.sqrt(corrected.variance_m2) if corrected.variance_m2 >= 0.0 else math.nan
        measured = corrected.range_raw_m, corrected.range_m, sd_m, corrected.status
        sample = Sample(key.stamp_ns / 1e9, *measured, math.nan if truth is None else truth.range_m)
        sample.gap_db = self._gaps_db.pop(key, math.nan)
        pair = key.anchor_id, key.tag_id
        self.scene.add_sample(pair, sample)
        self.scene.pairs[pair].count_lost(key.sequence)
        self.scene.count_error(sample)
        if truth is None:
            self._without_truth.add(key, sample)

    def _pose(self, tag: str, message: Any) -> None:
        position = message.pose.pose.position
        if not math.isfinite(position.x + position.y):
            self.malformed += 1
            return
        covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)
        q, heading_rad = message.pose.pose.orientation, math.nan
        if 0.0 < covariance[5, 5] < MAX_HEADING_VARIANCE:
            heading_rad = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        stamp_s = to_ns(message.header.stamp) / NS_PER_S
        shape = horizontal_ellipse(covariance), heading_rad, stamp_s, _horizontal_sd_m(covariance)
        self.scene.add_pose(tag, Pose(position.x, position.y, position.z, *shape))

    def estimate(self, tag: str, estimate: Estimate, received_s: float, stamp_offset_s: float) -> None:
        """Add a position that the viewer itself estimated from ranges to whose stamps an offset was added."""
        x, y, z = estimate.position.tolist()
        stamp_s, sd_m = estimate.stamp_ns / NS_PER_S - stamp_offset_s, _horizontal_sd_m(estimate.covariance)
        with self.scene.lock:
            ellipse = horizontal_ellipse(estimate.covariance)
            pose = Pose(x, y, z, ellipse, stamp_s=stamp_s, sd_m=sd_m, received_s=received_s)
            self.scene.add_pose(tag, pose)

    def _position(self, kind: TrackKind, tag: str, message: Any) -> None:
        position = message.pose.pose.position
        if math.isfinite(position.x + position.y):
            stamp_s, sd_m = to_ns(message.header.stamp) / NS_PER_S, _horizontal_sd_m(message.pose.covariance)
            self.scene.add_position(tag, kind, (stamp_s, position.x, position.y, position.z, sd_m))

    def markers(self, message: Any) -> None:
        """Add the anchors of a visualization_msgs/MarkerArray."""
        if anchors := parse_markers(message):
            self.scene.set_anchors(anchors)

    def _diagnostics(self, message: Any) -> None:
        """Add a diagnostic_msgs/DiagnosticArray."""
        for status in message.status:
            # An octet is bytes in rclpy and int in rosbags.
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            determinations = tuple(
                f"{entry.key}: {entry.value}"
                for entry in status.values
                if entry.key.endswith(" determination") and not entry.value.startswith(UNIQUE)
            )
            report = NodeStatus(level, str(status.message), self.scene.clock(), determinations)
            self.scene.set_node_status(str(status.name), report)


def _horizontal_sd_m(covariance: Any) -> float:
    """Return the root of the sum of the variances of x and y; NaN: unknown."""
    variance = float(np.trace(np.asarray(covariance, np.float64).reshape(6, 6)[:2, :2]))
    return math.sqrt(variance) if 0.0 < variance < math.inf else math.nan
