"""Poses of a robot's localisation in bags of other recorders."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag.pose_paths import read_bodies, read_heights, read_lever_arm
from uwb_mitigation.types.ros.poses import encode_pose
from uwb_mitigation.types.ros.topics import POSE_TYPE
from uwb_mitigation.types.tracks import Estimate, Heading, PosePath

STORE = get_typestore(Stores.ROS2_JAZZY)
SECONDS = 10


def of(name: str, *values: Any) -> Any:
    return STORE.types[name](*values)


def header(second: int, frame: str = "map") -> Any:
    return of("std_msgs/msg/Header", of("builtin_interfaces/msg/Time", second, 0), frame)


def pose(second: int) -> Any:
    """Return poses that move along x at 1 m/s."""
    return of("geometry_msgs/msg/Pose", of("geometry_msgs/msg/Point", float(second), 2.0, 0.5), identity())


def identity() -> Any:
    return of("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)


def step(second: int, parent: str, child: str, x: float) -> Any:
    moved = of("geometry_msgs/msg/Transform", of("geometry_msgs/msg/Vector3", x, 1.0, 0.25), identity())
    return of("geometry_msgs/msg/TransformStamped", header(second, parent), child, moved)


def posed(second: int) -> Any:
    return of("geometry_msgs/msg/PoseStamped", header(second), pose(second))


def posed_with_covariance(second: int) -> Any:
    sure = of("geometry_msgs/msg/PoseWithCovariance", pose(second), np.zeros(36))
    return of("geometry_msgs/msg/PoseWithCovarianceStamped", header(second), sure)


def transformed(second: int) -> Any:
    """With an intermediate frame, and with other frames."""
    links = [step(second, "base_link", f"link_{n}", 0.0) for n in range(70)]
    chain = [step(second, "map", "odom", float(second)), step(second, "odom", "base_link", 0.0)]
    return of("tf2_msgs/msg/TFMessage", [*chain, *links])


def write(folder: Path, topic: str, make: Callable[[int], Any]) -> Path:
    kind = make(0).__msgtype__
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(topic, kind, typestore=STORE)
        for second in range(SECONDS):
            writer.write(connection, second * 10**9, STORE.serialize_cdr(make(second), kind))
    return folder / "bag"


@pytest.mark.parametrize(
    ("topic", "make", "frames"),
    [
        ("/pose", posed, None),
        ("/amcl_pose", posed_with_covariance, None),
        ("/tf", transformed, ("map", "base_link")),
    ],
)
def test_poses_are_read_from_every_supported_type(tmp_path, topic, make, frames):
    (path,) = read_bodies(write(tmp_path, topic, make), topic, frames).values()
    assert path.stamp_ns.tolist() == [second * 10**9 for second in range(SECONDS)]
    assert np.allclose(path.position, [[second, 2.0, 0.5] for second in range(SECONDS)])
    assert np.allclose(np.abs(path.orientation), [0.0, 0.0, 0.0, 1.0])


def test_published_covariance_contains_that_of_position_and_yaw():
    estimate = Estimate(0, np.ones(3), np.zeros(3), np.eye(6), Heading(0.5, np.array([0.1, 0.2, 0.3, 0.4])))
    rows = STORE.deserialize_cdr(encode_pose(estimate), POSE_TYPE).pose.covariance.reshape(6, 6)
    assert rows[5].tolist() == rows[:, 5].tolist() == [0.1, 0.2, 0.3, 0.0, 0.0, 0.4]


def odometry(second: int, child: str = "base_link") -> Any:
    covariance = np.diag([1.0, 1, 0.04, 1, 1, 1]).reshape(-1)
    sure = of("geometry_msgs/msg/PoseWithCovariance", pose(second), covariance)
    zero = of("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    twist = of("geometry_msgs/msg/Twist", zero, zero)
    moving = of("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
    return of("nav_msgs/msg/Odometry", header(second), child, sure, moving)


def test_each_child_frame_is_a_body_of_its_own(tmp_path):
    bag = write(tmp_path, "/odom", lambda second: odometry(second, f"tag_{7 + second % 2}"))
    bodies = read_bodies(bag, "/odom")
    assert {frame: path.position[:, 0].tolist() for frame, path in bodies.items()} == {
        "tag_7": [0.0, 2.0, 4.0, 6.0, 8.0],
        "tag_8": [1.0, 3.0, 5.0, 7.0, 9.0],
    }
    assert list(read_bodies(bag, "/odom", ("map", "tag_8"))) == ["tag_8"]
    with pytest.raises(RecordingError, match="base_link"):
        read_bodies(bag, "/odom", ("map", "base_link"))


def test_lever_arm_is_the_transform_from_robot_to_antenna(tmp_path):
    bag = write(tmp_path, "/tf", transformed)
    assert read_lever_arm(bag, "base_link", "link_3") == (0.0, 1.0, 0.25)
    assert read_lever_arm(bag, "base_link", "uwb") is None
    assert read_lever_arm(bag, "base_link", "base_link") is None
    with pytest.raises(RecordingError, match="moves relative to"):
        read_lever_arm(bag, "map", "base_link")


def test_missing_frames_are_reported(tmp_path):
    bag = write(tmp_path, "/tf", transformed)
    with pytest.raises(RecordingError, match="--frames"):
        read_bodies(bag, "/tf", None)
    with pytest.raises(RecordingError, match="lidar"):
        read_bodies(bag, "/tf", ("map", "lidar"))
    with pytest.raises(RecordingError, match="no topic /tg") as caught:
        read_bodies(bag, "/tg", None)
    assert caught.value.suggestion == "did you mean '/tf'?"


def test_poses_are_interpolated_between_neighbours_of_unequal_distance_and_held_outside():
    turned = np.array([[0, 0, 0, 1], [0, 0, 0, -1], [0, 0, 0.6, 0.8]], float)
    path = PosePath(np.array([0, 10, 14]), np.array([[0.0, 0, 0], [10, 0, 0], [10, 4, 0]]), turned)
    position, rotation = path.interpolated(np.array([-5, 5, 10, 11, 99]))
    assert position.tolist() == [[0, 0, 0], [5, 0, 0], [10, 0, 0], [10, 1, 0], [10, 4, 0]]
    assert rotation.as_rotvec()[1] == pytest.approx(0.0)
    assert 0.0 < rotation.as_rotvec()[3, 2] < rotation.as_rotvec()[4, 2] == pytest.approx(2 * np.arcsin(0.6))


def measured_range(second: int) -> Any:
    """Return heights that grow by 0.1 m/s; in second 3 the sensor exceeds its maximum."""
    value = 9.0 if second == 3 else 0.5 + 0.1 * second
    return of("sensor_msgs/msg/Range", header(second), 1, 0.1, 0.0, 4.0, value, 0.0004)


@pytest.mark.parametrize(
    ("make", "seconds", "height_m", "variance_m2"),
    [
        (measured_range, 9, 1.4, 0.0004),
        (odometry, 10, 0.5, 0.04),
        (posed_with_covariance, 10, 0.5, 0.01),  # no variance in the message
    ],
)
def test_heights_are_read_from_each_type(tmp_path, make, seconds, height_m, variance_m2):
    heights = read_heights(write(tmp_path, "/height", make), "/height")
    assert len(heights) == seconds
    assert heights.height_m[-1] == pytest.approx(height_m)
    assert heights.variance_m2[-1] == pytest.approx(variance_m2)
    value, _ = heights.height_at(np.array([500_000_000, 3_000_000_000, 60_000_000_000]))
    assert np.isfinite(value).tolist() == [True, make is not measured_range, False]


def test_topic_without_heights_is_refused(tmp_path):
    bag = write(tmp_path, "/pose", posed)
    with pytest.raises(RecordingError, match="no topic /height"):
        read_heights(bag, "/height")
    with pytest.raises(RecordingError, match="PoseStamped"):
        read_heights(bag, "/pose")
