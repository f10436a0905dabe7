"""Measurements from an MCAP bag: raw ranges with their CIRs, joined with the truth where the bag holds it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from uwb_mitigation.bag.codec import Key, decode_range, decode_truth, key_of
from uwb_mitigation.bag.reader import BagReader, check_channel
from uwb_mitigation.bag.topics import RANGE_CIR_TYPE, RANGE_RAW, RANGE_TRUTH, RANGE_TRUTH_TYPE
from uwb_mitigation.errors import RecordingError
from uwb_mitigation.measurement import RangeMeasurement, Truth
from uwb_mitigation.sources.source import Record

JOIN_WINDOW = 32
"""How many exchanges a range and its truth may lie apart; bounds what waits in memory."""


class McapRecording:
    """The measurements in an MCAP file or a rosbag2 folder; implements `sources.source.Source`.

    Args:
        path: an MCAP file, or a folder with `metadata.yaml` or `*.mcap`.
        topic: where the raw ranges are, of type `uwb_mitigation_msgs/msg/RangeCir`.
        truth_topic: where their truth is, of type `uwb_mitigation_msgs/msg/RangeTruth`; need not exist.
        start_ns, stop_ns: bounds on log times, start <= time < stop; None = open.

    Attributes:
        message_count: messages on all topics of the bag, as its own index says.

    Raises:
        RecordingError: the path is absent or no MCAP bag. Iterating raises it when the topic is not in
            the bag, or when its type, schema or field layout is not what this package reads.
    """

    def __init__(
        self,
        path: Path,
        *,
        topic: str = RANGE_RAW,
        truth_topic: str = RANGE_TRUTH,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> None:
        self._path = path
        self._topic = topic
        self._truth_topic = truth_topic
        self._start_ns = start_ns
        self._stop_ns = stop_ns
        self._closed = False
        bag = BagReader(path)
        self.message_count = bag.message_count
        self.simulated = bag.metadata.get("uwb_mitigation", {}).get("simulated") == "true"
        self.name = f"MCAP bag {path}" + (" (simulated)" if self.simulated else "")
        self.skipped: Counter[str] = Counter()

    def __iter__(self) -> Iterator[Record]:
        self.skipped = Counter()
        self._closed = False
        bag = BagReader(self._path)
        try:
            yield from self._join(bag)
        finally:
            self.skipped.update(bag.oddities)
        if not self._closed and self._topic not in bag.topics:
            known = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.topics.items()))
            raise RecordingError(
                f"no topic {self._topic}",
                where=str(self._path),
                valid=f"the bag holds: {known or 'no topic'}",
            )

    def close(self) -> None:
        """End an iteration at its next message; files are open only while iterating."""
        self._closed = True

    def __enter__(self) -> McapRecording:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _join(self, bag: BagReader) -> Iterator[Record]:
        """Pair ranges with their truths, whichever of the two comes first; in the order of the ranges."""
        waiting: deque[_Waiting] = deque()
        by_key: dict[Key, _Waiting] = {}
        early: dict[Key, Truth] = {}

        def leave() -> Record:
            entry = waiting.popleft()
            by_key.pop(key_of(entry.measurement), None)
            return Record(entry.measurement, entry.truth)

        try:
            for item in self._decoded(bag):
                if isinstance(item, RangeMeasurement):
                    key = key_of(item)
                    entry = _Waiting(item, early.pop(key, None))
                    waiting.append(entry)
                    by_key[key] = entry
                else:
                    key, truth = item
                    if key in by_key:
                        by_key[key].truth = truth
                    else:
                        early[key] = truth
                        if len(early) > JOIN_WINDOW:
                            del early[next(iter(early))]
                            self.skipped["truth without its range"] += 1
                while waiting and (waiting[0].truth is not None or len(waiting) > JOIN_WINDOW):
                    yield leave()
        except RecordingError:
            while waiting:
                yield leave()
            raise
        while waiting and not self._closed:
            yield leave()
        if early:
            self.skipped["truth without its range"] += len(early)

    def _decoded(self, bag: BagReader) -> Iterator[RangeMeasurement | tuple[Key, Truth]]:
        checked: set[int] = set()
        topics = (self._topic, self._truth_topic)
        for message in bag.messages(topics, self._start_ns, self._stop_ns):
            if self._closed:
                return
            is_range = message.channel.topic == self._topic
            # The bag keeps its channels, so that an identity stands for one channel of one file.
            if id(message.channel) not in checked:
                check_channel(message.channel, RANGE_CIR_TYPE if is_range else RANGE_TRUTH_TYPE, self._path)
                checked.add(id(message.channel))
            try:
                yield decode_range(message.data) if is_range else decode_truth(message.data)
            except RecordingError as error:
                self.skipped[error.what] += 1


@dataclass(slots=True)
class _Waiting:
    """A range that its truth may still reach."""

    measurement: RangeMeasurement
    truth: Truth | None
