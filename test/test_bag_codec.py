"""CDR codec: exact, equal to rosbags, and safe for arbitrary bytes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from bag_material import record
from hypothesis import given
from hypothesis import strategies as st

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.types.measurement import (
    Cir,
    CorrectedBy,
    CorrectedColumns,
    CorrectedRange,
    Encoding,
    RadioType,
    RangeMeasurement,
    Segment,
    Status,
    Truth,
)
from uwb_mitigation.types.ros import codec, schemas
from uwb_mitigation.types.ros.topics import RANGE_CIR_TYPE, RANGE_CORRECTED_TYPE, RANGE_TRUTH_TYPE

TYPES = (RANGE_CIR_TYPE, RANGE_TRUTH_TYPE, RANGE_CORRECTED_TYPE)

COLUMNS = (
    "start_index",
    "first_path_index",
    "scale",
    "preamble_count",
    "rx_power_dbm",
    "first_path_power_dbm",
)

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


@given(measurements, truths, corrections)
def test_messages_equal_rosbags(
    measurement: RangeMeasurement, truth: Truth, correction: CorrectedRange
) -> None:
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
def test_batch_equals_single_messages_or_is_refused(
    measurement: RangeMeasurement, data: st.DataObject
) -> None:
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
        expected = [getattr(decoded.cir, name) for name in COLUMNS]
        assert repr(expected) == repr([getattr(ranges, name)[row].item() for name in COLUMNS])
        range_m, correction_m, variance_m2 = (float(column[row]) for column in columns.values())
        single = CorrectedRange(
            range_m, decoded.range_m, correction_m, variance_m2, Status(status[row]), CorrectedBy.DEVICE, 77
        )
        assert encoded[row] == codec.encode_corrected(decoded, single)


@given(measurements, st.integers(0, 3))
def test_message_of_an_earlier_version_has_no_radio(measurement: RangeMeasurement, padding: int) -> None:
    old = codec.encode_range(measurement)[:-2] + bytes(padding)
    expected = replace(measurement.cir, radio=RadioType.UNKNOWN, segment=Segment.UNKNOWN)
    decoded = codec.decode_range(old)
    assert repr(decoded) == repr(replace(measurement, cir=expected))


def test_message_of_a_later_radio_is_refused() -> None:
    data = codec.encode_range(record(0).measurement)
    with pytest.raises(RecordingError, match="unknown radio"):
        codec.decode_range(data[:-2] + b"\x09\x00")


@given(measurements, st.data())
def test_truncated_message_is_refused(measurement: RangeMeasurement, data: st.DataObject) -> None:
    complete = codec.encode_range(measurement)
    # Messages of earlier versions end without the last two bytes, radio and segment.
    cut = data.draw(st.integers(0, len(complete) - 3))
    with pytest.raises(RecordingError, match="ends early"):
        codec.decode_range(complete[:cut])


@pytest.mark.parametrize("decode", [codec.decode_range, codec.decode_truth, codec.decode_corrected])
@given(noise=st.binary(max_size=200), start=st.sampled_from([b"", b"\0\1\0\0"]))
def test_any_bytes_decode_or_are_refused(
    decode: Callable[[bytes], object], noise: bytes, start: bytes
) -> None:
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
    ],
)
def test_invalid_field_is_refused_and_named(at: int, value: bytes, what: str) -> None:
    data = bytearray(codec.encode_range(record(0).measurement))
    data[at : at + len(value)] = value
    with pytest.raises(RecordingError, match=what):
        codec.decode_range(bytes(data))


@pytest.mark.parametrize(
    "field", [{"tag_id": 2**64}, {"sequence": -1}, {"stamp_ns": 2**63}, {"range_m": 1e39}]
)
def test_value_that_does_not_fit_is_refused(field: dict[str, float]) -> None:
    with pytest.raises(RecordingError, match="does not fit RangeCir"):
        codec.encode_range(replace(record(0).measurement, **field))
