"""Odometry, IMU and transforms of the robot that carries a tag, for the locator."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.nodes.support import endpoints
from uwb_mitigation.nodes.support.lifecycle import ManagedNode
from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning, PathPoint
from uwb_mitigation.positioning.online.odometry_filter import SCALE_SD
from uwb_mitigation.types.ros.poses import BodyTwist, yaw_of
from uwb_mitigation.types.ros.topics import TF_STATIC, relative
from uwb_mitigation.types.stamps import NS_PER_S, to_ns
from uwb_mitigation.types.tracks import Estimate, Heading

Vector = tuple[float, float, float]

HOLD_S = 30.0
"""The last map to odom is repeated for this time: odometry alone is useful for as long."""

LEVER_ARM_WAIT_S = 5.0
"""The lever arm is reported as unknown if it is not on /tf_static this time after the first range."""

_MAX_FRAMES = 1000

MAX_GAP_SPEED = 0.5
"""If the odometry moved by this much faster than before and after a crash (m/s), it was reset meanwhile."""

MAX_GAP_S, CURRENT_S = 2.0, 1.0
"""The pose before a gap of the odometry of at most `MAX_GAP_S` is moved on, if it was estimated in the last `CURRENT_S`. After a
crash, estimates wait for the first odometry for at most `MAX_GAP_S`."""

CONTRADICTION = 25.0
"""The pose that is moved on is dropped if ranges contradict it by 5 standard deviations."""

REPLACE_S, REPLACED_SHARE = 5.0, 0.99
"""The share of new estimates with a heading grows in this time, so that the transform does not step. From `REPLACED_SHARE` on, the
pose that is moved on is dropped."""


@dataclass(slots=True)
class MotionState:
    """The motion with which a respawned locator continues; its file has the same keys.

    Attributes:
        odom_frame: frame of the odometry; empty before its first message.
        base_frame: the parameter, or else the child frame of the odometry.
        map_to_odom: x, y, z (m) and yaw (rad) of the last transform; None: unknown.
        map_to_odom_ns: stamp of its estimate.
        variance: of the x, y and z of the base (m^2) and of its yaw (rad^2) in this estimate.
        pose: x, y (m) and yaw (rad) of the latest odometry; None: unknown.
        pose_ns, speed: its stamp, and its speed in m/s.
    """

    odom_frame: str
    base_frame: str
    map_to_odom: tuple[float, float, float, float] | None = None
    map_to_odom_ns: int = 0
    variance: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    pose: Vector | None = None
    pose_ns: int = 0
    speed: float = 0.0

    @classmethod
    def read(cls, saved: dict[str, Any]) -> MotionState:
        """Return a saved state; raise KeyError, TypeError or ValueError if it has no pose, or is invalid."""
        x, y, z, yaw, vx, vy, vz, of_yaw, *pose, speed = map(
            float, (*saved["map_to_odom"], *saved["variance"], *saved["pose"], saved["speed"])
        )
        if not all(map(math.isfinite, (x, y, z, yaw, *pose, speed))) or not 0.0 < min(vx, vy, of_yaw) < 1e6:
            raise ValueError("numbers that are not valid")
        stamps = int(saved["map_to_odom_ns"]), int(saved["pose_ns"])
        frames = str(saved["odom_frame"]), str(saved["base_frame"])
        odom_x, odom_y, odom_yaw = pose
        variance = vx, vy, vz, of_yaw
        return cls(*frames, (x, y, z, yaw), stamps[0], variance, (odom_x, odom_y, odom_yaw), stamps[1], speed)


class _Held(NamedTuple):
    """The transform before a crash, a gap of the odometry, or the loss of the heading.

    Attributes:
        map_to_odom, variance: see `MotionState`.
        begin, begin_ns: first point of the path since then.
        distance_m: distance driven in the gap.
    """

    map_to_odom: tuple[float, float, float, float]
    variance: tuple[float, float, float, float]
    begin: PathPoint
    begin_ns: int
    distance_m: float


class OdometryInput:
    """Subscribes to the topics of the parameters `odometry` and `imu`, and to /tf_static.

    Args:
        node: the locator, while it is configured.
        path: integrates the messages.

    Raises:
        ParameterError: the frames of the robot and the map are equal.

    Attributes:
        path: as given.
        state: frames, and the latest pose and transform.
        lever_arm_is_set: it is a parameter, or was found.
    """

    def __init__(self, node: ManagedNode, path: DeadReckoning) -> None:
        self.path = path
        self.state = MotionState("", node.value("base_frame"))
        self.lever_arm_is_set = bool(node.value("lever_arm"))
        self._map, self._log = node.value("map_frame"), node.get_logger()
        if self.state.base_frame == self._map:
            raise ParameterError(
                f"parameter base_frame = {self._map!r} is the frame of the map",
                valid="the robot's frame, such as base_link",
            )
        self._uses_orientation = node.value("imu_orientation")
        self._is_resuming, self._resumed_ns = False, 0
        self._held_pose: _Held | None = None
        self._replace_ns: int | None = None
        self._antenna_frame: str | None = None
        self._static_topic = node.resolve_topic_name(relative(TF_STATIC))
        self._first_range_s = 0.0
        # {child frame: (parent frame, translation, quaternion)} of static transforms.
        self._static: dict[str, tuple[str, Vector, tuple[float, ...]]] = {}

        node.subscription(Odometry, node.value("odometry"), self._on_odometry)
        if node.value("imu"):
            node.subscription(Imu, node.value("imu"), self._on_imu)
        message = transform_type()
        if not self.lever_arm_is_set and message is not None:
            qos = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            node.subscription(message, self._static_topic, self._on_static, qos)

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
        if self.lever_arm_is_set or waiting or not self.state.base_frame:
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

    def resume(self, state: MotionState) -> None:
        """Continue with the state of a process that has crashed."""
        self.state, self._is_resuming = state, True

    def is_resuming(self, stamp_ns: int) -> bool:
        """Return whether an estimate after a crash is older than the odometry, which may still arrive."""
        if not self._is_resuming:
            return (
                self._held_pose is not None and 0 < self._held_pose.begin_ns - stamp_ns < MAX_GAP_S * NS_PER_S
            )
        self._resumed_ns = self._resumed_ns or stamp_ns
        return 0 <= stamp_ns - self._resumed_ns < MAX_GAP_S * NS_PER_S

    def carried_on(self, stamp_ns: int) -> Estimate | None:
        """Return the pose before a crash or gap, moved on by the odometry; None: unknown, or replaced."""
        point, pose = self.path.point_at(stamp_ns), self.path.pose_at(stamp_ns)
        if self._held_pose is None or point is None or pose is None:
            return None
        (x, y, z, yaw), variance, begin, _, gap_m = self._held_pose
        if point.segment != begin.segment:
            return None
        cosine, sine = math.cos(yaw), math.sin(yaw)
        position = np.array([x + cosine * pose[0] - sine * pose[1], y + sine * pose[0] + cosine * pose[1], z])
        drift, turn = point.drift - begin.drift, point.turn - begin.turn
        distance = point.distance_m - begin.distance_m
        of_yaw = variance[3] + point.yaw_variance - begin.yaw_variance + drift**2 + turn**2
        moved = point.position_variance - begin.position_variance
        moved += (SCALE_SD**2 + of_yaw) * (gap_m + distance) ** 2
        covariance = np.diag([variance[0] + moved, variance[1] + moved, variance[2], 1.0, 1.0, 1.0])
        heading = Heading(yaw + pose[2], np.array([0.0, 0.0, 0.0, of_yaw]))
        return Estimate(stamp_ns, position, np.zeros(3), covariance, heading)

    def without_estimate(self, stamp_ns: int) -> Estimate | None:
        """Return the pose that is moved on while there is no position."""
        if self._held_pose is None:
            return None
        self._hold_latest(stamp_ns)
        return self.carried_on(stamp_ns)

    def mixed(self, base: Estimate, *, trusts_odometry: bool) -> Estimate:
        """Return an estimate of the base, mixed with `carried_on` by their variances: the transform does not step."""
        if not trusts_odometry:
            self._held_pose = None
        elif base.heading is None:
            self._hold_latest(base.stamp_ns)
        held_estimate, new = self.carried_on(base.stamp_ns), base.heading
        if held_estimate is None or held_estimate.heading is None:
            return base
        delta = base.position - held_estimate.position
        of_held, of_new = held_estimate.covariance, base.covariance
        error = float(delta[:2] @ np.linalg.solve((of_held + of_new)[:2, :2], delta[:2]))
        turn, of_turn = 0.0, math.inf
        if new is not None:
            turn = math.remainder(new.yaw - held_estimate.heading.yaw, math.tau)
            of_turn = float(new.covariance[3])
        of_yaw = float(held_estimate.heading.covariance[3])
        # The estimates may be right: the robot was moved, or the saved pose was wrong.
        if not max(error, turn**2 / (of_yaw + of_turn)) <= CONTRADICTION:
            self._held_pose = self.state.map_to_odom = None
            return base
        if new is None:
            return held_estimate
        self._replace_ns = base.stamp_ns if self._replace_ns is None else self._replace_ns
        limit = (base.stamp_ns - self._replace_ns) / (REPLACE_S * NS_PER_S)
        weight = min(float(np.trace(of_held[:2, :2]) / np.trace((of_held + of_new)[:2, :2])), limit)
        of_heading = min(of_yaw / (of_yaw + of_turn), limit)
        if min(weight, of_heading) > REPLACED_SHARE:
            self._held_pose = None
        # Their errors are correlated: the variance of the mixture is not smaller.
        covariance = of_new.copy()
        covariance[:3, :3] = weight * of_new[:3, :3] + (1.0 - weight) * of_held[:3, :3]
        yaw_covariance = of_heading * new.covariance + (1.0 - of_heading) * held_estimate.heading.covariance
        heading = Heading(held_estimate.heading.yaw + of_heading * turn, yaw_covariance)
        return replace(
            base, position=held_estimate.position + weight * delta, covariance=covariance, heading=heading
        )

    def last_map_to_odom(self, stamp_ns: int, tolerance_ns: int) -> TransformStamped | None:
        """Return the last transform with a new stamp, for `HOLD_S`; None: later, or no heading was known yet."""
        last = self.state.map_to_odom
        if last is None or not 0 <= stamp_ns - self.state.map_to_odom_ns <= HOLD_S * NS_PER_S:
            return None
        x, y, z, yaw = last
        valid_ns = stamp_ns + tolerance_ns
        return make_transform(valid_ns, self._map, self.state.odom_frame, (x, y, z), yaw)

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
            state, (of_x, of_y, of_z) = self.state, np.diag(base.covariance)[:3].tolist()
            state.map_to_odom, state.map_to_odom_ns = (x, y, z, yaw), base.stamp_ns
            state.variance = of_x, of_y, of_z, float(base.heading.covariance[3])
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
        position, twist = message.pose.pose.position, message.twist.twist
        covariance = message.twist.covariance
        stamp_ns = to_ns(message.header.stamp)
        pose = (position.x, position.y, yaw_of(message.pose.pose.orientation))
        velocity = (twist.linear.x, twist.linear.y, twist.angular.z)
        variance = (covariance[0], covariance[7], covariance[35])
        speed = math.hypot(twist.linear.x, twist.linear.y)
        before = self.path.point_at(state.pose_ns)
        self.path.add(stamp_ns, pose, velocity, variance)
        point = self.path.point_at(stamp_ns)
        if point is not None and (self._is_resuming or (before and before.segment != point.segment)):
            self._hold(stamp_ns, pose, max(speed, state.speed), point)
        state.pose, state.pose_ns, state.speed = pose, stamp_ns, speed

    def _hold_latest(self, stamp_ns: int) -> None:
        """Hold the latest transform if it was current until now: the filter starts again if odometry arrives late."""
        state, point = self.state, self.path.point_at(stamp_ns)
        is_current = 0 <= stamp_ns - state.map_to_odom_ns <= CURRENT_S * NS_PER_S
        is_newer = self._held_pose is None or self._replace_ns is not None
        if state.map_to_odom is not None and point is not None and is_current and is_newer:
            self._held_pose = _Held(state.map_to_odom, state.variance, point, stamp_ns, 0.0)
            self._replace_ns = None

    def _hold(self, stamp_ns: int, pose: Vector, speed: float, begin: PathPoint) -> None:
        """Hold the transform from before a crash or gap, unless it was old, or the odometry was reset meanwhile."""
        state, is_resuming = self.state, self._is_resuming
        self._is_resuming, self._held_pose, self._replace_ns = False, None, None
        before, last, gap_s = state.pose, state.map_to_odom, (stamp_ns - state.pose_ns) / NS_PER_S
        if before is None or last is None:
            return
        gap_m = math.hypot(pose[0] - before[0], pose[1] - before[1])
        # Also false for NaN.
        if not gap_m <= (speed + MAX_GAP_SPEED) * gap_s <= (speed + MAX_GAP_SPEED) * HOLD_S:
            state.map_to_odom = None
        elif (
            is_resuming or gap_s <= MAX_GAP_S
        ) and state.pose_ns - state.map_to_odom_ns <= CURRENT_S * NS_PER_S:
            self._held_pose = _Held(last, state.variance, begin, stamp_ns, gap_m)

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


def make_transform(stamp_ns: int, parent: str, child: str, xyz: Vector, yaw: float = 0.0) -> TransformStamped:
    """Return a transform: the position (m) and the yaw (rad) of the child frame in the parent frame."""
    x, y, z = xyz
    rotation = Quaternion(z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))
    pose = Transform(translation=Vector3(x=x, y=y, z=z), rotation=rotation)
    return TransformStamped(header=endpoints.header(stamp_ns, parent), child_frame_id=child, transform=pose)


def transform_type() -> Any:
    """Return the type of messages on /tf; None: tf2_msgs is not installed."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return None
    return TFMessage
