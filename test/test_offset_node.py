"""The mitigator's offsets, live: taken off, refused in words, and what the diagnostics make of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from model_material import measurement
from rclpy.serialization import deserialize_message
from ros_harness import Ros
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.bag.codec import encode_range
from uwb_mitigation.measurement import Status
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.shipped import default_model_path
from uwb_mitigation.nodes.health import FEWEST_DIRECT, OFFSET, MitigatorHealth
from uwb_mitigation.offsets import Offsets, read_offsets

pytestmark = pytest.mark.ros


def test_offsets_are_set_while_it_runs_and_nonsense_leaves_those_before(ros: Ros, tmp_path: Path):
    path = tmp_path / "offsets.yaml"
    path.write_text("pairs: [{anchor: 2, tag: 1, offset: 1.5}]")
    asked = measurement(5.0)
    host = Mitigation(load_bundle(default_model_path()))
    publisher = ros.node.create_publisher(RangeCir, "/uwb/range_raw", 10)
    corrected = ros.collect(RangeCorrected, "/uwb/range_corrected")
    ros.start("mitigator", "offsets:=0.25").wait_for_output("correcting with")
    ros.find_each_other(publisher, deserialize_message(encode_range(asked), RangeCir), corrected)

    def answer() -> RangeCorrected:
        corrected.clear()
        publisher.publish(deserialize_message(encode_range(asked), RangeCir))
        ros.spin_until(lambda: len(corrected) == 1)
        return corrected[0]

    def expected(offsets: Offsets) -> np.float32:
        host.offsets = offsets
        return np.float32(host.correct([asked])[0].range_m)

    assert answer().range == expected(Offsets(0.25))
    assert ros.set_parameter("mitigator", "offsets", str(path)).successful
    assert answer().range == expected(read_offsets(str(path)))
    for nonsense, said in (
        ("220", "millimetres"),
        (str(tmp_path / "no.yaml"), "no such file"),
        (True, "number of metres"),
    ):
        refused = ros.set_parameter("mitigator", "offsets", nonsense)
        assert not refused.successful
        assert said in refused.reason
    assert answer().range == expected(read_offsets(str(path)))
    assert ros.set_parameter("mitigator", "offsets", 0.5).successful
    last = answer()
    assert last.range == expected(Offsets(0.5))
    assert last.range_raw == np.float32(asked.range_m)


def test_a_model_that_holds_an_offset_is_warned_of_once_enough_ranges_show_it():
    health = MitigatorHealth()
    health.statuses[Status.OK] = FEWEST_DIRECT
    health.direct_m.extend([0.3] * (FEWEST_DIRECT - 1))
    health.predicts_excess_alone = True
    assert OFFSET.text not in health.period().warnings()
    health.direct_m.append(0.3)
    assert OFFSET.text in health.period().warnings()
    health.predicts_excess_alone = False
    assert OFFSET.text not in health.period().warnings()
    health.predicts_excess_alone = True
    health.direct_m.extend([-0.05] * 1000)
    assert OFFSET.text not in health.period().warnings()
