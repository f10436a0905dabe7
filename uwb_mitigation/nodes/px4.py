"""The node `px4`: sends positions or ranges to a PX4 autopilot, through the uXRCE-DDS agent.

Mode positions: `/uwb/pose` as external vision. Orientation and velocity are NaN, so that EKF2 takes the heading from the
compass. Mode ranges: `/uwb/range_corrected` with the positions of the anchors, which EKF2 fuses itself (PX4 1.18).
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.errors import MissingDependencyError, ParameterError, format_id
from uwb_mitigation.nodes.support import diagnostics
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.nodes.support.lifecycle import ManagedNode
from uwb_mitigation.positioning.geodetic import parse_origin, to_geodetic
from uwb_mitigation.types.anchors import AnchorMap, load_anchors
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.stamps import NS_PER_S, to_ns

CORRELATION_S = 1.0
"""Errors within this time are correlated. EKF2 takes them as independent, so their variance is increased."""

MAX_VALUE = 1e6
"""Positions (m) and variances (m^2) beyond this, NaN, and stamps before 1970 are not sent."""

RANGE_PERIOD_NS = 15_000_000
"""Interval between ranges: EKF2 drops ranges whose stamps are less than about 11 ms apart, and PX4 queues only one."""

MAX_SHIFT_NS = 60_000_000
"""A range whose stamp would have to be later by more than this is not sent: at 1 m/s, it is 0.06 m. Nor is one whose stamp
is later than now by more: EKF2 would drop all ranges until that time."""

MAX_AGE_NS = 300_000_000
"""EKF2 ignores older ranges: its buffer holds EKF2_DELAY_MAX (200 ms), and 100 ms more are accepted (RingBuffer.h)."""

MIN_SD_M = 0.1
"""Smallest standard deviation that EKF2 uses (minimum of EKF2_RNGBC_NOISE)."""

TOO_OFTEN, NO_ORIGIN = "more often than EKF2 accepts", "before the origin was known"
FUTURE, LATE = "stamp in the future", "older than 0.3 s, sent nevertheless"
NO_RANGE, NO_VARIANCE = "no valid range or stamp", "no variance"
OTHER_TAG, UNKNOWN_ANCHOR = "of other tags", "anchor not in the file"

MAX_IDS = 10
"""Number of tags, and of unknown anchors, that are named."""

_QOS = QoSProfile(depth=10)


class Px4(ManagedNode):
    """Lifecycle: configure subscribes, activate sends.

    The message types are loaded at run time, because they must be those of the firmware's release.

    Raises:
        MissingDependencyError: px4_msgs is not installed.
    """

    def __init__(self) -> None:
        super().__init__("px4")
        try:
            import px4_msgs.msg as messages
        except ImportError as error:
            self.destroy_node()
            raise MissingDependencyError(
                "px4_msgs is not installed",
                valid="build the branch of https://github.com/PX4/px4_msgs for your firmware, and source its workspace",
            ) from error
        self._messages: Any = messages
        self._resets = 0
        self._publisher: Publisher
        self._anchors: AnchorMap
        self._forget()
        self.autostart()

    def _forget(self) -> None:
        """Begin without earlier positions and ranges."""
        self._sent = 0
        self._latest_ns: int | None = None
        self._tags: set[int] = set()
        self._positions: NDArray[np.float64] | None = None
        self._waiting: dict[int, tuple[int, RangeCorrected]] = {}
        self._last_ns: dict[int, int] = {}
        self._unknown: set[int] = set()
        self._counts: Counter[str] = Counter()

    def open(self) -> None:
        self._forget()
        if self.value("mode") == "ranges":
            self._open_ranges()
        else:
            self._publisher = self.publisher(self._messages.VehicleOdometry, topics.PX4_ODOMETRY, _QOS)
            name = topics.relative(topics.POSE)
            poses = self.subscription(PoseWithCovarianceStamped, name, self._on_pose, 10)
            self.get_logger().info(f"sends {poses.topic_name} to {self._publisher.topic_name}")

    def describe(self) -> Description:
        values: dict[str, object] = {"sent": self._sent, "mode": self.value("mode")}
        values |= {f"ranges {reason}": count for reason, count in sorted(self._counts.items())}
        warning = ""
        if self.value("mode") == "ranges" and self._positions is None:
            warning = "the origin of PX4 is unknown: set parameter origin, or wait for GNSS"
        elif len(self._tags) > 1:
            ids = ", ".join(map(format_id, sorted(self._tags)))
            warning = f"no ranges are sent, because they are of several tags: set parameter tag to that of the vehicle ({ids})"
        elif self._unknown:
            ids = ", ".join(map(format_id, sorted(self._unknown)))
            warning = f"ranges of anchors that are not in the file: {ids}"
        elif self._counts[LATE] + self._counts[FUTURE] > self._sent // 2:
            warning = "EKF2 ignores most ranges, because of their stamps: synchronise the clocks"
        elif self._counts and not self._sent:
            warning = f"no ranges are sent: {self._counts.most_common(1)[0][0]}"
        text = warning or ("sending" if self._sent else "no positions or ranges yet")
        return "PX4", diagnostics.WARN if warning else diagnostics.OK, text, values

    def _open_ranges(self) -> None:
        beacon = getattr(self._messages, "RangingBeacon", None)
        if beacon is None or not hasattr(beacon, "alt_type"):
            raise MissingDependencyError(
                "this px4_msgs has no message RangingBeacon with alt_type",
                valid="px4_msgs of PX4 1.18 or newer; mode:=positions for others",
            )
        if not self.value("anchors"):
            raise ParameterError("parameter anchors is empty", valid="anchors:=FILE for mode:=ranges")
        self._anchors = load_anchors(Path(self.value("anchors")).expanduser())
        self._tag = self.value("tag")
        if self.value("origin"):
            self._place_anchors(parse_origin(self.value("origin")))
        else:
            kind = self._messages.VehicleLocalPosition
            version = getattr(kind, "MESSAGE_VERSION", 0)
            name = topics.relative(topics.PX4_LOCAL_POSITION) + (f"_v{version}" if version else "")
            self.subscription(kind, name, self._on_local_position, qos_profile_sensor_data)
        self._publisher = self.publisher(beacon, topics.PX4_BEACON, _QOS)
        ranges = self.subscription(RangeCorrected, topics.relative(topics.RANGE_CORRECTED), self._on_range)
        self.steady_timer(RANGE_PERIOD_NS / NS_PER_S, self._send_range)
        self.get_logger().info(f"sends {ranges.topic_name} to {self._publisher.topic_name}")

    def _place_anchors(self, origin: tuple[float, float, float]) -> None:
        self._positions = to_geodetic(self._anchors.position, origin)

    def _on_local_position(self, message: Any) -> None:
        """Place the anchors in the local frame of PX4, whose origin changes if PX4 sets another one."""
        if message.xy_global and message.z_global:
            self._place_anchors((message.ref_lat, message.ref_lon, message.ref_alt))

    def _on_range(self, message: RangeCorrected) -> None:
        """Keep the latest range of each anchor until it is sent."""
        if not self.is_active:
            return
        stamp_ns = to_ns(message.header.stamp)
        if message.tag_id != (self._tag or message.tag_id):
            self._counts[OTHER_TAG] += 1
            return
        if len(self._tags) < MAX_IDS:
            self._tags.add(message.tag_id)
        if len(self._tags) > 1:
            # One of them is on the vehicle. The ranges of another one would move it.
            self._counts[OTHER_TAG] += 1 + len(self._waiting)
            self._waiting.clear()
            return
        reason = self._reason_to_drop(message, stamp_ns)
        if reason:
            self._counts[reason] += 1
            return
        if message.anchor_id in self._waiting:
            self._counts[NO_ORIGIN if self._positions is None else TOO_OFTEN] += 1
        self._waiting[message.anchor_id] = stamp_ns, message

    def _reason_to_drop(self, message: RangeCorrected, stamp_ns: int) -> str:
        """Return why EKF2 cannot use a range; empty: it can. Count one that is late."""
        if message.anchor_id not in self._anchors.index:
            if len(self._unknown) < MAX_IDS:
                self._unknown.add(message.anchor_id)
            return UNKNOWN_ANCHOR
        if stamp_ns < 0 or not 0.0 < message.range < MAX_VALUE:
            return NO_RANGE
        if not 0.0 < message.variance < MAX_VALUE:
            return NO_VARIANCE
        age_ns = self.now_ns() - stamp_ns
        if age_ns > MAX_AGE_NS:
            # They are sent, because EKF2_DELAY_MAX may be larger than its default.
            self._counts[LATE] += 1
        return FUTURE if age_ns < -MAX_SHIFT_NS else ""

    def _send_range(self) -> None:
        """Send the range that has waited longest."""
        if not self._waiting or self._positions is None or not self.is_active:
            return
        # The oldest one; of those with the same stamp, that of the anchor whose range was sent least recently.
        anchor = min(
            self._waiting, key=lambda key: (self._waiting[key][0], self._last_ns.get(key, -NS_PER_S))
        )
        stamp_ns, message = self._waiting.pop(anchor)
        sent_ns = stamp_ns
        if self._latest_ns is not None and abs(stamp_ns - self._latest_ns) < CORRELATION_S * NS_PER_S:
            sent_ns = max(stamp_ns, self._latest_ns + RANGE_PERIOD_NS)
            if sent_ns - stamp_ns > MAX_SHIFT_NS:
                self._counts[TOO_OFTEN] += 1
                return
        since_ns = max(abs(stamp_ns - self._last_ns.get(anchor, -NS_PER_S)), RANGE_PERIOD_NS)
        increase = max(1.0, CORRELATION_S * NS_PER_S / since_ns)
        self._latest_ns, self._last_ns[anchor] = sent_ns, stamp_ns
        row = self._anchors.index[anchor]
        latitude, longitude, altitude = self._positions[row].tolist()
        kind = self._messages.RangingBeacon
        self._send(
            kind,
            sent_ns,
            # The field has 8 bits: larger ids are numbered in the order of the file.
            beacon_id=anchor if max(self._anchors.index) < 256 else row + 1,
            range=message.range,
            lat=latitude,
            lon=longitude,
            alt=altitude,
            alt_type=kind.ALT_TYPE_MSL,
            hacc=float(self._anchors.sd[row]),
            vacc=float(self._anchors.sd[row]),
            sequence_nr=message.sequence % 256,
            range_accuracy=max(math.sqrt(message.variance * increase), MIN_SD_M),
        )

    def _on_pose(self, pose: PoseWithCovarianceStamped) -> None:
        stamp_ns = to_ns(pose.header.stamp)
        position, covariance = pose.pose.pose.position, pose.pose.covariance
        # x is east and y is north; each position counts as much as the time since the previous one.
        values = [position.y, position.x, -position.z]
        variances = [covariance[7], covariance[0], covariance[14]]
        increase, is_reset = 1.0, False
        if self._latest_ns is not None:
            since_s = (stamp_ns - self._latest_ns) / NS_PER_S
            if -CORRELATION_S < since_s <= 0.0:
                return
            increase = max(1.0, CORRELATION_S / abs(since_s))
            is_reset = abs(since_s) > CORRELATION_S
        is_valid = stamp_ns >= 0 and all(0.0 < variance < MAX_VALUE for variance in variances)
        if not is_valid or not all(abs(value) < MAX_VALUE for value in values):
            return
        # After a gap, or if a replay starts again, the position may be elsewhere: EKF2 must not reject it as an outlier.
        self._resets += is_reset
        self._latest_ns = stamp_ns
        kind = self._messages.VehicleOdometry
        unknown = ("velocity", "angular_velocity", "orientation_variance", "velocity_variance")
        self._send(
            kind,
            stamp_ns,
            pose_frame=kind.POSE_FRAME_NED,
            position=values,
            q=(math.nan,) * 4,
            velocity_frame=kind.VELOCITY_FRAME_UNKNOWN,
            position_variance=[variance * increase for variance in variances],
            reset_counter=self._resets % 256,
            **dict.fromkeys(unknown, (math.nan,) * 3),
        )

    def _send(self, kind: Any, stamp_ns: int, **values: Any) -> None:
        """Publish a message of PX4, whose times are in microseconds."""
        self._sent += 1
        now_us = self.get_clock().now().nanoseconds // 1000
        self._publisher.publish(kind(timestamp=now_us, timestamp_sample=stamp_ns // 1000, **values))
