"""Ranges on topics of other software: driver and locator over real DDS, and the shipped mappings for messages."""

import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from geometry_msgs.msg import Point, Pose, PoseArray, PoseWithCovarianceStamped, Vector3
from rclpy.qos import QoSProfile
from ros_harness import Ros, diagnostic_values
from sensor_msgs.msg import Range
from std_msgs.msg import String
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected
from visualization_msgs.msg import Marker, MarkerArray

from uwb_mitigation.errors import MissingDependencyError, ParameterError
from uwb_mitigation.nodes.feeds.topic import TopicFeed
from uwb_mitigation.nodes.markers import ANCHOR_TYPES, anchors_in
from uwb_mitigation.nodes.support.endpoints import LATCHED, message_type
from uwb_mitigation.recordings.mapping.mapping import FieldRule, Mapping, RowFilter, load_mapping
from uwb_mitigation.types.anchors import Anchor, AnchorMap, dump_anchors
from uwb_mitigation.types.measurement import RangeMeasurement

CORNERS = {0: (0.0, 0.0, 2.0), 1: (8.0, 0.0, 2.0), 2: (8.0, 6.0, 2.0), 3: (0.0, 6.0, 2.0)}
TAG = (3.0, 2.0, 0.4)
LEVEL = ("level:=true", f"height:={TAG[2]}")

MAPPING = """
name: markers of a site
type: visualization_msgs/msg/MarkerArray
topics: [/site/ranges]
fields:
  tag: {constant: 9}
  anchor: markers[].id
  range: markers[].scale.x
  rx_power: markers[].scale.y
  first_path_power: markers[].scale.z
drop:
  - {column: "markers[].scale.x", equals: 0}
"""


@pytest.fixture
def markers(tmp_path: Path) -> Path:
    """Return the file of a user's mapping for messages that contain an array of messages."""
    path = tmp_path / "markers.yaml"
    path.write_text(MAPPING)
    return path


def send_ranges(ros: Ros) -> None:
    """Publish ranges 20 times a second while the client spins."""
    publisher = ros.node.create_publisher(MarkerArray, "/site/ranges", 10)
    ranges_m = {number: math.dist(TAG, corner) for number, corner in CORNERS.items()} | {7: 0.0}
    shown = [Marker(id=n, scale=Vector3(x=range_m, y=-80.5, z=-85.0)) for n, range_m in ranges_m.items()]
    ros.node.create_timer(0.05, lambda: publisher.publish(MarkerArray(markers=shown)))


def has_position(poses: list[PoseWithCovarianceStamped]) -> bool:
    point = poses[-1].pose.pose.position if poses else Point(x=math.nan)
    return math.dist((point.x, point.y), TAG[:2]) < 0.1


@pytest.mark.ros
def test_ranges_of_a_users_message_give_poses_and_pass_the_mitigator(ros: Ros, markers: Path, tmp_path: Path):
    anchors = tmp_path / "anchors.yaml"
    anchors.write_text(dump_anchors(AnchorMap([Anchor(key, place) for key, place in CORNERS.items()])))
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    corrected = ros.collect(RangeCorrected, "/uwb/range_corrected")
    ros.start("driver", "source:=topic", f"map:={markers}")
    ros.start("mitigator", "offsets:=0.25")
    ros.start("locator", "ranges:=uwb/range_raw", f"anchors:={anchors}", *LEVEL)
    send_ranges(ros)
    ros.spin_until(lambda: has_position(poses) and len(raw) > 40 and len(corrected) > 0)
    assert {(message.tag_id, message.anchor_id) for message in raw} == {(9, corner) for corner in CORNERS}
    measured = next(message for message in raw if message.anchor_id == 2)
    assert measured.range == pytest.approx(math.dist(TAG, CORNERS[2]), abs=1e-4)
    assert (measured.cir.rx_power, measured.cir.first_path_power) == pytest.approx((-80.5, -85.0))
    assert corrected[0].status == RangeCorrected.NO_CIR
    true_m = math.dist(TAG, CORNERS[corrected[0].anchor_id])
    assert corrected[0].range == pytest.approx(true_m - 0.25, abs=1e-4)


PLACES = [Pose(position=Point(x=x, y=y, z=z)) for x, y, z in CORNERS.values()]


@pytest.mark.ros
def test_locator_takes_a_mapping_with_its_range_sd_and_anchors_from_a_topic(ros: Ros, markers: Path):
    markers.write_text(f"{MAPPING}\nrange_sd: 1.0\n")
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    ros.start("locator", f"ranges:={markers}", "anchors:=poses:/site/anchors", *LEVEL)
    ros.node.create_publisher(PoseArray, "/site/anchors", LATCHED).publish(PoseArray(poses=PLACES))
    send_ranges(ros)
    ros.spin_until(lambda: has_position(poses) and len(poses) > 10)
    assert poses[10].pose.covariance[0] > 0.1, "0.02 with the default of 0.1 m"


def test_anchors_are_markers_or_poses():
    shown = [Marker(id=number, pose=place) for number, place in enumerate(PLACES)]
    for kind, fields in (("markers", {"markers": shown}), ("poses", {"poses": PLACES})):
        found = anchors_in(ANCHOR_TYPES[kind](**fields))
        assert {anchor.id: anchor.position for anchor in found.anchors} == CORNERS


@pytest.mark.ros
def test_driver_counts_messages_that_do_not_fit_and_goes_on(ros: Ros):
    received = ros.collect(RangeCir, "/uwb/range_raw")
    ros.start("driver", "source:=topic", "map:=string_json")
    sender = ros.node.create_publisher(String, "/uwb/json", QoSProfile(depth=100))
    texts = ["{", '{"tag": 7}', '{"tag": -1, "ranges": [{"anchor": 1, "range_m": 4.5}]}']
    texts.append('{"tag": 7, "ranges": [{"anchor": 1, "range_m": 4.5}, {"anchor": 2, "range_m": null}]}')
    texts.append('{"tag": 7, "ranges": [{"anchor": null, "range_m": 4.5}]}')

    def sent() -> bool:
        for text in texts:
            sender.publish(String(data=text))
        return len(received) > 2

    ros.spin_until(sent)
    assert {(message.tag_id, message.anchor_id, message.range) for message in received} == {(7, 1, 4.5)}

    for reason in ("range is not a number", "tag or anchor is unknown", "message that cannot be used"):
        ros.diagnosis("driver", lambda s, reason=reason: int(diagnostic_values(s).get(reason, 0)) > 2)


class Convert:
    """Passes messages of a shipped mapping to `TopicFeed` without DDS."""

    def __init__(self, mapping: str | Mapping) -> None:
        self.published: list[RangeMeasurement] = []
        node: Any = SimpleNamespace(get_logger=lambda: SimpleNamespace(warning=lambda *_, **__: None))
        used = load_mapping(mapping) if isinstance(mapping, str) else mapping
        self.ranges = TopicFeed(node, used, "", self.published.append, lambda: 5_000)

    def take(self, message: Any, topic: str = "/x") -> list[tuple[int, int, float]]:
        self.ranges.take(message, topic)
        return [(m.tag_id, m.anchor_id, round(m.range_m, 4)) for m in self.published]


@pytest.fixture
def types(monkeypatch: pytest.MonkeyPatch) -> None:
    for package, names in {
        "gtec_msgs": ("Ranging", "UWBRanging", "PozyxRangingWithCir"),
        "nlink_parser": ("LinktrackAnchorframe0", "LinktrackNodeframe3", "LinktrackTagframe0"),
    }.items():
        module = SimpleNamespace(**dict.fromkeys(names, SimpleNamespace))
        monkeypatch.setitem(sys.modules, package, module)
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)


def test_linktrack_frames(types: None):
    tagframe = SimpleNamespace(id=5, dis_arr=np.array([1.5, 0, 2.5, 0, 0, 0, 0, 0], np.float32))
    assert Convert("nlink_tagframe0").take(tagframe) == [(5, 0, 1.5), (5, 2, 2.5)]
    tags = [SimpleNamespace(id=number, dis_arr=tagframe.dis_arr) for number in (3, 4)]
    pairs = [(3, 0, 1.5), (3, 2, 2.5), (4, 0, 1.5), (4, 2, 2.5)]
    assert Convert("nlink_anchorframe0").take(SimpleNamespace(nodes=tags)) == pairs
    nodes = [SimpleNamespace(id=3, dis=4.25, rx_rssi=-80.0, fp_rssi=-82.0)]
    convert = Convert("nlink_nodeframe3")
    assert convert.take(SimpleNamespace(id=5, nodes=nodes)) == [(5, 3, 4.25)]
    assert convert.take(SimpleNamespace(id=5, nodes=[])) == [(5, 3, 4.25)]
    assert (convert.published[0].cir.first_path_power_dbm, convert.published[0].stamp_ns) == (-82.0, 5_000)


def test_gtec_messages(types: None):
    convert = Convert("gtec_ranging")
    message = SimpleNamespace(anchorId=2, tagId=7, range=4310, seq=12, rss=-81.5, errorEstimation=0.0)
    assert convert.take(message) == [(7, 2, 4.31)]
    assert (convert.published[0].sequence, convert.published[0].cir.rx_power_dbm) == (12, -81.5)
    convert = Convert("gtec_uwbranging")
    registers = {"firstPathAmp1": 4889, "firstPathAmp2": 13876, "firstPathAmp3": 10464, "maxGrowthCIR": 9048}
    registers |= {"firstPath": 749 * 64 + 32, "rxPreamCount": 1024, "channel": 5.0, "prf": 64}
    message = SimpleNamespace(anchorId=2, tagId=7, range=4310, seq=1, **registers)
    assert convert.take(message) == [(7, 2, 4.31)]
    cir = convert.published[0].cir
    assert (cir.first_path_index, cir.preamble_count, cir.channel) == (749.5, 1024, 5)
    assert cir.rx_power_dbm == pytest.approx(-91.2, abs=0.1)
    convert = Convert("gtec_pozyx_cir")
    fields = {"rxPower": -79.0, "channel": 5.0, "cir": np.array([1, -2, 3, 4], np.int16)}
    message = SimpleNamespace(originId=0x6A40, destinationId=0x6A41, range=2500, seq=1, **fields)
    assert convert.take(message) == [(0x6A40, 0x6A41, 2.5)]
    assert convert.published[0].cir.samples.tolist() == [1, -2, 3, 4]


def test_standard_messages():
    convert = Convert("sensor_range")
    message = Range(range=3.5)
    message.header.stamp.sec, message.header.stamp.nanosec = 17, 5
    assert convert.take(message, "/uwb/range_12") == [(1, 12, 3.5)]
    assert convert.published[0].stamp_ns == 17_000_000_005
    convert.take(Range(range=3.5), "/uwb/range_12")
    assert convert.published[1].stamp_ns == 5_000
    line = "AT+RANGE=tid:4,mask:05,seq:218,range:(72,0,131,0,0,0,0,0),rssi:(-77.60,0.00,-75.13,0.00,0.00,0.00,0.00,0.00)"
    convert = Convert("string_at")
    assert convert.take(String(data=line)) == [(4, 0, 0.72), (4, 2, 1.31)]
    assert [measured.cir.rx_power_dbm for measured in convert.published] == [-77.6, -75.13]
    # Newer firmware names the anchors.
    line = "AT+RANGE=tid:4,mask:03,seq:219,range:(90,210,0,0,0,0,0,0),ancid:(7,5,-1,-1,-1,-1,-1,-1)"
    assert convert.take(String(data=line))[-2:] == [(4, 7, 0.9), (4, 5, 2.1)]
    count = len(convert.published)
    for end in range(line.index(",ancid"), len(line)):
        assert len(convert.take(String(data=line[:end]))) == count, "a line that is cut"
    assert Convert("string_at").take(String(data="tid:4,seq:1,range:[110]")) == [(4, 0, 1.1)]
    message = String(data='{"tag": 1, "ranges": [{"anchor": 2, "range_m": 3}]}')
    assert Convert("string_json").take(message) == [(1, 2, 3.0)]


def test_types_and_mappings_that_cannot_be_used_are_errors():
    assert message_type("sensor_msgs/msg/Range") is Range
    with pytest.raises(MissingDependencyError, match="nowhere_msgs/msg/X is not installed"):
        message_type("nowhere_msgs/msg/X")
    with pytest.raises(ParameterError, match="PACKAGE/msg/NAME"):
        message_type("os; rm/x")
    with pytest.raises(ParameterError, match="eWINE is for recordings"):
        Convert("ewine")
    mapping = load_mapping("sensor_range")
    names = FieldRule(column="header.frame_id", names=True)
    with pytest.raises(ParameterError, match="numbers texts"):
        Convert(mapping.model_copy(update={"fields": mapping.fields.model_copy(update={"anchor": names})}))
    with pytest.raises(ParameterError, match="from_median"):
        Convert(mapping.model_copy(update={"drop": [RowFilter(column="range", from_median=1.0)]}))
