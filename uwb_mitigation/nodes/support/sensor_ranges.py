"""Ranges as sensor_msgs/Range."""

from __future__ import annotations

import math
from typing import Any

from rclpy.publisher import Publisher

from uwb_mitigation.errors import format_id
from uwb_mitigation.nodes.support import endpoints
from uwb_mitigation.nodes.support.lifecycle import ManagedNode
from uwb_mitigation.types.measurement import CorrectedRange
from uwb_mitigation.types.ros.topics import RANGE_CORRECTED

MAX_SENSOR_RANGE_M = 300.0
"""Maximum range of a DW1000 in free space (data sheet, section 1)."""

MAX_SENSOR_TOPICS = 256
"""Maximum number of sensor_msgs/Range topics; bounded because ids are received over the air."""


class SensorRanges:
    """Publishes ranges as sensor_msgs/Range on `uwb/range_corrected/anchor_ID`; an invalid range is +Inf (REP-117).

    sensor_msgs has no radiation type for radio, so it is 0; the field of view is the full circle.

    Args:
        node: the publishers exist until its `close`. Without its parameter `sensor_ranges`, nothing is published.
    """

    def __init__(self, node: ManagedNode) -> None:
        self._node = node
        self._publishers: dict[int, Publisher] = {}
        self._kind: Any = None
        if node.value("sensor_ranges"):
            # Import on demand: sensor_msgs takes a twelfth of the start-up time of a node.
            self._kind = endpoints.message_type("sensor_msgs/msg/Range")

    def publish(self, anchor_id: int, stamp_ns: int, frame_id: str, corrected: CorrectedRange) -> None:
        if self._kind is None:
            return
        publisher = self._publishers.get(anchor_id)
        if publisher is None:
            if len(self._publishers) == MAX_SENSOR_TOPICS:
                text = f"more than {MAX_SENSOR_TOPICS} anchors: no topic for anchor {format_id(anchor_id)}"
                self._node.get_logger().warning(text, throttle_duration_sec=60.0)
                return
            topic = f"{RANGE_CORRECTED}/anchor_{format_id(anchor_id)}"
            publisher = self._publishers[anchor_id] = self._node.publisher(self._kind, topic)
        valid = math.isfinite(corrected.range_m) and math.isfinite(corrected.variance_m2)
        publisher.publish(
            self._kind(
                header=endpoints.header(stamp_ns, frame_id),
                field_of_view=2 * math.pi,
                max_range=MAX_SENSOR_RANGE_M,
                range=float(corrected.range_m) if valid else math.inf,
                variance=float(corrected.variance_m2) if valid else math.inf,
            )
        )
