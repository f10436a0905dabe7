"""Ranges on topics of other software: messages of any installed type, converted with a mapping file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.nodes.support import diagnostics, endpoints
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.recordings.mapping.checks import unknown_rows
from uwb_mitigation.recordings.mapping.conversion import (
    NO_CIR,
    Converter,
    count_bad,
    filter_rows,
    measurement,
    samples_of,
)
from uwb_mitigation.recordings.mapping.mapping import LIST_INDEX, TOPIC, Mapping
from uwb_mitigation.recordings.mapping.messages import MessageRows
from uwb_mitigation.recordings.mapping.tables import LOG_TIME, UNREADABLE, Chunk
from uwb_mitigation.types.measurement import (
    LINEAR_MAGNITUDES,
    Cir,
    Encoding,
    RangeMeasurement,
    is_logarithmic,
)

_WARNING_PERIOD_S = 10.0


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
        # Ids by order of appearance may change with each start, and one message has no useful median.
        for refused, why, valid in (
            (not (self._names and mapping.type), "is for recordings", "a mapping with topics and type"),
            (mapping.fields.tag.names or mapping.fields.anchor.names, "numbers texts (names)", "values"),
            (any(r.from_median is not None for r in mapping.drop), "drops by from_median", "above, below"),
        ):
            if refused:
                raise ParameterError(f"the mapping {mapping.name} {why}", valid=f"for topics: {valid}")
        self._ranges = 0
        self.counts: Counter[str] = Counter()
        self._problem = ""
        self._node, self._mapping, self._on_range, self._now_ns = node, mapping, on_range, now_ns
        self._meter = diagnostics.RateMonitor(now_ns)
        self._type = endpoints.message_type(mapping.type)
        self._converter = Converter(mapping.values)
        extra_columns = [*mapping.cir_columns, *(rule.column for rule in mapping.drop)]
        self._rows = MessageRows(mapping, self._converter.columns | dict.fromkeys(extra_columns, False))
        self._subscriptions: list[Subscription] = []

    def start(self) -> None:
        """Subscribe to the topics."""
        for name in self._names:
            self._subscriptions.append(
                endpoints.create_subscription(
                    self._node, self._type, name, self._callback(name), ReliabilityPolicy.BEST_EFFORT
                )
            )
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

    def _callback(self, name: str) -> Callable[[Any], None]:
        return lambda message: self.take(message, name)

    def take(self, message: Any, name: str) -> None:
        """Convert one message of the topic `name`; a message that cannot be used is counted and logged."""
        try:
            for measurement in self._measurements(message, name):
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

    def _measurements(self, message: Any, name: str) -> list[RangeMeasurement]:
        rows, now_ns = self._rows.rows(message), self._now_ns()
        count = len(rows[LIST_INDEX])
        rows |= {LOG_TIME: [now_ns] * count, TOPIC: [name] * count}
        chunk = Chunk(
            {column: _array(values) for column, values in rows.items()}, count, name, np.arange(count)
        )
        chunk = chunk.take(filter_rows(self._mapping.drop, chunk, self.counts))
        if not chunk.count:
            return []
        values = self._converter.convert(chunk)
        # Radios without a synchronised clock send a zero stamp.
        values["stamp"][values["stamp"] <= 0] = now_ns
        unknown = [count_bad(bad, self.counts, reason) for reason, bad in unknown_rows(values).items()]
        rows_used = np.flatnonzero(~np.any(unknown, axis=0)).tolist()
        return [measurement(values, row, self._cir(chunk, row), self._ranges + row) for row in rows_used]

    def _cir(self, chunk: Chunk, row: int) -> Cir:
        source = self._mapping.cir
        if source is None or source.files:
            return NO_CIR
        samples, encoding, scale = samples_of(chunk.columns[source.column][row], source.samples)
        if encoding is Encoding.MAGNITUDE and is_logarithmic(samples):
            self.counts[f"CIR in dB; valid: {LINEAR_MAGNITUDES}"] += 1
            return NO_CIR
        return Cir(samples, encoding, scale=scale)


def _array(values: Any) -> Any:
    """Return single values as an array, and lists unchanged."""
    return (
        values
        if len(values) and hasattr(values[0], "__len__") and not isinstance(values[0], str)
        else np.asarray(values)
    )
