"""A node that only republishes ranges: the floor that rclpy sets, which `bench nodes` compares with.

`-p serialised:=true` passes the bytes through without making objects of them, which is less than any node
that looks at a message can do.
"""

from __future__ import annotations

import threading

from rclpy.node import Node
from uwb_mitigation_msgs.msg import RangeCir

from uwb_mitigation.nodes import topics

RELAYED = "uwb/range_relayed"


class Relay(Node):
    def __init__(self) -> None:
        super().__init__("relay")
        serialised = bool(self.declare_parameter("serialised", False).value)
        publisher = self.create_publisher(RangeCir, RELAYED, topics.RANGES)
        self.create_subscription(RangeCir, topics.RANGE_RAW, publisher.publish, topics.RANGES, raw=serialised)


def make_nodes(stop: threading.Event) -> list[Node]:
    return [Relay()]
