"""Encode and decode estimates as standard messages in CDR: poses and odometry, in the frame of the anchors.

The orientation is unobservable: it is the identity with a large variance. `pose_paths` reads poses from bags.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from uwb_mitigation.errors import RecordingError, format_id
from uwb_mitigation.types.ros.codec import LITTLE_ENDIAN
from uwb_mitigation.types.ros.topics import ODOMETRY_TYPE
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Estimate, Heading

MAP = "map"
"""The anchors' frame (REP-105)."""

UWB_TAG = "uwb_tag"
"""The frame of the only tag: at its antenna, with the axes of `MAP`."""

UNOBSERVED = 1e6
"""Variance of unobservable values, rad^2 and rad^2/s^2."""

POSITION_TYPES = (
    ODOMETRY_TYPE,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
"""Message types with a position."""

_PREFIX = struct.Struct("<4siII")
_LENGTH = struct.Struct("<I")
_POSE = struct.Struct("<43d")
_TWIST = struct.Struct("<42d")
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
    data = _header(estimate.stamp_ns, frame_id)
    data += bytes((4 - len(data)) % 8)
    return data + _pose(estimate)


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
    estimate: Estimate,
    frame_id: str = MAP,
    child_frame_id: str = UWB_TAG,
    twist: BodyTwist | None = None,
) -> bytes:
    """Return `nav_msgs/Odometry` in CDR.

    Args:
        estimate: the pose.
        frame_id: of the pose.
        child_frame_id: of the tag or the robot.
        twist: in the axes of the child frame; None: the child frame has the axes of `frame_id`, and the velocity of the
            estimate is used.
    """
    data = _header(estimate.stamp_ns, frame_id)
    child = child_frame_id.encode() + b"\0"
    data += bytes(-len(data) % 4) + _LENGTH.pack(len(child)) + child
    data += bytes((4 - len(data)) % 8)
    covariance = np.zeros((6, 6))
    if twist is None:
        velocity = (*estimate.velocity, 0.0, 0.0, 0.0)
        covariance[:3, :3] = estimate.covariance[3:, 3:]
        covariance[[3, 4, 5], [3, 4, 5]] = UNOBSERVED
    else:
        velocity = (twist.vx, twist.vy, 0.0, 0.0, 0.0, twist.yaw_rate)
        variances = (twist.speed_variance, twist.speed_variance, *[UNOBSERVED] * 3, twist.yaw_rate_variance)
        np.fill_diagonal(covariance, variances)
    return data + _pose(estimate) + _TWIST.pack(*velocity, *covariance.reshape(-1))


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


def decode_true_position(data: bytes) -> tuple[int, int, tuple[float, float, float], float | None] | None:
    """Decode stamp, tag, position and yaw (None: unknown) from the CDR of an Odometry of `encode_true_position`.

    Returns:
        None for another frame.

    Raises:
        RecordingError: the bytes are not an Odometry.
    """
    try:
        encapsulation, seconds, nanoseconds, length = _PREFIX.unpack_from(data)
        at = _PREFIX.size + length
        at += -at % 4
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        child = bytes(data[at : at + length])
        at += length
        at += (4 - at) % 8
        x, y, z, _, _, sine, cosine, *covariance = _POSE.unpack_from(data, at)
    except struct.error as error:
        raise RecordingError("an odometry message that is cut short") from error
    if encapsulation[:2] != LITTLE_ENDIAN:
        raise RecordingError("an odometry message in another encoding")
    tag_id = tag_of_frame(child.rstrip(b"\0").decode(errors="replace"))
    if tag_id is None or not all(map(math.isfinite, (x, y, z))):
        return None
    known = covariance[-1] < UNOBSERVED and math.isfinite(sine + cosine)
    yaw = 2.0 * math.atan2(sine, cosine) if known else None
    return seconds * NS_PER_S + nanoseconds, tag_id, (x, y, z), yaw


def _header(stamp_ns: int, frame_id: str) -> bytes:
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    frame = frame_id.encode() + b"\0"
    return _PREFIX.pack(LITTLE_ENDIAN + b"\0\0", seconds, nanoseconds, len(frame)) + frame


def _pose(estimate: Estimate) -> bytes:
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = estimate.covariance[:3, :3]
    covariance[[3, 4, 5], [3, 4, 5]] = UNOBSERVED
    sine, cosine = 0.0, 1.0
    if (heading := estimate.heading) is not None:
        sine, cosine = math.sin(heading.yaw / 2.0), math.cos(heading.yaw / 2.0)
        rows = [0, 1, 2, 5]
        covariance[5, rows] = covariance[rows, 5] = heading.covariance
    return _POSE.pack(*estimate.position, 0.0, 0.0, sine, cosine, *covariance.reshape(-1))
