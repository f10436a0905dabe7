"""What a robot relies on: nodes that are killed and come back, models swapped live, diagnostics that are right."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from model_material import bundle
from ros_harness import Ros, domain
from rosgraph_msgs.msg import Clock
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.bag.codec import encode_range
from uwb_mitigation.bag.writer import BagWriter
from uwb_mitigation.measurement import Status
from uwb_mitigation.mitigation import Mitigation
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.model.shipped import default_model_path
from uwb_mitigation.nodes.diagnostics import Meter
from uwb_mitigation.nodes.health import (
    DROPPED,
    OUT_OF_DISTRIBUTION,
    SILENT,
    SLOW,
    THRESHOLDS,
    UNUSABLE,
    Health,
    Numbering,
)
from uwb_mitigation.sources.simulated import SimulatedSource

RAW = "/uwb/range_raw"
CORRECTED = "/uwb/range_corrected"
ENDLESS = ("simulated_rate:=100.0", "start_delay:=0.2")


@pytest.fixture
def ros(tmp_path: Path):
    with domain(tmp_path) as ros:
        yield ros


@pytest.mark.ros
def test_a_mitigator_that_is_killed_leaves_the_driver_running_and_another_joins(
    ros: Ros, record_property: pytest.FixtureRequest
):
    raw, corrected = ros.collect(RangeCir, RAW), ros.collect(RangeCorrected, CORRECTED)
    mitigator = ros.start("mitigator")
    driver = ros.start("driver", *ENDLESS)
    ros.spin_until(lambda: len(corrected) > 20)
    mitigator.send(signal.SIGKILL)
    mitigator.wait()
    ros.spin_for(0.3)
    raw.clear()
    corrected.clear()
    ros.spin_until(lambda: len(raw) > 20)
    assert corrected == []
    began_s = time.monotonic()
    ros.start("mitigator")
    ros.spin_until(lambda: len(corrected) > 0)
    record_property("joined_after_s", time.monotonic() - began_s)
    assert driver.exit_code() is None


@pytest.mark.ros
def test_a_driver_that_is_killed_leaves_the_mitigator_running_and_another_joins(
    ros: Ros, record_property: pytest.FixtureRequest
):
    corrected = ros.collect(RangeCorrected, CORRECTED)
    mitigator = ros.start("mitigator")
    driver = ros.start("driver", *ENDLESS)
    ros.spin_until(lambda: len(corrected) > 20)
    driver.send(signal.SIGKILL)
    driver.wait()
    ros.spin_for(0.3)
    corrected.clear()
    began_s = time.monotonic()
    ros.start("driver", "simulated_rate:=100.0", "start_delay:=0.0")
    ros.spin_until(lambda: len(corrected) > 20)
    record_property("joined_after_s", time.monotonic() - began_s)
    assert mitigator.exit_code() is None


@pytest.mark.ros
def test_ranges_that_queue_up_are_all_corrected_in_order_and_to_the_bit(ros: Ros):
    mitigation = Mitigation(load_bundle(default_model_path()))
    measurements = [record.measurement for record in SimulatedSource(seed=2, count=300)]
    corrected = ros.collect(RangeCorrected, CORRECTED)
    mitigator = ros.start("mitigator")
    publisher = ros.node.create_publisher(RangeCir, RAW, 1000)
    ros.wait_for_publishers(CORRECTED, 1)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    ros.spin_for(0.5)
    # Stopped meanwhile, it finds all of them in its queue.
    mitigator.send(signal.SIGSTOP)
    for measurement in measurements:
        publisher.publish(encode_range(measurement))
    mitigator.send(signal.SIGCONT)
    ros.spin_until(lambda: len(corrected) == len(measurements))
    assert [m.sequence for m in corrected] == [m.sequence for m in measurements]
    expected = [np.float32(mitigation.correct(m).range_m) for m in measurements]
    assert np.array_equal([m.range for m in corrected], expected, equal_nan=True)


@pytest.mark.ros
def test_what_a_queue_has_dropped_is_told(ros: Ros):
    measurement = next(iter(SimulatedSource(seed=2)))
    data = encode_range(measurement.measurement)
    ros.start("mitigator", "qos_overrides./uwb/range_raw.subscription.depth:=10").wait_for_output(
        "correcting"
    )
    publisher = ros.node.create_publisher(RangeCir, RAW, 10)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    ros.spin_for(0.5)

    def told(status: DiagnosticStatus) -> bool:
        # More at once than the queue holds.
        for _ in range(300):
            publisher.publish(data)
        return status.message == DROPPED.text

    status = ros.diagnosis("mitigator", told)
    assert status.level == DiagnosticStatus.WARN


@pytest.mark.ros
def test_a_model_is_swapped_live_without_losing_a_range_and_a_bad_one_is_refused(ros: Ros, tmp_path: Path):
    shipped = load_bundle(default_model_path())
    other = bundle(tmp_path)
    torn = tmp_path / "torn.onnx"
    torn.write_bytes(default_model_path().read_bytes()[:-100])
    corrected = ros.collect(RangeCorrected, CORRECTED)
    mitigator = ros.start("mitigator")
    mitigator.wait_for_output("correcting with model")
    ros.start("driver", "simulated_rate:=200.0", "start_delay:=0.5")
    ros.spin_until(lambda: len(corrected) > 50)
    refused = ros.set_parameter("mitigator", "model", str(torn))
    assert not refused.successful
    assert "model" in refused.reason
    assert str(torn) in refused.reason
    assert not ros.set_parameter("mitigator", "model", 5).successful
    assert ros.set_parameter("mitigator", "model", str(other.path)).successful
    ros.spin_until(lambda: corrected[-1].model_id == other.model_id)
    after = len(corrected)
    ros.spin_until(lambda: len(corrected) > after + 50)
    assert [m.sequence for m in corrected] == list(range(len(corrected)))
    identities = [m.model_id for m in corrected]
    swap = identities.index(other.model_id)
    assert set(identities[:swap]) == {shipped.model_id}
    assert set(identities[swap:]) == {other.model_id}


@pytest.mark.ros
def test_every_transition_of_the_driver_can_be_repeated_and_a_replay_starts_over(ros: Ros):
    received = ros.collect(RangeCir, RAW)
    ros.start("driver", *ENDLESS, "autostart:=false")
    for _ in range(2):
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            assert ros.change_state("driver", transition)
        ros.spin_until(lambda: len(received) > 3)
        assert received[0].sequence == 0
        assert ros.change_state("driver", Transition.TRANSITION_DEACTIVATE)
        assert ros.change_state("driver", Transition.TRANSITION_ACTIVATE)
        assert ros.change_state("driver", Transition.TRANSITION_DEACTIVATE)
        assert ros.change_state("driver", Transition.TRANSITION_CLEANUP)
        assert ros.state_of("driver") == "unconfigured"
        ros.spin_for(0.2)
        received.clear()
    assert ros.change_state("driver", Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert ros.state_of("driver") == "finalized"


@pytest.mark.ros
def test_a_driver_that_cannot_be_configured_says_why_and_can_be_mended(ros: Ros, tmp_path: Path):
    path = tmp_path / "late.mcap"
    received = ros.collect(RangeCir, RAW)
    ros.start("driver", "source:=mcap", f"path:={path}", "start_delay:=0.2", "autostart:=false")
    assert not ros.change_state("driver", Transition.TRANSITION_CONFIGURE)
    assert ros.state_of("driver") == "unconfigured"
    status = ros.diagnosis("driver", lambda status: status.level == DiagnosticStatus.ERROR)
    assert str(path) in status.message
    with BagWriter(path, {"source": "a test", "simulated": "true"}) as writer:
        for record in SimulatedSource(seed=1, count=5):
            writer.write(record)
    assert ros.change_state("driver", Transition.TRANSITION_CONFIGURE)
    assert ros.change_state("driver", Transition.TRANSITION_ACTIVATE)
    ros.spin_until(lambda: len(received) == 5)


@pytest.mark.ros
def test_diagnostics_go_on_when_simulated_time_stands_still_and_are_stamped_with_it(ros: Ros):
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    arrays = ros.collect(DiagnosticArray, "/diagnostics")
    ros.start("mitigator", "use_sim_time:=true")
    message = Clock()
    message.clock.sec = 1234

    def stamped() -> bool:
        clock.publish(message)
        return sum(array.header.stamp.sec == 1234 for array in arrays) >= 2

    ros.spin_until(stamped)


def test_a_rate_is_counted_on_the_nodes_clock():
    now_ns = [0]
    meter = Meter(lambda: now_ns[0])
    for _ in range(50):
        meter.add(2_000_000)
    now_ns[0] = 5_000_000_000
    assert meter.facts() == {"rate Hz": "10.0", "latency p50 ms": "2.000", "latency p99 ms": "2.000"}
    now_ns[0] = 1_000_000_000
    assert meter.facts() == {"rate Hz": "unknown"}


def health(statuses: dict[Status, int] | None = None, processing_ms: float = 0.1) -> Health:
    health = Health()
    for status, count in (statuses or {Status.OK: 100}).items():
        health.statuses[status] += count
        health.add_time(int(processing_ms * 1e6))
    return health


def test_nothing_is_warned_of_while_all_is_well():
    assert health().period().warnings() == []


@pytest.mark.parametrize(
    ("statuses", "threshold"),
    [
        ({Status.OK: 79, Status.OUT_OF_DISTRIBUTION: 21}, OUT_OF_DISTRIBUTION),
        ({Status.OK: 79, Status.BAD_CIR: 11, Status.NO_CIR: 10}, UNUSABLE),
    ],
)
def test_many_ranges_of_a_bad_status_are_warned_of(statuses: dict[Status, int], threshold):
    assert health(statuses).period().warnings() == [threshold.text]
    statuses[Status.OK] += 10
    assert health(statuses).period().warnings() == []


def test_the_documented_thresholds_are_those_in_force():
    document = (Path(__file__).parent.parent / "docs" / "diagnostics.md").read_text()
    for threshold in THRESHOLDS:
        assert f"| WARN | {threshold.fact} above {threshold.limit:g} | {threshold.text} |" in document


def test_slow_correcting_and_silence_are_warned_of():
    assert health(processing_ms=25.0).period().warnings() == [SLOW.text]
    silent = health()
    silent._last_s -= 6.0
    assert silent.period().warnings() == [SILENT.text]


def test_a_drop_is_warned_of_once():
    dropping = health()
    dropping.lost += 3
    assert dropping.period().warnings() == [DROPPED.text]
    assert dropping.period().warnings() == []
    assert dropping.dropped == 3


def test_drops_are_found_by_the_publishers_numbers():
    numbering = Numbering()
    numbering.add()
    for number in (2, 3):
        numbering.add_number(number)
    numbering.add()
    numbering.add_number(5)
    assert numbering.missing == 0
    numbering.add()
    numbering.add_number(17)
    assert numbering.missing == 10
    numbering.add_number(1)
    numbering.add_number(2)
    assert numbering.missing == 10
    numbering.restart()
    numbering.add_number(500)
    assert numbering.missing == 10
