"""Replays a recording or the simulator for the driver: waits for subscribers, plays, and reports."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from typing import Any

from rclpy.clock import Clock

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.measurement import Record
from uwb_mitigation.nodes import diagnostics
from uwb_mitigation.nodes.feed import Description, Value
from uwb_mitigation.nodes.playback import Playback, ReplayOptions
from uwb_mitigation.offsets import Offsets
from uwb_mitigation.sources.source import Source

ANNOUNCED_AFTER_S = 3.0
FALLEN_BEHIND_S = 0.5
"""A replay that is later than this is said to fall behind."""


class ReplayFeed:
    """A playback that starts when enough subscribers are there, and logs what it skipped at its end.

    Args:
        source: closed by who opened it.
        clock, options, publish, on_time, on_end: see `Playback`.
        logger: with `info` and `warning`, as rclpy's.
        subscribers: returns the number of subscribers.
    """

    def __init__(
        self,
        source: Source,
        clock: Clock,
        options: ReplayOptions,
        logger: Any,
        *,
        subscribers: Callable[[], int],
        publish: Callable[[Sequence[tuple[Record, int]]], None],
        on_time: Callable[[int], None],
        on_end: Callable[[UwbMitigationError | None], None],
    ) -> None:
        self._source = source
        self._logger = logger
        self._subscribers = subscribers
        self._options = options
        self._start_delay_s = options.start_delay_s
        if options.start_delay_s < 0.0:
            # The middleware repeats announcements every 3 s, in case that the first ones are lost.
            self._start_delay_s = 0.0 if options.wanted_subscribers > 1 else ANNOUNCED_AFTER_S
        self._on_end = on_end
        self._started_s = 0.0
        self._connected_s: float | None = None
        self._playback = Playback(
            source,
            clock,
            options,
            ready=self._is_ready,
            publish=publish,
            on_time=on_time,
            on_end=self._finish,
        )

    def start(self) -> None:
        if self._source.simulated:
            self._logger.warning(f"replaying simulated ranges, which no radio measured: {self._source.name}")
        else:
            self._logger.info(f"replaying {self._source.name}")
        self._started_s = time.monotonic()
        self._playback.start()

    def stop(self) -> None:
        """End playing; may be called twice."""
        self._playback.stop()

    def apply(self, changed: Collection[str], value: Value, offsets: Offsets) -> None:
        """Change rate, pause and position of the playback."""
        if "rate" in changed:
            self._playback.rate = float(value("rate"))
        if "paused" in changed:
            self._playback.paused = value("paused")
        if "seek_to" in changed:
            self._playback.seek(float(value("seek_to")))

    def describe(self) -> Description:
        facts: dict[str, object] = {
            "source": self._source.name,
            "simulated": "unknown" if self._source.simulated is None else self._source.simulated,
            "ranges published": self._playback.played,
        }
        facts |= {f"oddity: {kind}": count for kind, count in self._source.skipped.copy().items()}
        level, text = diagnostics.OK, "paused" if self._playback.paused else "replaying"
        if self._source.simulated:
            level, text = diagnostics.WARN, f"{text} simulated ranges: no radio measured them"
        late_s = self._playback.late_ns / 1e9
        if late_s > FALLEN_BEHIND_S:
            level, text = (
                diagnostics.WARN,
                f"{text}; {late_s:.1f} s behind: the rate is too high for this machine",
            )
            self._logger.warning(text, throttle_duration_sec=10.0)
        facts["behind s"] = f"{max(late_s, 0.0):.3f}"
        return "simulated" if self._source.simulated else "recording", level, text, facts

    def _is_ready(self) -> bool:
        """Whether enough subscribers are there and the graph had time to connect, or the wait is over."""
        now_s = time.monotonic()
        if self._connected_s is None:
            subscribers, wanted = self._subscribers(), self._options.wanted_subscribers
            if subscribers >= wanted:
                self._connected_s = now_s
            elif now_s - self._started_s >= self._options.longest_wait_s:
                self._logger.warning(f"{subscribers} of {wanted} subscribers have come; playing all the same")
                return True
            return False
        return now_s - self._connected_s >= self._start_delay_s

    def _finish(self, error: UwbMitigationError | None) -> None:
        skipped = ", ".join(f"{count} x {kind}" for kind, count in sorted(self._source.skipped.items()))
        self._logger.info(
            f"played {self._playback.played} ranges" + (f"; oddities: {skipped}" if skipped else "")
        )
        self._on_end(error)
