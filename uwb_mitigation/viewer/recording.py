"""A recording: its topics in one namespace, and its index with all ranges and the complete tracks of the tags.

The times of the player, its marks and the figures are log times: the times at which a subscriber received the messages.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError, RecordingError, format_id
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import horizontal_ellipse
from uwb_mitigation.positioning.online.robot_estimator import live_track
from uwb_mitigation.positioning.recorded_tracks import TagTracks, check_one_tag, track_tag
from uwb_mitigation.recordings.bag.pose_paths import read_truth
from uwb_mitigation.recordings.bag.reader import BagReader, check_channel
from uwb_mitigation.recordings.recorded_ranges import KEY, RangeTable, Table, match
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.measurement import FAULTS
from uwb_mitigation.types.ros import schemas, topics
from uwb_mitigation.types.ros.codec import measurement_key
from uwb_mitigation.types.ros.poses import tag_frame
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Track, TruePath
from uwb_mitigation.viewer.feed import DECODERS, SceneUpdater
from uwb_mitigation.viewer.histories import MAX_RANGE_M, NO_DATA_S, Pair, Trace
from uwb_mitigation.viewer.incidents import Incidents
from uwb_mitigation.viewer.palette import ATTRIBUTES, TrackKind
from uwb_mitigation.viewer.scene import (
    DEFAULT_TAG,
    MAX_TAGS,
    POSITION,
    Scene,
    antenna_position,
    tag_label,
    tag_name,
)

BATCH = 64
"""Number of messages that are read ahead to correct their ranges in one call."""
POSITIONS = frozenset({topics.POSE, topics.ODOMETRY, topics.POSE_SMOOTHED})
RANGES = frozenset({topics.RANGE_RAW, topics.RANGE_CORRECTED})

Displaced = dict[int, tuple[float, Anchor]]
"""{anchor whose ranges fit another position: (its median held-out residual, m, the anchor there)}."""

_TRUTH = np.dtype([*KEY, ("true_m", "f8")])
_POSITION_TOPIC = re.compile(r"(.*)/uwb/(?:(tag_(?:\d+|0x[0-9a-f]+))/)?(pose|odometry|pose_smoothed)")


class Event(NamedTuple):
    """A decoded message.

    Attributes:
        time_ns: log time since the beginning of the recording.
        topic: without namespace and tag.
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
        damage: of the messages that were read; empty: none.

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
        self.damage = ""

    @property
    def contents(self) -> set[str]:
        return {plain for plain, _ in self._topics.values()}

    @property
    def corrects(self) -> bool:
        """Whether the bag contains raw ranges only."""
        return self.contents & RANGES == {topics.RANGE_RAW}

    def events(self, selected: Collection[str], start_ns: int = 0) -> Iterator[Event]:
        """Yield the messages of topics that can be decoded, from a time since the beginning until a damage of the bag."""
        names = [topic for topic, (plain, _) in self._topics.items() if plain in selected]
        try:
            for message in self._bag.messages(names, self.start_ns + start_ns):
                plain, tag = self._topics[message.channel.topic]
                if (decoded := _decode(plain, message.data)) is not None:
                    yield Event(message.log_time_ns - self.start_ns, plain, decoded, tag)
        except RecordingError as error:
            self.damage = error.what

    def corrected_events(self, backend: Corrector | None) -> Iterator[Event]:
        """Yield all messages, and with a backend a corrected range after each raw one."""
        events = self.events(self.contents)
        while batch := list(islice(events, BATCH)):
            raw = [event.message for event in batch if backend and event.topic == topics.RANGE_RAW]
            results = iter(backend.correct(raw) if backend else ())
            for event in batch:
                yield event
                if backend and event.topic == topics.RANGE_RAW:
                    corrected = measurement_key(event.message), next(results)
                    yield event._replace(topic=topics.RANGE_CORRECTED, message=corrected)

    def read_trace(self, pair: Pair, log_ns: int) -> Trace | None:
        """Return the CIR of the first range of a pair from a time on; None: it has none that can be shown."""
        for event in self.events([topics.RANGE_RAW], log_ns):
            if (event.message.anchor_id, event.message.tag_id) == pair:
                return Trace.from_cir(event.message.cir)
        return None


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


@dataclass
class Timeline:
    """Content of a recording: everything that does not depend on the position of the player.

    Attributes:
        scene: its ranges, positions and incidents; times are log times from the beginning.
        read_s: time up to which it has been read. is_read: whether it has been read completely.
        cirs_ns: {pair: log time of each raw range with a CIR}.
        notices: messages for the page.
        estimates: {tag: its estimated tracks}, if the recording contains no positions.
        displaced: the anchor whose ranges fit another position.
        is_complete: whether tracks, residuals and all incidents have been added.
    """

    scene: Scene = field(default_factory=lambda: Scene(is_whole=True))
    read_s: float = 0.0
    is_read: bool = False
    cirs_ns: dict[Pair, list[int]] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    estimates: dict[str, TagTracks] = field(default_factory=dict)
    displaced: Displaced = field(default_factory=dict)
    is_complete: bool = False

    def __post_init__(self) -> None:
        self.scene.clock = lambda: self.read_s

    @property
    def bad_s(self) -> NDArray[np.float64]:
        """Times of the ranges whose status needs attention."""
        columns = (history.columns for history in self.scene.pairs.values())
        times_s = [ranges.received_s[np.isin(ranges.status, FAULTS)] for ranges in columns]
        return np.concatenate([np.zeros(0), *times_s])


def read_recording(recording: Recording, backend: Corrector | None, timeline: Timeline) -> RangeTable:
    """Read the messages of a recording into a timeline; return its ranges.

    Args:
        recording: the bag.
        backend: corrects raw ranges; None: the recording contains corrected ranges.
        timeline: is filled; may be shown meanwhile.
    """
    table, truths, feed = RangeTable(), Table(_TRUTH), SceneUpdater(timeline.scene)
    for log_ns, topic, message, tag in recording.corrected_events(backend):
        timeline.read_s = log_ns / NS_PER_S
        if topic == topics.RANGE_RAW:
            table.add_raw(message)
            if len(message.cir.samples):
                timeline.cirs_ns.setdefault((message.anchor_id, message.tag_id), []).append(log_ns)
        elif topic == topics.RANGE_TRUTH:
            truths.add(*message[0], message[1].range_m)
        elif topic == topics.RANGE_CORRECTED:
            table.add_corrected(*message)
        if topic not in (topics.ANCHORS, topics.RANGE_RAW, topics.RANGE_TRUTH):
            feed.add(topic, message, tag)
    with timeline.scene.lock:
        if recording.damage:
            timeline.notices.append(f"{recording.damage}: nothing beyond can be shown")
        _add_truths_and_levels(timeline.scene, table, truths.array())
        timeline.read_s, timeline.is_read = recording.seconds, True
        timeline.scene.incidents.check(recording.seconds)
        _add_largest_error(timeline.scene)
    return table


def _add_truths_and_levels(scene: Scene, table: RangeTable, truths: NDArray[Any]) -> None:
    """Set true ranges and levels, which a recording may contain in any order, and count the errors.

    Args:
        scene: with all corrected ranges.
        table: the ranges.
        truths: rows of `_TRUTH`.
    """
    ranges, measured = table.corrected.array(), table.raw.array()
    true_m = np.append(truths["true_m"], np.nan)[match(ranges, truths)]
    gap_db, rx_dbm = (
        np.append(measured[name], np.nan)[match(ranges, measured)] for name in ("gap_db", "rx_dbm")
    )
    order, first = np.lexsort((ranges["tag"], ranges["anchor"])), 0
    # By anchor and tag, as the ranges.
    for _, history in sorted(scene.pairs.items()):
        rows, columns = order[first : first + len(history.rows)], history.columns
        first += len(rows)
        columns.true_m[:], columns.gap_db[:], columns.rx_dbm[:] = true_m[rows], gap_db[rows], rx_dbm[rows]
    scene.count_errors(np.stack([ranges["raw_m"], ranges["range_m"]]) - true_m)


def estimate_tracks(
    recording: Recording,
    timeline: Timeline,
    table: RangeTable,
    config: EstimatorConfig,
    stamp_offset_s: float = 0.0,
    estimated: Sequence[TagTracks] = (),
) -> None:
    """Add estimated tracks, or the tracks of raw ranges if the recording contains positions, and residuals to a timeline.

    Args:
        recording: the bag.
        timeline: what `read_recording` has read.
        table: its result.
        config: of the estimators.
        stamp_offset_s: added to the stamps of the ranges.
        estimated: tracks with `config` that are known already.
    """
    truths: dict[int | None, TruePath] = {}
    with contextlib.suppress(RecordingError):
        truths = read_truth(recording.path, recording.prefix + topics.ODOMETRY_TRUTH)
    recorded, scene = table.by_tag(config.anchors, stamp_offset_s, truths), timeline.scene
    by_tag = {one.recording.tag_id: one for one in estimated}
    has_positions = bool(recording.contents & POSITIONS)
    names = {name for name, kind in scene.tracks if kind is TrackKind.CORRECTED}
    for tag in recorded.tags[:MAX_TAGS]:
        of_tag = [history.rows for pair, history in scene.pairs.items() if pair[1] == tag.tag_id]
        if not of_tag:
            continue
        name = tag_name(tag.tag_id, names, scene.pairs) or tag_frame(tag.tag_id)
        tracks = dict[TrackKind, Track]()
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
        received_s, _, _, stamp_s, *_ = np.concatenate(of_tag).T
        order = np.argsort(stamp_s, kind="stable")
        for kind, track in tracks.items():
            rows = np.full((len(track), POSITION), np.nan)
            rows[:, 5] = track.stamp_ns / NS_PER_S - stamp_offset_s
            rows[:, 0] = np.interp(rows[:, 5], stamp_s[order], received_s[order])
            rows[:, 1:4] = track.position
            rows[:, 4] = np.sqrt(track.covariance[:, 0, 0] + track.covariance[:, 1, 1])
            if kind is TrackKind.CORRECTED:
                rows[:, 6:9] = [horizontal_ellipse(covariance) for covariance in track.covariance]
                _add_incidents(scene, tag_label(name, None), rows, recording.seconds)
            with scene.lock:
                scene.set_track(name, kind, rows)
    # Tracks are those of the antenna, poses those of the robot.
    is_of_robot = topics.POSE in recording.contents
    add_residuals(scene, config.anchors, scene.lever_arms if is_of_robot else {})


def _add_incidents(scene: Scene, label: str, track: NDArray[np.float64], seconds: float) -> None:
    """Add the incidents of an estimated track until the end of the recording."""
    incidents = Incidents()
    for time_s, x, y in track[:, :3].tolist():
        incidents.add_position(label, time_s, x, y)
    incidents.check(seconds)
    for incident in incidents.latest:
        scene.incidents.add(*incident)
    scene.incidents.count += incidents.count - len(incidents.latest)


def add_residuals(
    scene: Scene, anchors: AnchorMap, lever_arms: Mapping[str, tuple[float, float, float]] = {}
) -> None:
    """Set the residuals of ranges: NaN without a recent position, or if the anchor is not in the map; see `Scene.lever_arms`."""
    place = {anchor.id: anchor.position for anchor in anchors.anchors}
    tracks = {name: track.rows for (name, kind), track in scene.tracks.items() if kind is TrackKind.CORRECTED}
    for (anchor_id, tag_id), history in scene.pairs.items():
        track, columns = tracks.get(tag_name(tag_id, tracks, scene.pairs)), history.columns
        if track is None or anchor_id not in place:
            continue
        track = track[np.argsort(track[:, 5], kind="stable")]
        arm, position, at_s = lever_arms.get(format_id(tag_id)), track[:, 1:4], track[:, 5]
        if arm is not None:
            position = antenna_position(position, track[:, -1], arm)
        x, y, z = (np.interp(columns.stamp_s, at_s, axis) for axis in position.T)
        distance_m = np.linalg.norm(np.column_stack([x, y, np.nan_to_num(z)]) - place[anchor_id], axis=1)
        latest = np.maximum(np.searchsorted(at_s, columns.stamp_s, side="right") - 1, 0)
        is_recent = np.abs(columns.stamp_s - at_s[latest]) < NO_DATA_S
        columns.residual_m[:] = np.where(is_recent, columns.corrected_m - distance_m, np.nan)


def _add_largest_error(scene: Scene) -> None:
    """Add the largest error of a range to the incidents; without truth, the largest correction."""
    name, largest = "error" if scene.errors else "correction", (0.0, 0.0, (0, 0))
    for pair, history in scene.pairs.items():
        columns = history.columns
        change_m = np.abs(columns.corrected_m - (columns.true_m if scene.errors else columns.raw_m))
        change_m[~(change_m < MAX_RANGE_M)] = 0.0
        row = int(change_m.argmax())
        largest = max(largest, (float(change_m[row]), -float(columns.received_s[row]), pair))
    largest_m, time_s, (anchor_id, tag_id) = largest
    if largest_m > 0.0:
        text = f"largest {name} of a range, {largest_m:.2f} m: anchor {format_id(anchor_id)}, tag {format_id(tag_id)}"
        scene.incidents.largest_error = [(-time_s, text)]
