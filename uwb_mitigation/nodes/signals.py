"""SIGINT and SIGTERM as an event, from the moment that a node is loaded; before that, see `entry`."""

from __future__ import annotations

import signal
import threading
from typing import Any

_stop = threading.Event()


def stop_event() -> threading.Event:
    """The event that SIGINT and SIGTERM set from now on; a second signal ends the process the hard way."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not _on_signal:
            signal.signal(number, _on_signal)
    return _stop


def _on_signal(number: int, frame: Any) -> None:
    _stop.set()
    signal.signal(number, signal.SIG_DFL)
