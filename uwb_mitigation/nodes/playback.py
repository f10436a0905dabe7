"""Plays a source at its recorded pace: a thread between a source's iterator and a publisher.

Knows time, pausing for it and the end of a recording; knows nothing of messages or topics.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from rclpy.clock import Clock

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.sources.source import Record, Source

# How often the pace is checked against a clock that may be simulated, and /clock is published.
TICK_S = 0.02


class Playback:
    """Calls `publish(record, stamp_ns)` for every record of a source when its time has come.

    A record's time is its offset from the first record, divided by `rate`, counted on `clock` from
    the moment that playing starts; pauses longer than `longest_pause_s` of recorded time are cut to it. Stamps are on that clock; with `recorded_stamps` they are the
    recording's own and `on_time(recorded_ns)` is called all along, to drive `/clock`.
    `on_end(error)` is called once, from the playing thread, unless `stop()` came first.
    """

    def __init__(
        self,
        source: Source,
        clock: Clock,
        *,
        rate: float,
        loop: bool,
        longest_pause_s: float,
        recorded_stamps: bool,
        ready: Callable[[], bool],
        publish: Callable[[Record, int], None],
        on_time: Callable[[int], None],
        on_end: Callable[[UwbMitigationError | None], None],
    ) -> None:
        self._source = source
        self._clock = clock
        self._rate = rate
        self._loop = loop
        self._longest_pause_ns = int(longest_pause_s * 1e9)
        self._recorded_stamps = recorded_stamps
        self._ready = ready
        self._publish = publish
        self._on_time = on_time
        self._on_end = on_end
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="playback", daemon=True)
        self.played = 0

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End playing before the next record, and wait for that."""
        self._stopping.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        error: UwbMitigationError | None = None
        try:
            while not self._ready():
                if self._stopping.wait(TICK_S):
                    return
            self._play()
        except UwbMitigationError as problem:
            error = problem
        if not self._stopping.is_set():
            self._on_end(error)

    def _play(self) -> None:
        start_ns = self._clock.now().nanoseconds
        while True:
            last_ns: int | None = None
            pause_ns = due_ns = 0
            for record in self._source:
                recorded_ns = record.measurement.stamp_ns
                if last_ns is not None:
                    pause_ns = int(min(recorded_ns - last_ns, self._longest_pause_ns) / self._rate)
                    due_ns += pause_ns
                last_ns = recorded_ns
                if not self._wait_until(start_ns + due_ns, recorded_ns):
                    return
                self._publish(record, recorded_ns if self._recorded_stamps else start_ns + due_ns)
                self.played += 1
            if not self._loop or last_ns is None:
                return
            # The next round begins where a next record would have come.
            start_ns += due_ns + max(pause_ns, 1)

    def _wait_until(self, due_ns: int, recorded_ns: int) -> bool:
        """Wait on the clock; False when playing is to stop."""
        while True:
            ahead_ns = max(due_ns - self._clock.now().nanoseconds, 0)
            if self._recorded_stamps:
                self._on_time(recorded_ns - int(ahead_ns * self._rate))
            if not ahead_ns:
                return not self._stopping.is_set()
            if self._stopping.wait(min(ahead_ns / 1e9, TICK_S)):
                return False
