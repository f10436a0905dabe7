"""Bag writer, compared with the libraries rosbags and mcap."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_material import corrected, record, write_corrected
from mcap.reader import SeekingReader
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.recordings.bag.reader import BagReader
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.types.measurement import SAMPLE_PERIOD_S, Record
from uwb_mitigation.types.ros import codec, schemas
from uwb_mitigation.types.ros.topics import (
    RANGE_CIR_TYPE,
    RANGE_CORRECTED,
    RANGE_CORRECTED_TYPE,
    RANGE_RAW,
    RANGE_TRUTH,
    RANGE_TRUTH_TYPE,
)

TYPES = (RANGE_CIR_TYPE, RANGE_TRUTH_TYPE, RANGE_CORRECTED_TYPE)


def write_bag(path: Path, count: int = 5, **options: bool) -> Path:
    with BagWriter(path, {"source": "a test", "simulated": "true"}, **options) as bag:
        for number in range(count):
            bag.write(record(number))
            write_corrected(bag, record(number).measurement, corrected(number))
    return path


@pytest.mark.parametrize("name", ["bag.mcap", "folder"])
def test_rosbags_opens_a_bag_and_agrees_on_every_field(tmp_path: Path, name: str) -> None:
    path = write_bag(tmp_path / name)
    store = schemas.typestore()
    read = []
    with Reader(path) as reader:
        for connection, stamp_ns, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            number, stamp = message.sequence, message.header.stamp
            read.append((connection.topic, number))
            assert stamp_ns == stamp.sec * 10**9 + stamp.nanosec == record(number).measurement.stamp_ns
            assert message.header.frame_id == "antenna"
            assert (message.tag_id, message.anchor_id) == (7, 1 + number % 2)
            expected = {
                RANGE_RAW: {"device_time": number * 1000, "range": 4.5 + number},
                RANGE_TRUTH: {
                    "range": 4.0 + number, "label": "NDP NLOS", "configuration": f"place {number}",
                },
                RANGE_CORRECTED: {
                    "range": 4.25 + number, "range_raw": 4.5 + number, "correction": 0.25, "variance": 0.0625,
                    "status": 0, "source": 1, "model_id": 77,
                },
            }[connection.topic]  # fmt: skip
            assert {name: getattr(message, name) for name in expected} == expected
            if connection.topic == RANGE_RAW:
                assert np.array_equal(message.cir.samples, record(number).measurement.cir.samples)
                expected = {
                    "start_index": 700, "first_path_index": 740.25 + number, "encoding": 0, "scale": 1.0,
                    "preamble_count": 200 + number, "noise_threshold": 1500, "rx_power": -79.5,
                    "first_path_power": -83.25, "channel": 2, "prf": 64, "sample_period": np.float32(SAMPLE_PERIOD_S),
                }  # fmt: skip
                assert {name: getattr(message.cir, name) for name in expected} == expected
    topics = (RANGE_RAW, RANGE_TRUTH, RANGE_CORRECTED)
    assert sorted(read) == sorted((topic, number) for topic in topics for number in range(5))


def test_mcap_library_reads_a_bag_with_every_checksum_tested(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", 20)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        messages = list(reader.iter_messages(RANGE_RAW))
        summary = reader.get_summary()
        records = {item.name: item.metadata for item in reader.iter_metadata()}
    assert len(messages) == 20
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    schema, channel, message = messages[3]
    assert (schema.name, schema.encoding, channel.message_encoding) == (RANGE_CIR_TYPE, "ros2msg", "cdr")
    assert b"MSG: builtin_interfaces/Time" in schema.data
    assert channel.metadata == {
        "offered_qos_profiles": "[]",
        "topic_type_hash": schemas.type_hash(RANGE_CIR_TYPE),
    }
    assert message.data == codec.encode_range(record(3).measurement)
    assert records["uwb_mitigation"]["simulated"] == "true"
    described = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]
    assert yaml.safe_load(records["rosbag2"]["serialized_metadata"]) == described


@pytest.mark.parametrize("name", ["bag.mcap", "folder"])
def test_existing_bag_is_kept_without_force(tmp_path: Path, name: str) -> None:
    path = write_bag(tmp_path / name, 5)
    with pytest.raises(ParameterError, match="--force"):
        write_bag(path, 2)
    assert BagReader(path).message_count == 15
    write_bag(path, 2, force=True)
    assert BagReader(path).message_count == 6


@pytest.mark.parametrize("name", ["bag.mcap", "folder"])
def test_interrupted_writer_leaves_no_file(tmp_path: Path, name: str) -> None:
    def interrupted() -> None:
        with BagWriter(tmp_path / name, {}) as bag:
            bag.write(record(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


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
    text = schemas.definition(RANGE_CIR_TYPE)
    other = re.sub(*change, text)
    assert other != text
    assert re.search(difference, schemas.difference(other, RANGE_CIR_TYPE) or "")


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
