"""Play a bag into a scene as if its topics were live, from any position and in real time.

Only the data on the page is read: a seek reads the minute before, and playing continues from there. A bag of any size
therefore opens quickly and needs little memory.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from uwb_mitigation.bag import schemas
from uwb_mitigation.bag.codec import decode_range, measurement_key
from uwb_mitigation.bag.reader import BagReader, RawMessage, check_channel
from uwb_mitigation.bag.topics import (
    ANCHORS,
    MARKERS_TYPE,
    ODOMETRY,
    ODOMETRY_TRUTH,
    ODOMETRY_TYPE,
    POSE,
    POSE_SMOOTHED,
    POSE_TYPE,
    RANGE_CIR_TYPE,
    RANGE_CORRECTED,
    RANGE_CORRECTED_TYPE,
    RANGE_RAW,
    RANGE_TRUTH,
    RANGE_TRUTH_TYPE,
)
from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.measurement import RangeMeasurement
from uwb_mitigation.mitigation import Backend
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.geometry import Height
from uwb_mitigation.viewer.feed import Feed
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import (
    DEFAULT_TAG,
    HISTORY_S,
    MAX_MESSAGES,
    MAX_TRACK,
    SPEEDS,
    MissingData,
    NodeStatus,
    Pair,
)
from uwb_mitigation.viewer.timeline import Contents, Timeline

DIAGNOSTICS = "/diagnostics"
DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"

MAX_STEP_S = 1.0
"""If no page was open for longer than this, playing continues from the last position."""

POSE_PERIOD_S = 0.1
"""Recorded time between two positions of a tag."""

_BATCH = 256
_RANGE_TYPES = {
    RANGE_RAW: RANGE_CIR_TYPE,
    RANGE_TRUTH: RANGE_TRUTH_TYPE,
    RANGE_CORRECTED: RANGE_CORRECTED_TYPE,
}
_POSITION_TYPES = {POSE: POSE_TYPE, ODOMETRY: ODOMETRY_TYPE, POSE_SMOOTHED: POSE_TYPE}
_POSITION_TOPIC = re.compile(r"(.*)/uwb/(?:(tag_(?:\d+|0x[0-9a-f]+))/)?(pose|odometry|pose_smoothed)")


class BagPlayer:
    """Player of the ranges or tracks of a bag; updates the scene of `feed`, which all pages show.

    If the bag contains raw ranges only, they are corrected for display.

    Args:
        path: an MCAP file or a rosbag2 folder.
        feed: adds messages to the scene.
        backend: returns the backend that corrects raw ranges; called only if the bag has no corrected ranges.
        namespace: namespace of the topics, such as `/board1`; None: the only namespace with ranges (or tracks) in the bag.

    Attributes:
        seconds: duration of the recording.
        position_s: the current position.
        playing: whether `advance` changes the position.
        speed: recorded seconds per second.
        corrects: whether the bag contains raw ranges only.
        timeline: index of the recording; None: not ready.
        companion: player of another recording of the same drive, which follows this one.
        missing: messages for the page on data that the bag does not contain.

    Raises:
        RecordingError: the path is not an MCAP bag, or contains neither ranges nor tracks, or ranges of another version.
        ParameterError: the bag has several namespaces, and none was given.
    """

    def __init__(
        self, path: Path, feed: Feed, backend: Callable[[], Backend], namespace: str | None = None
    ) -> None:
        self._feed = feed
        self._bag = BagReader(path)
        topics, bounds = self._bag.topics, self._bag.bounds_ns
        prefix = _namespace(path, topics) if namespace is None else namespace.rstrip("/")
        has_ranges = bool({prefix + RANGE_RAW, prefix + RANGE_CORRECTED} & topics.keys())
        positions = _positions(prefix, topics)
        if bounds is None or not (has_ranges or positions):
            raise _no_ranges(path, topics)
        for channel in self._bag.channels:
            if kind := _RANGE_TYPES.get(channel.topic.removeprefix(prefix)):
                check_channel(channel, kind, path)
        self._start_ns, end_ns = bounds
        self.seconds = (end_ns - self._start_ns) / 1e9
        self.position_s = 0.0
        self.playing = False
        self.speed = 1.0
        self.timeline: Timeline | None = None
        self.companion: BagPlayer | None = None
        self.corrects = has_ranges and prefix + RANGE_CORRECTED not in topics
        self.missing = MissingData(
            ranges="No ranges up to this time."
            if has_ranges
            else "The recording contains tracks without ranges.",
            anchors="No anchor positions: set --anchors FILE.",
            positions=""
            if positions
            else "No tag positions: they need anchors, and --height if all anchors have one height.",
        )
        self._new_backend = backend
        self._backend = backend() if self.corrects else None
        kinds = {POSE_SMOOTHED: TrackKind.SMOOTHED}
        self._contents = Contents(
            path,
            prefix,
            self._start_ns,
            {
                topic: (_POSITION_TYPES[plain], tag, kinds.get(plain, TrackKind.CORRECTED))
                for topic, (tag, plain) in positions.items()
            },
        )
        self._callbacks = self._callbacks_of(prefix, topics)
        self._uncorrected: list[tuple[float, RangeMeasurement]] = []
        self._next: RawMessage | None = None
        self._messages: Iterator[RawMessage] = iter(())
        self._advanced_s = time.monotonic()
        self._clock_s, self._posed_s = 0.0, -math.inf
        feed.scene.clock = lambda: self._clock_s
        per_s = self._bag.message_count / max(self.seconds, 1e-9)
        self._window_s = min(HISTORY_S, MAX_MESSAGES / max(per_s, 1e-9))
        # Anchors are published once at the beginning.
        if (topic := prefix + ANCHORS) in self._callbacks:
            with contextlib.suppress(RecordingError):
                for message in islice(self._bag.messages([topic]), 1):
                    self._callbacks[topic](message.data)
        self.seek(0.0)

    def index(self, anchors: AnchorMap | None, height: Height | None = None) -> threading.Thread:
        """Index the recording in a thread, which is returned; `anchors` and `height` are used for tracks."""

        def run() -> None:
            self.timeline = self._contents.index(
                anchors, height, self._new_backend() if self.corrects else None
            )
            with self._feed.lock:
                self._feed.scene.heat = self.timeline.heat
                self._feed.scene.is_indexed = True

        thread = threading.Thread(target=run, name="index", daemon=True)
        thread.start()
        return thread

    def command(self, name: str, *arguments: Any) -> Pair | None:
        """Execute a command of the page; return the pair to select, if any."""
        if name == "play":
            self.play(bool(arguments[0]))
        elif name == "seek" and math.isfinite(position_s := float(arguments[0])):
            self.seek(position_s)
        elif name == "speed" and float(arguments[0]) in SPEEDS:
            self.speed = float(arguments[0])
        elif name == "step":
            self.step()
        elif name == "next_bad" and self.timeline is not None:
            return self.jump(self.timeline.next_bad(self.position_s))
        elif name == "largest" and self.timeline is not None:
            return self.jump(self.timeline.largest_error())
        return None

    def step(self) -> None:
        """Advance to the next range."""
        if self.timeline is not None:
            row = int(np.searchsorted(self.timeline.time_s, self.position_s + 1e-6))
            if row < len(self.timeline.time_s):
                self.playing = False
                self._move(float(self.timeline.time_s[row]))

    def jump(self, row: int | None) -> Pair | None:
        """Pause at a row of the timeline, and return its pair."""
        if self.timeline is None or row is None:
            return None
        self.playing = False
        self.seek(float(self.timeline.time_s[row]) + 1e-6)
        return self.timeline.pairs[row]

    def play(self, on: bool) -> None:
        """Play or pause; at the end, the recording starts again."""
        if on and self.position_s >= self.seconds:
            self.seek(0.0)
        self.playing = on
        self._advanced_s = time.monotonic()

    def seek(self, position_s: float) -> None:
        """Show a position, with the minute before it."""
        self.position_s = min(max(position_s, 0.0), self.seconds)
        self._feed.clear()
        self._shown: dict[tuple[str, TrackKind], int] = {}
        start_ns = self._start_ns + int((self.position_s - self._window_s) * 1e9)
        self._next = None
        self._messages = self._bag.messages(self._callbacks, max(start_ns, 0))
        self._read()
        self._advanced_s = time.monotonic()
        if self.companion is not None:
            self.companion.seek(self._companion_position())

    def advance(self) -> None:
        """Advance by the time since the last call."""
        now_s = time.monotonic()
        passed_s, self._advanced_s = min(now_s - self._advanced_s, MAX_STEP_S), now_s
        if self.playing:
            self.playing = self.position_s + self.speed * passed_s < self.seconds
            self._move(self.position_s + self.speed * passed_s)
        else:
            self._read()

    def _move(self, position_s: float) -> None:
        self.position_s = min(max(position_s, 0.0), self.seconds)
        self._read()
        if self.companion is not None:
            self.companion._move(self._companion_position())

    def _companion_position(self) -> float:
        assert self.companion is not None
        return self.position_s + (self._start_ns - self.companion._start_ns) / 1e9

    def _read(self) -> None:
        """Read up to the current position; at most `MAX_MESSAGES`, the rest at the next call."""
        stop_ns = self._start_ns + round(self.position_s * 1e9)
        try:
            for _ in range(MAX_MESSAGES):
                message = self._next or next(self._messages, None)
                self._next = None
                if message is None:
                    break
                if message.log_time_ns > stop_ns:
                    self._next = message
                    break
                self._clock_s = (message.log_time_ns - self._start_ns) / 1e9
                self._show_poses()
                self._callbacks[message.channel.topic](message.data)
        except RecordingError as error:
            self._messages = iter(())
            self._feed.report("recording", NodeStatus(2, f"{error.what}: nothing beyond can be shown"))
        self._correct()
        self._clock_s = self.position_s
        self._posed_s = -math.inf
        self._show_poses()
        if self.timeline is not None:
            self._show_tracks(self.timeline)

    def _show_poses(self) -> None:
        """Show the estimates of the index at the time of the message that is read."""
        if self.timeline is None or 0.0 <= self._clock_s - self._posed_s < POSE_PERIOD_S:
            return
        self._posed_s = self._clock_s
        for tag, estimates in self.timeline.estimates.items():
            time_s, _ = self.timeline.tracks[tag, TrackKind.CORRECTED]
            if count := int(np.searchsorted(time_s, self._clock_s, side="right")):
                self._feed.estimate(tag, estimates[count - 1])

    def _show_tracks(self, timeline: Timeline) -> None:
        """Show the tracks up to the current position."""
        scene = self._feed.scene
        for key, (time_s, position) in timeline.tracks.items():
            count = int(np.searchsorted(time_s, self.position_s, side="right"))
            if self._shown.get(key) != count:
                self._shown[key] = count
                step = max(1, math.ceil(count / MAX_TRACK))
                with self._feed.lock:
                    scene.set_track(*key, position[:count:step, :2].tolist())

    def _callbacks_of(self, prefix: str, topics: dict[str, str]) -> dict[str, Callable[[bytes], None]]:
        """Return the callback of each topic that is shown."""
        feed = self._feed
        callbacks: dict[str, Callable[[bytes], None]] = {
            prefix + RANGE_RAW: self._raw if self.corrects else feed.range_raw,
            prefix + RANGE_TRUTH: feed.range_truth,
            prefix + RANGE_CORRECTED: feed.range_corrected,
        }
        standard: dict[str, tuple[str, Callable[[Any], None]]] = {
            prefix + ODOMETRY_TRUTH: (ODOMETRY_TYPE, feed.true_position),
            prefix + ANCHORS: (MARKERS_TYPE, feed.markers),
            DIAGNOSTICS: (DIAGNOSTICS_TYPE, feed.diagnostics),
        }
        for topic, (tag, plain) in _positions(prefix, topics).items():
            add = feed.smoothed if plain == POSE_SMOOTHED else feed.pose
            standard[topic] = _POSITION_TYPES[plain], partial(add, tag)
        for topic, (kind, take) in standard.items():
            if topics.get(topic, "").replace("/msg/", "/") == kind.replace("/msg/", "/"):
                callbacks[topic] = partial(self._standard, kind, take)
        return {topic: take for topic, take in callbacks.items() if topic in topics}

    def _standard(self, kind: str, take: Callable[[Any], None], data: bytes) -> None:
        """Decode a standard message with the types of ROS 2 Jazzy, and pass it to `take`."""
        try:
            take(schemas.typestore().deserialize_cdr(data, kind))
        except Exception:  # rosbags raises various types, and values may be invalid.
            self._feed.malformed += 1

    def _raw(self, data: bytes) -> None:
        try:
            measurement = decode_range(data)
        except RecordingError:
            self._feed.malformed += 1
            return
        self._feed.measurement(measurement)
        self._uncorrected.append((self._clock_s, measurement))
        if len(self._uncorrected) == _BATCH:
            self._correct()

    def _correct(self) -> None:
        if self._backend is None:
            return
        batch, self._uncorrected = self._uncorrected, []
        results = self._backend.correct([measurement for _, measurement in batch])
        for (self._clock_s, measurement), corrected in zip(batch, results, strict=True):
            self._show_poses()
            self._feed.corrected(measurement_key(measurement), corrected)


def _positions(prefix: str, topics: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return the topics with estimated positions, {topic: (tag, its plain topic)}.

    Tracks (the output of `track`) are used only if there are no poses.
    """
    found = {
        topic: (match[2] or DEFAULT_TAG, f"/uwb/{match[3]}")
        for topic in topics
        if (match := _POSITION_TOPIC.fullmatch(topic)) and match[1] == prefix
    }
    poses = {topic: entry for topic, entry in found.items() if entry[1] == POSE}
    return poses or found


def _namespace(path: Path, topics: dict[str, str]) -> str:
    """Return the only namespace with ranges, or with tracks if there are no ranges."""
    found = {
        topic.removesuffix(name)
        for topic in topics
        for name in (RANGE_RAW, RANGE_CORRECTED)
        if topic.endswith(name)
    } or {match[1] for topic in topics if (match := _POSITION_TOPIC.fullmatch(topic))}
    if len(found) > 1:
        raise ParameterError(
            "several namespaces",
            where=str(path),
            valid="--namespace with one of: " + ", ".join(repr(name) for name in sorted(found)),
        )
    if not found:
        raise _no_ranges(path, topics)
    return found.pop()


def _no_ranges(path: Path, topics: dict[str, str]) -> RecordingError:
    known = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items()))
    return RecordingError(
        "no ranges and no tracks", where=str(path), valid=f"the bag contains: {known or 'no topic'}"
    )
