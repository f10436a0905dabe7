"""Ranges on topics of other software: messages of any installed type, converted with a mapping file."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.validate_topic_name import validate_topic_name

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.nodes.support import diagnostics, endpoints
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.recordings.live_ranges import LiveConverter
from uwb_mitigation.recordings.mapping.conversion import UNREADABLE
from uwb_mitigation.recordings.mapping.mapping import Mapping, load_mapping, shipped_mappings
from uwb_mitigation.types.measurement import RangeMeasurement

_WARNING_PERIOD_S = 10.0


def find_mapping(name: str) -> Mapping | None:
    """Return the mapping of a file, or a shipped one; None: it is the name of a topic."""
    return load_mapping(name) if name in shipped_mappings() or name.endswith((".yaml", ".yml")) else None


class TopicFeed:
    """Converts the messages of the topics of a mapping to measurements; implements `Feed`.

    Args:
        node: The node that subscribes.
        mapping: The mapping.
        names: Topics with commas between, instead of those of the mapping; empty: those of the mapping.
        on_range: Called with each range.
        now_ns: The clock of the node, for messages without a stamp.

    Attributes:
        counts: {reason: number of rows or messages that were not used}.

    Raises:
        ParameterError: The mapping has no topics or no type, or needs a whole recording.
        InvalidTopicNameException: A name is invalid.
        MissingDependencyError: The message type is not installed.
    """

    def __init__(
        self,
        node: LifecycleNode,
        mapping: Mapping,
        names: str,
        on_range: Callable[[RangeMeasurement], None],
        now_ns: Callable[[], int],
    ) -> None:
        self._names = [name.strip() for name in names.split(",") if name.strip()] or mapping.topics
        if not (self._names and mapping.type):
            valid = "for topics: a mapping with topics and type"
            raise ParameterError(f"the mapping {mapping.name} is for recordings or lines", valid=valid)
        for name in self._names:
            validate_topic_name(name)
        self._converter = LiveConverter(mapping, "topics")
        self.counts = self._converter.counts
        self._ranges = 0
        self._problem = ""
        self._node, self._mapping, self._on_range, self._now_ns = node, mapping, on_range, now_ns
        self._meter = diagnostics.RateMonitor(now_ns)
        self._type = endpoints.message_type(mapping.type)
        self._subscriptions: list[Subscription] = []

    def start(self) -> None:
        """Subscribe to the topics."""
        best_effort = ReliabilityPolicy.BEST_EFFORT
        for name in self._names:
            take = partial(self.take, name=name)
            received = endpoints.create_subscription(self._node, self._type, name, take, best_effort)
            self._subscriptions.append(received)
        self._node.get_logger().info(f"{self._mapping.name}: ranges from {', '.join(self._names)}")

    def stop(self) -> None:
        """Unsubscribe; may be called twice."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())

    def describe(self) -> Description:
        """Return the diagnostics."""
        entries: dict[str, object] = {"mapping": self._mapping.name, "ranges published": self._ranges}
        entries |= dict(self.counts) | self._meter.entries()
        silent = [name for name in self._names if not self._node.count_publishers(name)]
        level, text = diagnostics.OK, "receiving"
        if self._problem:
            level, text = diagnostics.ERROR, self._problem
        elif silent:
            level, text = diagnostics.WARN, f"no publisher on {', '.join(silent)}"
        elif not self._ranges:
            level, text = diagnostics.WARN, "no ranges yet"
        return f"topic {self._names[0]}", level, text, entries

    def apply(self, changed: Collection[str], value: Callable[[str], Any]) -> None:
        """Change nothing: no parameter of this source is live."""

    def take(self, message: Any, name: str) -> None:
        """Convert one message of the topic `name`; a message that cannot be used is counted and logged."""
        try:
            for measurement in self._converter.measurements(message, name, self._now_ns()):
                self._ranges += 1
                self._on_range(measurement)
                self._meter.add(self._now_ns() - measurement.stamp_ns)
            self._problem = ""
        except (RecordingError, *UNREADABLE) as error:
            self.counts["message that cannot be used"] += 1
            self._problem = f"{name}: {error}"
            self._node.get_logger().warning(
                f"a message cannot be used: {self._problem:.300}", throttle_duration_sec=_WARNING_PERIOD_S
            )
