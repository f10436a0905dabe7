"""The node `px4` in this process: its messages must have the fields and types of px4_msgs."""

from __future__ import annotations

import math
import struct
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseWithCovariance, PoseWithCovarianceStamped
from ros_harness import Ros
from std_msgs.msg import Header
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.nodes import px4
from uwb_mitigation.nodes.px4 import Px4
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

CODES = {"bool": "?", "int8": "b", "uint8": "B", "uint16": "H", "uint32": "I", "uint64": "Q", "float32": "f", "float64": "d"}  # fmt: skip


def message_class(text: str) -> type:
    """Return a class with the fields and constants of a message, which refuses values of other types and sizes."""
    constants: dict[str, int] = {}
    codes: dict[str, str] = {}
    for kind, *names in (field.split() for field in text.split(";")):
        element, _, size = kind.rstrip("]").partition("[")
        codes |= {name: size + CODES[element] for name in names if "=" not in name}
        constants |= {name: int(value) for name, _, value in (n.partition("=") for n in names) if value}

    def check(message: object, **values: Any) -> None:
        for name, value in values.items():
            struct.pack(codes[name], *np.atleast_1d(value).tolist())
            setattr(message, name, value)

    return type("Message", (), constants | dict.fromkeys(codes, 0) | {"__init__": check})


Start = Callable[..., tuple[Px4, list[Any]]]


@pytest.fixture
def start(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Return a function that starts the node with parameters, and returns it with the messages that it will send."""
    messages = SimpleNamespace(**{name: message_class(text) for name, text in MESSAGES.items()})
    monkeypatch.setitem(sys.modules, "px4_msgs", SimpleNamespace(msg=messages))
    monkeypatch.setitem(sys.modules, "px4_msgs.msg", messages)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros.domain))
    sent: list[Any] = []

    def endpoint(node: Px4, kind: type, topic: str, *_: object) -> SimpleNamespace:
        vars(node).setdefault("topics", []).append(topic)
        return SimpleNamespace(publish=sent.append, topic_name=topic)

    monkeypatch.setattr(Px4, "publisher", endpoint)
    monkeypatch.setattr(Px4, "subscription", endpoint)
    nodes: list[Px4] = []

    def start(*parameters: str) -> tuple[Px4, list[Any]]:
        options = [word for parameter in parameters for word in ("-p", parameter)]
        rclpy.init(args=["--ros-args", *options])
        nodes.append(Px4())
        return nodes[0], sent

    yield start
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


def stamp(seconds: float) -> Time:
    return Time(sec=math.floor(seconds), nanosec=round(seconds % 1 * 1e9))


def pose(seconds: float, x: float, variance: float = 0.04) -> PoseWithCovarianceStamped:
    covariance = [0.0] * 36
    covariance[0], covariance[7], covariance[14], covariance[35] = variance, 0.09, 0.25, 1e6
    enu = PoseWithCovariance(pose=Pose(position=Point(x=x, y=2.0, z=0.5)), covariance=covariance)
    return PoseWithCovarianceStamped(header=Header(frame_id="map", stamp=stamp(seconds)), pose=enu)


def test_positions_are_sent_in_ned_without_orientation_and_velocity(start: Start):
    node, sent = start()
    # Repeated and negative stamps, positions that are not finite, and variances that are not positive are not sent.
    for seconds, x, variance in (
        *((100.0, 1.0, 0.04), (100.05, 1.1, 0.04), (100.05, 9.9, 0.04)),
        *((100.1, x, 0.04) for x in (math.nan, 1e39)),
        *((100.1, 1.2, variance) for variance in (0.0, -0.01, math.nan, math.inf)),
        *((-100.0, 1.2, 0.04), (103.0, 5.0, 0.04), (91.0, 4.0, 0.04)),
    ):
        node._on_pose(pose(seconds, x, variance))
    assert node.topics == ["/fmu/in/vehicle_visual_odometry", "uwb/pose"]
    first, second, third, again = sent
    assert first.timestamp_sample == 100_000_000
    assert first.timestamp > 1_700_000_000_000_000
    assert (first.pose_frame, first.position) == (1, [2.0, 1.0, -0.5])
    assert first.position_variance == pytest.approx([0.09, 0.04, 0.25])
    for name in ("q", "velocity", "angular_velocity", "orientation_variance", "velocity_variance"):
        assert all(map(math.isnan, getattr(first, name))), name
    # Twenty correlated positions a second: each has twenty times the variance.
    assert second.position_variance == pytest.approx([1.8, 0.8, 5.0])
    assert third.position == [2.0, 5.0, -0.5]
    assert third.position_variance == pytest.approx([0.09, 0.04, 0.25])
    assert again.position == [2.0, 4.0, -0.5], "a replay starts again"
    assert [message.reset_counter for message in sent] == [0, 0, 1, 2]
    assert node.describe()[2] == "sending"


@pytest.mark.skipif(find_spec("px4_msgs") is not None, reason="px4_msgs is installed")
def test_missing_px4_msgs_is_a_one_line_error(ros: Ros):
    node = ros.start("px4")
    assert node.wait() == 1
    assert node.output.startswith("error: px4_msgs is not installed (build the branch of")


# Ranges ----------------------------------------------------------------------------------------------------------

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


def corrected(seconds: float = 100.0, **fields: Any) -> RangeCorrected:
    fields = {"tag_id": 1, "anchor_id": 0x022E, "range": 1.0, "variance": 0.01} | fields
    return RangeCorrected(header=Header(stamp=stamp(seconds)), **fields)


@pytest.mark.parametrize("has_origin", [True, False])
def test_ranges_are_sent_as_ekf2_accepts_them(start: Start, anchors: Path, has_origin: bool):
    anchors.write_text(dump_anchors(AnchorMap([Anchor(key, place, 0.03) for key, place in ANCHORS.items()])))
    origin = [f"origin:={','.join(map(str, ZURICH))}"] if has_origin else []
    node, sent = start("mode:=ranges", f"anchors:={anchors}", *origin)
    if not has_origin:
        assert node.topics[0].endswith("fmu/out/vehicle_local_position_v1")
        node._on_range(corrected())
        node._send_range()
        assert "the origin of PX4 is unknown" in node.describe()[2]
        latitude, longitude, altitude = ZURICH
        fields = {"ref_lat": latitude, "ref_lon": longitude, "ref_alt": altitude}
        node._on_local_position(SimpleNamespace(xy_global=True, z_global=True, **fields))
        node._waiting.clear()
    tag = (3.0, 2.0, 0.4)
    for number in range(1000, 1012):
        # Ranges of four anchors with the same stamp, as a DWM1001 with PANS, ten times a second.
        node.now_ns = lambda number=number: number * 10**8
        for anchor, place in ANCHORS.items():
            fields = {"anchor_id": anchor, "range": math.dist(tag, place), "sequence": number}
            node._on_range(corrected(number / 10, **fields))
        for _ in range(6):
            node._send_range()
    assert node.topics[-2:] == ["/fmu/in/ranging_beacon", "uwb/range_corrected"]
    vehicle = ecef(*to_geodetic([tag], ZURICH)[0])
    stamps = [message.timestamp_sample for message in sent]
    assert len(stamps) == 48
    assert min(np.diff(stamps)) >= MIN_INTERVAL_US
    assert max(stamp % 100_000 for stamp in stamps) <= 60_000
    assert {message.beacon_id for message in sent} == {1, 2, 3, 4}, "ids above 255 are numbered"
    for message in sent:
        assert message.alt_type == 1
        beacon = ecef(message.lat, message.lon, message.alt)
        assert math.dist(beacon, vehicle) == pytest.approx(message.range, abs=1e-3)
    # Ten correlated ranges a second from each anchor: each has ten times the variance.
    assert {round(message.range_accuracy**2, 4) for message in sent[4:]} == {0.1}
    node._on_range(corrected(anchor_id=7))
    assert "anchors that are not in the file: 7" in node.describe()[2]
    node.now_ns = lambda: 200 * 10**9
    node._on_range(corrected(200.0, variance=1e-6))
    node._send_range()
    assert sent[-1].range_accuracy == pytest.approx(0.1), "EKF2 uses no smaller standard deviation"
    # Which of two tags is on the vehicle is not known.
    for tag_id in (9, 1):
        node._on_range(corrected(200.0, tag_id=tag_id))
    node._send_range()
    assert len(sent) == 49
    assert "set parameter tag to that of the vehicle (1, 9)" in node.describe()[2]


@pytest.mark.parametrize(
    ("changes", "reason", "is_late"),
    [
        ({}, "", False),
        ({"anchor_id": 7}, px4.UNKNOWN_ANCHOR, False),
        ({"range": math.nan}, px4.NO_RANGE, False),
        ({"age_s": 200.0}, px4.NO_RANGE, False),
        ({"variance": math.inf}, px4.NO_VARIANCE, False),
        ({"age_s": -0.1}, px4.FUTURE, False),
        ({"age_s": 0.4}, "", True),
    ],
)
def test_each_range_that_ekf2_cannot_use_has_a_reason(changes: dict[str, float], reason: str, is_late: bool):
    anchors = AnchorMap([Anchor(key, place) for key, place in ANCHORS.items()])
    node = SimpleNamespace(_anchors=anchors, _unknown=set(), _counts=Counter(), now_ns=lambda: 100 * 10**9)
    fields = {"age_s": 0.1} | changes
    stamp_ns = 100 * 10**9 - round(fields.pop("age_s") * 1e9)
    assert Px4._reason_to_drop(node, corrected(**fields), stamp_ns) == reason
    assert node._counts == (Counter({px4.LATE: 1}) if is_late else Counter())
    assert node._unknown == {fields["anchor_id"]} if reason == px4.UNKNOWN_ANCHOR else not node._unknown


def test_missing_anchors_are_named(start: Start):
    node, _ = start("mode:=ranges", "autostart:=false")
    with pytest.raises(ParameterError, match="parameter anchors is empty"):
        node.open()
