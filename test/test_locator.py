"""The node `locator` as a real process over real DDS."""

import math
import re
import signal
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from diagnostic_msgs.msg import DiagnosticStatus
from drives import HALL, NANOSECONDS, drive
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from ros_harness import Ros, corrected_range, diagnostic_values, header_at
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage
from uwb_mitigation_msgs.msg import RangeCorrected
from visualization_msgs.msg import MarkerArray

from uwb_mitigation.nodes.support.endpoints import LATCHED
from uwb_mitigation.nodes.support.position_monitor import PositionMonitor
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.positioning.multi_tag import MultiTagEstimator
from uwb_mitigation.types.anchors import dump_anchors
from uwb_mitigation.types.measurement import CorrectedBy, CorrectedRange, Status
from uwb_mitigation.types.stamps import to_ns

pytestmark = pytest.mark.ros

CORRECTED = "/uwb/range_corrected"
SHARED = ("-r", f"uwb/range_corrected:={CORRECTED}")


class Drive:
    """Publishes a drive at a given speed, with stamps from the current time on."""

    def __init__(self, ros: Ros, **options) -> None:
        self.ranges, self.truth = drive(**options)
        self.start_ns = ros.node.get_clock().now().nanoseconds - int(self.ranges.stamp_ns[-1])
        self._ros = ros
        self._publisher = ros.node.create_publisher(RangeCorrected, CORRECTED, QoSProfile(depth=10_000))
        ros.wait_for_subscribers(CORRECTED, 1)
        # Its first poses would be lost.
        ros.wait_until_active("locator")

    def send(self, rows: range, **changes) -> None:
        for i in rows:
            header = header_at(self.start_ns + int(self.ranges.stamp_ns[i]))
            self._publisher.publish(corrected_range(self.ranges, i, header, **changes))
            if i % 50 == 0:
                self._ros.spin_for(0.01)

    def errors(self, poses: list) -> np.ndarray:
        """Return the horizontal errors of poses."""
        at = self.truth.position_at(np.array([stamp_ns(pose) for pose in poses]) - self.start_ns)
        places = np.array([(pose.pose.pose.position.x, pose.pose.pose.position.y) for pose in poses])
        return np.hypot(*(places - at[:, :2]).T)


def stamp_ns(pose: PoseWithCovarianceStamped) -> int:
    return to_ns(pose.header.stamp)


def test_ranges_yield_poses_odometry_smoothed_poses_and_markers(ros: Ros, anchors: Path):
    locator = ros.start("locator", f"anchors:={anchors}", "rate:=0.0")
    locator.wait_for_output("locating")
    monitor = ros.start("monitor")
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    odometry = ros.collect(Odometry, "/uwb/odometry")
    smoothed = ros.collect(PoseWithCovarianceStamped, "/uwb/pose_smoothed")
    second = ros.collect(PoseWithCovarianceStamped, "/uwb/tag_9/pose")
    run = Drive(ros, seconds=20)
    half = len(run.ranges) // 2
    run.send(range(half))
    ros.spin_until(lambda: len(smoothed) > 0)
    # Invalid messages are counted and reported; the node continues.
    run.send(range(half, half + 3), range=math.nan)
    run.send(range(half, half + 3), anchor_id=4711)
    run.send(range(half, len(run.ranges)))
    run.send(range(half), tag_id=9)
    ros.spin_until(lambda: len(second) > 20)

    def is_current(status: DiagnosticStatus) -> bool:
        run.send(range(len(run.ranges) - 1, len(run.ranges)))
        values = diagnostic_values(status)
        return values.get("ranges of unknown anchors") == "3" and "tag 7 HDOP" in values

    status = ros.diagnosis("locator", is_current)
    errors = run.errors([pose for pose in poses if stamp_ns(pose) < run.start_ns + 18 * NANOSECONDS])
    known = np.isfinite(errors)
    assert known.sum() > 500
    assert np.sqrt(np.mean(errors[known] ** 2)) < 0.3
    assert np.nanmax(run.errors(smoothed)) < 0.5
    assert {pose.header.frame_id for pose in poses} == {"map"}
    assert {message.child_frame_id for message in odometry} == {"uwb_tag"}
    assert poses[-1].pose.covariance[35] >= 1e5
    assert poses[-1].pose.pose.orientation.w == 1.0
    reported = diagnostic_values(status)
    assert reported["ranges not valid"] == "3"
    assert float(reported["tag 7 HDOP"]) < 3
    assert reported["tag 7 determination"].startswith("unique: HDOP")
    assert "anchor 4711 are left out" in locator.output
    shown = ros.collect(MarkerArray, "/uwb/anchors", LATCHED)
    ros.spin_until(lambda: bool(shown))
    names = {(marker.ns, marker.id) for marker in shown[0].markers}
    assert {("anchors", row) for row in range(len(HALL))} <= names
    # Of a tag that was switched off, nothing that was true before is repeated.
    lost = re.compile(r"Position of tag 9 lost: no ranges of tag 9 for (1[1-9]|[2-9]\d) s")
    status = ros.diagnosis("locator", lambda status: lost.search(status.message) is not None)
    assert 0 <= status.message.find("4711") < lost.search(status.message).start(), "it hides no other warning"
    assert {key for key in diagnostic_values(status) if key.startswith("tag 9 ")} == {
        "tag 9 lever arm",
        "tag 9 position",
    }
    # A terminal without a browser shows it, too.
    assert monitor.signal(signal.SIGINT) == 0, monitor.output
    assert re.search("locator: .*Position of tag 9 lost", " ".join(monitor.output.split())), monitor.output
    assert locator.signal(signal.SIGINT) == 0, locator.output


ALL = [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("changes", "anchors", "expected"),
    [
        ({}, ALL, r"good: horizontal sd 0.\d\d m, 95 % within 0.\d\d m"),
        (
            {2: 0.5},
            ALL,
            r"degraded: Anchor 2 reads 0.\d\d m long. Check its position, or run `uwb-mitigation calibrate`",
        ),
        ({5: 0.5}, ALL, "good: .*"),
        ({1: 0.9, 4: -0.9}, ALL, "degraded: Anchor 1 .*: check height and lever arm of the tag, too"),
        (
            {},
            [1, 2],
            "not determined: mirrored position: the 2 received anchors leave two mirror positions.* Remedy: an area on one side.*",
        ),
        (
            {},
            [1, -2, 3, 4, 5],
            r"degraded: Anchor 2 is probably not where the anchors file says. At least [01].\d m away, .*survey`",
        ),
    ],
)
def test_verdict_has_the_sentences_of_the_viewer(
    changes: dict[int, float], anchors: list[int], expected: str
):
    """A negative anchor is not where the file says."""
    wrong = np.array([(0.0, 1.6 * (-anchor.id in anchors), 0.0) for anchor in HALL.anchors])
    config = EstimatorConfig(HALL.moved(HALL.position + wrong, HALL.sd), height=Height(1.0))
    estimator, now_s = MultiTagEstimator(config), [0.0]
    monitor = None
    ranges, _ = drive(seconds=60 if min(anchors) < 0 else 20)
    for i, stamp in enumerate(ranges.stamp_ns.tolist()):
        anchor = config.anchors.anchors[ranges.anchor[i]]
        if anchor.id in np.abs(anchors):
            now_s[0], range_m = stamp / NANOSECONDS, float(ranges.range_m[i]) + changes.get(anchor.id, 0.0)
            # Anchor 5 is behind a wall if its ranges are long.
            variance_m2 = 0.09 if anchor.id == 5 and 5 in changes else 0.01
            tag, estimate = estimator.add(7, anchor.id, stamp, range_m, variance_m2)
            monitor = monitor or PositionMonitor(tag, lambda: now_s[0])
            source = Status.OK, CorrectedBy.HOST, 1
            monitor.add(anchor, CorrectedRange(range_m, range_m, 0.0, variance_m2, *source), estimate)
    is_good, text = monitor.sentence()
    assert re.fullmatch(f"Position of tag 7 {expected}", text), text
    assert is_good == expected.startswith("good")
    assert (2 in changes or -2 in anchors) == bool(re.search(r"\b2 \+0\.[3-6]\d", monitor.residuals())), (
        monitor.residuals()
    )
    now_s[0] += 12.0
    lost = "Position of tag 7 lost: no ranges of tag 7 for 12 s. Check power of the tag, and the driver"
    assert monitor.sentence() == (False, lost)


def test_gap_is_bridged_by_predictions_with_growing_covariance(ros: Ros, anchors: Path):
    locator = ros.start("locator", f"anchors:={anchors}", "rate:=0.0", "use_sim_time:=true")
    locator.wait_for_output("locating")
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    run = Drive(ros, seconds=10)

    def spread_at(row: int, silent_s: float) -> float:
        """Return the variance reported at the given time after a range."""
        now_ns = run.start_ns + int(run.ranges.stamp_ns[row]) + round(silent_s * NANOSECONDS)
        now = Clock(clock=header_at(now_ns).stamp)

        def variances() -> list[float]:
            return [pose.pose.covariance[0] for pose in poses if stamp_ns(pose) == now_ns]

        ros.spin_until(lambda: clock.publish(now) or bool(variances()))
        return variances()[-1]

    half = len(run.ranges) // 2
    run.send(range(half))
    # A subscriber of half a drive receives the pose of the last range.
    spread_at(half - 1, 0.4)
    run.send(range(half, len(run.ranges)))
    ros.spin_until(lambda: stamp_ns(poses[-1]) == run.start_ns + int(run.ranges.stamp_ns[-1]))
    spread = [spread_at(-1, silent_s) for silent_s in (0.4, 0.8, 1.2, 1.6, 2.0)]
    assert spread == sorted(spread)
    assert spread[-1] > 2 * spread[0]


def test_absent_mitigator_and_a_second_locator_are_reported(ros: Ros, anchors: Path):
    locator = ros.start("locator", f"anchors:={anchors}")
    remedy = "no ranges: /uwb/range_corrected has no publisher. Start driver and mitigator"
    ros.diagnosis("locator", lambda status: remedy in status.message)
    locator.wait_for_output(remedy)
    run = Drive(ros, seconds=5)
    run.send(range(100))
    ros.diagnosis(
        "locator", lambda status: status.message.startswith("Position of tag 7 good: horizontal sd")
    )
    locator.wait_for_output("Position of tag 7 good: horizontal sd")
    ros.node.create_publisher(PoseWithCovarianceStamped, "/uwb/pose", 10)
    ros.diagnosis("locator", lambda status: "another node publishes /uwb/pose" in status.message)


def test_best_effort_height_is_received_and_best_effort_ranges_are_reported(ros: Ros, anchors: Path):
    heights = ros.node.create_publisher(PoseWithCovarianceStamped, "/height", qos_profile_sensor_data)
    ros.node.create_publisher(RangeCorrected, CORRECTED, qos_profile_sensor_data)
    locator = ros.start("locator", f"anchors:={anchors}", "height_topic:=/height", "rate:=0.0")
    locator.wait_for_output(
        f"publishes with best-effort reliability and is not received: set qos_overrides.{CORRECTED}"
    )
    ros.spin_until(lambda: heights.get_subscription_count() == 1)
    (subscription,) = ros.node.get_subscriptions_info_by_topic("/height")
    assert subscription.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT


def test_tf_contains_only_the_frames_of_the_tags_below_the_map(ros: Ros, anchors: Path):
    # One robot in a namespace and one without; their tags share the map frame.
    locator = ros.start("locator", f"anchors:={anchors}", "rate:=0.0", "publish_tf:=true", "tag:=7")
    other = ros.start(
        "locator", f"anchors:={anchors}", "publish_tf:=true", arguments=("-r", "__ns:=/left", *SHARED)
    )
    for process in (locator, other):
        process.wait_for_output("locating")
    transforms, left_transforms = ros.collect(TFMessage, "/tf"), ros.collect(TFMessage, "/left/tf")
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    long_id = 0x1122334455667788
    long_tag = f"tag_{long_id:#x}"
    odometry = {
        frame: ros.collect(Odometry, topic)
        for frame, topic in (
            ("uwb_tag", "/uwb/odometry"),
            ("left/uwb_tag", "/left/uwb/odometry"),
            (long_tag, f"/uwb/{long_tag}/odometry"),
        )
    }
    run = Drive(ros, seconds=5)
    ros.wait_for_subscribers(CORRECTED, 2)
    ros.wait_until_active("left/locator")
    for step in range(0, len(run.ranges), 20):
        rows = range(step, min(step + 20, len(run.ranges)))
        run.send(rows)
        run.send(rows, tag_id=long_id)
    ros.spin_until(lambda: all(len(messages) > 20 for messages in odometry.values()))

    def links() -> dict[tuple[str, int], TransformStamped]:
        return {(one.child_frame_id, stamp_ns(one)): one for array in transforms for one in array.transforms}

    ros.spin_until(lambda: bool(poses) and ("uwb_tag", stamp_ns(poses[-1])) in links())
    found = links()
    frames = {frame for frame, _ in found}
    # A frame has one parent: frames of the robot (odom, base_link) are not published.
    assert frames == {"uwb_tag", long_tag}
    left_frames = {one.child_frame_id for array in left_transforms for one in array.transforms}
    assert {"left/uwb_tag"} <= left_frames <= {"left/uwb_tag", f"left/{long_tag}"}
    assert {one.header.frame_id for one in found.values()} == {"map"}
    for frame, messages in odometry.items():
        assert {message.child_frame_id for message in messages} == {frame}
    at, pose = found["uwb_tag", stamp_ns(poses[-1])].transform.translation, poses[-1].pose.pose.position
    assert (at.x, at.y, at.z) == (pose.x, pose.y, pose.z)
    # A replay that starts again.
    transforms.clear()
    run.send(range(len(run.ranges) // 2))
    half_ns = run.start_ns + int(run.ranges.stamp_ns[-1]) // 2
    ros.spin_until(lambda: any(frame == "uwb_tag" and stamp < half_ns for frame, stamp in links()))


@pytest.mark.parametrize(
    ("parameter", "excerpt"),
    [
        ("tag_frame:=tag_9", "tag_frame = 'tag_9'"),
        ("tag_frame:=map", "tag_frame = 'map'"),
        ("anchors:=no.yaml", "no such file"),
    ],
)
def test_tag_frame_in_use_and_missing_anchors_are_reported(
    ros: Ros, anchors: Path, parameter: str, excerpt: str
):
    locator = ros.start("locator", f"anchors:={anchors}", "tag:=7", parameter)
    locator.wait_for_output(excerpt)
    ros.diagnosis("locator", lambda status: excerpt in status.message)
    assert locator.signal(signal.SIGINT) == 0


def test_pipeline_contains_a_locator_if_anchors_are_given(ros: Ros, tmp_path: Path):
    from uwb_mitigation.simulation.simulated import SimulatedSource

    path = tmp_path / "flat.yaml"
    path.write_text(dump_anchors(SimulatedSource().anchors))
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    truth = ros.collect(Odometry, "/uwb/odometry_truth")
    pipeline = ros.start(
        "pipeline", f"anchors:={path}", "level:=true", "start_delay:=0.2", "wait_for_subscribers:=0"
    )
    ros.spin_until(lambda: len(poses) > 20 and len(truth) > 20)
    assert truth[0].child_frame_id == "tag_101"
    assert pipeline.signal(signal.SIGINT) == 0, pipeline.output
