"""The table of positions that ends the demo."""

from __future__ import annotations

import re

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")

from builtin_interfaces.msg import Time
from drives import HALL, circuit
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rich.console import Console
from std_msgs.msg import Header
from uwb_mitigation_msgs.msg import RangeCorrected

from uwb_mitigation.demos.positions import Positions
from uwb_mitigation.nodes import topics

SECOND_NS = 1_000_000_000


class Heard:
    """Stands for the node: hands what is published to who subscribed."""

    def __init__(self) -> None:
        self.callbacks: dict[str, object] = {}

    def create_subscription(self, kind: type, topic: str, callback, qos) -> None:
        self.callbacks[topic] = callback


def header(stamp_ns: int) -> Header:
    return Header(stamp=Time(sec=stamp_ns // SECOND_NS, nanosec=stamp_ns % SECOND_NS))


def rows(table) -> dict[str, list[str]]:
    console = Console(width=120)
    with console.capture() as shown:
        console.print(table)
    cells = [re.split(r"\s*[│┃]\s*", line.strip("│┃ ")) for line in shown.get().splitlines()]
    return {row[0]: row[1:] for row in cells if len(row) == 5}


def test_each_row_tells_the_errors_of_its_own_positions():
    node = Heard()
    # The table's tag is level with its anchors.
    level = HALL.moved(HALL.position * (1, 1, 0), HALL.sd)
    positions = Positions(node, level)
    assert positions.table() is None
    rng = np.random.default_rng(1)
    for i, place in enumerate(circuit(np.arange(200) / 20, height_m=0.0)):
        row, stamp_ns = i % len(level), 5 * SECOND_NS + i * SECOND_NS // 20
        distance = float(np.linalg.norm(place - level.position[row]))
        ranged = RangeCorrected(header=header(stamp_ns), tag_id=7, anchor_id=level.anchors[row].id)
        # Raw ranges of one anchor are a metre too long, corrected ones are right.
        ranged.range, ranged.range_raw = distance + rng.normal(0, 0.001), distance + 1.0 * (row == 0)
        node.callbacks[topics.RANGE_CORRECTED](ranged)
        truth, pose = Odometry(header=header(stamp_ns)), PoseWithCovarianceStamped(header=header(stamp_ns))
        for message, off in ((truth, 0.0), (pose, 0.3)):
            at = message.pose.pose.position
            at.x, at.y = float(place[0]), float(place[1]) + off
        node.callbacks[topics.ODOMETRY_TRUTH](truth)
        node.callbacks[topics.POSE](pose)
    node.callbacks[topics.RANGE_CORRECTED](RangeCorrected(header=header(0), anchor_id=4711, range=1.0))
    told = rows(positions.table())
    raw, corrected = told["raw ranges, least squares"], told["corrected ranges, least squares"]
    assert float(raw[1]) > 0.3
    # Within the second that a snapshot looks back the tag moves on.
    assert float(corrected[1]) < 0.5 * float(raw[1])
    assert told["corrected ranges, locator"] == ["200", "0.300", "0.300", "0.300"]
