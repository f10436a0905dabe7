"""Replay a recording or the simulator for the driver: timing, pause, seek, loop, and waiting for subscribers."""

from __future__ import annotations

import heapq
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rclpy.clock import Clock

from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.nodes.feeds.publishing import RangePublisher
from uwb_mitigation.nodes.feeds.radios import CAPTURED_SOURCES, radio_source
from uwb_mitigation.nodes.feeds.replay_clock import ReplayClock
from uwb_mitigation.nodes.support import diagnostics
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.ros.topics import RANGE_RAW
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import NS_PER_S

if TYPE_CHECKING:
    from uwb_mitigation.nodes.feeds.robot_messages import RobotMessage, RobotMessages

TICK_S = 0.02
"""Interval at which commands and a simulated clock are checked, and /clock is published."""

LATE_NS, BATCH = 1_000_000, 64
"""A record that is later than this is published in a batch with the next ones, of at most BATCH records."""

ANNOUNCEMENT_S = 3.0
"""The middleware repeats its announcements after this time, if the first ones were lost."""

LATE_WARNING_S = 0.5
"""A delay of the replay above this is reported."""


def open_source(value: Callable[[str], Any]) -> Source:
    """Open the recording or simulation of the parameters; `value(name)` returns a parameter's value.

    Raises:
        ParameterError: the parameter path is empty.
        RecordingError: the recording cannot be read.
    """
    # Import here, because each source needs other dependencies.
    if value("source") == "simulated":
        from uwb_mitigation.simulation.simulated import SimulatedSource

        return SimulatedSource(seed=value("seed"), count=value("count"), rate_hz=value("simulated_rate"))
    if not value("path"):
        raise ParameterError("parameter path is empty", valid="the recording to replay, as -p path:=FILE")
    path = Path(value("path")).expanduser()
    if value("source") in CAPTURED_SOURCES:
        return radio_source(value("source")).open_capture(path, value)
    if value("source") == "mcap":
        from uwb_mitigation.recordings.mcap import McapRecording

        return McapRecording(path, topic=value("topic") or RANGE_RAW)
    from uwb_mitigation.recordings.decaranging import CirFrame, open_decaranging

    return open_decaranging(path, cir=CirFrame(value("cir")))


class ReplayFeed:
    """Publishes the records of a source when they are due, from its own thread; implements `Feed`.

    A record is due at its offset from the first record, divided by the rate. Late records may be published in
    batches. Rate, pause and position may change at any time; they take effect within `TICK_S`.

    Args:
        source: closed by the caller.
        clock: the node's clock; simulated time paces the replay, otherwise a steady clock does.
        value: returns the value of a parameter of the driver. With `publish_clock`, stamps are the recorded ones.
        logger: with `info` and `warning`, as rclpy's.
        output: publishes the records and, with `publish_clock`, the recorded time at every tick.
        robot: messages of a recorded robot; None: none.
        on_end: called once from the playing thread with the error or None, unless `stop` came first.

    Attributes:
        played: number of records published.
        late_ns: delay of the latest record.
    """

    def __init__(
        self,
        source: Source,
        clock: Clock,
        value: Callable[[str], Any],
        logger: Any,
        output: RangePublisher,
        on_end: Callable[[UwbMitigationError | None], None],
        robot: RobotMessages | None = None,
    ) -> None:
        self.played = 0
        self.late_ns = 0
        self._source = source
        self._robot = robot
        self._clock = ReplayClock(clock)
        self._value = value
        self._logger = logger
        self._output = output
        self._on_end = on_end
        self._uses_recorded_stamps = value("publish_clock")
        self._requested_rate = self._rate = float(value("rate"))
        self._pause_requested, self._paused = value("paused"), False
        self._seeks = deque([int(value("seek_to") * NS_PER_S)])
        self._late: list[tuple[Record, int]] = []
        # The played time `_reference_ns` is due at `_reference_clock_ns`.
        self._reference_ns = self._reference_clock_ns = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)

    def start(self) -> None:
        if self._source.simulated:
            self._logger.warning(f"replaying simulated ranges: {self._source.name}")
        else:
            self._logger.info(f"replaying {self._source.name}")
        if self._robot is not None and self._robot.topics:
            self._logger.info(f"replaying {', '.join(self._robot.topics)} of the robot")
            if self._rate != 1.0 and not self._uses_recorded_stamps:
                self._logger.warning(
                    "velocities and yaw rates of the robot do not fit the stamps of another rate: set publish_clock"
                )
        self._thread.start()

    def stop(self) -> None:
        """Stop before the next record, and join the thread; may be called twice."""
        self._stopping.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def apply(self, changed: Collection[str], value: Callable[[str], Any]) -> None:
        """Change rate, pause and position."""
        if "rate" in changed:
            self._requested_rate = float(value("rate"))
        if "paused" in changed:
            self._pause_requested = value("paused")
        if "seek_to" in changed:
            self._seeks.append(int(value("seek_to") * NS_PER_S))

    def describe(self) -> Description:
        simulated = self._source.simulated
        entries: dict[str, object] = {
            "source": self._source.name,
            "simulated": "unknown" if simulated is None else simulated,
            "ranges published": self.played,
        }
        entries |= {f"warning: {kind}": count for kind, count in self._source.skipped.copy().items()}
        level, text = diagnostics.OK, "paused" if self._pause_requested else "replaying"
        if simulated:
            level, text = diagnostics.WARN, f"{text} simulated ranges"
        late_s = max(self.late_ns / NS_PER_S, 0.0)
        if late_s > LATE_WARNING_S:
            level = diagnostics.WARN
            text = f"{text}; {late_s:.1f} s behind: the rate is too high for this machine"
            self._logger.warning(text, throttle_duration_sec=10.0)
        entries["behind s"] = f"{late_s:.3f}"
        return "simulated" if simulated else "recording", level, text, entries

    def _run(self) -> None:
        error: UwbMitigationError | None = None
        try:
            self._wait_for_subscribers()
            self._play()
        except UwbMitigationError as problem:
            error = problem
        except Exception as bug:
            # Otherwise the thread would end without a message, and the node would stop publishing.
            traceback.print_exc()
            error = UwbMitigationError(f"the source failed: {bug!r}", where=self._source.name)
        if not self._stopping.is_set():
            skipped = ", ".join(f"{count} x {kind}" for kind, count in sorted(self._source.skipped.items()))
            self._logger.info(f"played {self.played} ranges" + (f"; warnings: {skipped}" if skipped else ""))
            self._on_end(error)

    def _wait_for_subscribers(self) -> None:
        """Wait until there are enough subscribers and the graph had time to connect, or until the timeout."""
        required, started_s = self._value("wait_for_subscribers"), time.monotonic()
        while (count := self._output.subscription_count) < required:
            if time.monotonic() - started_s >= self._value("longest_wait"):
                self._logger.warning(f"{count} of {required} subscribers connected; the replay starts")
                return
            if self._stopping.wait(TICK_S):
                return
        delay_s = self._value("start_delay")
        if delay_s < 0.0:
            delay_s = 0.0 if required > 1 else ANNOUNCEMENT_S
        self._stopping.wait(delay_s)

    def _play(self) -> None:
        self._reference_clock_ns = self._clock.now_ns()
        due_ns = 0
        while not self._stopping.is_set():
            from_ns = self._seeks.popleft() if self._seeks else 0
            has_records, due_ns = self._play_from(from_ns, due_ns)
            if not self._seeks and not (self._value("loop") and has_records):
                return

    def _play_from(self, from_ns: int, due_ns: int) -> tuple[bool, int]:
        """Play until the source ends or a seek is requested.

        Returns:
            Whether the source has any record, and the played time at which the next one is due.
        """
        first_ns: int | None = None
        last_ns: int | None = None
        pause_ns, longest_ns = 1, int(self._value("longest_pause") * NS_PER_S)
        try:
            for record in self._recorded():
                recorded_ns = _recorded_ns(record)
                if first_ns is None:
                    first_ns = recorded_ns
                if recorded_ns - first_ns < from_ns:
                    if self._stopping.is_set() or self._seeks:
                        break
                    continue
                if last_ns is not None:
                    pause_ns = min(recorded_ns - last_ns, longest_ns)
                    due_ns += pause_ns
                else:
                    self._start_clock(due_ns)
                last_ns = recorded_ns
                late_ns = self._wait_until(due_ns, recorded_ns)
                if late_ns is None:
                    return True, min(due_ns, self._position_ns(self._clock.now_ns()))
                self.late_ns = late_ns
                stamp_ns = recorded_ns
                if not self._uses_recorded_stamps:
                    stamp_ns = self._clock.stamp_ns(self._clock_ns(due_ns))
                if not isinstance(record, Record):
                    self._flush()
                    assert self._robot is not None
                    self._robot.publish(record, stamp_ns - recorded_ns)
                    continue
                self._late.append((record, stamp_ns))
                if late_ns < LATE_NS or len(self._late) == BATCH:
                    self._flush()
        finally:
            # Publish what was read before an error of the source or a seek.
            self._flush()
        # The next round begins when the next record would be due.
        return first_ns is not None, due_ns + max(pause_ns, 1)

    def _recorded(self) -> Iterator[Record | RobotMessage]:
        if self._robot is None:
            return iter(self._source)
        self._robot.publish_static()
        return heapq.merge(self._source, self._robot, key=_recorded_ns)

    def _start_clock(self, due_ns: int) -> None:
        """Let a record be due not before now: opening a source and skipping records takes time."""
        now_ns = self._clock.now_ns()
        if self._clock_ns(due_ns) < now_ns:
            self._reference_ns, self._reference_clock_ns = due_ns, now_ns

    def _flush(self) -> None:
        if self._late:
            self._output.publish_records(self._late)
            self.played += len(self._late)
            self._late = []

    def _wait_until(self, due_ns: int, recorded_ns: int) -> int | None:
        """Wait until a record is due; return the delay, ns, or None if playing must stop."""
        while True:
            if self._stopping.is_set() or self._seeks:
                return None
            now_ns = self._clock.now_ns()
            if self._paused or self._pause_requested or self._requested_rate != self._rate:
                # Continue at the new rate, but never past the next record, so that stamps stay in order.
                self._reference_ns, self._reference_clock_ns = min(self._position_ns(now_ns), due_ns), now_ns
                self._paused, self._rate = self._pause_requested, self._requested_rate
            ahead_ns = self._clock_ns(due_ns) - now_ns
            if self._uses_recorded_stamps:
                # Simulated recordings start at 0, and ROS time cannot be negative.
                self._output.publish_clock(max(recorded_ns - int(max(ahead_ns, 0) * self._rate), 0))
            if ahead_ns <= 0 and not self._paused:
                return -ahead_ns
            self._flush()
            self._stopping.wait(TICK_S if self._paused else min(ahead_ns / NS_PER_S, TICK_S))

    def _clock_ns(self, due_ns: int) -> int:
        """Return the time of the replay clock at which a played time is due."""
        return self._reference_clock_ns + int((due_ns - self._reference_ns) / self._rate)

    def _position_ns(self, now_ns: int) -> int:
        """Return the played time at a time of the replay clock."""
        if self._paused:
            return self._reference_ns
        return self._reference_ns + int((now_ns - self._reference_clock_ns) * self._rate)


def _recorded_ns(item: Record | RobotMessage) -> int:
    return item.measurement.stamp_ns if isinstance(item, Record) else item.recorded_ns
