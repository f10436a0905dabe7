"""Records and bags for tests."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from drives import HALL
from mcap.reader import make_reader
from mcap.writer import Writer

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.types.measurement import (
    SAMPLE_PERIOD_S,
    Cir,
    CorrectedBy,
    CorrectedRange,
    RangeMeasurement,
    Record,
    Status,
    Truth,
)
from uwb_mitigation.types.ros import codec, schemas, topics
from uwb_mitigation.types.tracks import Ranges

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000


def record(number: int, samples: int = 20) -> Record:
    rng = np.random.default_rng(number)
    cir = Cir(
        rng.integers(-900, 900, 2 * samples).astype(np.int16),
        first_path_index=740.25 + number,
        preamble_count=200 + number,
        noise_threshold=1500,
        rx_power_dbm=-79.5,
        first_path_power_dbm=-83.25,
        channel=2,
        prf_mhz=64,
        start_index=700,
        sample_period_s=float(np.float32(SAMPLE_PERIOD_S)),
    )
    measurement = RangeMeasurement(
        START_NS + number * STEP_NS, 7, 1 + number % 2, number, number * 1000, 4.5 + number, cir, "antenna"
    )
    return Record(measurement, Truth(4.0 + number, "NDP NLOS", f"place {number}"))


def without_cir(ranges: Ranges, row: int) -> RangeMeasurement:
    """Return a range of a drive past `HALL`."""
    stamp_ns, anchor_id = int(ranges.stamp_ns[row]), HALL.anchors[ranges.anchor[row]].id
    empty = Cir(np.zeros(0, np.int16))
    return RangeMeasurement(stamp_ns, 7, anchor_id, row, 0, float(ranges.range_m[row]), empty)


def corrected(number: int) -> CorrectedRange:
    return CorrectedRange(4.25 + number, 4.5 + number, 0.25, 0.0625, Status.OK, CorrectedBy.DEVICE, 77)


def write_corrected(bag: BagWriter, measurement: RangeMeasurement, corrected: CorrectedRange) -> None:
    """Write the corrected range of a measurement, with the time of the measurement."""
    data, stamp_ns = codec.encode_corrected(measurement, corrected), measurement.stamp_ns
    bag.write_message(
        topics.RANGE_CORRECTED, topics.RANGE_CORRECTED_TYPE, data, stamp_ns, measurement.sequence
    )


def write_records(
    path: Path, records: Iterable[Record], simulated: str = "true", source: str = "a test"
) -> Path:
    """Write records to a bag; return its path."""
    with BagWriter(path, {"source": source, "simulated": simulated}) as bag:
        for item in records:
            bag.write(item)
    return path


def write_bag(path: Path, count: int = 5, simulated: str = "false") -> Path:
    return write_records(path, map(record, range(count)), simulated)


class Foreign:
    """Write messages to a bag with the `mcap` library, as another recorder does."""

    def __init__(self, path: Path, **options: object) -> None:
        self.path = path
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, **options)
        self._writer.start("ros2", "another recorder")
        self._channels: dict[str, int] = {}

    def channel(self, topic: str, type_name: str, schema: str | None, *, encoding: str = "cdr") -> None:
        number = 0
        if schema is not None:
            number = self._writer.register_schema(type_name, "ros2msg", schema.encode())
        self._channels[topic] = self._writer.register_channel(topic, encoding, number, {})

    def ours(self) -> Foreign:
        self.channel(topics.RANGE_RAW, topics.RANGE_CIR_TYPE, schemas.definition(topics.RANGE_CIR_TYPE))
        self.channel(topics.RANGE_TRUTH, topics.RANGE_TRUTH_TYPE, schemas.definition(topics.RANGE_TRUTH_TYPE))
        return self

    def add(self, topic: str, log_time_ns: int, data: bytes) -> None:
        self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns)

    def range(self, number: int, log_time_ns: int | None = None) -> None:
        measurement = record(number).measurement
        self.add(topics.RANGE_RAW, log_time_ns or measurement.stamp_ns, codec.encode_range(measurement))

    def truth(self, number: int, log_time_ns: int | None = None) -> None:
        known = record(number)
        data = codec.encode_truth(known.measurement, known.truth)
        self.add(topics.RANGE_TRUTH, log_time_ns or known.measurement.stamp_ns, data)

    def flush(self) -> None:
        self._writer.flush()

    def finish(self) -> Path:
        self._writer.finish()
        self._stream.close()
        return self.path

    def cut(self) -> Path:
        self._writer.flush()
        self._stream.close()
        return self.path


def numbers(source: McapRecording) -> list[int]:
    return [item.measurement.sequence for item in source]


def prefix(path: Path) -> tuple[list[int], RecordingError | None]:
    """Return the messages read from a bag and the final error; any other exception fails the test."""
    read: list[int] = []
    try:
        for item in McapRecording(path):
            assert item.measurement.frame_id == "antenna"
            read.append(item.measurement.sequence)
    except RecordingError as error:
        return read, error
    return read, None


def chunk_offsets(path: Path) -> list[tuple[int, int]]:
    """Return the first and last byte of each chunk of a complete file."""
    with path.open("rb") as stream:
        indexes = make_reader(stream).get_summary().chunk_indexes
    return [(one.chunk_start_offset, one.chunk_start_offset + one.chunk_length) for one in indexes]


def damage_after_first_chunk(path: Path) -> int:
    """Cut a bag after its first chunk, and add a record that ends beyond the file; return the position."""
    end = chunk_offsets(path)[0][1]
    path.write_bytes(path.read_bytes()[:end] + b"\x06\xff\xff\xff")
    return end
