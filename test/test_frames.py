"""Lookups in tf: map -> odom of the locator together with odom -> base_link of a robot at 50 Hz."""

import bisect
import itertools
import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from drives import HALL
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from ros_harness import Ros, header_at
from sensor_msgs.msg import Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.recordings.bag.odometry import encode_imu_row, encode_odometry_row, encode_transform_row
from uwb_mitigation.simulation.odometry import RATE_HZ, simulate_motion
from uwb_mitigation.types.ros.poses import yaw_of
from uwb_mitigation.types.stamps import to_ns

pytestmark = pytest.mark.ros

ROUTE = ((2.0, 2.0), (10.0, 2.0), (10.0, 7.0), (6.0, 5.0), (2.0, 7.0))
HEIGHT_M, SPEED, SECONDS = 1.0, 1.0, 22.5


class Buffer:
    """Transforms in the plane with the rules of tf2 core: one parent per frame, interpolation, no extrapolation."""

    def __init__(self) -> None:
        self.parents: dict[str, str] = {}
        self.poses: dict[str, dict[int, tuple[float, float, float]]] = {}

    def add(self, transform: TransformStamped) -> None:
        child, parent = transform.child_frame_id, transform.header.frame_id
        assert self.parents.setdefault(child, parent) == parent, f"{child} has two parents"
        at = transform.transform.translation
        pose = at.x, at.y, yaw_of(transform.transform.rotation)
        self.poses.setdefault(child, {})[to_ns(transform.header.stamp)] = pose

    def lookup(self, target: str, source: str, stamp: int) -> np.ndarray | None:
        """Return x, y and yaw of the source frame in the target frame; None: the lookup fails."""
        pose = np.zeros(3)
        while source != target:
            stamps = sorted(self.poses.get(source, ()))
            if not stamps or not stamps[0] <= stamp <= stamps[-1]:
                return None
            row = bisect.bisect_left(stamps, stamp)
            stamps = stamps[max(row - 1, 0) : row + 1]
            x, y, yaw = np.array([self.poses[source][at] for at in stamps]).T
            passed = np.array(stamps) - stamp
            x, y, yaw = (np.interp(0.0, passed, values) for values in (x, y, np.unwrap(yaw)))
            cosine, sine = np.cos(yaw), np.sin(yaw)
            turned = cosine * pose[0] - sine * pose[1], sine * pose[0] + cosine * pose[1]
            pose = np.array([x + turned[0], y + turned[1], yaw + pose[2]])
            source = self.parents[source]
        return pose


@pytest.mark.slow
def test_no_lookup_fails_and_the_yaw_error_fits_its_variance(ros: Ros, anchors: Path):
    # Best-effort messages can be lost under load.
    reliable = [f"qos_overrides./{name}.subscription.reliability:=reliable" for name in ("odom", "imu")]
    parameters = ("odometry:=/odom", "imu:=/imu", "publish_tf:=true", "rate:=0.0", "level:=true", *reliable)
    locator = ros.start("locator", f"anchors:={anchors}", *parameters, f"height:={HEIGHT_M}")
    locator.wait_for_output("locating")
    motion = simulate_motion(ROUTE, SPEED, SECONDS, seed=3)
    # Old enough that the locator does not predict poses at the current time.
    stamps = motion.odometry.stamp_ns + ros.node.get_clock().now().nanoseconds - round((SECONDS + 40.0) * 1e9)
    rng, qos = np.random.default_rng(3), QoSProfile(depth=1000)
    ranges = ros.node.create_publisher(RangeCorrected, "/uwb/range_corrected", qos)
    robot = [
        (ros.node.create_publisher(kind, topic, qos), kind, encode, data)
        for kind, topic, encode, data in (
            (TFMessage, "/tf", encode_transform_row, motion.odometry),
            (Imu, "/imu", encode_imu_row, motion.imu),
            (Odometry, "/odom", encode_odometry_row, motion.odometry),
        )
    ]
    transforms, poses = ros.collect(TFMessage, "/tf"), ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    for topic in ("/uwb/range_corrected", "/odom", "/imu"):
        ros.wait_for_subscribers(topic, 1)
    ros.wait_until_active("locator")
    ros.spin_until(lambda: ros.node.count_publishers("/tf") == 2)

    buffer, numbers, found = Buffer(), itertools.count(), []

    def received(frame: str) -> int:
        """Return the latest stamp of a frame's transforms."""
        while transforms:
            for transform in transforms.pop(0).transforms:
                buffer.add(transform)
        return max(buffer.poses.get(frame, (0,)))

    for step in range(round(SECONDS * RATE_HZ) // 5):
        rows = range(5 * step, 5 * step + 5)
        at = [header_at(int(stamps[row])).stamp for row in rows]
        for row, (publisher, kind, encode, data) in itertools.product(rows, robot):
            message = deserialize_message(encode(data, row), kind)
            for stamped in getattr(message, "transforms", [message]):
                stamped.header.stamp = at[row - rows[0]]
            publisher.publish(message)
        # Wait for the robot's own transform only: that of the locator is valid for a second longer.
        ros.spin_until(lambda last=int(stamps[rows[-1]]): received("base_link") >= last)
        found += [buffer.lookup("map", "base_link", int(stamps[row])) for row in rows]
        for row in rows[:4]:
            number = next(numbers)
            anchor = number % len(HALL)
            distance = np.linalg.norm([*motion.position[row], HEIGHT_M] - HALL.position[anchor])
            header = Header(stamp=at[row - rows[0]], frame_id="uwb_antenna")
            message = RangeCorrected(header=header, tag_id=7, anchor_id=HALL.anchors[anchor].id)
            message.sequence, message.variance = number, 0.01
            message.range = message.range_raw = float(distance + rng.normal(0.0, 0.1))
            ranges.publish(message)
        # The first ranges determine no position.
        if step > 10:
            ros.spin_until(lambda last=at[3]: bool(poses) and poses[-1].header.stamp == last)

    known = [row for row, pose in enumerate(found) if pose is not None]
    assert buffer.parents == {"odom": "map", "base_link": "odom"}
    assert known, "no heading"
    # The first corner is at 8 s: on a straight drive, ranges do not exclude faults of odometry.
    assert known[0] < 15 * RATE_HZ
    assert known == list(range(known[0], len(found))), "failed lookups"
    rows = np.arange(round(16 * RATE_HZ), len(found))
    pose = np.array([found[row] for row in rows])
    assert np.sqrt(2 * np.mean((pose[:, :2] - motion.position[rows]) ** 2)) < 0.15
    yaw_error = np.angle(np.exp(1j * (pose[:, 2] - motion.yaw[rows])))
    variances = [one.pose.covariance[35] for one in poses[-len(poses) // 4 :]]
    assert max(variances) < math.radians(15.0) ** 2
    assert np.mean(yaw_error**2) < 2.0 * np.mean(variances)
