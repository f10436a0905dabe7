"""The node `px4`: sends the positions of `/uwb/pose` to a PX4 autopilot, through the uXRCE-DDS agent.

It sends positions only. Orientation and velocity are NaN, so that EKF2 takes the heading from the compass.
"""

from __future__ import annotations

import math

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from uwb_mitigation.errors import MissingDependencyError
from uwb_mitigation.types.ros import topics
from uwb_mitigation.types.stamps import NS_PER_S, to_ns

CORRELATION_S = 1.0
"""Errors of positions within this time are correlated. EKF2 takes them as independent, so their variance is increased."""

MAX_VALUE = 1e6
"""Positions (m) and variances (m^2) beyond this, NaN, and stamps before 1970 are not sent."""

_NAN3 = (math.nan,) * 3


class Px4(Node):
    """Subscribes to `PoseWithCovarianceStamped` in ENU axes and publishes `px4_msgs/VehicleOdometry` in NED axes.

    The message type is loaded at run time, because it must be that of the firmware's release.

    Raises:
        MissingDependencyError: px4_msgs is not installed.
    """

    def __init__(self) -> None:
        super().__init__("px4")
        try:
            from px4_msgs.msg import VehicleOdometry
        except ImportError as error:
            self.destroy_node()
            raise MissingDependencyError(
                "px4_msgs is not installed",
                valid="build the branch of https://github.com/PX4/px4_msgs for your firmware, and source its workspace",
            ) from error
        self._type = VehicleOdometry
        self._latest_ns: int | None = None
        self._resets = 0
        self._publisher = self.create_publisher(VehicleOdometry, topics.relative(topics.PX4_ODOMETRY), 10)
        poses = self.create_subscription(
            PoseWithCovarianceStamped, topics.relative(topics.POSE), self._on_pose, 10
        )
        self.get_logger().info(f"sends {poses.topic_name} to {self._publisher.topic_name}")

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
        self._publisher.publish(
            self._type(
                timestamp=self.get_clock().now().nanoseconds // 1000,
                timestamp_sample=stamp_ns // 1000,
                pose_frame=self._type.POSE_FRAME_NED,
                position=values,
                q=(math.nan,) * 4,
                velocity_frame=self._type.VELOCITY_FRAME_UNKNOWN,
                velocity=_NAN3,
                angular_velocity=_NAN3,
                position_variance=[variance * increase for variance in variances],
                orientation_variance=_NAN3,
                velocity_variance=_NAN3,
                reset_counter=self._resets % 256,
            )
        )
