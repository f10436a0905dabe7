"""Corrected ranges as `sensor_msgs/Range`, a topic for each anchor, for what subscribes to that and knows no UWB."""

from __future__ import annotations

import math

from rclpy.lifecycle import LifecycleNode
from rclpy.publisher import Publisher
from sensor_msgs.msg import Range

from uwb_mitigation.errors import format_id
from uwb_mitigation.measurement import CorrectedRange
from uwb_mitigation.nodes import conversions, topics

LONGEST_M = 300.0
"""What a DW1000 reaches in the open (data sheet, section 1)."""

MOST_ANCHORS = 256
"""Identities come from the air: no more topics than these."""


class SensorRanges:
    """Publishes on `uwb/range_corrected/anchor_ID`; a range that is none is +Inf (REP-117), as is its variance.

    The name of a topic cannot begin with a digit, hence `anchor_`. sensor_msgs has no radiation type for radio:
    it stays 0, and the field of view is all around.
    """

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._publishers: dict[int, Publisher] = {}

    def publish(self, anchor_id: int, stamp_ns: int, frame_id: str, corrected: CorrectedRange) -> None:
        publisher = self._publishers.get(anchor_id)
        if publisher is None:
            if len(self._publishers) == MOST_ANCHORS:
                self._node.get_logger().warning(
                    f"more than {MOST_ANCHORS} anchors: no topic for anchor {format_id(anchor_id)}",
                    throttle_duration_sec=60.0,
                )
                return
            publisher = self._publishers[anchor_id] = self._make(anchor_id)
        valid = math.isfinite(corrected.range_m) and math.isfinite(corrected.variance_m2)
        publisher.publish(
            Range(
                header=conversions.to_header(stamp_ns, frame_id),
                field_of_view=2 * math.pi,
                min_range=0.0,
                max_range=LONGEST_M,
                range=float(corrected.range_m) if valid else math.inf,
                variance=float(corrected.variance_m2) if valid else math.inf,
            )
        )

    def close(self) -> None:
        """Destroy the publishers; may be called twice."""
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._publishers.clear()

    def _make(self, anchor_id: int) -> Publisher:
        publisher = topics.create_publisher(
            self._node, Range, f"{topics.RANGE_CORRECTED}/anchor_{format_id(anchor_id)}"
        )
        publisher.on_activate(None)
        return publisher
