"""A recording: its topics in one namespace, all of its ranges, and the complete tracks of the tags.

Times are log times: the times at which a subscriber received the messages.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, ParameterError, RecordingError, format_id
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import horizontal_ellipse
from uwb_mitigation.positioning.health import NO_DATA_S
from uwb_mitigation.positioning.online.robot_estimator import live_track
from uwb_mitigation.positioning.recorded_tracks import TagTracks, check_one_tag, track_tag
from uwb_mitigation.recordings.bag.pose_paths import read_truth
from uwb_mitigation.recordings.bag.reader import BagReader, check_channel
from uwb_mitigation.recordings.recorded_ranges import KEY, RangeTable, Table, match
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.measurement import Cir
from uwb_mitigation.types.ros import schemas, topics
from uwb_mitigation.types.ros.codec import measurement_key
from uwb_mitigation.types.ros.poses import tag_frame
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import TruePath
from uwb_mitigation.viewer.feed import DECODERS, SceneUpdater
from uwb_mitigation.viewer.histories import MAX_RANGE_M, LeverArm, Pair, Pose, Sample, plausible_cir
from uwb_mitigation.viewer.palette import ATTRIBUTES, TrackKind
from uwb_mitigation.viewer.scene import DEFAULT_TAG, MAX_TAGS, Scene, tag_label, tag_name

BATCH = 64
"""Number of messages that are read ahead to correct their ranges in one call."""
POSITIONS = frozenset({topics.POSE, topics.ODOMETRY, topics.POSE_SMOOTHED})
RANGES = frozenset({topics.RANGE_RAW, topics.RANGE_CORRECTED})

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


class Recording(Scene):
    """A bag with ranges or tracks, and what was read from it; times are log times from the beginning.

    Args:
        path: an MCAP file or a rosbag2 folder.
        namespace: namespace of the topics, such as `/board1`; None: the only namespace with ranges (or tracks) in the bag.

    Attributes:
        start_ns: time of the first message. seconds: duration.
        prefix: the namespace.
        contents: topics without namespace and tag.
        damage: of the messages that were read; empty: none.
        read_s: time up to which it has been read.

    Raises:
        RecordingError: the path is not an MCAP bag, or contains neither ranges nor tracks, or ranges of another version.
        ParameterError: the bag has several namespaces, and none was given.
    """

    def __init__(self, path: Path, namespace: str | None = None) -> None:
        super().__init__(lambda: self.read_s, is_whole=True)
        self.path, self._bag, self._table = path, BagReader(path), RangeTable()
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
        self.damage, self.read_s, self.is_read, self.is_complete = "", 0.0, False, False

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

    def read_cir(self, pair: Pair, log_ns: int) -> Cir | None:
        """Return the CIR of the first range of a pair from a time on; None: it has none that can be shown."""
        for event in self.events([topics.RANGE_RAW], log_ns):
            if (event.message.anchor_id, event.message.tag_id) == pair:
                return plausible_cir(event.message.cir)
        return None

    def read(self, backend: Corrector | None) -> None:
        """Read all messages; what has been read may be shown meanwhile.

        Args:
            backend: corrects raw ranges; None: the recording contains corrected ranges.
        """
        truths, feed = Table(_TRUTH), SceneUpdater(self)
        for log_ns, topic, message, tag in self.corrected_events(backend):
            self.read_s = log_ns / NS_PER_S
            if topic == topics.RANGE_RAW:
                self._table.add_raw(message)
                if len(message.cir.samples):
                    self.cirs_ns.setdefault((message.anchor_id, message.tag_id), []).append(log_ns)
            elif topic == topics.RANGE_TRUTH:
                truths.add(*message[0], message[1].range_m)
            elif topic == topics.RANGE_CORRECTED:
                self._table.add_corrected(*message)
            if topic not in (topics.ANCHORS, topics.RANGE_RAW, topics.RANGE_TRUTH):
                feed.add(topic, message, tag)
        with self.lock:
            if self.damage:
                self.notices.append(f"{self.damage}: nothing beyond can be shown")
            self._add_truths_and_levels(truths.array())
            self.read_s, self.is_read = self.seconds, True
            self.incidents.check(self.seconds)
            _add_largest_error(self)

    def _add_truths_and_levels(self, truths: NDArray[Any]) -> None:
        """Set true ranges (rows of `_TRUTH`) and levels, which may be in any order, and count the errors."""
        ranges, measured = self._table.corrected.array(), self._table.raw.array()
        true_m = np.append(truths["true_m"], np.nan)[match(ranges, truths)]
        gap_db, rx_dbm = (
            np.append(measured[name], np.nan)[match(ranges, measured)] for name in ("gap_db", "rx_dbm")
        )
        order, first = np.lexsort((ranges["tag"], ranges["anchor"])), 0
        # By anchor and tag, as the ranges.
        for _, history in sorted(self.pairs.items()):
            rows, columns = order[first : first + len(history.rows)], history.columns
            first += len(rows)
            columns.true_m[:], columns.gap_db[:], columns.rx_dbm[:] = true_m[rows], gap_db[rows], rx_dbm[rows]
        self.count_errors(np.stack([ranges["raw_m"], ranges["range_m"]]) - true_m)

    def forget_ranges(self) -> None:
        """Free the tables of ranges, which only `estimate` needs."""
        self._table = RangeTable()

    def estimate(
        self, config: EstimatorConfig, stamp_offset_s: float = 0.0, estimated: Sequence[TagTracks] = ()
    ) -> None:
        """Add residuals and estimated tracks (only those of raw ranges if there are positions) to what was read.

        Args:
            config: of the estimators.
            stamp_offset_s: added to the stamps of the ranges.
            estimated: tracks with `config` that are known already.
        """
        truths: dict[int | None, TruePath] = {}
        with contextlib.suppress(RecordingError):
            truths = read_truth(self.path, self.prefix + topics.ODOMETRY_TRUTH)
        recorded = self._table.by_tag(config.anchors, stamp_offset_s, truths)
        by_tag = {one.recording.tag_id: one for one in estimated}
        names = {name for name, kind in self.tracks if kind is TrackKind.CORRECTED}
        for tag in recorded.tags[:MAX_TAGS]:
            of_tag = [history.rows for pair, history in self.pairs.items() if pair[1] == tag.tag_id]
            if not of_tag:
                continue
            name = tag_name(tag.tag_id, names, self.pairs) or tag_frame(tag.tag_id)
            if self.contents & POSITIONS:
                tracks = {TrackKind.RAW: live_track(config, tag.raw)}
            else:
                try:
                    check_one_tag(config, recorded.tags)
                    estimate = by_tag.get(tag.tag_id) or track_tag(tag, config)
                except (DatasetError, ParameterError) as error:
                    self.notices.append(str(error))
                    continue
                self.estimates[name] = estimate
                tracks = {kind: getattr(estimate, attribute) for kind, attribute in ATTRIBUTES.items()}
                label, state = f"tag {format_id(tag.tag_id)}", str(estimate.determination)
                self.notices += [
                    f"{label}{' determination' * (text == state)}: {text}" for text in estimate.warnings
                ]
            ranges = Sample(*np.concatenate(of_tag).T)
            order = np.argsort(ranges.stamp_s, kind="stable")
            for kind, track in tracks.items():
                stamp_s = track.stamp_ns / NS_PER_S - stamp_offset_s
                received_s = np.interp(stamp_s, ranges.stamp_s[order], ranges.received_s[order])
                sd_m = np.sqrt(track.covariance[:, 0, 0] + track.covariance[:, 1, 1])
                x, y, z = track.position.T
                poses = Pose(x, y, z, stamp_s=stamp_s, sd_m=sd_m, received_s=received_s)
                if kind is TrackKind.CORRECTED:
                    ellipses = np.array([horizontal_ellipse(covariance) for covariance in track.covariance])
                    poses = poses._replace(**dict(zip(Pose._fields[3:6], ellipses.T, strict=True)))
                    self.incidents.add_track(tag_label(name, None), poses, self.seconds)
                with self.lock:
                    self.set_track(name, kind, np.stack(np.broadcast_arrays(*poses), axis=1))
        # Tracks are those of the antenna, poses those of the robot.
        is_of_robot = topics.POSE in self.contents
        add_residuals(self, config.anchors, self.lever_arms if is_of_robot else {})


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


def add_residuals(scene: Scene, anchors: AnchorMap, lever_arms: Mapping[str, LeverArm] = {}) -> None:
    """Set the residuals of ranges: NaN without a recent position, or if the anchor is not in the map; see `Scene.lever_arms`."""
    place = {anchor.id: anchor.position for anchor in anchors.anchors}
    tracks = {name: track for (name, kind), track in scene.tracks.items() if kind is TrackKind.CORRECTED}
    for (anchor_id, tag_id), history in scene.pairs.items():
        track, columns = tracks.get(tag_name(tag_id, tracks, scene.pairs)), history.columns
        if track is None or anchor_id not in place:
            continue
        poses = Pose(*track.rows[np.argsort(track.columns.stamp_s, kind="stable")].T)
        if (arm := lever_arms.get(format_id(tag_id))) is not None:
            poses = poses.antenna(arm)
        x, y, z = (np.interp(columns.stamp_s, poses.stamp_s, axis) for axis in poses[:3])
        distance_m = np.linalg.norm(np.column_stack([x, y, np.nan_to_num(z)]) - place[anchor_id], axis=1)
        latest = np.maximum(np.searchsorted(poses.stamp_s, columns.stamp_s, side="right") - 1, 0)
        is_recent = np.abs(columns.stamp_s - poses.stamp_s[latest]) < NO_DATA_S
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
