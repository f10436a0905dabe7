"""Encode and decode estimates as standard messages: poses and odometry, in the frame of the anchors.

The orientation is unobservable: it is the identity with a large variance. `pose_paths` reads poses from bags.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace as Fields
from typing import Any

import numpy as np

from uwb_mitigation.errors import format_id
from uwb_mitigation.types.ros.schemas import deserialize, serialize
from uwb_mitigation.types.ros.topics import ODOMETRY_TYPE, POSE_TYPE
from uwb_mitigation.types.stamps import NS_PER_S, to_ns
from uwb_mitigation.types.tracks import Estimate, Heading

MAP = "map"
"""The anchors' frame (REP-105)."""

UWB_TAG = "uwb_tag"
"""The frame of the only tag: at its antenna, with the axes of `MAP`."""

UNOBSERVED = 1e6
"""Variance of unobservable values, rad^2 and rad^2/s^2."""

POSITION_TYPES = (ODOMETRY_TYPE, "geometry_msgs/msg/PoseStamped", POSE_TYPE)
"""Message types with a position."""

_TAG_FRAME = "tag_"


def tag_frame(tag_id: int) -> str:
    """Return the frame of a tag's antenna."""
    return f"{_TAG_FRAME}{format_id(tag_id)}"


def tag_of_frame(frame: str) -> int | None:
    """Return the tag id in a frame name of `tag_frame`, in any namespace; None for another frame."""
    name = frame.rpartition("/")[2]
    try:
        return int(name.removeprefix(_TAG_FRAME), 0) if name.startswith(_TAG_FRAME) else None
    except ValueError:
        return None


def tag_topic(topic: str, tag_id: int | None) -> str:
    """Return the topic of one tag: the plain topic for the only tag (None), otherwise such as `/uwb/tag_7/pose`."""
    if tag_id is None:
        return topic
    head, _, tail = topic.rpartition("/")
    return f"{head}/{tag_frame(tag_id)}/{tail}"


def encode_pose(estimate: Estimate, frame_id: str = MAP) -> bytes:
    """Return `geometry_msgs/PoseWithCovarianceStamped` in CDR."""
    return serialize(POSE_TYPE, header=header_fields(estimate.stamp_ns, frame_id), pose=_pose(estimate))


@dataclass(frozen=True, slots=True)
class BodyTwist:
    """Velocity in the axes of the child frame.

    Attributes:
        vx, vy, yaw_rate: m/s and rad/s.
        speed_variance, yaw_rate_variance: of vx and vy, and of the yaw rate.
    """

    vx: float = 0.0
    vy: float = 0.0
    yaw_rate: float = 0.0
    speed_variance: float = UNOBSERVED
    yaw_rate_variance: float = UNOBSERVED


def encode_odometry(
    estimate: Estimate, frame_id: str = MAP, child_frame_id: str = UWB_TAG, twist: BodyTwist | None = None
) -> bytes:
    """Return `nav_msgs/Odometry` in CDR.

    Args:
        estimate: the pose.
        frame_id: of the pose.
        child_frame_id: of the tag or the robot.
        twist: in the axes of the child frame; None: the child frame has the axes of `frame_id`, and the velocity of the
            estimate is used.
    """
    covariance = np.zeros((6, 6))
    if twist is None:
        velocity = Fields(linear=vector(*estimate.velocity), angular=vector())
        covariance[:3, :3] = estimate.covariance[3:, 3:]
        covariance[[3, 4, 5], [3, 4, 5]] = UNOBSERVED
    else:
        velocity = Fields(linear=vector(twist.vx, twist.vy), angular=vector(z=twist.yaw_rate))
        variances = (twist.speed_variance, twist.speed_variance, *[UNOBSERVED] * 3, twist.yaw_rate_variance)
        np.fill_diagonal(covariance, variances)
    motion = Fields(twist=velocity, covariance=covariance.ravel())
    return odometry_cdr(estimate.stamp_ns, (frame_id, child_frame_id), _pose(estimate), motion)


def odometry_cdr(stamp_ns: int, frames: tuple[str, str], pose: Fields, twist: Fields) -> bytes:
    """Return `nav_msgs/Odometry` in CDR from its fields; `frames`: of the pose, and of the tag or the robot."""
    header = header_fields(stamp_ns, frames[0])
    return serialize(ODOMETRY_TYPE, header=header, child_frame_id=frames[1], pose=pose, twist=twist)


def encode_true_position(
    position: tuple[float, float, float], tag_id: int, stamp_ns: int, yaw: float | None = None
) -> bytes:
    """Return `nav_msgs/Odometry` in CDR with the true position of a tag: no velocity, zero variance.

    Args:
        position: x, y, z, m.
        tag_id: id of the tag.
        stamp_ns: time of the position.
        yaw: true heading, rad; None: unknown, the variance is `UNOBSERVED`.
    """
    heading = None if yaw is None else Heading(yaw, np.zeros(4))
    pose = Estimate(stamp_ns, np.array(position), np.zeros(3), np.zeros((6, 6)), heading)
    return encode_odometry(pose, child_frame_id=tag_frame(tag_id))


def prepare_encoders() -> None:
    """Load the message definitions and compile their encoders, so that the first message does not wait 0.3 s for it."""
    encode_true_position((0.0, 0.0, 0.0), 0, 0)
    encode_pose(Estimate(0, np.zeros(3), np.zeros(3), np.zeros((6, 6))))


def decode_true_position(data: bytes) -> tuple[int, int, tuple[float, float, float], float | None] | None:
    """Decode stamp, tag, position and yaw (None: unknown) from the CDR of an Odometry of `encode_true_position`.

    Returns:
        None for another frame.

    Raises:
        RecordingError: the bytes are not an Odometry.
    """
    odometry = deserialize(ODOMETRY_TYPE, data)
    position, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
    xyz, tag_id = (position.x, position.y, position.z), tag_of_frame(odometry.child_frame_id)
    if tag_id is None or not all(map(math.isfinite, xyz)):
        return None
    has_yaw = odometry.pose.covariance[-1] < UNOBSERVED and math.isfinite(turn.z + turn.w)
    return to_ns(odometry.header.stamp), tag_id, xyz, 2.0 * math.atan2(turn.z, turn.w) if has_yaw else None


def header_fields(stamp_ns: int, frame_id: str) -> Fields:
    """Return the fields of `std_msgs/Header`."""
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    return Fields(stamp=Fields(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Fields:
    """Return the fields of a `geometry_msgs` Vector3 or Point."""
    return Fields(x=x, y=y, z=z)


def yaw_of(orientation: Any) -> float:
    """Return the yaw (rad) of a quaternion with the fields x, y, z, w; NaN: it is not a rotation."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    norm = x * x + y * y + z * z + w * w
    # An orientation that nobody set is zero.
    if not 0.25 < norm < 4.0:
        return math.nan
    return math.atan2(2.0 * (w * z + x * y) / norm, 1.0 - 2.0 * (y * y + z * z) / norm)


def quaternion(yaw: float) -> Fields:
    """Return the fields of `geometry_msgs/Quaternion` for a rotation about z, rad."""
    return Fields(x=0.0, y=0.0, z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))


def _pose(estimate: Estimate) -> Fields:
    """Return the fields of `geometry_msgs/PoseWithCovariance`."""
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = estimate.covariance[:3, :3]
    covariance[[3, 4, 5], [3, 4, 5]] = UNOBSERVED
    if estimate.heading is not None:
        rows = [0, 1, 2, 5]
        covariance[5, rows] = covariance[rows, 5] = estimate.heading.covariance
    orientation = quaternion(estimate.heading.yaw if estimate.heading else 0.0)
    pose = Fields(position=vector(*estimate.position), orientation=orientation)
    return Fields(pose=pose, covariance=covariance.ravel())
