"""Driver and mitigator as real processes over real DDS, and in one process without a CIR on a topic."""

import math
import re
import shutil
import signal
import sys
from array import array
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import write_records

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from rclpy.serialization import deserialize_message
from ros_harness import PAUSED, Ros
from sensor_msgs.msg import Range
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected, RangeTruth

from uwb_mitigation.errors import DamagedRecordingError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import Session, load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.nodes import mitigator as mitigator_node
from uwb_mitigation.nodes.support.lifecycle import DUPLICATE_NAME_DELAY_S
from uwb_mitigation.nodes.support.parameter_tables import CRASHED, DAMAGED, REFUSED
from uwb_mitigation.recordings.decaranging import open_decaranging
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import Record, Status
from uwb_mitigation.types.ros.codec import encode_range

pytestmark = pytest.mark.ros

RAW = "/uwb/range_raw"
CORRECTED = "/uwb/range_corrected"


@pytest.fixture(scope="session")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of 300 simulated ranges at 40 Hz."""
    source = SimulatedSource(seed=3, count=300, rate_hz=40.0)
    return write_records(tmp_path_factory.mktemp("bag") / "simulated.mcap", source, source=source.name)


def replay_through_both(ros: Ros, count: int, *driver: str) -> tuple[list[RangeCir], list[RangeCorrected]]:
    """Replay through driver and mitigator; return raw and corrected ranges."""
    raw, corrected = ros.collect(RangeCir, RAW), ros.collect(RangeCorrected, CORRECTED)
    ros.start("mitigator").wait_for_output("correcting with model")
    publisher = ros.node.create_publisher(RangeCir, RAW, 10)
    ros.find_each_other(publisher, good_message(), corrected)
    ros.node.destroy_publisher(publisher)
    raw.clear()
    replay = ros.start("driver", "wait_for_subscribers:=2", *driver)
    assert replay.wait() == 0, replay.output
    ros.spin_until(lambda: len(corrected) >= count <= len(raw))
    return raw, corrected


def test_subscriber_receives_every_corrected_range_of_a_bag_and_its_truth(ros: Ros, bag: Path):
    truths = ros.collect(RangeTruth, "/uwb/range_truth")
    raw, corrected = replay_through_both(ros, 300, "source:=mcap", f"path:={bag}", "rate:=10.0")
    assert len(corrected) == 300
    sent = [(m.header, m.sequence, m.anchor_id, m.tag_id, m.range) for m in raw]
    assert [(m.header, m.sequence, m.anchor_id, m.tag_id, m.range_raw) for m in corrected] == sent
    ros.spin_until(lambda: len(truths) == 300)
    assert [t.header for t in truths] == [m.header for m in raw]
    assert all(t.range > 0 for t in truths)


def test_nodes_equal_the_library_on_a_real_log(ros: Ros, apartment: Path):
    log = apartment / "logs" / "19.log.xz"
    mitigation = Mitigation(load_bundle(default_model_path()), median_at_rest=True)
    with open_decaranging(log) as source:
        expected = mitigation.correct([record.measurement for record in source])
    given = ("source:=decaranging", f"path:={log}", "rate:=200.0")
    _, corrected = replay_through_both(ros, len(expected), *given)
    assert [m.range for m in corrected] == [np.float32(item.range_m) for item in expected]
    assert [m.variance for m in corrected] == [np.float32(item.variance_m2) for item in expected]
    assert [m.status for m in corrected] == [int(item.status) for item in expected]
    assert {m.model_id for m in corrected} == {mitigation.bundle.model_id}


def test_only_errors_of_ros_and_the_system_at_the_start_are_crashes_and_no_empty_bag_remains(
    ros: Ros, tmp_path: Path
):
    program = (
        "import sys\n"
        "from unittest import mock\n"
        "from rclpy.impl.implementation_singleton import rclpy_implementation as rcl\n"
        "from uwb_mitigation.nodes.support import spinning\n"
        "for step, error in (\n"
        "    ('driver.Driver.__init__', RuntimeError), ('driver.Driver.create_lifecycle_publisher', rcl.RCLError),\n"
        "    ('feeds.publishing.prepare_encoders', OSError), ('feeds.publishing.prepare_encoders', RuntimeError),\n"
        "):\n"
        "    failing = error(f'{step} fails')\n"
        "    try:\n"
        "        with mock.patch(f'uwb_mitigation.nodes.{step}', side_effect=failing):\n"
        "            spinning.run_node('driver')\n"
        "    except SystemExit as end:\n"
        "        print(f'{step} fails, exit code {end.code}', file=sys.stderr)\n"
    )
    driver = ros.run([sys.executable, "-c", program, "--ros-args", "-p", f"record:={tmp_path}/live.mcap"])
    assert driver.wait() == 0
    assert re.findall(r"fails, exit code (\d+)", driver.output) == list(map(str, [CRASHED] * 3 + [REFUSED]))
    for step in ("__init__", "create_lifecycle_publisher", "prepare_encoders"):
        assert f"{step} fails\n" in driver.output
    assert not list(tmp_path.glob("live*"))


def test_damaged_bag_is_replayed_up_to_the_damage(ros: Ros, bag: Path, tmp_path: Path):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(bag.read_bytes()[: bag.stat().st_size * 9 // 10])
    records: list[Record] = []
    with open_recording(torn) as source, pytest.raises(DamagedRecordingError):
        records.extend(source)
    assert 0 < len(records) < 300
    received = ros.collect(RangeCir, RAW)
    driver = ros.start("driver", "source:=mcap", f"path:={torn}", "rate:=20.0", "start_delay:=0.5")
    assert driver.wait() == DAMAGED
    ros.spin_until(lambda: len(received) == len(records))
    assert "torn.mcap" in driver.output


def test_mitigator_without_a_usable_model_stays_inactive_until_it_is_fixed(ros: Ros, tmp_path: Path):
    model = tmp_path / "model.onnx"
    model.write_bytes(default_model_path().read_bytes()[:-100])
    mitigator = ros.start("mitigator", f"model:={model}")
    status = ros.diagnosis("mitigator", lambda status: status.level == DiagnosticStatus.ERROR)
    assert str(model) in status.message
    assert ros.state_of("mitigator") == "inactive"
    shutil.copy(default_model_path(), model)
    assert ros.change_state("mitigator", Transition.TRANSITION_ACTIVATE)
    assert ros.state_of("mitigator") == "active"
    assert mitigator.exit_code() is None


def good_message() -> RangeCir:
    record = next(iter(SimulatedSource(seed=5, count=1)))
    measurement = replace(record.measurement, stamp_ns=1_500_000_000, frame_id="antenna")
    return deserialize_message(encode_range(measurement), RangeCir)


def test_ranges_that_cannot_be_corrected_pass_through_also_as_sensor_msgs(ros: Ros):
    changes = (
        ({"samples": array("h")}, Status.NO_CIR),
        ({"encoding": 9}, Status.NO_CIR),
        ({"scale": math.inf}, Status.BAD_CIR),
        ({"range": math.nan}, Status.OUT_OF_DISTRIBUTION),
    )
    mitigator = ros.start("mitigator", "sensor_ranges:=true")
    publisher = ros.node.create_publisher(RangeCir, RAW, 10)
    corrected = ros.collect(RangeCorrected, CORRECTED)
    plain = ros.collect(Range, f"{CORRECTED}/anchor_{good_message().anchor_id}")

    def heard() -> bool:
        publisher.publish(good_message())
        return len(plain) > 0 and len(corrected) > 0

    ros.spin_until(heard)
    assert (plain[-1].range, plain[-1].variance) == (corrected[-1].range, corrected[-1].variance)
    assert plain[-1].header == corrected[-1].header
    ros.find_each_other(publisher, good_message(), corrected)
    for change, status in changes:
        message = good_message()
        for name, value in change.items():
            setattr(message.cir if hasattr(message.cir, name) else message, name, value)
        corrected.clear()
        publisher.publish(message)
        ros.spin_until(lambda: len(corrected) == 1)
        (answer,) = corrected
        assert (answer.status, answer.correction) == (status, 0.0)
        assert np.array_equal([answer.range, answer.range_raw], [message.range] * 2, equal_nan=True)
        assert math.isinf(answer.variance) == math.isnan(message.range)
    ros.spin_until(lambda: plain[-1].range == math.inf)
    assert plain[-1].variance == math.inf
    mitigator.wait_for_output("ranges with status BAD_CIR: a sample or the scale of the CIR is NaN")


def test_another_node_of_the_same_name_is_reported_but_not_one_that_may_have_been_killed(
    ros: Ros, tmp_path: Path
):
    is_later = tmp_path / "later"
    program = (
        "import os, time, types\n"
        "from uwb_mitigation.nodes.support import lifecycle, spinning\n"
        f"clock = {{'monotonic': lambda: {DUPLICATE_NAME_DELAY_S} * os.path.exists('{is_later}')}}\n"
        "lifecycle.time = types.SimpleNamespace(**vars(time) | clock)\n"
        "spinning.run_node('mitigator')\n"
    )
    name = ("-r", "__ns:=/left")
    ros.run([sys.executable, "-c", program, "--ros-args", *name])
    other = ros.start("mitigator", arguments=name)
    ros.spin_until(lambda: ros.node.get_node_names_and_namespaces().count(("mitigator", "/left")) == 2)
    arrays = ros.collect(DiagnosticArray, "/diagnostics")
    ros.spin_until(lambda: len(arrays) >= 6)
    warning = "another node has the name /left/mitigator"
    assert not any(warning in status.message for array in arrays for status in array.status)
    is_later.touch()
    ros.diagnosis("left/mitigator", lambda status: warning in status.message)
    assert other.signal(signal.SIGINT) == 0
    ros.diagnosis("left/mitigator", lambda status: warning not in status.message)


PLAY = ("count:=200", "seed:=1", "simulated_rate:=400.0", *PAUSED)


def test_pipelines_in_two_namespaces_give_the_ranges_of_the_library_to_the_bit(ros: Ros):
    mitigation = Mitigation(load_bundle(default_model_path()))
    source = SimulatedSource(seed=1, count=200, rate_hz=400.0)
    expected = [mitigation.correct([record.measurement])[0] for record in source]
    received = {name: ros.collect(RangeCorrected, f"/{name}{CORRECTED}") for name in ("left", "right")}
    pipelines = [ros.start("pipeline", *PLAY, arguments=("-r", f"__ns:=/{name}")) for name in received]
    for name in received:
        ros.play(f"{name}/driver")
    for pipeline in pipelines:
        assert pipeline.wait() == 0, pipeline.output
        assert "unknown" not in pipeline.output
    ros.spin_until(lambda: all(len(messages) == 200 for messages in received.values()))
    for messages in received.values():
        assert [m.sequence for m in messages] == list(range(200))
        assert [m.range for m in messages] == [np.float32(e.range_m) for e in expected]
        assert [m.variance for m in messages] == [np.float32(e.variance_m2) for e in expected]


@pytest.mark.parametrize("model", ["universal", "universal_amplitude", "evk1000_apartment", "dw3000_sts"])
def test_network_runs_before_the_mitigator_is_active(model: str, monkeypatch: pytest.MonkeyPatch):
    batches: list[int] = []
    predict_m = Session.predict_m
    monkeypatch.setattr(
        Session, "predict_m", lambda self, windows: batches.append(len(windows)) or predict_m(self, windows)
    )
    mitigator_node.load_corrector(model)
    assert {1, mitigator_node.BATCH} <= set(batches)
