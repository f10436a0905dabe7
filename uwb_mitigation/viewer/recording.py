"""A recording: its topics in one namespace, and its index with all ranges and the complete tracks of the tags.

The time of a message is its stamp, or its log time if they differ by more than `MAX_STAMP_S`. The player and its marks use
the log time, because it is the time at which a subscriber received the message.
"""

from __future__ import annotations

import contextlib
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError, RecordingError, format_id
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.online.robot_estimator import live_track
from uwb_mitigation.positioning.recorded_tracks import TagTracks, check_one_tag, track_tag
from uwb_mitigation.recordings.bag.pose_paths import read_truth
from uwb_mitigation.recordings.bag.reader import BagReader, check_channel
from uwb_mitigation.recordings.recorded_ranges import KEY, RangeTable, Table, match
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import CORRECTED, FAULTS
from uwb_mitigation.types.ros import schemas, topics
from uwb_mitigation.types.ros.codec import measurement_key
from uwb_mitigation.types.ros.poses import tag_frame
from uwb_mitigation.types.stamps import NS_PER_S, to_ns
from uwb_mitigation.types.tracks import Track, TruePath
from uwb_mitigation.viewer.feed import DECODERS
from uwb_mitigation.viewer.histories import MAX_RANGE_M, NO_DATA_S, Pair, RangeColumns
from uwb_mitigation.viewer.incidents import Incidents
from uwb_mitigation.viewer.palette import ATTRIBUTES, TrackKind
from uwb_mitigation.viewer.scene import DEFAULT_TAG, MAX_TAGS, Counts, tag_label, tag_name

BATCH = 64
"""Number of messages that are read ahead to correct their ranges in one call."""
POSITIONS = frozenset({topics.POSE, topics.ODOMETRY, topics.POSE_SMOOTHED})
RANGES = frozenset({topics.RANGE_RAW, topics.RANGE_CORRECTED})

_POSITION_TOPIC = re.compile(r"(.*)/uwb/(?:(tag_(?:\d+|0x[0-9a-f]+))/)?(pose|odometry|pose_smoothed)")


class Event(NamedTuple):
    """A decoded message.

    Attributes:
        time_ns: log time since the beginning of the recording.
        topic: without namespace and tag.
        message: None: it cannot be decoded.
        tag: of a position; otherwise `DEFAULT_TAG`.
    """

    time_ns: int
    topic: str
    message: Any
    tag: str


class Recording:
    """A bag with ranges or tracks.

    Args:
        path: an MCAP file or a rosbag2 folder.
        namespace: namespace of the topics, such as `/board1`; None: the only namespace with ranges (or tracks) in the bag.

    Attributes:
        start_ns: time of the first message. seconds: duration.
        prefix: the namespace.
        contents: topics without namespace and tag.

    Raises:
        RecordingError: the path is not an MCAP bag, or contains neither ranges nor tracks, or ranges of another version.
        ParameterError: the bag has several namespaces, and none was given.
    """

    def __init__(self, path: Path, namespace: str | None = None) -> None:
        self.path, self._bag = path, BagReader(path)
        types, bounds = self._bag.topics, self._bag.bounds_ns
        self.prefix = prefix = _namespace(path, types) if namespace is None else namespace.rstrip("/")
        for channel in self._bag.channels:
            if (plain := channel.topic.removeprefix(prefix)) in DECODERS:
                check_channel(channel, topics.TYPES[plain], path)
        self._topics: dict[str, tuple[str, str]] = {}
        for topic, kind in types.items():
            plain, tag = topic.removeprefix(prefix), DEFAULT_TAG
            if match := _POSITION_TOPIC.fullmatch(topic):
                plain, tag = f"/uwb/{match[3]}", match[2] or DEFAULT_TAG
            is_selected = match[1] == prefix if match else topic in (prefix + plain, topics.DIAGNOSTICS)
            expected = topics.TYPES.get(plain, "")
            if is_selected and kind.replace("/msg/", "/") == expected.replace("/msg/", "/"):
                self._topics[topic] = plain, tag
        if topics.POSE in self.contents:
            # Tracks (the output of `track`) are used only if there are no poses.
            tracks = POSITIONS - {topics.POSE}
            self._topics = {topic: names for topic, names in self._topics.items() if names[0] not in tracks}
        if bounds is None or not self.contents & (RANGES | POSITIONS):
            raise _no_ranges(path, types)
        self.start_ns, self.seconds = bounds[0], (bounds[1] - bounds[0]) / 1e9
        self.rate_hz = self._bag.message_count / max(self.seconds, 1e-9)

    @property
    def contents(self) -> set[str]:
        return {plain for plain, _ in self._topics.values()}

    @property
    def corrects(self) -> bool:
        """Whether the bag contains raw ranges only."""
        return self.contents & RANGES == {topics.RANGE_RAW}

    def events(self, selected: Collection[str], start_ns: int = 0) -> Iterator[Event]:
        """Yield the messages of topics from a time since the beginning.

        Raises:
            RecordingError: the bag is damaged; every message before the damage has been yielded.
        """
        names = [topic for topic, (plain, _) in self._topics.items() if plain in selected]
        for message in self._bag.messages(names, self.start_ns + start_ns):
            plain, tag = self._topics[message.channel.topic]
            yield Event(message.log_time_ns - self.start_ns, plain, _decode(plain, message.data), tag)


def corrected_events(events: Iterator[Event], backend: Corrector | None) -> Iterator[Event]:
    """Yield events, and with a backend a corrected range after each raw one.

    Raises:
        RecordingError: the bag is damaged; every event before the damage has been yielded.
    """
    if backend is None:
        yield from events
        return
    is_end, damage = False, None
    while not is_end:
        batch = list[Event]()
        try:
            # After an error, `batch` contains the events before.
            batch.extend(islice(events, BATCH))
        except RecordingError as error:
            damage = error
        is_end = len(batch) < BATCH
        raw = [event for event in batch if event.topic == topics.RANGE_RAW and event.message is not None]
        results = dict(zip(map(id, raw), backend.correct([event.message for event in raw]), strict=True))
        for event in batch:
            yield event
            if (result := results.get(id(event))) is not None:
                corrected = measurement_key(event.message), result
                yield event._replace(topic=topics.RANGE_CORRECTED, message=corrected)
    if damage is not None:
        raise damage


def _decode(topic: str, data: bytes) -> Any:
    try:
        if topic in DECODERS:
            return DECODERS[topic](data)
        return schemas.typestore().deserialize_cdr(data, topics.TYPES[topic])
    except Exception:  # rosbags raises various types.
        return None


def _namespace(path: Path, types: dict[str, str]) -> str:
    """Return the only namespace with ranges, or with tracks if there are no ranges."""
    prefixes = {topic.removesuffix(name) for topic in types for name in RANGES if topic.endswith(name)}
    prefixes = prefixes or {match[1] for topic in types if (match := _POSITION_TOPIC.fullmatch(topic))}
    if len(prefixes) > 1:
        names = ", ".join(map(repr, sorted(prefixes)))
        raise ParameterError("several namespaces", where=str(path), valid=f"--namespace with one of: {names}")
    if not prefixes:
        raise _no_ranges(path, types)
    return prefixes.pop()


def _no_ranges(path: Path, types: dict[str, str]) -> RecordingError:
    contents = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items()))
    return RecordingError(
        "no ranges and no tracks", where=str(path), valid=f"the bag contains: {contents or 'no topic'}"
    )


MAX_STAMP_S = 1.0
"""If stamp and log time of a message differ by more, its time is the log time."""
_KINDS = {topics.ODOMETRY_TRUTH: TrackKind.TRUE, topics.POSE_SMOOTHED: TrackKind.SMOOTHED}
_TRUTH = np.dtype([*KEY, ("true_m", "f8")])


@dataclass
class Timeline:
    """Everything about a recording that does not depend on the position of the player.

    Attributes:
        log_s: log time of each range from the beginning, float64 (n,), increasing.
        anchor, tag: ids of each range, uint64 (n,).
        columns: all ranges; times are from the beginning.
        notices: messages for the page.
        tracks: {(tag, kind): float64 (k, 5), time (s), x, y, z and horizontal standard deviation (m)}.
        estimates: {tag: its estimated tracks}, if the recording contains no positions.
        incidents: (log time, text).
        displaced: {anchor whose ranges fit another position: its median held-out residual, m}.
        is_complete: whether tracks, residuals and incidents have been added.
    """

    log_s: NDArray[np.float64]
    anchor: NDArray[np.uint64]
    tag: NDArray[np.uint64]
    columns: RangeColumns
    notices: list[str] = field(default_factory=list)
    tracks: dict[tuple[str, TrackKind], NDArray[np.float64]] = field(default_factory=dict)
    estimates: dict[str, TagTracks] = field(default_factory=dict)
    incidents: list[tuple[float, str]] = field(default_factory=list)
    displaced: dict[int, float] = field(default_factory=dict)
    is_complete: bool = False

    @cached_property
    def bad(self) -> NDArray[np.bool_]:
        """Whether the status of each range needs attention."""
        return np.isin(self.columns.status, FAULTS)

    @cached_property
    def counts(self) -> Counts:
        """Numbers of ranges."""
        return int(np.isin(self.columns.status, CORRECTED).sum()), len(self.bad), int(self.bad.sum())

    @cached_property
    def rows(self) -> dict[Pair, NDArray[np.intp]]:
        """Rows of each pair."""
        order = np.lexsort((self.tag, self.anchor))
        is_new = (np.diff(self.anchor[order]) != 0) | (np.diff(self.tag[order]) != 0)
        rows_of_pairs = np.split(order, np.flatnonzero(is_new) + 1) if len(order) else []
        return {(int(self.anchor[rows[0]]), int(self.tag[rows[0]])): rows for rows in rows_of_pairs}

    def ranges(self, pair: Pair, begin_s: float = -np.inf, end_s: float = np.inf) -> RangeColumns:
        """Return the ranges of a pair in an interval of the log time."""
        rows = self.rows.get(pair, np.zeros(0, np.intp))
        rows = rows[slice(*np.searchsorted(self.log_s[rows], (begin_s, end_s + 1e-6), side="right"))]
        return RangeColumns(*(column[rows] for column in self.columns))

    @property
    def range_errors(self) -> NDArray[np.float64]:
        """Raw and corrected errors of the ranges with known truth, m, float64 (2, k)."""
        errors = np.stack([self.columns.raw_m, self.columns.corrected_m]) - self.columns.true_m
        return errors[:, (np.abs(errors) <= MAX_RANGE_M).all(axis=0)]


def index_recording(
    recording: Recording,
    config: EstimatorConfig | None,
    backend: Corrector | None,
    publish: Callable[[Timeline], None],
    stamp_offset_s: float = 0.0,
    estimated: Sequence[TagTracks] = (),
) -> Timeline:
    """Read a recording.

    Args:
        recording: the bag.
        config: of the estimators of tracks; None: the anchors are unknown.
        backend: corrects raw ranges; None: the recording contains corrected ranges.
        publish: called with the timeline as soon as the ranges have been read; the estimation of tracks takes longer.
        stamp_offset_s: added to the stamps of the ranges.
        estimated: tracks with `config` that are known already.
    """
    reader = _Reader(recording, backend)
    # The player reports the damage of a bag when it reaches it.
    with contextlib.suppress(RecordingError):
        reader.read()
    ranges = reader.table.corrected.array()
    timeline = reader.timeline(ranges)
    publish(timeline)
    if config is not None and len(ranges):
        truths: dict[int | None, TruePath] = {}
        with contextlib.suppress(RecordingError):
            truths = read_truth(recording.path, recording.prefix + topics.ODOMETRY_TRUTH)
        recorded = reader.table.by_tag(config.anchors, stamp_offset_s, truths)
        by_tag = {tracks.recording.tag_id: tracks for tracks in estimated}
        has_positions = bool(recording.contents & POSITIONS)
        names = {name for name, kind in timeline.tracks if kind is TrackKind.CORRECTED}
        for tag in recorded.tags[:MAX_TAGS]:
            name = tag_name(tag.tag_id, names, timeline.rows) or tag_frame(tag.tag_id)
            tracks: dict[TrackKind, Track] = {}
            if has_positions:
                tracks[TrackKind.RAW] = live_track(config, tag.raw)
            else:
                try:
                    check_one_tag(config, recorded.tags)
                    estimate = by_tag.get(tag.tag_id) or track_tag(tag, config)
                except (DatasetError, ParameterError) as error:
                    timeline.notices.append(str(error))
                    continue
                timeline.estimates[name] = estimate
                tracks = {kind: getattr(estimate, attribute) for kind, attribute in ATTRIBUTES.items()}
                label, state = f"tag {format_id(tag.tag_id)}", str(estimate.determination)
                timeline.notices += [
                    f"{label}{' determination' * (text == state)}: {text}" for text in estimate.warnings
                ]
            rows = np.flatnonzero(ranges["tag"] == tag.tag_id)
            rows = rows[np.argsort(ranges["stamp_ns"][rows], kind="stable")]
            stamp_ns = ranges["stamp_ns"][rows] + round(stamp_offset_s * NS_PER_S)
            for kind, track in tracks.items():
                # Relative stamps: a float64 resolves nanoseconds since 1970 only to a fraction of a microsecond.
                since_ns = track.stamp_ns - stamp_ns[0]
                track_s = np.interp(since_ns, stamp_ns - stamp_ns[0], timeline.columns.time_s[rows])
                sd_m = np.sqrt(track.covariance[:, 0, 0] + track.covariance[:, 1, 1])
                timeline.tracks[name, kind] = np.column_stack([track_s, track.position, sd_m])
        add_residuals(timeline, config.anchors)
    timeline.incidents = _incidents(timeline, recording.seconds)
    timeline.is_complete = True
    return timeline


class _Reader:
    """Reads ranges, truths and positions of a recording."""

    def __init__(self, recording: Recording, backend: Corrector | None) -> None:
        self._recording, self._backend = recording, backend
        self._truths = Table(_TRUTH)
        self._points = defaultdict[tuple[str, TrackKind], list[tuple[float, ...]]](list)
        self._delays_s: dict[str, float] = {}
        self.table = RangeTable()

    def read(self) -> None:
        names = {
            topics.RANGE_RAW,
            topics.RANGE_CORRECTED,
            topics.RANGE_TRUTH,
            topics.ODOMETRY_TRUTH,
            *POSITIONS,
        }
        for log_ns, topic, message, tag in corrected_events(self._recording.events(names), self._backend):
            if message is None:
                continue
            if topic == topics.RANGE_CORRECTED:
                key, result = message
                self.table.add_corrected(key, result, log_ns)
            elif topic == topics.RANGE_RAW:
                self.table.add_raw(message)
            elif topic == topics.RANGE_TRUTH:
                self._truths.add(*message[0], message[1].range_m)
            else:
                self._add_position(log_ns, topic, message, tag)

    def _add_position(self, log_ns: int, topic: str, message: Any, tag: str) -> None:
        kind = _KINDS.get(topic, TrackKind.CORRECTED)
        name = str(message.child_frame_id) if kind is TrackKind.TRUE else tag
        point, covariance = message.pose.pose.position, message.pose.covariance
        is_new = (name, kind) not in self._points
        if not np.isfinite([point.x, point.y]).all() or (is_new and len(self._points) >= 4 * MAX_TAGS):
            return
        time_s, log_s = (to_ns(message.header.stamp) - self._recording.start_ns) / NS_PER_S, log_ns / NS_PER_S
        if abs(time_s - log_s) > MAX_STAMP_S:
            self._delays_s.setdefault(f"the positions of {name}", time_s - log_s)
            time_s = log_s
        variance = covariance[0] + covariance[7]
        sd_m = np.sqrt(variance) if variance > 0.0 else np.nan
        self._points[name, kind].append((time_s, point.x, point.y, point.z, sd_m))

    def timeline(self, ranges: NDArray[Any]) -> Timeline:
        """Return the timeline without estimated tracks."""
        stamp_s = (ranges["stamp_ns"] - self._recording.start_ns) / NS_PER_S
        log_s = ranges["log_ns"] / NS_PER_S
        delay_s = stamp_s - log_s
        is_late = np.abs(delay_s) > MAX_STAMP_S
        for tag in np.unique(ranges["tag"][is_late]):
            median_s = float(np.median(delay_s[is_late & (ranges["tag"] == tag)]))
            self._delays_s[f"the ranges of tag {format_id(int(tag))}"] = median_s
        names = ", ".join(f"{name} by {delay:+.1f} s" for name, delay in self._delays_s.items())
        notice = f"Stamps differ from the log time, and the log time is used: {names[:300]}." if names else ""
        truths, measured = self._truths.array(), self.table.raw.array()
        columns = RangeColumns(
            time_s=np.where(is_late, log_s, stamp_s),
            stamp_s=ranges["stamp_ns"] / NS_PER_S,
            raw_m=ranges["raw_m"].copy(),
            corrected_m=ranges["range_m"].copy(),
            true_m=np.append(truths["true_m"], np.nan)[match(ranges, truths)],
            residual_m=np.full(len(ranges), np.nan),
            interval_s=np.full(len(ranges), np.nan),
            gap_db=np.append(measured["gap_db"], np.nan)[match(ranges, measured)],
            status=ranges["status"].copy(),
        )
        timeline = Timeline(log_s, ranges["anchor"].copy(), ranges["tag"].copy(), columns)
        timeline.notices += [notice] if notice else []
        for rows in timeline.rows.values():
            columns.interval_s[rows] = np.diff(columns.stamp_s[rows], prepend=np.nan)
        for key, points in self._points.items():
            track = np.array(points)
            timeline.tracks[key] = track[np.argsort(track[:, 0], kind="stable")]
        return timeline


def add_residuals(timeline: Timeline, anchors: AnchorMap) -> None:
    """Set the residuals of ranges: NaN without a recent position, or if the anchor is not in the map."""
    ranges, place = timeline.columns, {anchor.id: anchor.position for anchor in anchors.anchors}
    tracks = {name: track for (name, kind), track in timeline.tracks.items() if kind is TrackKind.CORRECTED}
    for tag_id in np.unique(timeline.tag):
        track = tracks.get(tag_name(int(tag_id), tracks, timeline.rows))
        if track is None or not len(track):
            continue
        rows = np.flatnonzero(timeline.tag == tag_id)
        time_s, at_s = ranges.time_s[rows], track[:, 0]
        latest = np.maximum(np.searchsorted(at_s, time_s, side="right") - 1, 0)
        ids, index = np.unique(timeline.anchor[rows], return_inverse=True)
        anchor = np.array([place.get(int(anchor_id), (np.nan,) * 3) for anchor_id in ids])[index]
        position = np.column_stack([np.interp(time_s, at_s, axis) for axis in track[:, 1:4].T])
        position[:, 2] = np.nan_to_num(position[:, 2])
        residual_m = ranges.corrected_m[rows] - np.linalg.norm(position - anchor, axis=1)
        is_recent = np.abs(time_s - at_s[latest]) < NO_DATA_S
        ranges.residual_m[rows] = np.where(is_recent, residual_m, np.nan)


def _incidents(timeline: Timeline, seconds: float) -> list[tuple[float, str]]:
    """Return the incidents of ranges and positions until the end, and the largest error, in the order of their times."""
    streams, ranges = [Incidents()], timeline.columns
    columns = (timeline.anchor, timeline.tag, timeline.log_s, ranges.stamp_s)
    for anchor_id, tag_id, log_s, stamp_s in zip(*(column.tolist() for column in columns), strict=True):
        streams[0].add_range((anchor_id, tag_id), log_s, stamp_s)
    for (name, kind), track in timeline.tracks.items():
        if kind is TrackKind.CORRECTED:
            streams.append(Incidents())
            for time_s, x, y in track[:, :3].tolist():
                streams[-1].add_position(tag_label(name, None), time_s, x, y)
    for stream in streams:
        stream.check(seconds)
    found = [incident for stream in streams for incident in stream.found]
    has_truth = bool(np.isfinite(ranges.true_m).any())
    deviation_m = np.abs(ranges.corrected_m - (ranges.true_m if has_truth else ranges.raw_m))
    deviation_m[~(deviation_m < MAX_RANGE_M)] = 0.0
    if deviation_m.any():
        row = int(deviation_m.argmax())
        pair = f"anchor {format_id(int(timeline.anchor[row]))}, tag {format_id(int(timeline.tag[row]))}"
        largest = (
            f"largest {'error' if has_truth else 'correction'} of a range, {deviation_m[row]:.2f} m: {pair}"
        )
        found.append((float(timeline.log_s[row]), largest))
    return sorted(found)
