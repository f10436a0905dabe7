"""What the driver publishes from: one interface for replays, boards and radios, and the base of the live ones."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Sequence
from typing import Any, Protocol

from uwb_mitigation.measurement import RangeMeasurement
from uwb_mitigation.nodes import diagnostics
from uwb_mitigation.nodes.diagnostics import Description
from uwb_mitigation.offsets import Offsets

Value = Callable[[str], Any]
"""Returns the value of a parameter."""

EVENT_TIMEOUT_S = 0.5


class Feed(Protocol):
    """A source that is playing or connected; `stop` ends it and may be called twice."""

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def describe(self) -> Description: ...

    def apply(self, changed: Collection[str], value: Value, offsets: Offsets) -> None:
        """Use new values of the parameters `changed`."""


class Port(Protocol):
    """A connection that keeps itself alive and yields events."""

    def get(self, timeout_s: float) -> Any: ...

    @property
    def closed(self) -> bool: ...

    def close(self) -> None: ...


class LiveFeed:
    """Takes the events of ports in one thread for each port, and publishes their ranges.

    Args:
        ports: closed by `stop`.
        on_range: publishes a range; called by one thread at a time.
        now_ns: the clock of the stamps.
        logger: with `info`, `warning` and `error`, as rclpy's.

    Attributes:
        ranges: number of ranges that were published.
    """

    def __init__(
        self,
        ports: Sequence[Port],
        *,
        on_range: Callable[[RangeMeasurement], None],
        now_ns: Callable[[], int],
        logger: Any,
    ) -> None:
        self.ranges = 0
        self.meter = diagnostics.Meter(now_ns)
        self._logger = logger
        self._ports = ports
        self._on_range = on_range
        self._now_ns = now_ns
        self._publishing = threading.Lock()
        self._threads = [
            threading.Thread(target=self._run, args=(port,), name="feed", daemon=True) for port in ports
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Close the ports and wait for the threads."""
        for port in self._ports:
            port.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def handle(self, event: Any, port: Any) -> None:
        """Take an event that is not a range."""
        raise NotImplementedError

    def check(self, port: Any) -> None:
        """Called after every event, and at least every `EVENT_TIMEOUT_S`."""

    def _run(self, port: Port) -> None:
        while not port.closed:
            event = port.get(EVENT_TIMEOUT_S)
            if isinstance(event, RangeMeasurement):
                with self._publishing:
                    self.ranges += 1
                    self._on_range(event)
                    self.meter.add(self._now_ns() - event.stamp_ns)
            elif event is not None:
                self.handle(event, port)
            self.check(port)
