"""A node that only republishes ranges: the lower bound set by rclpy, which `benchmarks nodes` compares with.

`-p serialised:=true` passes the bytes through without creating objects, which is less than any useful node does.
"""

from __future__ import annotations

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from uwb_mitigation_msgs.msg import RangeCir

from uwb_mitigation.nodes.support import endpoints
from uwb_mitigation.nodes.support.spinning import spin, stop_event
from uwb_mitigation.types.ros import topics

RELAYED = "uwb/range_relayed"


class Relay(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("relay")
        serialised = bool(self.declare_parameter("serialised", False).value)
        publisher = self.create_publisher(RangeCir, RELAYED, endpoints.RANGES)
        self.create_subscription(
            RangeCir, topics.relative(topics.RANGE_RAW), publisher.publish, endpoints.RANGES, raw=serialised
        )


if __name__ == "__main__":
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    spin(Relay(), stop_event())
