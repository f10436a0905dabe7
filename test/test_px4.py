"""The node `px4`, with a stand-in for px4_msgs that is built like the message package of this project."""

import itertools
import json
import math
import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from conftest import REPOSITORY
from geometry_msgs.msg import Point, Pose, PoseWithCovariance, PoseWithCovarianceStamped
from ros_harness import Process, Ros, diagnostic_values, header_at
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.nodes import px4
from uwb_mitigation.positioning.geodetic import parse_origin, to_geodetic
from uwb_mitigation.types.anchors import Anchor, AnchorMap, dump_anchors

pytestmark = pytest.mark.ros

MESSAGES = {
    # Fields of px4_msgs, release/1.15.
    "VehicleOdometry": "uint64 timestamp timestamp_sample; uint8 POSE_FRAME_UNKNOWN=0 POSE_FRAME_NED=1 POSE_FRAME_FRD=2 pose_frame;"
    "float32[3] position; float32[4] q; uint8 VELOCITY_FRAME_UNKNOWN=0 velocity_frame; float32[3] velocity angular_velocity;"
    "float32[3] position_variance orientation_variance velocity_variance; uint8 reset_counter; int8 quality",
    # Fields of px4_msgs, main.
    "RangingBeacon": "uint64 timestamp timestamp_sample; uint8 beacon_id; float32 range; float64 lat lon; float32 alt;"
    "uint8 alt_type ALT_TYPE_WGS84=0 ALT_TYPE_MSL=1; float32 hacc vacc; uint8 sequence_nr status; uint16 carrier_freq;"
    "float32 range_accuracy",
    # The used fields of px4_msgs, main.
    "VehicleLocalPosition": "uint32 MESSAGE_VERSION=1; bool xy_global z_global; float64 ref_lat ref_lon; float32 ref_alt",
}
"""{message: fields, with several of a type in one place}."""

CLIENT = """
import json, time, rclpy
from px4_msgs.msg import *
from rclpy.qos import qos_profile_sensor_data
rclpy.init()
node = rclpy.create_node("fmu")
"""

RECEIVER = f"""{CLIENT}
def show(message):
    values = {{name: getattr(message, name) for name in message.get_fields_and_field_types()}}
    print(json.dumps({{name: v if isinstance(v, (int, float)) else [float(x) for x in v] for name, v in values.items()}}))
node.create_subscription(RangingBeacon, "/fmu/in/ranging_beacon", show, 10)
node.create_subscription(VehicleOdometry, "/fmu/in/vehicle_visual_odometry", show, 10)
rclpy.spin(node)
"""

LOCAL_PUBLISHER = f"""{CLIENT}
publisher = node.create_publisher(VehicleLocalPosition, "/fmu/out/vehicle_local_position_v1", qos_profile_sensor_data)
while True:
    publisher.publish(VehicleLocalPosition(xy_global=True, z_global=True, ref_lat=47.397742, ref_lon=8.545594, ref_alt=488.0))
    time.sleep(0.1)
"""


def build_messages(folder: Path) -> dict[str, str]:
    """Generate and compile px4_msgs as in a user's workspace; return the environment of a process that uses it."""
    source, build = folder / "source", folder / "build"
    (source / "msg").mkdir(parents=True)
    for message, text in MESSAGES.items():
        kinds = (field.split() for field in text.split(";"))
        lines = [f"{kind} {name}\n" for kind, *names in kinds for name in names]
        (source / "msg" / f"{message}.msg").write_text("".join(lines))
    files = " ".join(f'"msg/{message}.msg"' for message in MESSAGES)
    (source / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(px4_msgs)\nfind_package(ament_cmake REQUIRED)\n"
        "find_package(rosidl_default_generators REQUIRED)\n"
        f"rosidl_generate_interfaces(${{PROJECT_NAME}} {files})\n"
        # One compiler call for the C++ files of a target.
        "foreach(kind c cpp fastrtps_c fastrtps_cpp introspection_cpp)\n"
        "  set_target_properties(${PROJECT_NAME}__rosidl_typesupport_${kind} PROPERTIES UNITY_BUILD ON)\n"
        "endforeach()\nament_package()\n"
    )
    (source / "package.xml").write_text(
        '<package format="3"><name>px4_msgs</name><version>0.0.0</version><description>test</description>'
        '<maintainer email="a@example.com">a</maintainer><license>none</license>'
        "<buildtool_depend>rosidl_default_generators</buildtool_depend>"
        "<member_of_group>rosidl_interface_packages</member_of_group></package>"
    )
    environment = os.environ | {
        "AMENT_PREFIX_PATH": os.environ.get("AMENT_PREFIX_PATH", sys.prefix),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    include = f"-DCMAKE_PROJECT_INCLUDE={REPOSITORY / 'cmake' / 'ros_wheels.cmake'}"
    options = [f"-DPython3_EXECUTABLE={sys.executable}", include, "-DBUILD_TESTING=OFF"]
    # What Python needs; of the rest, only what these depend on.
    targets = ["px4_msgs_s__rosidl_typesupport_c", "px4_msgs__rosidl_typesupport_fastrtps_c"]
    for command in (
        ["cmake", "-S", str(source), "-B", str(build), *options],
        ["cmake", "--build", str(build), "--parallel", "2", "--target", *targets],
    ):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    found = {"PYTHONPATH": build / "rosidl_generator_py", "LD_LIBRARY_PATH": build}
    return {name: f"{path}:{os.environ.get(name, '')}".rstrip(":") for name, path in found.items()}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return build_messages(tmp_path_factory.mktemp("px4"))


@pytest.fixture
def px4_msgs(built: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Use a message package that has the name and the fields of px4_msgs."""
    for name, value in built.items():
        monkeypatch.setenv(name, value)


def messages_of(receiver: Process) -> list[dict[str, Any]]:
    return [json.loads(line) for line in receiver.output.splitlines() if line.startswith("{")]


def pose(seconds: float, x: float, variance: float = 0.04) -> PoseWithCovarianceStamped:
    covariance = [0.0] * 36
    covariance[0], covariance[7], covariance[14], covariance[35] = variance, 0.09, 0.25, 1e6
    pose_enu = Pose(position=Point(x=x, y=2.0, z=0.5))
    return PoseWithCovarianceStamped(
        header=header_at(round(seconds * 1e9), "map"),
        pose=PoseWithCovariance(pose=pose_enu, covariance=covariance),
    )


@pytest.mark.slow
def test_positions_are_sent_in_ned_without_orientation_and_velocity(ros: Ros, px4_msgs: None):
    node, receiver = ros.start("px4"), ros.run([sys.executable, "-c", RECEIVER])
    publisher = ros.node.create_publisher(PoseWithCovarianceStamped, "/uwb/pose", 10)
    ros.wait_for_subscribers("/uwb/pose", 1)
    ros.wait_for_subscribers("/fmu/in/vehicle_visual_odometry", 1)
    stamps = itertools.count(100, 10)

    def arrived(stamp: float) -> bool:
        return f'"timestamp_sample": {stamp * 1e6:.0f}' in receiver.output

    def any_arrived() -> bool:
        # Positions before the two have found each other are lost.
        publisher.publish(pose(next(stamps), 1.0))
        ros.spin_for(0.2)
        return "timestamp_sample" in receiver.output

    ros.spin_until(any_arrived)
    start = next(stamps) - 10.0
    ros.spin_until(lambda: arrived(start))
    publisher.publish(pose(start + 0.05, 1.1))
    ros.spin_until(lambda: arrived(start + 0.05))
    # Repeated and negative stamps, positions that are not finite, and variances that are not positive are not sent.
    # The queue of the node is not longer.
    for seconds, x, variance in (
        (0.05, 9.9, 0.04),
        *((0.1, x, 0.04) for x in (math.nan, 1e39)),
        *((0.1, 1.2, variance) for variance in (0.0, -0.01, math.nan, math.inf)),
        (-2.0 * start, 1.2, 0.04),
        (3.0, 5.0, 0.04),
        (-9.0, 4.0, 0.04),
    ):
        publisher.publish(pose(start + seconds, x, variance))
    ros.spin_until(lambda: arrived(start - 9.0))
    first, second, third, again = messages_of(receiver)[-4:]
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


ZURICH = (47.397742, 8.545594, 488.0)
ANCHORS = {0x022E: (0.0, 0.0, 2.0), 0x9280: (8.0, 0.0, 2.0), 0xDCAE: (8.0, 6.0, 2.0), 0x5431: (0.0, 6.0, 2.0)}
MIN_INTERVAL_US = 10_600
"""EKF2's smallest interval between stamps: EKF2_DELAY_MAX of 200 ms in 19 intervals (setRangingBeaconData)."""


def ecef(latitude: float, longitude: float, height: float) -> np.ndarray:
    """Return a position as EKF2 computes it from latitude, longitude and altitude (LatLonAlt::toEcef)."""
    phi, la = math.radians(latitude), math.radians(longitude)
    normal = 6378137.0 / math.sqrt(1 - 6.69437999014e-3 * math.sin(phi) ** 2)
    across = (normal + height) * math.cos(phi)
    z = (normal * (1 - 6.69437999014e-3) + height) * math.sin(phi)
    return np.array([across * math.cos(la), across * math.sin(la), z])


@pytest.mark.parametrize(
    "origin", [ZURICH, (-33.9, 151.2, -20.0), (0.0, -179.9999, 0.0), (78.2, 15.6, 8000.0)]
)
def test_positions_of_anchors_keep_their_distances_on_the_ellipsoid(origin: tuple[float, float, float]):
    local = np.random.default_rng(1).uniform(-1000, 1000, (50, 3))
    placed = np.array([ecef(*row) for row in to_geodetic(local, origin)])
    for place, reference in ((ecef(*origin), np.zeros(3)), (placed[0], local[0])):
        distances_m = np.linalg.norm(local - reference, axis=1)
        assert np.linalg.norm(placed - place, axis=1) == pytest.approx(distances_m, abs=1e-5)
    (north, east, up) = to_geodetic([[0, 10, 0], [10, 0, 0], [0, 0, 10]], origin) - np.array(origin)
    assert north[0] > 8e-5
    assert abs(north[1]) < 1e-9
    assert (east[1] % 360) > 8e-5
    assert up[2] == pytest.approx(10)


@pytest.mark.parametrize("text", ["", "1,2", "91,0,0", "nan,0,0", "1,2,x", "1,2,3,4"])
def test_invalid_origins_are_refused(text: str):
    with pytest.raises(ParameterError, match="LATITUDE,LONGITUDE,ALTITUDE"):
        parse_origin(text)


@pytest.mark.slow
@pytest.mark.parametrize("has_origin", [True, False])
def test_ranges_are_sent_as_ekf2_accepts_them(ros: Ros, px4_msgs: None, tmp_path: Path, has_origin: bool):
    path = tmp_path / "anchors.yaml"
    path.write_text(dump_anchors(AnchorMap([Anchor(key, place, 0.03) for key, place in ANCHORS.items()])))
    # Best-effort messages can be lost under load.
    reliable = "qos_overrides./uwb/range_corrected.subscription.reliability:=reliable"
    options = ["mode:=ranges", f"anchors:={path}", reliable]
    options += [f"origin:={','.join(map(str, ZURICH))}"] if has_origin else []
    node, receiver = ros.start("px4", *options), ros.run([sys.executable, "-c", RECEIVER])
    publisher = ros.node.create_publisher(RangeCorrected, "/uwb/range_corrected", 100)
    ros.wait_for_subscribers("/uwb/range_corrected", 1)
    ros.wait_for_subscribers("/fmu/in/ranging_beacon", 1)
    if not has_origin:
        ros.diagnosis("px4", lambda status: "the origin of PX4 is unknown" in status.message)
        ros.run([sys.executable, "-c", LOCAL_PUBLISHER])
    tag, rounds = (3.0, 2.0, 0.4), itertools.count(100)

    def send_round() -> None:
        """Publish ranges of four anchors with the same stamp, as a DWM1001 with PANS, and invalid ones."""
        number, before = next(rounds), len(received())
        for anchor, place in [*ANCHORS.items(), (7, (0, 0, 0))]:
            true_m = math.dist(tag, place)
            for range_m, variance, later_s in (
                *((range_m, 0.01, 0) for range_m in (math.nan, -1.0)),
                *((1.0, *invalid) for invalid in ((math.inf, 0), (0.01, -1000), (0.01, 2**31 - 1000))),
                (true_m, 0.01, 0),
            ):
                header = header_at(number * 10**8 + later_s * 10**9, "uwb")
                fields = {"header": header, "tag_id": 1, "anchor_id": anchor}
                fields |= {"sequence": number, "range": range_m, "variance": variance}
                publisher.publish(RangeCorrected(**fields))
        # Rounds that wait for a busy node would change the variances.
        if before:
            ros.spin_until(lambda: len(received()) > before)
        ros.spin_for(0.1)

    def received() -> list[dict[str, float]]:
        return [message for message in messages_of(receiver) if "beacon_id" in message]

    ros.spin_until(lambda: send_round() or len(received()) > 40)
    messages = received()
    vehicle = ecef(*to_geodetic([tag], ZURICH)[0])
    stamps = [message["timestamp_sample"] for message in messages]
    assert min(np.diff(stamps)) >= MIN_INTERVAL_US
    assert max(stamp % 100_000 for stamp in stamps) <= 60_000
    assert {message["beacon_id"] for message in messages} == {1, 2, 3, 4}, "ids above 255 are numbered"
    for message in messages:
        assert message["alt_type"] == 1
        beacon = ecef(message["lat"], message["lon"], message["alt"])
        assert math.dist(beacon, vehicle) == pytest.approx(message["range"], abs=1e-3)
    # Ten correlated ranges a second from each anchor: each has ten times the variance.
    assert {round(message["range_accuracy"] ** 2, 4) for message in messages[8:]} <= {0.1, 0.05}
    status = ros.diagnosis("px4", lambda status: "anchors that are not in the file: 7" in status.message)
    reasons = px4.NO_RANGE, px4.NO_VARIANCE, px4.FUTURE, px4.UNKNOWN_ANCHOR, px4.LATE
    assert min(int(diagnostic_values(status)[f"ranges {reason}"]) for reason in reasons) > 10
    # EKF2 uses no smaller standard deviation.
    header, before = header_at(next(rounds) * 10**9), len(received())
    fields = {"tag_id": 1, "anchor_id": 0x022E, "range": 1.0, "variance": 1e-6}
    publisher.publish(RangeCorrected(header=header, **fields))
    ros.spin_until(lambda: len(received()) > before)
    assert received()[-1]["range_accuracy"] == pytest.approx(0.1)
    # Which of two tags is on the vehicle is not known.
    publisher.publish(RangeCorrected(tag_id=9))
    ros.diagnosis("px4", lambda status: "set parameter tag to that of the vehicle (1, 9)" in status.message)
    before = len(received())
    for _ in range(5):
        publisher.publish(RangeCorrected(tag_id=1, anchor_id=0x022E, range=1.0, variance=0.1))
        ros.spin_for(0.1)
    assert len(received()) == before
    assert node.signal(signal.SIGINT) == 0, node.output


def test_invalid_settings_of_ranges_are_named(ros: Ros, px4_msgs: None):
    ros.start("px4", "mode:=ranges").wait_for_output("parameter anchors is empty")
    ros.start("px4", "mode:=range").wait_for_output("mode = 'range'")
