"""The topics of a bag that the viewer shows, in one namespace."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.recordings.bag.reader import BagReader, check_channel
from uwb_mitigation.types.ros import schemas, topics
from uwb_mitigation.types.ros.codec import measurement_key
from uwb_mitigation.viewer.feed import DECODERS
from uwb_mitigation.viewer.scene import DEFAULT_TAG

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
