"""The events of a port that tests wait for."""

from __future__ import annotations

import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

from uwb_mitigation.radios.port import RadioPort

TIMEOUT_S = 240.0
"""Timeout for expected events."""


class PortEvents:
    """Opens radios with a module of `radios`, and queues their events.

    Args:
        source: the module.
        settings: of the radios.

    Attributes:
        ports: the radios.
        port: the first radio.
    """

    def __init__(self, source: Any, *settings: object) -> None:
        self._events: SimpleQueue[object] = SimpleQueue()
        self.ports: list[RadioPort] = source.open(settings, lambda event: self._events.put(event))
        self.port: Any = self.ports[0]

    def wait_for(self, condition: type | Callable[[Any], bool], count: int = 1) -> list[Any]:
        """Wait for a number of events of a type, or that fulfil a condition; drop others."""
        events: list[Any] = []
        deadline = time.monotonic() + TIMEOUT_S
        while len(events) < count:
            assert time.monotonic() < deadline, f"{len(events)} of {count} {condition}: {self.port.report()}"
            try:
                event = self._events.get(timeout=0.1)
            except Empty:
                continue
            if isinstance(event, condition) if isinstance(condition, type) else condition(event):
                events.append(event)
        return events

    def __enter__(self) -> PortEvents:
        return self

    def __exit__(self, *_: object) -> None:
        for port in self.ports:
            port.close()


def wait_until(condition: Callable[[], object]) -> None:
    """Wait until a condition is true."""
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
