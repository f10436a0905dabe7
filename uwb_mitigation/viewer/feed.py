"""Convert messages to a scene, for live topics and for recordings.

Ranges are decoded by this package, all others are message objects; those of rclpy and of rosbags have the same fields.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.positioning.determination import UNIQUE
from uwb_mitigation.positioning.geometry import horizontal_ellipse, parse_lever_arm
from uwb_mitigation.recordings.bag.anchor_markers import parse_markers
from uwb_mitigation.types.measurement import CorrectedRange, RangeMeasurement, Truth
from uwb_mitigation.types.ros import codec, topics
from uwb_mitigation.types.stamps import NS_PER_S, to_ns
from uwb_mitigation.viewer.histories import BoundedDict, Pose, Sample, plausible_cir
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import DEFAULT_TAG, NodeStatus, Scene

MAX_WAITING, MAX_WITHOUT_TRUTH = 10_000, 1000
"""Truths and CIRs without corrected ranges, and corrected ranges without truths, that are kept."""

DECODERS: dict[str, Callable[[bytes], Any]] = {
    topics.RANGE_RAW: codec.decode_range,
    topics.RANGE_TRUTH: codec.decode_truth,
    topics.RANGE_CORRECTED: codec.decode_corrected,
}

LEVER_ARM = re.compile(r"tag (\S{1,20}) lever arm")
"""Key of a lever arm in the diagnostics of the locator."""

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
            topics.POSE: partial(self._position, TrackKind.CORRECTED),
            topics.ODOMETRY: partial(self._position, TrackKind.CORRECTED),
            topics.POSE_SMOOTHED: partial(self._position, TrackKind.SMOOTHED),
            topics.ODOMETRY_TRUTH: lambda _, m: self._position(TrackKind.TRUE, str(m.child_frame_id), m),
            topics.ANCHORS: lambda _, message: self.markers(message),
            topics.DIAGNOSTICS: lambda _, message: self._diagnostics(message),
        }
        # What waits for another message of its range.
        self._truths: BoundedDict[codec.MeasurementKey, Truth] = BoundedDict(MAX_WAITING)
        self._levels: BoundedDict[codec.MeasurementKey, tuple[float, float]] = BoundedDict(MAX_WAITING)
        self._without_truth: BoundedDict[codec.MeasurementKey, None] = BoundedDict(MAX_WITHOUT_TRUTH)

    def add_encoded(self, topic: str, data: bytes) -> None:
        """Decode and add a range."""
        try:
            message = DECODERS[topic](data)
        except RecordingError:
            self.malformed += 1
        else:
            self.add(topic, message)

    def add(self, topic: str, message: Any, tag: str = DEFAULT_TAG) -> None:
        """Add a message of a topic without its namespace and tag."""
        with self.scene.lock:
            self._adders[topic](tag, message)

    def measurement(self, measurement: RangeMeasurement) -> None:
        levels = measurement.cir.power_gap_db, measurement.cir.rx_power_dbm
        self._levels.add(codec.measurement_key(measurement), levels)
        if (cir := plausible_cir(measurement.cir)) is not None:
            self.scene.set_cir((measurement.anchor_id, measurement.tag_id), cir)

    def truth(self, key: codec.MeasurementKey, truth: Truth) -> None:
        if key in self._without_truth:
            del self._without_truth[key]
            pair = key.anchor_id, key.tag_id
            self.scene.set_truth(pair, key.stamp_ns / NS_PER_S, key.sequence, truth.range_m)
        else:
            self._truths.add(key, truth)

    def corrected(self, key: codec.MeasurementKey, corrected: CorrectedRange) -> None:
        truth = self._truths.pop(key, None)
        if truth is None and not self.scene.is_whole:
            self._without_truth.add(key, None)
        sd_m = math.sqrt(corrected.variance_m2) if corrected.variance_m2 >= 0.0 else math.nan
        measured = corrected.range_raw_m, corrected.range_m, sd_m, corrected.status
        true_m = math.nan if truth is None else truth.range_m
        levels = self._levels.pop(key, (math.nan, math.nan))
        sample = Sample(key.stamp_ns / NS_PER_S, *measured, true_m, *levels, key.sequence)
        self.scene.add_sample((key.anchor_id, key.tag_id), sample)

    def _position(self, kind: TrackKind, tag: str, message: Any) -> None:
        """Add a geometry_msgs/PoseWithCovarianceStamped or nav_msgs/Odometry."""
        position, q = message.pose.pose.position, message.pose.pose.orientation
        x, y, z, stamp_s = position.x, position.y, position.z, to_ns(message.header.stamp) / NS_PER_S
        if not math.isfinite(x + y):
            self.malformed += 1
            return
        covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)
        variance, heading_rad = float(covariance[0, 0] + covariance[1, 1]), math.nan
        sd_m = math.sqrt(variance) if 0.0 < variance < math.inf else math.nan
        if 0.0 < covariance[5, 5] < MAX_HEADING_VARIANCE:
            heading_rad = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        pose = Pose(x, y, z, *horizontal_ellipse(covariance), heading_rad, stamp_s, sd_m)
        self.scene.add_pose(tag, pose, kind)

    def markers(self, message: Any) -> None:
        """Add the anchors of a visualization_msgs/MarkerArray."""
        if anchors := parse_markers(message):
            self.scene.set_anchors(anchors)

    def _diagnostics(self, message: Any) -> None:
        """Add a diagnostic_msgs/DiagnosticArray."""
        for status in message.status:
            # An octet is bytes in rclpy and int in rosbags.
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            determinations = []
            for entry in status.values:
                if entry.key.endswith(" determination") and not entry.value.startswith(UNIQUE):
                    determinations.append(f"{entry.key}: {entry.value}")
                elif (match := LEVER_ARM.fullmatch(entry.key)) is not None:
                    with contextlib.suppress(ParameterError):
                        arm = parse_lever_arm(str(entry.value))
                        if arm is not None and any(arm):
                            self.scene.lever_arms.add(match[1], arm)
                        else:
                            self.scene.lever_arms.pop(match[1], None)
            report = NodeStatus(level, str(status.message), self.scene.clock(), tuple(determinations))
            self.scene.set_node_status(str(status.name), report)
