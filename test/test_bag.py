"""Bag writer and CDR codec, compared with the libraries rosbags and mcap; safe for arbitrary bytes."""

import contextlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_material import corrected, record, write_corrected
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import SeekingReader
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.measurement import (
    SAMPLE_PERIOD_S,
    Cir,
    CorrectedBy,
    CorrectedColumns,
    CorrectedRange,
    Encoding,
    RadioType,
    RangeMeasurement,
    Record,
    Segment,
    Status,
    Truth,
)
from uwb_mitigation.types.ros import codec, schemas, topics

TYPES = (topics.RANGE_CIR_TYPE, topics.RANGE_TRUTH_TYPE, topics.RANGE_CORRECTED_TYPE)


def write_bag(path: Path) -> Path:
    with BagWriter(path, {"source": "a test", "simulated": "true"}) as bag:
        for number in range(5):
            bag.write(record(number))
            write_corrected(bag, record(number).measurement, corrected(number))
    return path


@pytest.mark.parametrize("name", ["bag.mcap", "folder"])
def test_rosbags_opens_a_bag_and_agrees_on_every_field(tmp_path: Path, name: str) -> None:
    store = schemas.typestore()
    read = []
    with Reader(write_bag(tmp_path / name)) as reader:
        for connection, stamp_ns, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            number, stamp = message.sequence, message.header.stamp
            read.append((connection.topic, number))
            assert stamp_ns == stamp.sec * 10**9 + stamp.nanosec == record(number).measurement.stamp_ns
            assert message.header.frame_id == "antenna"
            assert (message.tag_id, message.anchor_id) == (7, 1 + number % 2)
            expected = {
                topics.RANGE_RAW: {"device_time": number * 1000, "range": 4.5 + number},
                topics.RANGE_TRUTH: {
                    "range": 4.0 + number, "label": "NDP NLOS", "configuration": f"place {number}",
                },
                topics.RANGE_CORRECTED: {
                    "range": 4.25 + number, "range_raw": 4.5 + number, "correction": 0.25, "variance": 0.0625,
                    "status": 0, "source": 1, "model_id": 77,
                },
            }[connection.topic]  # fmt: skip
            assert {name: getattr(message, name) for name in expected} == expected
            if connection.topic == topics.RANGE_RAW:
                assert np.array_equal(message.cir.samples, record(number).measurement.cir.samples)
                expected = {
                    "start_index": 700, "first_path_index": 740.25 + number, "encoding": 0, "scale": 1.0,
                    "preamble_count": 200 + number, "noise_threshold": 1500, "rx_power": -79.5,
                    "first_path_power": -83.25, "channel": 2, "prf": 64, "sample_period": np.float32(SAMPLE_PERIOD_S),
                }  # fmt: skip
                assert {name: getattr(message.cir, name) for name in expected} == expected
    names = (topics.RANGE_RAW, topics.RANGE_TRUTH, topics.RANGE_CORRECTED)
    assert sorted(read) == sorted((name, number) for name in names for number in range(5))


def test_bag_has_the_metadata_of_rosbag2(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag")
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        _, channel, _ = next(iter(reader.iter_messages(topics.RANGE_RAW)))
        records = {item.name: item.metadata for item in reader.iter_metadata()}
    assert channel.metadata["topic_type_hash"] == schemas.type_hash(topics.RANGE_CIR_TYPE)
    assert records["uwb_mitigation"]["simulated"] == "true"
    described = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    stated = yaml.safe_load(records["rosbag2"]["serialized_metadata"])
    assert stated == described["rosbag2_bagfile_information"]


def test_failed_replacement_keeps_the_old_bag(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag.mcap")
    before = path.read_bytes()
    with pytest.raises(RecordingError), BagWriter(path, {}, force=True) as bag:
        bag.write(Record(replace(record(0).measurement, tag_id=-1)))
    assert path.read_bytes() == before
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["bag.mcap"]


def test_full_disk_raises_a_recording_error(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    (tmp_path / "bag.mcap.part").symlink_to("/dev/full")
    with pytest.raises(RecordingError, match="No space left"):
        write_bag(tmp_path / "bag.mcap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        (("uint64 device_time", "uint32 device_time"), "field 5 .* is 'uint32 device_time'"),
        (("Cir cir ", "Cir cir\nfloat32 extra "), "additional field 'float32 extra'"),
        (("uint64 anchor_id", "# uint64 anchor_id"), "field 3 .* is 'uint32 sequence'"),
        (("MSG: uwb_mitigation_msgs/Cir", "MSG: uwb_mitigation_msgs/Other"), "Cir is not defined"),
        # Messages of an earlier version have no radio and no segment, which are the last fields.
        (("uint8 (radio|segment) .*\n", ""), "^$"),
        (("uint8 (prf|radio|segment) .*\n", ""), "field"),
    ],
)
def test_schema_with_other_fields_is_detected(change: tuple[str, str], difference: str) -> None:
    text = schemas.definition(topics.RANGE_CIR_TYPE)
    other = re.sub(*change, text)
    assert other != text
    assert re.search(difference, schemas.difference(other, topics.RANGE_CIR_TYPE) or "")


@pytest.mark.parametrize("type_name", TYPES)
def test_comments_and_constants_do_not_change_a_schema(type_name: str) -> None:
    bare, _ = schemas.typestore().generate_msgdef(type_name, ros_version=2)
    assert bare != schemas.definition(type_name)
    assert schemas.difference(bare, type_name) is None


@pytest.mark.parametrize("version", [8, 9])
def test_qos_of_a_copied_topic_is_copied(tmp_path: Path, version: int) -> None:
    zero, latched = QosTime(0, 0), (QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)
    qos = Qos(QosHistory.KEEP_LAST, 1, *latched, zero, zero, QosLiveliness.AUTOMATIC, zero, False)
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "in", version=version, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection(
            "/tf_static", "std_msgs/msg/Empty", typestore=store, offered_qos_profiles=[qos]
        )
        writer.write(topic, 5, b"\x00\x01\x00\x00\x00")
    with BagWriter(tmp_path / "out", {}) as bag:
        for message in BagReader(tmp_path / "in").messages():
            bag.write_serialized(bag.copy_channel(message.channel), message.data, message.log_time_ns, 5)
    for path in (tmp_path / "out", tmp_path / "out" / "out_0.mcap"):
        with Reader(path) as reader:
            (connection,) = reader.connections
            assert connection.ext.offered_qos_profiles == [qos]


COLUMNS = "start_index first_path_index scale preamble_count rx_power_dbm first_path_power_dbm"

float32 = st.floats(width=32)
uint64 = st.integers(0, 2**64 - 1)
uint16 = st.integers(0, 2**16 - 1)
texts = st.text(max_size=12)
cirs = st.builds(
    Cir,
    samples=st.lists(st.integers(-(2**15), 2**15 - 1), max_size=9).map(lambda x: np.array(x, np.int16)),
    encoding=st.sampled_from(Encoding),
    start_index=st.integers(-(2**31), 2**31 - 1),
    first_path_index=float32,
    sample_period_s=float32,
    scale=float32,
    preamble_count=uint16,
    noise_threshold=uint16,
    rx_power_dbm=float32,
    first_path_power_dbm=float32,
    channel=st.integers(0, 255),
    prf_mhz=st.integers(0, 255),
    radio=st.sampled_from(RadioType),
    segment=st.sampled_from(Segment),
)
measurements = st.builds(
    RangeMeasurement,
    stamp_ns=st.integers(-(2**31) * 10**9, (2**31) * 10**9 - 1),
    tag_id=uint64,
    anchor_id=uint64,
    sequence=st.integers(0, 2**32 - 1),
    device_time=uint64,
    range_m=float32,
    cir=cirs,
    frame_id=texts,
)
truths = st.builds(Truth, range_m=float32, label=texts, configuration=texts)
corrections = st.builds(
    CorrectedRange,
    range_m=float32,
    range_raw_m=float32,
    correction_m=float32,
    variance_m2=float32,
    status=st.sampled_from(Status),
    origin=st.sampled_from(CorrectedBy),
    model_id=st.integers(0, 2**32 - 1),
)


@settings(max_examples=50)
@given(measurements, truths, corrections)
def test_messages_equal_rosbags(measurement: RangeMeasurement, truth: Truth, correction: CorrectedRange):
    store = schemas.typestore()
    ours = (
        codec.encode_range(measurement),
        codec.encode_truth(measurement, truth),
        codec.encode_corrected(measurement, correction),
    )
    for data, type_name in zip(ours, TYPES, strict=True):
        theirs = store.serialize_cdr(store.deserialize_cdr(data, type_name), type_name)
        assert bytes(theirs) == data
    key = codec.measurement_key(measurement)
    assert codec.encode_range(codec.decode_range(ours[0])) == ours[0]
    for decoded, expected in (
        (codec.decode_truth(ours[1]), (key, truth)),
        (codec.decode_corrected(ours[2]), (key, correction)),
    ):
        assert repr(decoded) == repr(expected)


@given(measurements, st.data())
def test_batch_equals_single_messages_or_is_refused(measurement: RangeMeasurement, data: st.DataObject):
    count = len(measurement.cir.samples)
    samples = st.lists(st.integers(-9, 9), min_size=count, max_size=count).map(
        lambda x: np.array(x, np.int16)
    )
    messages = []
    for _ in range(3):
        cir = replace(measurement.cir, samples=data.draw(samples), rx_power_dbm=data.draw(float32))
        numbers = {"tag_id": data.draw(uint64), "range_m": data.draw(float32), "sequence": data.draw(uint16)}
        messages.append(codec.encode_range(replace(measurement, cir=cir, **numbers)))
    if is_changed := data.draw(st.booleans()):
        changed = bytearray(messages[2])
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
        messages[2] = bytes(changed)
    try:
        batch = codec.RangeBatch(messages)
    except RecordingError:
        # A frame_id that is not ASCII is decoded singly.
        assert is_changed or not (measurement.frame_id.isascii() and measurement.frame_id)
        return
    fields = ("range_m", "correction_m", "variance_m2")
    columns = {
        name: np.array(data.draw(st.lists(float32, min_size=3, max_size=3)), np.float32) for name in fields
    }
    status = np.array([0, 3, 4], np.uint8)
    corrected = CorrectedColumns(*columns.values(), status, CorrectedBy.DEVICE, 77, status)
    encoded = batch.encode_corrected(corrected)
    for row, message in enumerate(messages):
        decoded, ranges = codec.decode_range(message), batch.columns
        for name in ("encoding", "radio", "channel"):
            assert getattr(decoded.cir, name) == getattr(ranges, name)
        assert np.array_equal(decoded.cir.samples, ranges.samples[row])
        expected = [getattr(decoded.cir, name) for name in COLUMNS.split()]
        assert repr(expected) == repr([getattr(ranges, name)[row].item() for name in COLUMNS.split()])
        range_m, correction_m, variance_m2 = (float(column[row]) for column in columns.values())
        single = CorrectedRange(
            range_m, decoded.range_m, correction_m, variance_m2, Status(status[row]), CorrectedBy.DEVICE, 77
        )
        assert encoded[row] == codec.encode_corrected(decoded, single)


@given(measurements, st.integers(0, 3))
def test_message_of_an_earlier_version_has_no_radio(measurement: RangeMeasurement, padding: int) -> None:
    expected = replace(measurement.cir, radio=RadioType.UNKNOWN, segment=Segment.UNKNOWN)
    decoded = codec.decode_range(codec.encode_range(measurement)[:-2] + bytes(padding))
    assert repr(decoded) == repr(replace(measurement, cir=expected))


@given(measurements, st.data())
def test_truncated_message_is_refused(measurement: RangeMeasurement, data: st.DataObject) -> None:
    complete = codec.encode_range(measurement)
    # Messages of earlier versions end without the last two bytes, radio and segment.
    cut = data.draw(st.integers(0, len(complete) - 3))
    with pytest.raises(RecordingError, match="ends early"):
        codec.decode_range(complete[:cut])


@pytest.mark.parametrize("decode", [codec.decode_range, codec.decode_truth, codec.decode_corrected])
@given(noise=st.binary(max_size=200), start=st.sampled_from([b"", b"\0\1\0\0"]))
def test_any_bytes_decode_or_are_refused(decode: Callable[[bytes], object], noise: bytes, start: bytes):
    with contextlib.suppress(RecordingError):
        decode(start + noise)


@pytest.mark.parametrize(
    ("at", "value", "what"),
    [
        (0, b"\0\0", "big-endian"),
        (0, b"\0\7", "unknown encapsulation"),
        (8, b"\0\xca\x9a\x3b", "time stamp"),
        (12, b"\xff\xff\xff\xff", "ends early"),
        (16, b"\xff", "not UTF-8"),
        (23, b"x", "unterminated"),
        (28 + 48, b"\2", "unknown CIR encoding"),
        (28 + 56, b"\xff\xff\xff\xff", "ends early"),
        (-2, b"\x09", "unknown radio"),
    ],
)
def test_invalid_field_is_refused_and_named(at: int, value: bytes, what: str) -> None:
    data = bytearray(codec.encode_range(record(0).measurement))
    at %= len(data)
    data[at : at + len(value)] = value
    with pytest.raises(RecordingError, match=what):
        codec.decode_range(bytes(data))


@pytest.mark.parametrize(
    "field", [{"tag_id": 2**64}, {"sequence": -1}, {"stamp_ns": 2**63}, {"range_m": 1e39}]
)
def test_value_that_does_not_fit_is_refused(field: dict[str, float]) -> None:
    with pytest.raises(RecordingError, match="does not fit RangeCir"):
        codec.encode_range(replace(record(0).measurement, **field))
