"""Odometry, IMU and transforms of the robot that carries a tag, for the locator."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.nodes.support import endpoints
from uwb_mitigation.nodes.support.lifecycle import ManagedNode
from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning
from uwb_mitigation.types.ros.poses import BodyTwist, yaw_of
from uwb_mitigation.types.ros.topics import TF_STATIC, relative
from uwb_mitigation.types.stamps import NS_PER_S, to_ns
from uwb_mitigation.types.tracks import Estimate

Vector = tuple[float, float, float]

HOLD_S = 30.0
"""The last map to odom is repeated for this time: odometry alone is useful for as long."""

LEVER_ARM_WAIT_S = 5.0
"""The lever arm is reported as unknown if it is not on /tf_static this time after the first range."""

_MAX_FRAMES = 1000

_BRIDGE_STEP_NS = NS_PER_S // 5
"""Spacing of the poses that are interpolated over a restart; shorter than the timeout of the odometry."""

_BRIDGE_SPEED = 0.5
"""If the odometry moved by this much faster than before and after a restart (m/s), it was reset meanwhile."""


@dataclass(slots=True)
class MotionState:
    """What a respawned locator continues with.

    Attributes:
        odom_frame: frame of the odometry; empty before its first message.
        base_frame: the parameter, or else the child frame of the odometry.
        lever_arm_is_set: it is a parameter, or was found.
        map_to_odom: x, y, z (m) and yaw (rad) of the last transform; None: there was none.
        map_to_odom_ns: stamp of its estimate.
        pose: x, y (m) and yaw (rad) of the latest odometry; None: there was none.
        pose_ns, speed: its stamp, and its speed in m/s.
    """

    odom_frame: str
    base_frame: str
    lever_arm_is_set: bool
    map_to_odom: tuple[float, float, float, float] | None = None
    map_to_odom_ns: int = 0
    pose: tuple[float, float, float] | None = None
    pose_ns: int = 0
    speed: float = 0.0


class OdometryInput:
    """Subscribes to the topics of the parameters `odometry` and `imu`, and to /tf_static.

    Args:
        node: the locator, while it is configured.
        path: integrates the messages.

    Raises:
        ParameterError: the frames of the robot and the map are equal.

    Attributes:
        path: as given, or that of `resume`.
        state: frames, and the latest pose and transform.
    """

    def __init__(self, node: ManagedNode, path: DeadReckoning) -> None:
        self.path = path
        self.state = MotionState("", node.value("base_frame"), bool(node.value("lever_arm")))
        self._map, self._log = node.value("map_frame"), node.get_logger()
        if self.state.base_frame == self._map:
            raise ParameterError(
                f"parameter base_frame = {self._map!r} is the frame of the map",
                valid="the robot's frame, such as base_link",
            )
        self._uses_orientation = node.value("imu_orientation")
        self._is_resuming = False
        self._antenna_frame: str | None = None
        self._static_topic = node.resolve_topic_name(relative(TF_STATIC))
        self._first_range_s = 0.0
        # {child frame: (parent frame, translation, quaternion)} of static transforms.
        self._static: dict[str, tuple[str, Vector, tuple[float, ...]]] = {}

        def subscribe(kind: type, topic: str, callback: Any) -> None:
            received = endpoints.create_subscription(
                node, kind, topic, callback, ReliabilityPolicy.BEST_EFFORT
            )
            node.destroy_at_close(received, node.destroy_subscription)

        subscribe(Odometry, node.value("odometry"), self._on_odometry)
        if node.value("imu"):
            subscribe(Imu, node.value("imu"), self._on_imu)
        message = transform_type()
        if not self.state.lever_arm_is_set and message is not None:
            qos = QoSProfile(
                depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
            )
            static = node.create_subscription(message, self._static_topic, self._on_static, qos)
            node.destroy_at_close(static, node.destroy_subscription)

    def lever_arm(self, frame: str) -> Vector | None:
        """Return the position of a range's frame in the frame of the base, from /tf_static; None: unknown."""
        if self._antenna_frame is None:
            self._first_range_s = time.monotonic()
        self._antenna_frame = frame
        point: Vector = (0.0, 0.0, 0.0)
        for _ in range(len(self._static) + 1):
            if frame and frame == self.state.base_frame:
                return point
            if frame not in self._static:
                return None
            frame, (x, y, z), rotation = self._static[frame]
            dx, dy, dz = _rotate(rotation, point)
            point = x + dx, y + dy, z + dz
        return None

    def warning(self) -> str:
        """Return a warning if the lever arm is unknown, although it should have been received."""
        waiting = self._antenna_frame is None or time.monotonic() - self._first_range_s < LEVER_ARM_WAIT_S
        if self.state.lever_arm_is_set or waiting or not self.state.base_frame:
            return ""
        base, antenna = self.state.base_frame, self._antenna_frame or "the antenna (ranges without frame_id)"
        return (
            f"lever arm of the antenna unknown, 0,0,0 is used: no transform from {base} to {antenna} on "
            f"{self._static_topic}: publish it with static_transform_publisher, or set lever_arm"
        )

    def twist(self, stamp_ns: int) -> BodyTwist:
        """Return the velocity of the base at a time; unobserved without odometry, or just after it started."""
        if self.path.point_at(stamp_ns) is None or self.path.twist is None:
            return BodyTwist()
        return BodyTwist(*self.path.twist, *self.path.twist_variance)

    def resume(self, state: MotionState, path: DeadReckoning) -> None:
        """Continue with the state and the path of a process that has crashed."""
        self.state, self.path, self._is_resuming = state, path, True

    def last_map_to_odom(self, stamp_ns: int, tolerance_ns: int) -> TransformStamped | None:
        """Return the last transform with a new stamp, for `HOLD_S`; None: later, or no heading was known yet."""
        last = self.state.map_to_odom
        if last is None or not 0 <= stamp_ns - self.state.map_to_odom_ns <= HOLD_S * NS_PER_S:
            return None
        x, y, z, yaw = last
        return TransformStamped(
            header=endpoints.header(stamp_ns + tolerance_ns, self._map),
            child_frame_id=self.state.odom_frame,
            transform=Transform(
                translation=Vector3(x=x, y=y, z=z),
                rotation=Quaternion(z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0)),
            ),
        )

    def map_to_odom(self, base: Estimate, tolerance_ns: int) -> TransformStamped | None:
        """Return the transform from map to odom for an estimate of the base, valid for `tolerance_ns` longer.

        While the heading is unknown again, it is `last_map_to_odom`.
        """
        pose = self.path.pose_at(base.stamp_ns)
        if pose is not None and base.heading is not None and self.state.odom_frame:
            odom_x, odom_y, odom_yaw = pose
            yaw = base.heading.yaw - odom_yaw
            cosine, sine = math.cos(yaw), math.sin(yaw)
            x, y, z = base.position.tolist()
            x, y = x - cosine * odom_x + sine * odom_y, y - sine * odom_x - cosine * odom_y
            self.state.map_to_odom, self.state.map_to_odom_ns = (x, y, z, yaw), base.stamp_ns
        return self.last_map_to_odom(base.stamp_ns, tolerance_ns)

    def _on_odometry(self, message: Odometry) -> None:
        state, frame = self.state, message.header.frame_id
        if not state.odom_frame and frame:
            if frame == self._map:
                self._log.error(
                    f"the odometry is in the frame {frame} of the anchors: it must be in odom",
                    throttle_duration_sec=10.0,
                )
                return
            state.odom_frame = frame
            state.base_frame = state.base_frame or message.child_frame_id
            self._log.info(f"odometry of {state.base_frame} in {frame}")
        position, twist, covariance = (
            message.pose.pose.position,
            message.twist.twist,
            message.twist.covariance,
        )
        stamp_ns = to_ns(message.header.stamp)
        pose = (position.x, position.y, yaw_of(message.pose.pose.orientation))
        velocity = (twist.linear.x, twist.linear.y, twist.angular.z)
        variance = (covariance[0], covariance[7], covariance[35])
        speed = math.hypot(twist.linear.x, twist.linear.y)
        if self._is_resuming:
            self._is_resuming = False
            self._bridge(stamp_ns, pose, velocity, variance, max(speed, state.speed))
        self.path.add(stamp_ns, pose, velocity, variance)
        state.pose, state.pose_ns, state.speed = pose, stamp_ns, speed

    def _bridge(self, stamp_ns: int, pose: Vector, velocity: Vector, variance: Vector, speed: float) -> None:
        """Interpolate the poses of the odometry over a restart of this process: they contain the motion meanwhile."""
        before, gap_ns = self.state.pose, stamp_ns - self.state.pose_ns
        if before is None or not 0 < gap_ns <= HOLD_S * NS_PER_S:
            return
        dx, dy, dyaw = (now - then for now, then in zip(pose, before, strict=True))
        # Also false for NaN.
        if not math.hypot(dx, dy) <= (speed + _BRIDGE_SPEED) * gap_ns / NS_PER_S:
            return
        dyaw = math.remainder(dyaw, math.tau)
        steps = math.ceil(gap_ns / _BRIDGE_STEP_NS)
        for weight in (step / steps for step in range(1, steps)):
            x, y, yaw = before[0] + weight * dx, before[1] + weight * dy, before[2] + weight * dyaw
            self.path.add(self.state.pose_ns + round(weight * gap_ns), (x, y, yaw), velocity, variance)

    def _on_imu(self, message: Imu) -> None:
        # A -1 in front of the covariance marks rates that are not measured.
        if message.angular_velocity_covariance[0] == -1.0:
            return
        rate, variance = message.angular_velocity.z, message.angular_velocity_covariance[8]
        # The same mark for orientations.
        uses_yaw = self._uses_orientation and message.orientation_covariance[0] != -1.0
        yaw = yaw_of(message.orientation) if uses_yaw else math.nan
        self.path.add_imu(to_ns(message.header.stamp), rate, variance, yaw)

    def _on_static(self, message: Any) -> None:
        for transform in message.transforms:
            t, r = transform.transform.translation, transform.transform.rotation
            norm = math.hypot(r.x, r.y, r.z, r.w)
            if (
                len(self._static) < _MAX_FRAMES
                and all(map(math.isfinite, (t.x, t.y, t.z)))
                and 0.9 < norm < 1.1  # false for NaN
            ):
                rotation = (r.x / norm, r.y / norm, r.z / norm, r.w / norm)
                parent = transform.header.frame_id
                self._static[transform.child_frame_id] = parent, (t.x, t.y, t.z), rotation


def _rotate(quaternion: tuple[float, ...], point: Vector) -> Vector:
    """Rotate a point; SciPy would double the time until the locator is active."""
    *axis, w = quaternion
    turned = np.cross(axis, point)
    x, y, z = (np.asarray(point) + 2.0 * (w * turned + np.cross(axis, turned))).tolist()
    return x, y, z


def transform_type() -> Any:
    """Return the type of messages on /tf; None: tf2_msgs is not installed."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return None
    return TFMessage
