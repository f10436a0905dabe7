"""Plays a recording or the simulator for the driver: waits for listeners, plays, and tells how it went."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.clock import Clock

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.measurement import Record
from uwb_mitigation.nodes import diagnostics
from uwb_mitigation.nodes.playback import Playback
from uwb_mitigation.sources.source import Source

ANNOUNCED_AFTER_S = 3.0
FALLEN_BEHIND_S = 0.5
"""A replay that is later than this is said to fall behind."""


class ReplayFeed:
    """A playback that starts when enough others listen, and logs what it left out at its end.

    Args:
        source: closed by who opened it.
        clock, rate, loop, longest_pause_s, recorded_stamps, paused, from_s, publish, on_time, on_end: see `Playback`.
        logger: with `info` and `warning`, as rclpy's.
        subscribers: how many listen now.
        wanted_subscribers: playing waits for so many, but no longer than `longest_wait_s`.
        start_delay_s: then it waits so long again, for the rest of the graph to start and connect; negative =
            not at all where several are wanted, and have come.

    Attributes:
        playback: what plays; its rate and pause may be changed.
    """

    def __init__(
        self,
        source: Source,
        clock: Clock,
        logger: Any,
        *,
        rate: float,
        loop: bool,
        longest_pause_s: float,
        recorded_stamps: bool,
        subscribers: Callable[[], int],
        wanted_subscribers: int,
        longest_wait_s: float,
        start_delay_s: float,
        paused: bool,
        from_s: float,
        publish: Callable[[Sequence[tuple[Record, int]]], None],
        on_time: Callable[[int], None],
        on_end: Callable[[UwbMitigationError | None], None],
    ) -> None:
        self._source = source
        self._logger = logger
        self._subscribers = subscribers
        self._wanted_subscribers = wanted_subscribers
        self._longest_wait_s = longest_wait_s
        self._start_delay_s = start_delay_s
        if start_delay_s < 0.0:
            # The middleware announces what is new every 3 s, should its first announcements be missed.
            self._start_delay_s = 0.0 if wanted_subscribers > 1 else ANNOUNCED_AFTER_S
        self._on_end = on_end
        self._started_s = 0.0
        self._heard_s: float | None = None
        self.playback = Playback(
            source,
            clock,
            rate=rate,
            loop=loop,
            longest_pause_s=longest_pause_s,
            recorded_stamps=recorded_stamps,
            paused=paused,
            from_s=from_s,
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
        self.playback.start()

    def stop(self) -> None:
        """End playing; may be called twice."""
        self.playback.stop()

    def describe(self) -> tuple[str, bytes, str, dict[str, object]]:
        """Hardware id, level, message and facts for the diagnostics."""
        facts: dict[str, object] = {
            "source": self._source.name,
            "simulated": "unknown" if self._source.simulated is None else self._source.simulated,
            "ranges published": self.playback.played,
        }
        facts |= {f"oddity: {kind}": count for kind, count in self._source.skipped.copy().items()}
        level, text = diagnostics.OK, "paused" if self.playback.paused else "replaying"
        if self._source.simulated:
            level, text = diagnostics.WARN, f"{text} simulated ranges: no radio measured them"
        late_s = self.playback.late_ns / 1e9
        if late_s > FALLEN_BEHIND_S:
            level, text = (
                diagnostics.WARN,
                f"{text}; {late_s:.1f} s behind: the rate is too high for this machine",
            )
            self._logger.warning(text, throttle_duration_sec=10.0)
        facts["behind s"] = f"{max(late_s, 0.0):.3f}"
        return "simulated" if self._source.simulated else "recording", level, text, facts

    def _is_ready(self) -> bool:
        """True once enough others listen and the graph had time to settle, or they did not come."""
        now_s = time.monotonic()
        if self._heard_s is None:
            subscribers = self._subscribers()
            if subscribers >= self._wanted_subscribers:
                self._heard_s = now_s
            elif now_s - self._started_s >= self._longest_wait_s:
                self._logger.warning(
                    f"{subscribers} of {self._wanted_subscribers} subscribers have come; playing all the same"
                )
                return True
            return False
        return now_s - self._heard_s >= self._start_delay_s

    def _finish(self, error: UwbMitigationError | None) -> None:
        skipped = ", ".join(f"{count} x {kind}" for kind, count in sorted(self._source.skipped.items()))
        self._logger.info(
            f"played {self.playback.played} ranges" + (f"; oddities: {skipped}" if skipped else "")
        )
        self._on_end(error)
