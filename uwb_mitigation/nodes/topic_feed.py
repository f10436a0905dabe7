"""Ranges on topics of other software: messages of any installed type, converted with a mapping file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from importlib import import_module
from typing import Any

import numpy as np
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription

from uwb_mitigation.errors import MissingDependencyError, ParameterError, RecordingError
from uwb_mitigation.measurement import Cir, RangeMeasurement
from uwb_mitigation.nodes import diagnostics, topics
from uwb_mitigation.nodes.diagnostics import Description
from uwb_mitigation.offsets import Offsets
from uwb_mitigation.sources.conversion import NO_CIR, Converter, kept_rows, measurement, samples_of
from uwb_mitigation.sources.mapping import LIST_INDEX, Mapping, load_mapping
from uwb_mitigation.sources.messages import MessageRows
from uwb_mitigation.sources.tables import LOG_TIME, TOPIC, UNREADABLE, Chunk

_WARNING_PERIOD_S = 10.0


def message_type(name: str) -> type:
    """Return the class of a message type such as `sensor_msgs/msg/Range`.

    Raises:
        ParameterError: The name has another form.
        MissingDependencyError: The package is not installed, or has no such message.
    """
    package, _, kind = name.replace("/msg/", "/").partition("/")
    if not (package.isidentifier() and kind.isidentifier()):
        raise ParameterError(f"type = {name!r:.60}", valid="PACKAGE/msg/NAME, such as sensor_msgs/msg/Range")
    try:
        found: type = getattr(import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError) as error:
        raise MissingDependencyError(
            f"the message type {name} is not installed", valid=f"install {package}, and source its workspace"
        ) from error
    return found


class TopicRanges:
    """Converts the messages of the topics of a mapping to measurements.

    Args:
        node: The node that subscribes.
        mapping: The mapping.
        names: Topics with commas between, instead of those of the mapping; empty: those of the mapping.
        on_range: Called with each range.
        now_ns: The clock of the node, for messages without a stamp.

    Attributes:
        ranges: Number of ranges.
        counts: {reason: number of rows or messages that were not used}.
        names: The topics.

    Raises:
        ParameterError: The mapping has no topics or no type.
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
        self.names = [name.strip() for name in names.split(",") if name.strip()] or mapping.topics
        if not (self.names and mapping.type):
            raise ParameterError(
                f"the mapping {mapping.name} is for recordings", valid="a mapping with topics and type"
            )
        self.ranges = 0
        self.counts: Counter[str] = Counter()
        self.problem = ""
        self._node, self._mapping, self._on_range, self._now_ns = node, mapping, on_range, now_ns
        self._type = message_type(mapping.type)
        self._converter = Converter(mapping.values)
        others = [*mapping.cir_columns, *(rule.column for rule in mapping.drop)]
        self._rows = MessageRows(mapping, self._converter.columns | dict.fromkeys(others, False))
        self._subscriptions: list[Subscription] = []

    def open(self) -> None:
        """Subscribe."""
        for name in self.names:
            self._subscriptions.append(
                topics.create_subscription(
                    self._node, self._type, name, self._callback(name), ReliabilityPolicy.BEST_EFFORT
                )
            )

    def close(self) -> None:
        """Unsubscribe; may be called twice."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())

    def _callback(self, name: str) -> Callable[[Any], None]:
        return lambda message: self.take(message, name)

    def take(self, message: Any, name: str) -> None:
        """Convert one message of the topic `name`; a message that cannot be used is counted and logged."""
        try:
            for measurement in self._measurements(message, name):
                self.ranges += 1
                self._on_range(measurement)
            self.problem = ""
        except (RecordingError, *UNREADABLE) as error:
            self.counts["message that cannot be used"] += 1
            self.problem = f"{name}: {error}"
            self._node.get_logger().warning(
                f"a message cannot be used: {self.problem:.300}", throttle_duration_sec=_WARNING_PERIOD_S
            )

    def _measurements(self, message: Any, name: str) -> list[RangeMeasurement]:
        rows, now_ns = self._rows.rows(message), self._now_ns()
        count = len(rows[LIST_INDEX])
        rows |= {LOG_TIME: [now_ns] * count, TOPIC: [name] * count}
        chunk = Chunk({each: _array(values) for each, values in rows.items()}, count, name, np.arange(count))
        chunk = chunk.take(kept_rows(self._mapping.drop, chunk, self.counts))
        if not chunk.count:
            return []
        values = self._converter.convert(chunk)
        # Radios without a synchronised clock send a zero stamp.
        values["stamp"][values["stamp"] <= 0] = now_ns
        found = []
        for row in range(chunk.count):
            if np.isfinite(values["range"][row]):
                found.append(measurement(values, row, self._cir(chunk, row), self.ranges + row))
            else:
                self.counts["range is not a number"] += 1
        return found

    def _cir(self, chunk: Chunk, row: int) -> Cir:
        source = self._mapping.cir
        if source is None or source.files:
            return NO_CIR
        samples, encoding, scale = samples_of(chunk.columns[source.column][row], source.samples)
        return Cir(samples, encoding, source.start_index, scale=scale)


def _array(values: Any) -> Any:
    """Return single values as an array, and lists unchanged."""
    return (
        values
        if len(values) and hasattr(values[0], "__len__") and not isinstance(values[0], str)
        else np.asarray(values)
    )


class TopicFeed:
    """Publishes the ranges of topics with a mapping; implements `Feed`.

    Args:
        node: The driver.
        map_file: The mapping file, or the name of a shipped mapping.
        names: Topics, instead of those of the mapping.
        on_range: Publishes a range.
        now_ns: The clock of the stamps.

    Raises:
        ParameterError: The mapping is invalid or for recordings.
        MissingDependencyError: The message type is not installed.
    """

    def __init__(
        self,
        node: LifecycleNode,
        map_file: str,
        names: str,
        on_range: Callable[[RangeMeasurement], None],
        now_ns: Callable[[], int],
    ) -> None:
        if not map_file:
            raise ParameterError(
                "parameter map is empty", valid="map:=FILE, or the name of a shipped mapping"
            )
        self._mapping = load_mapping(map_file)
        self._meter = diagnostics.Meter(now_ns)
        self._on_range, self._now_ns, self._node = on_range, now_ns, node
        self._topics = TopicRanges(node, self._mapping, names, self._take, now_ns)

    def start(self) -> None:
        """Subscribe to the topics."""
        self._topics.open()
        self._node.get_logger().info(f"{self._mapping.name}: ranges from {', '.join(self._topics.names)}")

    def stop(self) -> None:
        """Unsubscribe."""
        self._topics.close()

    def describe(self) -> Description:
        """Return the diagnostics."""
        source = self._topics
        entries: dict[str, object] = {"mapping": self._mapping.name, "ranges published": source.ranges}
        entries |= dict(source.counts) | self._meter.entries()
        silent = [name for name in source.names if not self._node.count_publishers(name)]
        level, text = diagnostics.OK, "receiving"
        if source.problem:
            level, text = diagnostics.ERROR, source.problem
        elif silent:
            level, text = diagnostics.WARN, f"no publisher on {', '.join(silent)}"
        elif not source.ranges:
            level, text = diagnostics.WARN, "no ranges yet"
        return f"topic {source.names[0]}", level, text, entries

    def apply(self, changed: Collection[str], value: Callable[[str], Any], offsets: Offsets) -> None:
        """Change nothing: no parameter of this source is live."""

    def _take(self, measurement: RangeMeasurement) -> None:
        self._on_range(measurement)
        self._meter.add(self._now_ns() - measurement.stamp_ns)
