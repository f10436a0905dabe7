"""Nodes as a robot uses them, over DDS, each with what must not happen.

Other cases are tested elsewhere: a paused clock, a model that is swapped while driving, and
publishers with another QoS (`test_reliability`), two tags and a best-effort height (`test_locator`), Ctrl-C with a board in
each of its states (`test_serial_driver`), during imports and at the start (`test_entry`), several pipelines (`test_nodes`).
"""

import itertools
import signal
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from drives import drive
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_harness import STATE_AFTER, Ros, corrected_range, header_at, stamped_after
from rosgraph_msgs.msg import Clock
from uwb_mitigation_msgs.msg import RangeCir, RangeCorrected

from uwb_mitigation.types.stamps import to_ns

pytestmark = pytest.mark.ros

NS = 10**9
UP = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
DOWN = (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP)
STATES = {
    "unconfigured": (),
    "inactive": UP[:1],
    "active": UP,
    "finalized": (Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,),
}
NODES = ("driver", "mitigator", "locator")
SIMULATED = ("source:=simulated", "simulated_rate:=100.0", "start_delay:=0.0")


class Nav2Manager:
    """Nav2's lifecycle manager, which is C++ and not on PyPI: order and checks of its `lifecycle_manager.cpp` (Jazzy to main).

    It asks for the state after each transition, stops at the first failure, and takes nodes down in reverse order.
    Timeouts for services are those of `Ros` instead of 5 s, because the tests run on busy computers.

    Args:
        bond_timeout_s: as its parameter, 4.0 by default; 0: do not wait for a bond of each active node.
    """

    def __init__(self, ros: Ros, nodes: tuple[str, ...], bond_timeout_s: float) -> None:
        self._ros, self._nodes, self._bond_timeout_s = ros, nodes, bond_timeout_s

    def startup(self) -> bool:
        return self._change_all(UP, self._nodes)

    def reset(self) -> bool:
        return self._change_all(DOWN, self._nodes[::-1])

    def shutdown(self) -> bool:
        return self._change_all((*DOWN, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN), self._nodes[::-1])

    def _change_all(self, transitions: tuple[int, ...], nodes: tuple[str, ...]) -> bool:
        return all(self._change(*pair) for pair in itertools.product(transitions, nodes))

    def _change(self, transition: int, node: str) -> bool:
        if (
            not self._ros.change_state(node, transition)
            or self._ros.state_of(node) != STATE_AFTER[transition]
        ):
            return False
        if transition != Transition.TRANSITION_ACTIVATE or self._bond_timeout_s == 0.0:
            return True
        # A bond is formed when the node publishes on /bond, too.
        self._ros.spin_for(self._bond_timeout_s / 2)
        return self._ros.node.count_publishers("/bond") > 0


def raw_range(tag: int, sequence: int, range_m: float, time_ns: int = 0) -> RangeCir:
    """Return a range without a CIR: the mitigator subtracts exactly the offset."""
    return RangeCir(header=header_at(time_ns), tag_id=tag, anchor_id=1, sequence=sequence, range=range_m)


def test_nav2_takes_all_nodes_of_one_process_up_and_down_twice(ros: Ros, anchors: Path):
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    corrected = ros.collect(RangeCorrected, "/uwb/range_corrected")

    def wait_for(messages: list) -> int:
        """Wait for messages that are published from now on; return the time when they have arrived."""
        since_ns = time.time_ns()
        ros.spin_until(lambda: len(stamped_after(messages, since_ns)) > 20)
        return time.time_ns()

    process = ros.start("pipeline", *SIMULATED, f"anchors:={anchors}", "autostart:=false")
    manager = Nav2Manager(ros, NODES, bond_timeout_s=0.0)
    for _ in range(2):
        up_ns = time.time_ns()
        assert manager.startup(), process.output
        wait_for(corrected)
        assert stamped_after(raw, up_ns)[0].sequence == 0, "a replay starts over"
        # The raw range of the latest corrected one may arrive after it.
        used = {message.range_raw for message in corrected}
        ros.spin_until(lambda used=used: used <= {message.range for message in raw})
        assert ros.change_state("mitigator", DOWN[0])
        down_ns = time.time_ns()
        wait_for(raw)
        assert not stamped_after(corrected, down_ns), "an inactive mitigator must not publish"
        assert ros.state_of("driver") == "active", "the others must not follow"
        assert ros.change_state("mitigator", UP[1])
        wait_for(corrected)
        assert manager.reset()
        down_ns = time.time_ns()
        ros.spin_for(0.5)
        assert not stamped_after(raw + corrected, down_ns), "nodes that were taken down must not publish"
    assert not Nav2Manager(ros, NODES, bond_timeout_s=1.0).startup(), "the guide says bond_timeout: 0.0"
    assert [ros.state_of(node) for node in NODES] == ["active", "inactive", "inactive"]
    assert manager.reset() is False, "Nav2 stops at a transition that is not possible"
    assert ros.change_state("driver", DOWN[0])
    for node in reversed(NODES):
        assert ros.change_state(node, DOWN[1])
    assert manager.startup()
    assert manager.shutdown()
    assert process.exit_code() is None, "a transition must not end the process"
    assert process.signal(signal.SIGINT) == 0
    assert "Traceback" not in process.output


def test_a_simulated_clock_that_jumps_neither_stops_positions_nor_mixes_their_times(ros: Ros, anchors: Path):
    poses = ros.collect(PoseWithCovarianceStamped, "/uwb/pose")
    # As `ros2 bag play --clock`: best effort, 40 Hz of recorded time (rosbag2's player.cpp), here faster.
    clock = ros.node.create_publisher(
        Clock, "/clock", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    publisher = ros.node.create_publisher(RangeCorrected, "/uwb/range_corrected", 1000)
    node = ros.start("locator", f"anchors:={anchors}", "use_sim_time:=true", "rate:=0.0")
    ros.wait_for_subscribers("/uwb/range_corrected", 1)
    ranges, truth = drive(seconds=10)
    for start_s in (1000, 5000, 200):  # one hour ahead, and back, as a bag that is played again
        poses.clear()
        rounds = itertools.count()

        def played(start_s: int = start_s, rounds: itertools.count = rounds) -> bool:
            """Publish a fifth of a second."""
            for tick in np.arange(8) + 8 * next(rounds):
                # The time stops at the last range: the locator predicts positions in gaps.
                time_ns = min(int(tick) * NS // 40, int(ranges.stamp_ns[-1]))
                clock.publish(Clock(clock=header_at(start_s * NS + time_ns).stamp))
                for row in np.flatnonzero(ranges.stamp_ns * 40 // NS == tick).tolist():
                    header = header_at(start_s * NS + int(ranges.stamp_ns[row]))
                    publisher.publish(corrected_range(ranges, row, header))
            ros.spin_for(0.05)
            return any(to_ns(pose.header.stamp) == start_s * NS + int(ranges.stamp_ns[-1]) for pose in poses)

        ros.spin_until(played)
        times_ns = np.array([to_ns(pose.header.stamp) for pose in poses]) - start_s * NS
        assert len(times_ns) > 50
        assert set(times_ns.tolist()) <= set(ranges.stamp_ns.tolist()), (
            "no position of a time that was not played"
        )
        used = [pose for pose, second in zip(poses, times_ns / NS, strict=True) if 5 <= second < 10]
        places = np.array([(pose.pose.pose.position.x, pose.pose.pose.position.y) for pose in used])
        stamps = np.array([to_ns(pose.header.stamp) for pose in used])
        errors_m = np.hypot(*(places - truth.position_at(stamps - start_s * NS)[:, :2]).T)
        assert np.nanmedian(errors_m) < 0.5, "the position before the jump must not hold the new one"
    assert node.signal(signal.SIGINT) == 0, node.output


def test_offsets_that_change_while_two_tags_drive_lose_and_mix_no_range(ros: Ros, tmp_path: Path):
    file = tmp_path / "offsets.yaml"
    file.write_text("pairs: [{anchor: 1, tag: 2, offset: 1.5}]")
    corrected = ros.collect(RangeCorrected, "/uwb/range_corrected")
    node = ros.start("mitigator", "offsets:=0.125")
    publisher = ros.node.create_publisher(RangeCir, "/uwb/range_raw", 1000)
    ros.find_each_other(publisher, raw_range(1, 0, 5.0), corrected)
    sequence = itertools.count(1)
    sent: dict[int, list[int]] = defaultdict(list)

    def drive_on(count: int) -> None:
        for _, tag in itertools.product(range(count), (1, 2)):
            sent[tag].append(number := next(sequence))
            publisher.publish(raw_range(tag, number, 5.0 + tag))
        # Some are still in a queue when the offset changes.
        ros.spin_until(lambda: bool(corrected) and corrected[-1].sequence > number - 2 * count)

    for offset, reason in (
        *((0.25, ""), ("absent.yaml", "no such file"), (0.5, ""), ("220", "millimetres")),
        *((True, "number of metres"), (str(file), ""), ("nan", "nan"), (0.125, "")),
    ):
        drive_on(50)
        result = ros.set_parameter("mitigator", "offsets", offset)
        assert result.successful == (not reason)
        assert reason in result.reason
    drive_on(50)
    ros.spin_until(lambda: len(corrected) >= sum(map(len, sent.values())))
    for tag, numbers in sent.items():
        messages = [message for message in corrected if message.tag_id == tag]
        assert [message.sequence for message in messages] == numbers, "no range must be lost or repeated"
        assert {message.range_raw for message in messages} == {5.0 + tag}, "tags must not be mixed"
        corrections = {message.correction for message in messages}
        assert corrections == {0.125, 0.25, 0.5, 0.0 if tag == 1 else 1.5}, "only what was set"
    assert node.signal(signal.SIGINT) == 0, node.output


@pytest.mark.parametrize("node", ["pipeline", "viewer"])
def test_ctrl_c_ends_a_node_in_every_state_without_a_traceback(ros: Ros, anchors: Path, node: str):
    """The pipeline contains driver, mitigator and locator; other tests end each of them alone."""
    given = (*SIMULATED, f"anchors:={anchors}") if node == "pipeline" else ("port:=0",)
    names = NODES if node == "pipeline" else (node,)
    for state, transitions in STATES.items():
        process = ros.start(node, *given, "autostart:=false")
        for name, transition in itertools.product(names, transitions):
            assert ros.change_state(name, transition), process.output
        assert {ros.state_of(name) for name in names} == {state}
        assert process.signal(signal.SIGINT) == 0, (state, process.output)
        assert "Traceback" not in process.output, state
        # The graph forgets a node that has ended.
        ros.spin_until(lambda: not set(names) & set(ros.node.get_node_names()))
