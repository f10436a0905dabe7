"""Odometry, IMU data and transforms of a robot as standard messages: encode, and read from bags."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace as Fields

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag.pose_paths import read_topic, sorted_rows
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.ros.poses import UNOBSERVED, header_fields, odometry_cdr, quaternion, vector, yaw_of
from uwb_mitigation.types.ros.schemas import serialize
from uwb_mitigation.types.ros.topics import IMU_TYPE, ODOMETRY_TYPE, ROBOT_IMU, ROBOT_ODOMETRY, TF, TF_TYPE
from uwb_mitigation.types.stamps import to_ns
from uwb_mitigation.types.tracks import Imu, Odometry

ODOM, BASE_LINK = "odom", "base_link"
"""The odometry frame and the robot's frame (REP-105)."""

_PLANE = np.ix_([0, 1, 5], [0, 1, 5])
"""Rows and columns of x, y and yaw in a 6x6 covariance."""


def encode_odometry_row(odometry: Odometry, row: int) -> bytes:
    """Return one row as `nav_msgs/Odometry` in CDR."""
    x, y, yaw = odometry.pose[row].tolist()
    vx, vy, yaw_rate = odometry.twist[row].tolist()
    pose = Fields(position=vector(x, y), orientation=quaternion(yaw))
    twist = Fields(linear=vector(vx, vy), angular=vector(z=yaw_rate))
    pose = Fields(pose=pose, covariance=_six(odometry.pose_covariance[row]))
    twist = Fields(twist=twist, covariance=_six(odometry.twist_covariance[row]))
    return odometry_cdr(int(odometry.stamp_ns[row]), (ODOM, BASE_LINK), pose, twist)


def encode_imu_row(imu: Imu, row: int) -> bytes:
    """Return one row as `sensor_msgs/Imu` in CDR; the acceleration, and an unknown yaw, are marked as not measured."""
    yaw = float(imu.yaw[row])
    orientation, turning, acceleration = np.zeros(9), np.zeros(9), np.zeros(9)
    orientation[0] = acceleration[0] = -1.0
    if math.isfinite(yaw):
        orientation[[0, 4, 8]] = UNOBSERVED, UNOBSERVED, imu.yaw_variance[row]
    turning[[0, 4, 8]] = UNOBSERVED, UNOBSERVED, imu.yaw_rate_variance[row]
    return serialize(
        IMU_TYPE,
        header=header_fields(int(imu.stamp_ns[row]), BASE_LINK),
        orientation=quaternion(yaw if math.isfinite(yaw) else 0.0),
        orientation_covariance=orientation,
        angular_velocity=vector(z=float(imu.yaw_rate[row])),
        angular_velocity_covariance=turning,
        linear_acceleration=vector(),
        linear_acceleration_covariance=acceleration,
    )


def encode_transform_row(odometry: Odometry, row: int) -> bytes:
    """Return the pose of one row as `tf2_msgs/TFMessage` in CDR."""
    x, y, yaw = odometry.pose[row].tolist()
    transform = Fields(
        header=header_fields(int(odometry.stamp_ns[row]), ODOM),
        child_frame_id=BASE_LINK,
        transform=Fields(translation=vector(x, y), rotation=quaternion(yaw)),
    )
    return serialize(TF_TYPE, transforms=[transform])


def write_robot(bag: BagWriter, odometry: Odometry, imu: Imu | None, row: int, until_ns: int) -> int:
    """Write odometry, IMU data (with the same stamps, if known) and the transform from odom to base_link, from a row up to a time.

    Returns:
        The first row that was not written.

    Raises:
        RecordingError: The bag cannot be written.
    """
    while row < len(odometry) and (stamp_ns := int(odometry.stamp_ns[row])) <= until_ns:
        bag.write_message(ROBOT_ODOMETRY, ODOMETRY_TYPE, encode_odometry_row(odometry, row), stamp_ns)
        if imu is not None:
            bag.write_message(ROBOT_IMU, IMU_TYPE, encode_imu_row(imu, row), stamp_ns)
        bag.write_message(TF, TF_TYPE, encode_transform_row(odometry, row), stamp_ns)
        row += 1
    return row


def read_odometry(path: Path, topic: str) -> Odometry:
    """Read a topic of `nav_msgs/Odometry`; messages with values that are not finite, except for the pose, are skipped.

    Raises:
        RecordingError: The bag cannot be read, has no such topic of this type, or it contains no valid message.
    """
    rows: dict[int, NDArray[np.float64]] = {}
    for decoded in read_topic(path, topic, (ODOMETRY_TYPE,)):
        pose, twist = decoded.pose.pose, decoded.twist.twist
        values = [pose.position.x, pose.position.y, yaw_of(pose.orientation)]
        values += [twist.linear.x, twist.linear.y, twist.angular.z]
        six_by_six = np.reshape([decoded.pose.covariance, decoded.twist.covariance], (2, 6, 6))
        covariances = [covariance[_PLANE].ravel() for covariance in six_by_six]
        rows[to_ns(decoded.header.stamp)] = np.concatenate([values, *covariances])
    # Some robots publish twists only: their orientation is zero, and the yaw NaN.
    stamp_ns, columns = _columns(rows, path, topic, slice(3, None))
    pose, twist, of_pose, of_twist = np.split(columns, [3, 6, 15], axis=1)
    return Odometry(stamp_ns, pose, of_pose.reshape(-1, 3, 3), twist, of_twist.reshape(-1, 3, 3))


def read_imu(path: Path, topic: str) -> Imu:
    """Read a topic of `sensor_msgs/Imu`; messages without a finite yaw rate are skipped.

    Raises:
        RecordingError: The bag cannot be read, has no such topic of this type, or it contains no valid message.
    """
    rows: dict[int, NDArray[np.float64]] = {}
    for decoded in read_topic(path, topic, (IMU_TYPE,)):
        # The message marks values that are not measured with a -1 in front of their covariance.
        turning, orientation = decoded.angular_velocity_covariance, decoded.orientation_covariance
        if turning[0] == -1.0:
            continue
        yaw = math.nan if orientation[0] == -1.0 else yaw_of(decoded.orientation)
        has_yaw = math.isfinite(yaw)
        row = (decoded.angular_velocity.z, turning[8], yaw if has_yaw else 0.0, orientation[8], has_yaw)
        rows[to_ns(decoded.header.stamp)] = np.array(row, np.float64)
    stamp_ns, values = _columns(rows, path, topic)
    yaw_rate, yaw_rate_variance, yaw, yaw_variance, known_yaw = values.T
    return Imu(stamp_ns, yaw_rate, yaw_rate_variance, np.where(known_yaw, yaw, np.nan), yaw_variance)


def _columns(
    rows: dict[int, NDArray[np.float64]], path: Path, topic: str, checked: slice = slice(None)
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps and values of the rows whose `checked` values are finite, in the order of time."""
    finite = {stamp: row for stamp, row in rows.items() if np.isfinite(row[checked]).all()}
    if not finite:
        raise RecordingError(
            "no valid message", where=f"{path}, topic {topic}", valid="finite values and covariances"
        )
    return sorted_rows(finite)


def _six(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a 6x6 covariance, flat, from that of x, y and yaw."""
    covariance = np.diag(np.full(6, UNOBSERVED))
    covariance[_PLANE] = plane
    return covariance.ravel()
