"""Play a bag into a scene as if its topics were live, from any position and in real time.

Only the data on the page is read: a seek reads the minute before, and playing continues from there. A bag of any size
therefore opens quickly and needs little memory.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.mitigation.model.choice import Choice
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.recorded_tracks import TagTracks
from uwb_mitigation.types.ros.topics import ANCHORS
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.histories import HISTORY_S
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.recording import (
    POSITIONS,
    RANGES,
    Event,
    Recording,
    Timeline,
    corrected_events,
    index_recording,
)
from uwb_mitigation.viewer.scene import MissingData, NodeStatus, Scene

READ_S = 0.15
"""Maximum duration of one read, so that the page reacts to commands; playing continues at the position that was reached."""

MAX_STEP_S = 1.0
"""If no page was open for longer than this, playing continues from the last position."""

MAX_MESSAGES = 3000
"""Read at a seek; older ones are skipped."""

MAX_CHECKED = 50_000
"""A check of the anchors tracks once without each of them: a minute for this number of ranges."""

Check = Callable[[Sequence[TagTracks], EstimatorConfig], dict[int, float]]


class BagPlayer:
    """Player of the ranges or tracks of a bag; updates a scene, which all pages show.

    If the bag contains raw ranges only, they are corrected for display.

    Args:
        path, namespace: see `Recording`, also for errors.
        backend: returns the backend that corrects raw ranges; called only if the bag has no corrected ranges.

    Attributes:
        seconds: duration of the recording.
        position_s: the current position.
        playing: whether `advance` changes the position.
        speed: recorded seconds per second.
        corrects: whether the bag contains raw ranges only.
        timeline: index of the recording; None: not ready.
        is_behind: whether the messages up to the position have not been read yet.
        scene: what is shown; `index` sets its anchors.
        missing: messages for the page on data that the bag does not contain.
        models: number of ranges that `index` corrected, by choice of the model.
    """

    SPEEDS = 0.5, 1.0, 2.0, 5.0, 10.0, 50.0
    """Recorded seconds per second."""

    def __init__(self, path: Path, backend: Callable[[], Corrector], namespace: str | None = None) -> None:
        self.scene, self._new_backend = Scene(), backend
        self._feed = SceneUpdater(self.scene)
        self._recording = recording = Recording(path, namespace)
        self.seconds, self.corrects = recording.seconds, recording.corrects
        self.position_s, self.speed, self.playing = 0.0, 1.0, False
        self.is_behind = False
        self.timeline: Timeline | None = None
        self.models: Mapping[Choice, int] = {}
        self.missing = MissingData("No ranges up to this time.", "No anchor positions: set --anchors FILE.")
        if not recording.contents & RANGES:
            self.missing.ranges = "The recording contains tracks without ranges."
        if not recording.contents & POSITIONS:
            needs = "they need anchors, and --height if all anchors have one height"
            self.missing.positions = f"No tag positions: {needs}."
        self._stamp_offset_s = 0.0
        self._backend = backend() if self.corrects else None
        self._next: Event | None = None
        self._advanced_s, self._clock_s = time.monotonic(), 0.0
        self.scene.clock = lambda: self._clock_s
        self.scene.stamp_clock = lambda: self._clock_s + recording.start_ns / NS_PER_S
        self._window_s = min(HISTORY_S, MAX_MESSAGES / max(recording.rate_hz, 1e-9))
        # Anchors are published once at the beginning.
        with contextlib.suppress(RecordingError, StopIteration):
            self._feed.add(ANCHORS, next(recording.events([ANCHORS])).message)
        self.seek(0.0)

    @property
    def shown_s(self) -> float:
        """The position that the scene shows: while playing, that of the last message that was read."""
        return min(self._clock_s, self.position_s) if self.playing and self.is_behind else self.position_s

    def index(
        self,
        config: EstimatorConfig | None,
        stamp_offset_s: float = 0.0,
        check: Check | None = None,
        estimated: Sequence[TagTracks] = (),
    ) -> threading.Thread:
        """Index the recording in a thread, which is returned.

        Args:
            config: of the estimators, see `index_recording`; its anchors are shown.
            stamp_offset_s: added to the stamps of the ranges.
            check: returns `Timeline.displaced` for estimated tracks.
            estimated: tracks that are known already.
        """

        def run() -> None:
            recording = Recording(self._recording.path, self._recording.prefix)
            backend = self._new_backend() if self.corrects else None

            def publish(timeline: Timeline) -> None:
                self.timeline = timeline

            timeline = index_recording(recording, config, backend, publish, stamp_offset_s, estimated)
            self.models = {} if backend is None else backend.used
            with self.scene.lock:
                self.scene.is_indexed = True
                self.scene.revision += 1
            if check is None or config is None or not timeline.estimates:
                return
            if len(timeline.log_s) > MAX_CHECKED:
                timeline.notices.append(
                    f"The positions of anchors are checked in recordings of up to {MAX_CHECKED} ranges: run `track`."
                )
            else:
                timeline.displaced = check(list(timeline.estimates.values()), config)
            with self.scene.lock:
                self.scene.revision += 1

        if config is not None:
            with self.scene.lock:
                self.scene.set_anchors(config.anchors.anchors)
        self._stamp_offset_s = stamp_offset_s
        thread = threading.Thread(target=run, name="index", daemon=True)
        thread.start()
        return thread

    def command(self, name: str, *arguments: Any) -> None:
        """Execute a command of the page."""
        if name == "play":
            self.play(bool(arguments[0]))
        elif name == "seek" and math.isfinite(position_s := float(arguments[0])):
            self.seek(position_s)
        elif name == "speed" and float(arguments[0]) in self.SPEEDS:
            self.speed = float(arguments[0])

    def play(self, on: bool) -> None:
        """Play or pause; at the end, the recording starts again."""
        if on and self.position_s >= self.seconds:
            self.seek(0.0)
        self.playing = on
        self._advanced_s = time.monotonic()

    def seek(self, position_s: float) -> None:
        """Show a position, with the minute before it."""
        self._feed.clear()
        self._shown: dict[tuple[str, TrackKind], int] = {}
        self.position_s = min(max(position_s, 0.0), self.seconds)
        start_ns = max(int((self.position_s - self._window_s) * NS_PER_S), 0)
        self._next = None
        # The anchors are known already, and may have come from a file.
        events = self._recording.events(self._recording.contents - {ANCHORS}, start_ns)
        self._events: Iterator[Event] = corrected_events(events, self._backend)
        self._advanced_s = time.monotonic()
        self._read()

    def advance(self) -> None:
        """Advance by the time since the last call."""
        now_s = time.monotonic()
        passed_s, self._advanced_s = min(now_s - self._advanced_s, MAX_STEP_S), now_s
        if self.playing and not self.is_behind:
            self.position_s = min(self.position_s + self.speed * passed_s, self.seconds)
            self.playing = self.position_s < self.seconds
        self._read()

    def _read(self) -> None:
        """Read up to the current position for at most `READ_S`; the next call continues."""
        stop_ns, end_s = round(self.position_s * NS_PER_S), time.monotonic() + READ_S
        self.is_behind = False
        try:
            while not self.is_behind:
                event = self._next or next(self._events, None)
                self._next = None
                if event is None:
                    break
                if event.time_ns > stop_ns:
                    self._next = event
                    break
                self._clock_s = event.time_ns / NS_PER_S
                self._feed.add(event.topic, event.message, event.tag)
                self.is_behind = time.monotonic() >= end_s
        except RecordingError as error:
            self._events = iter(())
            self._feed.report("recording", NodeStatus(2, f"{error.what}: nothing beyond can be shown"))
        if not self.is_behind:
            self._clock_s = self.position_s
        if self.timeline is not None and self.timeline.is_complete:
            self._show_tracks(self.timeline)

    def _show_tracks(self, timeline: Timeline) -> None:
        """Show tracks and estimated positions of the index up to the current time."""
        for key, track in timeline.tracks.items():
            (name, kind), count = key, int(np.searchsorted(track[:, 0], self._clock_s, side="right"))
            if self._shown.get(key) == count:
                continue
            self._shown[key] = count
            with self.scene.lock:
                self.scene.set_track(*key, track[:count])
            if count and kind is TrackKind.CORRECTED and name in timeline.estimates:
                estimate = next(iter(timeline.estimates[name].live.take(slice(count - 1, count))))
                self._feed.estimate(name, estimate, float(track[count - 1, 0]), self._stamp_offset_s)
