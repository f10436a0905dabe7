"""Plays a source at its recorded pace: a thread between a source's iterator and a publisher.

Knows time, pausing, seeking and the end of a recording; knows nothing of messages or topics.
"""

from __future__ import annotations

import math
import threading
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rclpy.clock import Clock

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.measurement import Record
from uwb_mitigation.nodes import clocks
from uwb_mitigation.sources.source import Source

# How often the pace is checked against a clock that may be simulated, and /clock is published.
TICK_S = 0.02
# A record so late is published together with those behind it, at most BATCH at once.
LATE_NS = 1_000_000
BATCH = 16


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How a recording is replayed.

    Attributes:
        rate: speed relative to the recording.
        loop: start again at the end.
        longest_pause_s: longer pauses of the recording are shortened to this.
        recorded_stamps: keep the recorded stamps and drive `/clock`, instead of stamps on the node's clock.
        wanted_subscribers: wait for this number of subscribers, but not longer than `longest_wait_s`.
        start_delay_s: wait this long after that, until the rest of the graph is connected; negative: 3 s, or 0 if
            several subscribers are wanted.
        paused: start paused.
        from_s: start this long after the first record.
    """

    rate: float = 1.0
    loop: bool = False
    longest_pause_s: float = math.inf
    recorded_stamps: bool = False
    wanted_subscribers: int = 0
    longest_wait_s: float = 0.0
    start_delay_s: float = 0.0
    paused: bool = False
    from_s: float = 0.0


class Playback:
    """Calls `publish([(record, stamp_ns), ...])` for the records of a source when their time has come.

    A record's time is its offset from the first record, divided by `rate`, counted by a steady clock (by
    `clock` where that is simulated) from the moment that playing starts; pauses longer than `longest_pause_s` of recorded time are cut to it.
    It is one record a call as long as playing keeps up; late ones may come several at once. Stamps are
    on `clock`; with `recorded_stamps` they are the recording's own and `on_time(recorded_ns)` is
    called all along, to drive `/clock`. `on_end(error)` is called once, from the playing thread, unless
    `stop()` came first.

    `rate` and `paused` may be set at any time, and `seek` called; they take effect within `TICK_S`.

    Attributes:
        played: records published.
        late_ns: how late the latest record was.
        rate: speed relative to the recording.
        paused: while True no record is published, and its time stands still.
    """

    def __init__(
        self,
        source: Source,
        clock: Clock,
        options: ReplayOptions,
        *,
        ready: Callable[[], bool],
        publish: Callable[[Sequence[tuple[Record, int]]], None],
        on_time: Callable[[int], None],
        on_end: Callable[[UwbMitigationError | None], None],
    ) -> None:
        self.rate = options.rate
        self.paused = options.paused
        self.played = 0
        self.late_ns = 0
        self._source = source
        self._clock = clocks.Pace(clock)
        self._now_ns = self._clock.now_ns
        self._loop = options.loop
        self._longest_pause_ns = int(min(options.longest_pause_s, 1e9) * 1e9)
        self._recorded_stamps = options.recorded_stamps
        self._ready = ready
        self._publish = publish
        self._on_time = on_time
        self._on_end = on_end
        self._seeks: deque[int] = deque()
        if options.from_s:
            self.seek(options.from_s)
        self._late: list[tuple[Record, int]] = []
        # The pace: `_place_ns` of played time is due at `_place_clock_ns`.
        self._place_ns = self._place_clock_ns = 0
        self._pace = options.rate
        self._standing = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="playback", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End playing before the next record, and wait for that."""
        self._stopping.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def seek(self, recorded_s: float) -> None:
        """Go on with the first record so long after the recording's start, forwards or backwards."""
        self._seeks.append(int(recorded_s * 1e9))

    def _run(self) -> None:
        error: UwbMitigationError | None = None
        try:
            while not self._ready():
                if self._stopping.wait(TICK_S):
                    return
            self._play()
        except UwbMitigationError as problem:
            error = problem
        except Exception as bug:
            # A thread's end must not go unnoticed: the node would publish nothing for ever.
            traceback.print_exc()
            error = UwbMitigationError(f"the source failed: {bug!r}", where=self._source.name)
        if not self._stopping.is_set():
            self._on_end(error)

    def _play(self) -> None:
        self._place_clock_ns = self._now_ns()
        due_ns = 0
        while not self._stopping.is_set():
            from_ns = self._seeks.popleft() if self._seeks else 0
            found, due_ns = self._play_from(from_ns, due_ns)
            if not self._seeks and not (self._loop and found):
                return

    def _play_from(self, from_ns: int, due_ns: int) -> tuple[bool, int]:
        """Play until the source ends or a seek is asked for.

        Returns whether the source holds any record, and when the next one is due, in played time.
        """
        first_ns: int | None = None
        last_ns: int | None = None
        pause_ns = 1
        try:
            for record in self._source:
                recorded_ns = record.measurement.stamp_ns
                if first_ns is None:
                    first_ns = recorded_ns
                if recorded_ns - first_ns < from_ns:
                    if self._stopping.is_set() or self._seeks:
                        break
                    continue
                if last_ns is not None:
                    pause_ns = min(recorded_ns - last_ns, self._longest_pause_ns)
                    due_ns += pause_ns
                last_ns = recorded_ns
                late_ns = self._wait_until(due_ns, recorded_ns)
                if late_ns is None:
                    return True, min(due_ns, self._position_ns(self._now_ns()))
                self.late_ns = late_ns
                stamp_ns = (
                    recorded_ns if self._recorded_stamps else self._clock.stamp_ns(self._clock_ns(due_ns))
                )
                self._late.append((record, stamp_ns))
                if late_ns < LATE_NS or len(self._late) == BATCH:
                    self._flush()
        finally:
            # What was read before the source broke, or a seek came, is played all the same.
            self._flush()
        # The next round begins where a next record would have come.
        return first_ns is not None, due_ns + max(pause_ns, 1)

    def _flush(self) -> None:
        if self._late:
            self._publish(self._late)
            self.played += len(self._late)
            self._late = []

    def _clock_ns(self, due_ns: int) -> int:
        """When a moment of played time is due, by the clock of the pace."""
        return self._place_clock_ns + int((due_ns - self._place_ns) / self._pace)

    def _wait_until(self, due_ns: int, recorded_ns: int) -> int | None:
        """Wait on the clock; return how late it has become, or None when playing is not to go on."""
        while True:
            if self._stopping.is_set() or self._seeks:
                return None
            now_ns = self._now_ns()
            if self.paused or self._standing or self.rate != self._pace:
                self._keep_pace(now_ns, due_ns)
            ahead_ns = self._clock_ns(due_ns) - now_ns
            if self._recorded_stamps:
                # Before a recording that starts at 0, as simulated ones do, there is no time.
                self._on_time(max(recorded_ns - int(max(ahead_ns, 0) * self._pace), 0))
            if ahead_ns <= 0 and not self.paused:
                return -ahead_ns
            self._flush()
            self._stopping.wait(TICK_S if self.paused else min(ahead_ns / 1e9, TICK_S))

    def _keep_pace(self, now_ns: int, due_ns: int) -> None:
        """Go on from where playing is now, at the rate that is wanted now."""
        # Never past the next record, so that stamps stay in order.
        self._place_ns, self._place_clock_ns = min(self._position_ns(now_ns), due_ns), now_ns
        self._standing, self._pace = self.paused, self.rate

    def _position_ns(self, now_ns: int) -> int:
        """The played time at a moment of the clock."""
        if self._standing:
            return self._place_ns
        return self._place_ns + int((now_ns - self._place_clock_ns) * self._pace)
