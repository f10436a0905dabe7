"""Process one bag into one corrected bag.

Every message is copied unchanged, and the anchors of the anchors file are added. Each raw range is followed by its corrected range with the same log time. The output is
byte-identical to that of correcting the ranges one by one.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from uwb_mitigation.errors import (
    DamagedRecordingError,
    RecordingError,
    UwbMitigationError,
    missing_dependency,
)
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.choice import Choice
from uwb_mitigation.mitigation.model.shipped import AUTO, load_model
from uwb_mitigation.recordings.bag.anchor_markers import recorded_anchors, write_anchors
from uwb_mitigation.recordings.bag.reader import BagReader, RawMessage, check_channel
from uwb_mitigation.recordings.bag.writer import METADATA_RECORD, BagWriter
from uwb_mitigation.types.measurement import RangeMeasurement, Status, reason
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets
from uwb_mitigation.types.ros import schemas, topics
from uwb_mitigation.types.ros.codec import RangeBatch, decode_range, encode_corrected

BATCH = 256
"""Messages per batch: large enough for vectorisation, small enough for the network's inputs to fit into the cache."""

Report = Callable[[int, int], None]
"""Progress callback: (processed messages, total messages according to the bag's index)."""


@dataclass(frozen=True, slots=True)
class Job:
    """Input, output and settings of processing one bag.

    Attributes:
        source: an MCAP file or rosbag2 folder.
        output: an MCAP file if it ends in `.mcap`, otherwise a rosbag2 folder.
        model: path of the bundle; `auto`: the shipped one that fits each range.
        force: replace an existing `output`.
        offsets: offsets of the radios.
    """

    source: Path
    output: Path
    model: Path | str = AUTO
    force: bool = False
    offsets: Offsets = NO_OFFSETS


@dataclass(slots=True)
class Outcome:
    """The result of a job, counted while it is processed.

    Attributes:
        job: the job.
        messages: messages read.
        ranges: the number of raw ranges, corrected or passed through.
        statuses: corrected ranges by status, {name: count}.
        reasons: ranges that were not corrected, {reason: count}.
        replaced: corrected ranges of the input, which are not copied.
        skipped: warnings, {kind: count}.
        models: ranges by model, {choice: count}.
        seconds: wall time of reading, correcting and writing.
        error: why the output is missing or (damaged input) incomplete; None = success.
        written: whether there is an output.
    """

    job: Job
    messages: int = 0
    ranges: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    replaced: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    models: Counter[Choice] = field(default_factory=Counter)
    seconds: float = 0.0
    error: UwbMitigationError | None = None
    written: bool = False


def try_process(job: Job, report: Report | None = None) -> Outcome:
    """Run `process_bag` and return its errors in the outcome, so that one bag does not stop the others."""
    try:
        return process_bag(job, report)
    except UwbMitigationError as error:
        return Outcome(job, error=error)
    except ImportError as error:
        if (absent := missing_dependency(error)) is None:
            raise
        return Outcome(job, error=absent)
    except MemoryError:
        return Outcome(job, error=RecordingError("not enough memory", where=job.source))
    except OSError as error:
        problem = RecordingError(f"cannot be processed: {error.strerror}", where=job.source)
        return Outcome(job, error=problem)


def process_bag(job: Job, report: Report | None = None) -> Outcome:
    """Process one bag. If the input is damaged, the output ends there and the outcome contains the error.

    Raises:
        RecordingError: the input is not a bag of this package or has no raw ranges, or the output cannot be written. A
            partial output is removed.
        ParameterError: the output exists, or its folder does not.
        ModelError: the model cannot be used.
    """
    mitigation = Mitigation(load_model(job.model), job.offsets, median_at_rest=True)
    # Loading the models takes as long as thousands of ranges: do not count it in the bag's time.
    schemas.typestore()
    started = time.perf_counter()
    bag = BagReader(job.source)
    metadata = bag.metadata.get(METADATA_RECORD, {})
    origin = {
        "source": f"{job.source.name}, corrected by model {' or '.join(f'{b.model_id:08x}' for b in mitigation.bundles)}",
        "simulated": metadata.get("simulated", "unknown"),
    }
    outcome = Outcome(job, models=mitigation.used, written=True)
    with BagWriter(job.output, origin, force=job.force) as out:
        corrector = _Corrector(outcome, mitigation, out)
        if topics.ANCHORS not in bag.topics and bag.bounds_ns and (anchors := recorded_anchors(job.source)):
            write_anchors(out, anchors, bag.bounds_ns[0])
        messages = bag.messages()
        while outcome.error is None:
            batch: list[RawMessage] = []
            try:
                # Not list(islice()): messages before the damage must be kept.
                batch.extend(islice(messages, BATCH))
            except DamagedRecordingError as error:
                outcome.error = error
            if not batch:
                break
            corrector.write(batch)
            outcome.messages += len(batch)
            if report is not None:
                report(outcome.messages, bag.message_count)
        if outcome.error is not None and outcome.messages == 0:
            raise outcome.error
        bag.require(topics.RANGE_RAW)
    outcome.seconds = time.perf_counter() - started
    outcome.ranges = outcome.statuses.total()
    outcome.skipped.update(bag.warnings)
    return outcome


class _Corrector:
    """Writes batches of messages and inserts the corrected ranges."""

    def __init__(self, outcome: Outcome, mitigation: Mitigation, out: BagWriter) -> None:
        self._outcome, self._mitigation, self._out = outcome, mitigation, out
        # The bag keeps references to its channels, so that an id() identifies one channel of one file.
        self._channels: dict[int, int] = {}
        self._corrected = out.channel(topics.RANGE_CORRECTED, topics.RANGE_CORRECTED_TYPE)

    def write(self, batch: list[RawMessage]) -> None:
        """Write the messages of a batch, and after each raw range its corrected range."""
        channels, out = self._channels, self._out
        raw = [message for message in batch if message.channel.topic == topics.RANGE_RAW]
        for channel in {id(message.channel): message.channel for message in raw}.values():
            if id(channel) not in channels:
                check_channel(channel, topics.RANGE_CIR_TYPE, self._outcome.job.source)
                channels[id(channel)] = out.copy_channel(channel)
        corrected = iter(self._correct([message.data for message in raw]))
        for channel, sequence, log_ns, publish_ns, data in batch:
            if channel.topic == topics.RANGE_CORRECTED:
                self._outcome.replaced += 1
                continue
            if id(channel) not in channels:
                channels[id(channel)] = out.copy_channel(channel)
            out.write_serialized(channels[id(channel)], data, log_ns, publish_ns, sequence)
            if channel.topic == topics.RANGE_RAW and (message := next(corrected)) is not None:
                out.write_serialized(self._corrected, message, log_ns, publish_ns, sequence)

    def _correct(self, messages: list[bytes]) -> list[bytes | None]:
        """Return `RangeCorrected` for each message; None if it does not decode."""
        encoded: list[bytes | None] = [None] * len(messages)
        groups: dict[tuple[int, bytes], list[int]] = {}
        for index, message in enumerate(messages):
            groups.setdefault(RangeBatch.key(message), []).append(index)
        for indices in groups.values():
            try:
                batch = RangeBatch([messages[index] for index in indices])
            except RecordingError:
                self._correct_singly(messages, indices, encoded)
                continue
            corrected = self._mitigation.correct_columns(batch.columns)
            kinds = zip(corrected.status.tolist(), corrected.fault.tolist(), strict=True)
            for (status, fault), count in Counter(kinds).items():
                self._outcome.statuses[Status(status).name] += count
                if text := reason(status, fault, 0.0):
                    self._outcome.reasons[text] += count
            for index, message in zip(indices, batch.encode_corrected(corrected), strict=True):
                encoded[index] = message
        return encoded

    def _correct_singly(self, messages: list[bytes], indices: list[int], encoded: list[bytes | None]) -> None:
        """Correct messages of different forms, and count those that do not decode."""
        decoded: dict[int, RangeMeasurement] = {}
        for index in indices:
            try:
                decoded[index] = decode_range(messages[index])
            except RecordingError as error:  # noqa: PERF203
                self._outcome.skipped[error.what] += 1
        corrected = self._mitigation.correct([*decoded.values()])
        for (index, measurement), result in zip(decoded.items(), corrected, strict=True):
            encoded[index] = encode_corrected(measurement, result)
            self._outcome.statuses[result.status.name] += 1
            if result.reason:
                self._outcome.reasons[result.reason] += 1
