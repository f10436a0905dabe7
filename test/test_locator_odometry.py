"""The node `locator` with odometry as a real process over real DDS: ranges only, with odometry, and odometry lost."""

import itertools
import json
import math
import signal
from dataclasses import asdict
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from builtin_interfaces.msg import Time
from drives import NANOSECONDS, Robot, wrapped
from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    TwistWithCovariance,
    Vector3,
)
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_harness import Process, Ros, corrected_range, diagnostic_values, header_at, set_expiry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from uwb_mitigation_msgs.msg import RangeCorrected
from visualization_msgs.msg import MarkerArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.nodes.robot_motion import MotionState, OdometryInput
from uwb_mitigation.nodes.support.parameter_tables import RESPAWN_FOLDER
from uwb_mitigation.positioning.online.dead_reckoning import DeadReckoning
from uwb_mitigation.types.ros.poses import yaw_of
from uwb_mitigation.types.stamps import to_ns
from uwb_mitigation.types.tracks import Estimate, Heading

pytestmark = pytest.mark.ros

UNKNOWN_YAW = math.pi**2 / 3.0
"""Variance of a uniform distribution over all yaws, rad^2."""

LEVER = (0.3, 0.1, 0.2)
RELIABLE = [f"qos_overrides.{{}}/{name}.subscription.reliability:=reliable" for name in ("odom", "imu")]
CHUNK_S = 0.2


def stamp_ns(header: Header) -> int:
    return to_ns(header.stamp)


def link(parent: str, child: str, rotation: Quaternion, **at_m: float) -> TransformStamped:
    """Return the transform of a frame in its parent."""
    transform = Transform(translation=Vector3(**at_m), rotation=rotation)
    return TransformStamped(header=Header(frame_id=parent), child_frame_id=child, transform=transform)


def send_static(ros: Ros, topic: str, transforms: list[TransformStamped]) -> Publisher:
    qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = ros.node.create_publisher(TFMessage, topic, qos)
    publisher.publish(TFMessage(transforms=transforms))
    return publisher


class LiveRobot:
    """Publishes ranges and odometry of a robot in chunks, and waits until the locator has processed each.

    The odometry is a chunk ahead, because messages of two topics arrive in any order, and the locator's subscriptions are
    `RELIABLE`, because best-effort messages can be lost under load.
    """

    def __init__(
        self, ros: Ros, *, seconds: float = 40.0, imu: bool = False, slip=(0.0, 0.0), namespace: str = ""
    ) -> None:
        self.robot = Robot(lever=LEVER, facing=0.7, seconds=seconds, slip=slip)
        self.ranges = self.robot.ranges(seconds=seconds)
        # Old enough that the locator does not predict poses at the current time.
        self.start_ns = ros.node.get_clock().now().nanoseconds - round((seconds + 40.0) * NANOSECONDS)
        self._ros, self._at_s, self._uses_imu = ros, 0.0, imu
        self._odometry_end_ns = 0
        qos = QoSProfile(depth=1000)
        self._ranges_out = ros.node.create_publisher(RangeCorrected, f"{namespace}/uwb/range_corrected", qos)
        self._odometry_out = ros.node.create_publisher(Odometry, f"{namespace}/odom", qos)
        self._imu_out = ros.node.create_publisher(Imu, f"{namespace}/imu", qos)
        self.poses = ros.collect(PoseWithCovarianceStamped, f"{namespace}/uwb/pose")
        self.odometry = ros.collect(Odometry, f"{namespace}/uwb/odometry")
        self.transforms = ros.collect(TFMessage, f"{namespace}/tf")
        self._namespace = namespace
        self.wait()

    def wait(self) -> None:
        self._ros.wait_for_subscribers(f"{self._namespace}/uwb/range_corrected", 1)
        self._ros.wait_for_subscribers(f"{self._namespace}/odom", 1)
        self._ros.wait_until_active(f"{self._namespace}/locator".removeprefix("/"))

    def header(self, stamp: int, frame: str = "") -> Header:
        return header_at(self.start_ns + stamp, frame)

    def play(self, until_s: float, *, odometry: bool = True, tags: tuple[int, ...] = (7,)) -> None:
        while self._at_s < until_s - CHUNK_S / 2:
            begin, end = (round(s * NANOSECONDS) for s in (self._at_s, self._at_s + CHUNK_S))
            self._at_s += CHUNK_S
            if odometry:
                sent, ahead = self._odometry_end_ns, min(self._at_s + CHUNK_S, until_s)
                self.send_odometry(max(begin, sent) / NANOSECONDS, ahead)
            stamps = self.ranges.stamp_ns
            rows = np.flatnonzero((stamps >= begin) & (stamps < end)).tolist()
            for i, tag in itertools.product(rows, tags):
                self.send_range(i, tag)
            last_ns = self.start_ns + int(stamps[rows[-1]])
            if self._at_s > 1.0:
                self._ros.spin_until(
                    lambda last_ns=last_ns: bool(self.poses) and stamp_ns(self.poses[-1].header) >= last_ns
                )

    def skip(self, until_s: float) -> None:
        """Drive on without sending messages."""
        self._at_s = until_s

    def send_range(self, row: int, tag: int = 7) -> None:
        # The first ranges are in no frame.
        frame = "uwb_antenna" if self._at_s > 1.0 else ""
        header = self.header(int(self.ranges.stamp_ns[row]), frame)
        self._ranges_out.publish(corrected_range(self.ranges, row, header, tag_id=tag))

    def send_odometry(self, begin_s: float, end_s: float) -> None:
        measured, begin, end = self.robot.odometry, *(round(s * NANOSECONDS) for s in (begin_s, end_s))
        self._odometry_end_ns = end
        for i in np.flatnonzero((measured.stamp_ns >= begin) & (measured.stamp_ns < end)).tolist():
            header = self.header(int(measured.stamp_ns[i]), "odom")
            x, y, yaw = measured.pose[i].tolist()
            vx, vy, rate = measured.twist[i].tolist()
            message = Odometry(header=header, child_frame_id="base_link")
            message.pose.pose.position.x, message.pose.pose.position.y = x, y
            message.pose.pose.orientation = Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
            twist = TwistWithCovariance()
            twist.twist.linear.x, twist.twist.linear.y, twist.twist.angular.z = vx, vy, rate
            twist.covariance[0] = twist.covariance[7] = twist.covariance[35] = 4e-4
            message.twist = twist
            self._odometry_out.publish(message)
            if self._uses_imu:
                imu = Imu(header=header, angular_velocity=Vector3(z=rate / 1.02))
                imu.orientation_covariance[0] = -1.0
                imu.angular_velocity_covariance[8] = 1e-6
                self._imu_out.publish(imu)
                # Rates that are not measured are skipped, and the orientation, which is not measured either.
                imu.header = self.header(int(measured.stamp_ns[i]) + 10_000_000)
                imu.angular_velocity.z, imu.angular_velocity_covariance[0] = 9.0, -1.0
                self._imu_out.publish(imu)

    def transform_ns(self) -> int:
        """Return the stamp of the latest transform."""
        return stamp_ns(self.transforms[-1].transforms[0].header)

    def poses_between(self, begin_s: float, end_s: float) -> list[PoseWithCovarianceStamped]:
        limits = [self.start_ns + round(s * NANOSECONDS) for s in (begin_s, end_s)]
        return [pose for pose in self.poses if limits[0] <= stamp_ns(pose.header) < limits[1]]

    def errors(self, poses: list) -> tuple[np.ndarray, np.ndarray]:
        """Return horizontal and yaw errors of poses of the base."""
        time_s = (np.array([stamp_ns(pose.header) for pose in poses]) - self.start_ns) / NANOSECONDS
        position = np.array([(pose.pose.pose.position.x, pose.pose.pose.position.y) for pose in poses])
        yaw = np.array([yaw_of(pose.pose.pose.orientation) for pose in poses])
        away = position - self.robot.base(time_s)[:, :2]
        return np.hypot(*away.T), wrapped(yaw - self.robot.yaw(time_s))


def start(ros: Ros, anchors: Path, *parameters: str, namespace: str = "") -> Process:
    """Start a locator and wait until it is ready."""
    given = f"anchors:={anchors}", "rate:=0.0", "level:=true", f"height:={1.0 + LEVER[2]}", "odometry:=odom"
    reliable = [one.format(namespace) for one in RELIABLE]
    arguments = ("-r", f"__ns:={namespace}") if namespace else ()
    locator = ros.start("locator", *given, *reliable, *parameters, arguments=arguments)
    locator.wait_for_output("locating")
    return locator


def test_modes_ranges_only_odometry_odometry_lost_and_odometry_wrong(ros: Ros, anchors: Path):
    # The antenna is on a mast that is turned by 90 degrees; the quaternion is not quite normalised.
    mast = link("base_link", "mast", Quaternion(z=0.74, w=0.74), x=0.1)
    antenna = link("mast", "uwb_antenna", Quaternion(w=1.0), x=0.1, y=-0.2, z=0.2)
    # Transforms that are not rotations are skipped.
    not_rotations = Quaternion(w=0.0), Quaternion(w=2.0), Quaternion(x=math.nan, w=1.0)
    invalid = [link("base_link", "mast", rotation) for rotation in not_rotations]
    static = send_static(ros, "/tf_static", [antenna, mast, *invalid])
    locator = start(ros, anchors, "publish_tf:=true", "transform_tolerance:=1.0")
    live = LiveRobot(ros, seconds=44.0, slip=(40.0, 44.0))
    ros.spin_until(lambda: static.get_subscription_count() == 1)

    live.play(3.0, odometry=False)
    assert all(pose.pose.covariance[35] >= UNKNOWN_YAW for pose in live.poses)
    assert {message.child_frame_id for message in live.odometry} == {"base_link"}
    assert min(message.twist.covariance[0] for message in live.odometry) >= 1e5
    assert not live.transforms

    live.play(24.0)
    assert "lever arm of the antenna: 0.300, 0.100, 0.200" in locator.output
    with_heading = live.poses_between(16.0, 24.0)
    distance, of_yaw = live.errors(with_heading)
    assert np.sqrt(np.mean(distance**2)) < 0.2
    assert np.sqrt(np.mean(of_yaw**2)) < math.radians(4.0)
    assert np.mean(np.abs(of_yaw) < 3.0 * np.sqrt([pose.pose.covariance[35] for pose in with_heading])) > 0.95
    last = live.odometry[-1]
    row = np.searchsorted(live.robot.odometry.stamp_ns, stamp_ns(last.header) - live.start_ns)
    twist = last.twist
    assert twist.twist.linear.x == pytest.approx(live.robot.odometry.twist[row, 0], abs=0.05)
    assert twist.covariance[0] < 0.01

    transforms = [one for message in live.transforms for one in message.transforms]
    assert {(one.header.frame_id, one.child_frame_id) for one in transforms} == {("map", "odom")}

    live.play(30.0, odometry=False)
    lost = live.poses_between(25.0, 30.0)
    assert all(pose.pose.covariance[35] >= UNKNOWN_YAW for pose in lost)
    assert np.sqrt(np.mean(live.errors(lost)[0] ** 2)) < 0.6
    ros.diagnosis("locator", lambda status: "no odometry" in status.message)
    # The last transform is repeated with new stamps.
    last_ns = stamp_ns(live.poses[-1].header) + NANOSECONDS
    ros.spin_until(lambda: live.transform_ns() == last_ns)

    live.play(40.0)
    distance, of_yaw = live.errors(live.poses_between(38.0, 40.0))
    assert np.sqrt(np.mean(of_yaw**2)) < math.radians(6.0)
    ros.diagnosis("locator", lambda status: diagnostic_values(status).get("tag 7 heading") == "known")

    # The wheels slip.
    live.play(44.0)
    assert live.odometry[-1].twist.covariance[0] >= 1e5
    assert live.odometry[-1].twist.twist.linear.x == 0.0
    ros.diagnosis("locator", lambda status: "odometry contradicts the ranges" in status.message)


def test_lever_arm_of_the_parameters_and_yaw_rates_of_an_imu(ros: Ros, anchors: Path):
    parameters = ("imu:=/imu", "imu_orientation:=true", "base_frame:=base_footprint")
    start(ros, anchors, "lever_arm:=0.3,0.1,0.2", *parameters)
    live = LiveRobot(ros, seconds=20.0, imu=True)
    others = ros.collect(PoseWithCovarianceStamped, "/uwb/tag_9/pose")
    live.play(18.0)
    live.play(20.0, tags=(7, 9))
    distance, of_yaw = live.errors(live.poses_between(12.0, 20.0))
    assert np.sqrt(np.mean(distance**2)) < 0.2
    assert np.sqrt(np.mean(of_yaw**2)) < math.radians(4.0)
    assert live.odometry[-1].child_frame_id == "base_footprint"
    assert not live.transforms
    # The lever arm is that of the robot's tag.
    ros.spin_until(lambda: bool(others))
    assert others[-1].pose.pose.position.z == pytest.approx(1.2, abs=0.09)
    assert live.poses[-1].pose.pose.position.z == pytest.approx(1.0, abs=0.09)
    values = {entry.key: entry.value for entry in ros.diagnosis("locator", lambda _: True).values}
    assert (values["tag 7 lever arm"], values["tag 9 lever arm"]) == (
        "0.300,0.100,0.200",
        "0.000,0.000,0.000",
    )


def test_namespace_contains_the_topics_and_transforms_of_a_robot(ros: Ros, anchors: Path):
    antenna = link("base_link", "uwb_antenna", Quaternion(w=1.0), x=0.3, y=0.1, z=0.2)
    send_static(ros, "/robot1/tf_static", [antenna])
    locator = start(ros, anchors, "publish_tf:=true", namespace="/robot1")
    elsewhere = ros.collect(TFMessage, "/tf")
    live = LiveRobot(ros, seconds=16.0, namespace="/robot1")
    live.play(16.0)
    assert "lever arm of the antenna: 0.300, 0.100, 0.200" in locator.output
    (links,) = {
        (transform.header.frame_id, transform.child_frame_id)
        for message in live.transforms
        for transform in message.transforms
    }
    assert links == ("map", "odom")
    assert np.abs(live.errors(live.poses[-20:])[1]).max() < math.radians(8.0)
    assert not elsewhere


def test_transform_is_repeated_while_there_is_no_position(ros: Ros, anchors: Path):
    start(ros, anchors, "lever_arm:=0.3,0.1,0.2", "publish_tf:=true", "use_sim_time:=true")
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    live = LiveRobot(ros, seconds=25.0)
    live.play(16.0)
    # One range after a gap does not determine a position.
    live.send_range(len(live.ranges) - 1)
    ros.state_of("locator")
    now = live.header(25 * NANOSECONDS)
    expected = stamp_ns(now) + NANOSECONDS
    ros.spin_until(lambda: clock.publish(Clock(clock=now.stamp)) or live.transform_ns() == expected)
    ros.diagnosis("locator", lambda status: diagnostic_values(status).get("tag 7 candidates") == "0")
    assert stamp_ns(live.poses[-1].header) < live.start_ns + 16 * NANOSECONDS


def test_predictions_and_transforms_end_30_s_after_the_last_range(ros: Ros, anchors: Path):
    start(ros, anchors, "lever_arm:=0.3,0.1,0.2", "publish_tf:=true", "use_sim_time:=true")
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    markers = ros.collect(MarkerArray, "/uwb/anchors")
    live = LiveRobot(ros, seconds=16.0)
    live.play(16.0)

    def wait_for_timer(seconds: float) -> int:
        """Set the clock, wait until the locator has published everything at this time, and return it."""
        now = live.header(round(seconds * NANOSECONDS))
        ros.spin_until(
            lambda: (
                clock.publish(Clock(clock=now.stamp))
                or (bool(markers) and stamp_ns(markers[-1].markers[0].header) == stamp_ns(now))
            )
        )
        return stamp_ns(now)

    predicted_ns = wait_for_timer(16.35)
    ros.spin_until(lambda: stamp_ns(live.poses[-1].header) == predicted_ns)
    ros.spin_until(lambda: live.transform_ns() == predicted_ns + NANOSECONDS)
    for seconds in (46.2, 46.3, 46.4):
        wait_for_timer(seconds)
    ros.spin_for(0.2)
    assert stamp_ns(live.poses[-1].header) == predicted_ns
    assert live.transform_ns() == predicted_ns + NANOSECONDS


def test_respawned_locator_continues_with_transform_and_heading(
    ros: Ros, anchors: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv(RESPAWN_FOLDER, str(tmp_path))
    set_expiry(monkeypatch, tmp_path, 5)
    parameters = ("lever_arm:=0.3,0.1,0.2", "publish_tf:=true", "use_sim_time:=true")
    locator = start(ros, anchors, *parameters)
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    live = LiveRobot(ros, seconds=28.0)
    live.play(16.0)
    (tmp_path / "locator.state").unlink(missing_ok=True)
    ros.spin_until((tmp_path / "locator.state").exists)
    locator.signal(signal.SIGKILL)
    saved = json.loads((tmp_path / "locator.state").read_text())
    assert (saved["format"], saved["state"]["tag"]) == (1, 7)
    # Messages may still be in transit when the state is written.
    ros.spin_until(lambda: ros.node.count_subscribers("/odom") == 0)
    latest = [message.transforms[0].transform for message in live.transforms[-20:]]
    live.transforms.clear()
    start(ros, anchors, *parameters)
    # The transform is repeated once, because this clock stands still: the subscription of it must be connected.
    ros.wait_until_active("locator")
    # Before any message arrives.
    now = live.header(18 * NANOSECONDS)
    ros.spin_until(lambda: clock.publish(Clock(clock=now.stamp)) or bool(live.transforms))
    before = live.transforms[0].transforms[0].transform
    assert before in latest
    live.poses.clear()
    live.wait()
    live.skip(18.6)
    live.send_odometry(18.4, 18.8)
    # Ranges are a topic of their own, and are also received before: a node handles messages in order of arrival.
    ros.state_of("locator")
    # Tag 9 is of another robot: its ranges arrive first.
    live.send_range(int(np.searchsorted(live.ranges.stamp_ns, round(18.6 * NANOSECONDS))), 9)
    live.play(26.0)
    assert max(pose.pose.covariance[35] for pose in live.poses) < 0.02
    distance, of_yaw = live.errors(live.poses_between(18.6, 19.6))
    assert np.abs(of_yaw).max() < math.radians(6.0)
    assert distance.max() < 0.3
    # The new estimator replaces the old pose without a step, also before it knows the heading.
    transforms = [before, *(message.transforms[0].transform for message in live.transforms)]
    yaw = np.array([yaw_of(one.rotation) for one in transforms])
    assert np.abs(wrapped(np.diff(yaw))).max() < math.radians(1.0)
    assert yaw[-1] != yaw[0]


def test_unknown_lever_arm_is_reported(ros: Ros, anchors: Path):
    locator = start(ros, anchors)
    live = LiveRobot(ros, seconds=2.0)
    live.play(2.0)
    text = "no transform from base_link to uwb_antenna on /tf_static"
    ros.diagnosis("locator", lambda status: text in status.message)
    assert text in locator.output


def test_lever_arm_of_zero_is_not_read_from_tf(ros: Ros, anchors: Path):
    start(ros, anchors, "lever_arm:=0,0,0")
    # Its other subscriptions were created later.
    ros.wait_for_subscribers("/uwb/range_corrected", 1)
    assert ros.node.count_subscribers("/tf_static") == 0


def test_base_frame_that_is_the_map_is_refused():
    node = MagicMock()
    node.value.side_effect = {"map_frame": "map", "base_frame": "map", "odometry": "odom"}.get
    with pytest.raises(ParameterError, match="base_frame = 'map'"):
        OdometryInput(node, DeadReckoning())


class Continuation:
    """A robot that stands at (4, 2) with yaw 0.5 in the map before a crash, at (1, 0) with yaw 0 in odom."""

    def __init__(self) -> None:
        node, self.path = MagicMock(), DeadReckoning()
        node.value.side_effect = {"map_frame": "map", "base_frame": "base_link", "odometry": "odom"}.get
        self.motion = OdometryInput(node, self.path)
        self._receive = node.subscription.call_args_list[0].args[2]
        yaw = 0.5
        saved = {
            "odom_frame": "odom",
            "base_frame": "base_link",
            "map_to_odom": [4.0 - math.cos(yaw), 2.0 - math.sin(yaw), 0.0, yaw],
            "map_to_odom_ns": 0,
            "variance": [0.01, 0.01, 0.01, 0.001],
            "pose": [1.0, 0.0, 0.0],
            "pose_ns": 0,
            "speed": 0.5,
        }
        self.motion.resume(MotionState.read(json.loads(json.dumps(saved))))

    def drive(self, x: float, seconds: float) -> None:
        message = Odometry(header=Header(frame_id="odom", stamp=Time(sec=int(seconds))))
        message.header.stamp.nanosec = round(seconds % 1.0 * NANOSECONDS)
        message.pose.pose.position.x, message.pose.pose.orientation.w = x, 1.0
        message.twist.twist.linear.x = 0.5
        self._receive(message)

    def truth(self, yaw: float, odom_x: float) -> tuple[float, float]:
        """Return the position in the map of a robot that has driven from the crash on with another yaw of odom."""
        return 4.0 + math.cos(yaw) * (odom_x - 1.0), 2.0 + math.sin(yaw) * (odom_x - 1.0)

    def mixed(
        self, x: float, y: float, yaw: float | None, sd: float, seconds: float, *, trusts: bool = True
    ) -> Estimate:
        heading = None if yaw is None else Heading(yaw, np.array([0.0, 0.0, 0.0, sd**2]))
        stamp = round(seconds * NANOSECONDS)
        estimate = Estimate(stamp, np.array([x, y, 0.0]), np.zeros(3), np.eye(6) * sd**2, heading)
        return self.motion.mixed(estimate, trusts_odometry=trusts)


def test_pose_before_a_short_gap_of_the_odometry_is_moved_on():
    robot = Continuation()
    for x, seconds in ((2.0, 2.0), (2.1, 2.2), (2.8, 3.6)):
        robot.drive(x, seconds)
        robot.motion.map_to_odom(robot.mixed(4.0, 2.0, None, 1.0, seconds), 0)
    assert robot.mixed(4.0, 2.0, None, 1.0, 3.6).heading.yaw == pytest.approx(0.5)
    robot.drive(3.8, 6.0)
    assert robot.mixed(4.0, 2.0, None, 1.0, 6.0).heading is None, "a robot may be moved by hand"


def test_pose_before_the_heading_is_lost_is_moved_on():
    robot = Continuation()
    for step in range(80):
        robot.drive(2.0 + 0.1 * step, 2.0 + 0.2 * step)
        yaw = None if step in (0, 79) else 0.6
        mixed = robot.mixed(*robot.truth(0.6, 2.0 + 0.1 * step), yaw, 0.03, 2.0 + 0.2 * step)
        robot.motion.map_to_odom(mixed, 0)
    assert mixed.heading.yaw == pytest.approx(0.6, abs=0.02), "not that before the crash"
    assert robot.motion.without_estimate(mixed.stamp_ns).heading.yaw == mixed.heading.yaw


@pytest.mark.parametrize(
    ("x", "seconds", "estimate", "trusts"),
    [
        (2.0, 2.0, (8.0, 2.5, 0.5, 0.3), True),  # carried away
        (2.0, 2.0, (5.0, 2.5, 2.5, 0.1), True),  # turned by hand
        (30.0, 2.0, (5.0, 2.5, None, 0.3), True),  # odometry that starts elsewhere
        (2.0, 40.0, (5.0, 2.5, None, 0.3), True),  # too late
        (2.0, 2.0, (5.0, 2.5, None, 0.3), False),  # wheels slip
    ],
)
def test_pose_before_a_crash_is_dropped_if_it_cannot_be_true(
    x: float, seconds: float, estimate: tuple, trusts: bool
):
    robot = Continuation()
    robot.drive(x, seconds)
    mixed = robot.mixed(*estimate, seconds, trusts=trusts)
    assert mixed.position[:2].tolist() == list(estimate[:2])
    assert robot.motion.carried_on(mixed.stamp_ns) is None


@pytest.mark.parametrize(
    "change", [{"variance": [0.0] * 4}, {"speed": math.nan}, {"pose": [1.0]}, {"pose": None}]
)
def test_invalid_pose_before_a_crash_is_refused(change: dict):
    with pytest.raises((TypeError, ValueError)):
        MotionState.read(asdict(Continuation().motion.state) | change)
