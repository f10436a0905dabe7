"""The node `px4`, with a stand-in for px4_msgs that is built like the message package of this project."""

from __future__ import annotations

import itertools
import json
import math
import signal
import sys
from importlib.util import find_spec

import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseWithCovariance, PoseWithCovarianceStamped
from message_package import build
from ros_harness import Ros
from std_msgs.msg import Header

pytestmark = pytest.mark.ros

MESSAGE = """
uint64 timestamp
uint64 timestamp_sample
uint8 POSE_FRAME_UNKNOWN = 0
uint8 POSE_FRAME_NED = 1
uint8 POSE_FRAME_FRD = 2
uint8 pose_frame
float32[3] position
float32[4] q
uint8 VELOCITY_FRAME_UNKNOWN = 0
uint8 velocity_frame
float32[3] velocity
float32[3] angular_velocity
float32[3] position_variance
float32[3] orientation_variance
float32[3] velocity_variance
uint8 reset_counter
int8 quality
"""
"""Fields of VehicleOdometry in px4_msgs, release/1.15."""

RECEIVER = """
import json, rclpy
from px4_msgs.msg import VehicleOdometry
rclpy.init()
node = rclpy.create_node("receiver")
def show(message):
    names = message.get_fields_and_field_types()
    values = {name: getattr(message, name) for name in names}
    print(json.dumps({name: v if isinstance(v, int) else [float(x) for x in v] for name, v in values.items()}))
node.create_subscription(VehicleOdometry, "/fmu/in/vehicle_visual_odometry", show, 10)
rclpy.spin(node)
"""


@pytest.fixture(scope="module")
def px4_msgs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the environment with a message package that has the name and the fields of px4_msgs."""
    return build("px4_msgs", {"VehicleOdometry": MESSAGE}, tmp_path_factory.mktemp("px4"))


def pose(seconds: float, x: float, variance: float = 0.04) -> PoseWithCovarianceStamped:
    covariance = [0.0] * 36
    covariance[0], covariance[7], covariance[14], covariance[35] = variance, 0.09, 0.25, 1e6
    pose_enu = Pose(position=Point(x=x, y=2.0, z=0.5))
    stamp = Time(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
    return PoseWithCovarianceStamped(
        header=Header(frame_id="map", stamp=stamp),
        pose=PoseWithCovariance(pose=pose_enu, covariance=covariance),
    )


@pytest.mark.slow
def test_positions_are_sent_in_ned_without_orientation_and_velocity(
    ros: Ros, px4_msgs: dict[str, str], monkeypatch: pytest.MonkeyPatch
):
    for name, value in px4_msgs.items():
        monkeypatch.setenv(name, value)
    node, receiver = ros.start("px4"), ros.run([sys.executable, "-c", RECEIVER])
    publisher = ros.node.create_publisher(PoseWithCovarianceStamped, "/uwb/pose", 10)
    ros.wait_for_subscribers("/uwb/pose", 1)
    ros.wait_for_subscribers("/fmu/in/vehicle_visual_odometry", 1)
    stamps = itertools.count(100, 10)

    def arrived(stamp: float) -> bool:
        return f'"timestamp_sample": {stamp * 1e6:.0f}' in receiver.output

    def next_arrived() -> bool:
        # Positions before the two have found each other are lost.
        publisher.publish(pose(stamp := next(stamps), 1.0))
        ros.spin_for(0.2)
        return arrived(stamp)

    ros.spin_until(next_arrived)
    start = next(stamps) - 10.0
    # Repeated and negative stamps, positions that are not finite, and variances that are not positive are not sent.
    for seconds, x, variance in (
        (0.05, 1.1, 0.04),
        (0.05, 9.9, 0.04),
        *((0.1, x, 0.04) for x in (math.nan, 1e39)),
        *((0.1, 1.2, variance) for variance in (0.0, -0.01, math.nan, math.inf)),
        (-2.0 * start, 1.2, 0.04),
        (3.0, 5.0, 0.04),
        (-9.0, 4.0, 0.04),
    ):
        publisher.publish(pose(start + seconds, x, variance))
    ros.spin_until(lambda: arrived(start - 9.0))
    lines = [line for line in receiver.output.splitlines() if line.startswith("{")]
    first, second, third, again = map(json.loads, lines[-4:])
    assert first["timestamp_sample"] == start * 1e6
    assert first["timestamp"] > 1_700_000_000_000_000
    assert (first["pose_frame"], first["position"]) == (1, [2.0, 1.0, -0.5])
    assert first["position_variance"] == pytest.approx([0.09, 0.04, 0.25])
    for name in ("q", "velocity", "angular_velocity", "orientation_variance", "velocity_variance"):
        assert all(map(math.isnan, first[name])), name
    # Twenty correlated positions a second: each has twenty times the variance.
    assert second["position_variance"] == pytest.approx([1.8, 0.8, 5.0])
    assert third["position"] == [2.0, 5.0, -0.5]
    assert third["position_variance"] == pytest.approx([0.09, 0.04, 0.25])
    assert again["position"] == [2.0, 4.0, -0.5], "a replay starts again"
    resets = [message["reset_counter"] - first["reset_counter"] for message in (second, third, again)]
    assert resets == [0, 1, 2]
    assert node.signal(signal.SIGINT) == 0, node.output


@pytest.mark.skipif(find_spec("px4_msgs") is not None, reason="px4_msgs is installed")
def test_missing_px4_msgs_is_a_one_line_error(ros: Ros):
    node = ros.start("px4")
    assert node.wait() == 1
    assert node.output.startswith("error: px4_msgs is not installed (build the branch of")
