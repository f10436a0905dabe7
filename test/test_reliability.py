"""Reliability: killed and respawned nodes, live model changes, and correct diagnostics."""

import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from model_material import bundle
from rclpy.qos import qos_profile_sensor_data
from ros_harness import PAUSED, Ros, stamped_after
from rosgraph_msgs.msg import Clock
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.nodes.support import diagnostics, mitigator_health
from uwb_mitigation.nodes.support.mitigator_health import LossCounter, MitigatorHealth
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.types.ros.codec import encode_range

RAW = "/uwb/range_raw"
CORRECTED = "/uwb/range_corrected"
ENDLESS = ("simulated_rate:=100.0", "start_delay:=0.2")


@pytest.mark.ros
def test_killed_node_leaves_the_other_running_and_a_new_one_joins(ros: Ros):
    raw, corrected = ros.collect(RangeCir, RAW), ros.collect(RangeCorrected, CORRECTED)
    nodes = {"mitigator": ros.start("mitigator"), "driver": ros.start("driver", *ENDLESS)}
    ros.spin_until(lambda: len(corrected) > 20)
    for killed in ("mitigator", "driver"):
        nodes.pop(killed).signal(signal.SIGKILL)
        killed_ns = time.time_ns()
        if killed == "mitigator":
            ros.spin_until(lambda since=killed_ns: len(stamped_after(raw, since)) > 20)
            assert not stamped_after(corrected, killed_ns)
        nodes[killed] = ros.start(killed, *(ENDLESS if killed == "driver" else ()))
        ros.spin_until(lambda since=killed_ns: len(stamped_after(corrected, since)) > 20)
        assert [node.exit_code() for node in nodes.values()] == [None, None]


@pytest.mark.ros
def test_ranges_dropped_by_a_queue_are_reported(ros: Ros):
    data = encode_range(next(iter(SimulatedSource(seed=2))).measurement)
    ros.start("mitigator", "qos_overrides./uwb/range_raw.subscription.depth:=10").wait_for_output(
        "correcting"
    )
    publisher = ros.node.create_publisher(RangeCir, RAW, 10)

    def excerpt(status: DiagnosticStatus) -> bool:
        # Send more than the queue can hold.
        for _ in range(300):
            publisher.publish(data)
        return status.message == mitigator_health.DROPPED.text

    status = ros.diagnosis("mitigator", excerpt)
    assert status.level == DiagnosticStatus.WARN


@pytest.mark.ros
def test_model_is_swapped_live_without_losing_a_range_and_a_bad_one_is_refused(ros: Ros, tmp_path: Path):
    shipped = load_bundle(default_model_path())
    other = bundle(tmp_path)
    torn = tmp_path / "torn.onnx"
    torn.write_bytes(default_model_path().read_bytes()[:-100])
    corrected = ros.collect(RangeCorrected, CORRECTED)
    ros.start("mitigator").wait_for_output("correcting with model")
    # The driver itself counts the mitigator.
    ros.wait_until_active("mitigator")
    ros.start("driver", "simulated_rate:=200.0", *PAUSED)
    ros.play()
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
def test_diagnostics_continue_while_simulated_time_is_paused(ros: Ros):
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    arrays = ros.collect(DiagnosticArray, "/diagnostics")
    ros.start("mitigator", "use_sim_time:=true")
    message = Clock()
    message.clock.sec = 1234

    def stamped() -> bool:
        clock.publish(message)
        return sum(array.header.stamp.sec == 1234 for array in arrays) >= 2

    ros.spin_until(stamped)


def test_rate_is_counted_on_the_nodes_clock():
    now_ns = [0]
    meter = diagnostics.RateMonitor(lambda: now_ns[0])
    for _ in range(50):
        meter.add(2_000_000)
    now_ns[0] = 5_000_000_000
    assert meter.entries() == {"rate Hz": "10.0", "latency p50 ms": "2.000", "latency p99 ms": "2.000"}
    now_ns[0] = 1_000_000_000
    assert meter.entries() == {"rate Hz": "unknown"}


def health(statuses: dict[Status, int] | None = None, processing_ms: float = 0.1, **clock) -> MitigatorHealth:
    health = MitigatorHealth(**clock)
    for status, count in (statuses or {Status.OK: 100}).items():
        health.statuses[status] += count
        health.add_time(int(processing_ms * 1e6))
    return health


def warnings(health: MitigatorHealth) -> list[str]:
    return health.period()[0]


@pytest.mark.parametrize(
    ("statuses", "expected"),
    [
        ({Status.OK: 100}, []),
        ({Status.OK: 79, Status.OUT_OF_DISTRIBUTION: 21}, [mitigator_health.OUT_OF_DISTRIBUTION.text]),
        ({Status.OK: 89, Status.OUT_OF_DISTRIBUTION: 21}, []),
        ({Status.OK: 79, Status.BAD_CIR: 11, Status.NO_CIR: 10}, [mitigator_health.NO_USABLE_CIR.text]),
        ({Status.OK: 89, Status.BAD_CIR: 11, Status.NO_CIR: 10}, []),
    ],
)
def test_many_ranges_of_a_bad_status_cause_a_warning(statuses: dict[Status, int], expected: list[str]):
    assert warnings(health(statuses)) == expected


def test_slow_correction_and_no_data_cause_a_warning():
    assert warnings(health(processing_ms=25.0)) == [mitigator_health.SLOW.text]
    now_s = [100.0]
    silent = health(now_s=lambda: now_s[0])
    now_s[0] = 106.0
    assert warnings(silent) == [mitigator_health.NO_RANGES.text]


def test_drop_causes_one_warning():
    dropping = health()
    dropping.lost += 3
    assert warnings(dropping) == [mitigator_health.DROPPED.text]
    assert warnings(dropping) == []
    assert dropping.dropped == 3
    # Middleware without sequence numbers may hide more.
    dropping.loss_counter.add(mitigator_health.NO_SEQUENCE_NUMBER)
    assert dropping.period()[1]["dropped by a queue"] == "3 or more"


def test_model_that_includes_an_offset_causes_a_warning_after_enough_ranges():
    health = MitigatorHealth()
    for errors_m, excludes_offset, is_reported in (
        ([0.3] * (mitigator_health.MIN_LOS - 1), True, False),
        ([0.3], True, True),
        ([], False, False),
        ([-0.05] * 1000, True, False),
        # An offset is in all ranges; the median alone can be that of a few NLOS ranges with a strong first path.
        ([0.0] * 400 + [-0.3] * 600, True, False),
        ([-0.3] * 200, True, True),
    ):
        health.los_m.extend(errors_m)
        health.excludes_offset = excludes_offset
        assert (mitigator_health.OFFSET.text in warnings(health)) == is_reported


@pytest.mark.parametrize("count", [2, 3, 5])
def test_drops_of_several_publishers_add_up(count: int):
    random = np.random.default_rng(count)
    loss_counter = LossCounter(lambda: count)
    last = [int(start) for start in random.integers(0, 100_000, count)]
    lost = 0
    for step in range(3000):
        publisher = int(random.integers(count)) if step >= count else step
        gap = int(random.integers(50)) if step >= count and random.random() < 0.02 else 0
        last[publisher] += gap + 1
        lost += gap
        loss_counter.add(last[publisher])
    for publisher in range(count):
        last[publisher] += 1
        loss_counter.add(last[publisher])
    assert loss_counter.missing == lost > 0


def test_restarted_publisher_counts_no_drops():
    known = [2]
    loss_counter = LossCounter(lambda: known[0])
    # The middleware counts the killed publisher until its lease ends.
    for known[0], numbers, other in (
        (2, range(1, 100), 1000),
        (3, range(1, 50), 1099),
        (2, range(50, 200), 1099),
    ):
        for number in numbers:
            loss_counter.add(number)
            loss_counter.add(other + number)
    assert loss_counter.missing == 0


@pytest.mark.ros
def test_best_effort_publisher_is_reported_and_received_with_a_qos_override(ros: Ros):
    data = encode_range(next(iter(SimulatedSource(seed=2))).measurement)
    publisher = ros.node.create_publisher(RangeCir, RAW, qos_profile_sensor_data)
    mitigator = ros.start("mitigator")
    # DDS announces the name of a node after its publishers.
    warning = "/test_client publishes with best-effort reliability and is not received"
    status = ros.diagnosis("mitigator", lambda status: warning in status.message)
    assert status.level == DiagnosticStatus.WARN
    (parameter,) = re.findall(r"qos_overrides\S+", status.message)
    mitigator.wait_for_output("incompatible QoS")
    assert mitigator.signal(signal.SIGINT) == 0
    corrected = ros.collect(RangeCorrected, CORRECTED)
    ros.start("mitigator", parameter)

    def heard() -> bool:
        publisher.publish(data)
        return len(corrected) > 0

    ros.spin_until(heard)
