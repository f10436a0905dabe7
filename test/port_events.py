"""Parameters of a driver, the events of a port that tests wait for, and pseudo-terminals in place of boards."""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from typing import Any

from uwb_mitigation.nodes.support.parameter_tables import DRIVER
from uwb_mitigation.radios.port import RadioPort

TIMEOUT_S = 240.0
"""Timeout for expected events."""


def driver_values(**changes: object) -> Callable[[str], Any]:
    """Return the parameters of a driver: the defaults, and changes in whose names `__` replaces a dot."""
    values: dict[str, object] = {row.name: row.default for row in DRIVER}
    return (values | {name.replace("__", "."): value for name, value in changes.items()}).__getitem__


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


@contextmanager
def terminal(answer: Callable[[bytes], bytes] | None = None, sent: bytes = b"") -> Iterator[str]:
    """Yield the name of a port whose other side has sent something, and then answers what it receives."""
    controller, device = os.openpty()
    tty.setraw(device)
    os.write(controller, sent)
    stop = threading.Event()

    def run() -> None:
        while not stop.is_set():
            if select.select([controller], [], [], 0.05)[0]:
                os.write(controller, answer(os.read(controller, 100)))

    thread = threading.Thread(target=run)
    if answer is not None:
        thread.start()
    try:
        yield os.ttyname(device)
    finally:
        stop.set()
        if answer is not None:
            thread.join()
        os.close(controller)
        os.close(device)
