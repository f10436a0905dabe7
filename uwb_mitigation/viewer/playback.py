"""Play a recording: its scene shows the minute before the position of the player, from columns that a thread reads from the bag.

Only CIRs are read from the bag when they are shown.
"""

from __future__ import annotations

import math
import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.mitigation.model.choice import Choice
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.recorded_tracks import TagTracks
from uwb_mitigation.recordings.bag.anchor_markers import parse_markers
from uwb_mitigation.types.measurement import Cir
from uwb_mitigation.types.ros.topics import ANCHORS
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.viewer.histories import Pair
from uwb_mitigation.viewer.recording import POSITIONS, RANGES, Recording
from uwb_mitigation.viewer.scene import Displaced, Scene

MAX_STEP_S = 1.0
"""If no page was open for longer than this, playing continues from the last position."""

MAX_CHECKED = 50_000
"""A check of the anchors tracks once without each of them: a minute for this number of ranges."""

Check = Callable[[Sequence[TagTracks], EstimatorConfig], Displaced]


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
        timeline: the recording as far as it has been read.
        scene: what is shown; `index` sets its anchors.
        models: number of ranges that `index` corrected, by choice of the model.
        error: what has stopped the thread of `index`; the page shows it.
    """

    SPEEDS = 0.5, 1.0, 2.0, 5.0, 10.0, 50.0
    """Recorded seconds per second."""

    def __init__(self, path: Path, backend: Callable[[], Corrector], namespace: str | None = None) -> None:
        self.scene, self._new_backend = Scene(), backend
        self.timeline = recording = Recording(path, namespace)
        self.seconds, self.corrects = recording.seconds, recording.corrects
        self.position_s, self.speed, self.playing = 0.0, 1.0, False
        self.models: Mapping[Choice, int] = {}
        self.error: Exception | None = None
        needs = "they need anchors, and --height if all anchors have one height"
        self.scene.missing = {
            "ranges": "No ranges up to this time."
            if recording.contents & RANGES
            else "The recording contains tracks without ranges.",
            "anchors": "No anchor positions: set --anchors FILE.",
            "positions": "" if recording.contents & POSITIONS else f"No tag positions: {needs}.",
        }
        self._advanced_s, self._drawn_s = time.monotonic(), math.nan
        self._read_cir = lru_cache(16)(recording.read_cir)
        self.scene.clock = lambda: self.shown_s
        self.scene.stamp_clock = lambda: self.shown_s + recording.start_ns / NS_PER_S
        # Anchors are published once at the beginning.
        for event in islice(recording.events([ANCHORS]), 1):
            self.scene.set_anchors(parse_markers(event.message))

    @property
    def is_behind(self) -> bool:
        """Whether the bag has not been read up to the position."""
        return self.timeline.read_s < self.position_s

    @property
    def shown_s(self) -> float:
        """The position that the scene shows."""
        return min(self.position_s, self.timeline.read_s)

    def index(
        self,
        config: EstimatorConfig | None,
        stamp_offset_s: float = 0.0,
        check: Check | None = None,
        estimated: Sequence[TagTracks] = (),
    ) -> threading.Thread:
        """Read the recording in a thread, which is returned.

        Args:
            config: its anchors are shown; see `Recording.estimate`, also for the other arguments.
            stamp_offset_s: see there.
            check: returns `Scene.displaced` for estimated tracks.
            estimated: see there.

        Raises:
            UwbMitigationError: the backend cannot be opened.
        """
        timeline = self.timeline
        backend = self._new_backend() if self.corrects else None

        def run() -> None:
            try:
                timeline.read(backend)
                self.models = {} if backend is None else backend.used
                if config is not None:
                    timeline.estimate(config, stamp_offset_s, estimated)
                timeline.forget_ranges()
                timeline.is_complete = True
                self._show()
                if check is not None and config is not None and timeline.estimates:
                    if timeline.ranges <= MAX_CHECKED:
                        timeline.displaced = check(list(timeline.estimates.values()), config)
                    else:
                        limit = f"up to {MAX_CHECKED} ranges: run `track`."
                        timeline.notices.append(
                            f"The positions of anchors are checked in recordings of {limit}"
                        )
                self._show()
            except Exception as error:  # A player without a reader would wait for ever.
                self.error = error
                timeline.notices.append(f"Reading stopped: {type(error).__name__}: {error}")
                timeline.is_read = timeline.is_complete = True

        if config is not None:
            with self.scene.lock:
                self.scene.set_anchors(config.anchors.anchors)
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
        """Show a position."""
        self.position_s = min(max(position_s, 0.0), self.seconds)
        self._advanced_s = time.monotonic()
        self._show()

    def advance(self) -> None:
        """Advance by the time since the last call."""
        now_s = time.monotonic()
        passed_s, self._advanced_s = min(now_s - self._advanced_s, MAX_STEP_S), now_s
        if self.playing and not self.is_behind:
            self.position_s = min(self.position_s + self.speed * passed_s, self.seconds)
            self.playing = self.position_s < self.seconds
        if self.shown_s != self._drawn_s:
            self._show()

    def read_cir(self, pair: Pair) -> Cir | None:
        """Return the last CIR of a pair up to the position; None: it has none."""
        times_ns = self.timeline.cirs_ns.get(pair, [])
        count = bisect_right(times_ns, (self.shown_s + 1e-6) * NS_PER_S)
        return self._read_cir(pair, times_ns[count - 1]) if count else None

    def _show(self) -> None:
        self._drawn_s = self.shown_s
        with self.timeline.lock, self.scene.lock:
            self.scene.show(self.timeline, self._drawn_s)
