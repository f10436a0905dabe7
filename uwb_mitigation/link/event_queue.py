"""Events from the thread of a port to whoever waits for them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from typing import Generic, TypeVar

_Event = TypeVar("_Event")


class EventQueue(Generic[_Event]):
    """Hands events on, in order; for any number of threads.

    Args:
        capacity: events that wait at most; beyond it the oldest are dropped.

    Attributes:
        overflowed: how many were dropped.
    """

    def __init__(self, capacity: int) -> None:
        self.overflowed = 0
        self._capacity = capacity
        self._events: deque[_Event] = deque()
        self._closed = False
        self._changed = threading.Condition()

    def put(self, events: Iterable[_Event]) -> None:
        """Add events, and wake who waits."""
        with self._changed:
            self._events.extend(events)
            while len(self._events) > self._capacity:
                self._events.popleft()
                self.overflowed += 1
            self._changed.notify_all()

    def get(self, timeout_s: float) -> _Event | None:
        """The next event, or None if there is none within the time, or once the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._events or self._closed, timeout_s)
            return self._events.popleft() if self._events and not self._closed else None

    def close(self) -> None:
        """Void what waits, and what comes."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
