"""Encode and decode `RangeCir`, `RangeTruth` and `RangeCorrected` in CDR.

The layouts are fixed except for strings and one array, so each consists of a few packed blocks. Every length
is checked before use. CDR aligns each value to its size, counted from the end of the four-byte
encapsulation header (OMG DDSI-RTPS 2.5, section 10.2; OMG CDR, section 15.3). Only little-endian plain CDR is
supported, the format of ROS 2. A library is not used, because `RangeBatch` decodes many messages together by these offsets,
and a live range is decoded twice as fast.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError, format_id
from uwb_mitigation.types.measurement import (
    Cir,
    CorrectedBy,
    CorrectedColumns,
    CorrectedRange,
    Encoding,
    RadioType,
    RangeColumns,
    RangeMeasurement,
    Segment,
    Status,
    Truth,
)
from uwb_mitigation.types.stamps import NS_PER_S

LITTLE_ENDIAN = b"\x00\x01"
"""The supported encapsulation (OMG DDSI-RTPS 2.5, section 10.2)."""

# Each block starts at a multiple of 8; `x` is the padding of CDR.
_PREFIX = struct.Struct("<4siII")  # encapsulation, seconds, nanoseconds, length of frame_id
_RANGE_CIR = struct.Struct("<QQI4xQffifB3xfI")  # tag, anchor, sequence, ticks, range, Cir to sample count
_CIR_COUNTS = struct.Struct("<HH")
_CIR_POWERS = struct.Struct("<ffBBBB")
_CIR_SOURCE_BYTES = 2
"""Size of the last fields of `_CIR_POWERS`, radio and segment, which bags of earlier versions do not contain."""

_TRUTH = struct.Struct("<QQIf")
_CORRECTED = struct.Struct("<QQIffffBB2xI")
_LENGTH = struct.Struct("<I")

_RADIOS = {int(radio): radio for radio in RadioType}
_SEGMENTS = {int(segment): segment for segment in Segment}
_ENCODINGS = {int(encoding): encoding for encoding in Encoding}
_STATUSES = {int(status): status for status in Status}
_ORIGINS = {int(origin): origin for origin in CorrectedBy}


class MeasurementKey(NamedTuple):
    """The fields that identify the measurement of a truth or corrected range."""

    stamp_ns: int
    tag_id: int
    anchor_id: int
    sequence: int


def measurement_key(measurement: RangeMeasurement) -> MeasurementKey:
    """Return the key of a measurement."""
    m = measurement
    return MeasurementKey(m.stamp_ns, m.tag_id, m.anchor_id, m.sequence)


def encode_range(measurement: RangeMeasurement) -> bytes:
    """Encode `RangeCir` in CDR.

    Raises:
        RecordingError: a value does not fit its field.
    """
    m, cir, samples = measurement, measurement.cir, measurement.cir.samples
    if samples.dtype != np.int16 or samples.ndim != 1:
        raise RecordingError(
            f"CIR samples are {samples.dtype} of shape {samples.shape}", valid="int16 of one dimension"
        )
    try:
        fields = _RANGE_CIR.pack(
            m.tag_id, m.anchor_id, m.sequence, m.device_time, m.range_m, cir.sample_period_s,
            cir.start_index, cir.first_path_index, cir.encoding, cir.scale, len(samples),
        )  # fmt: skip
        powers = _CIR_POWERS.pack(
            cir.rx_power_dbm, cir.first_path_power_dbm, cir.channel, cir.prf_mhz, cir.radio, cir.segment
        )
        data, padding = samples.astype("<i2", copy=False).tobytes(), b"\0\0" if len(samples) % 2 else b""
        counts = _CIR_COUNTS.pack(cir.preamble_count, cir.noise_threshold)
        return b"".join((_encode_header(m), fields, data, counts, padding, powers))
    except (struct.error, OverflowError, UnicodeEncodeError) as error:
        raise _encoding_error("RangeCir", measurement, error) from error


def encode_truth(measurement: RangeMeasurement, truth: Truth) -> bytes:
    """Encode `RangeTruth` in CDR for a measurement.

    Raises:
        RecordingError: a value does not fit its field.
    """
    m = measurement
    try:
        data = _encode_header(m) + _TRUTH.pack(m.tag_id, m.anchor_id, m.sequence, truth.range_m)
        data = _append_string(data, truth.label)
        return _append_string(data, truth.configuration)
    except (struct.error, OverflowError, UnicodeEncodeError) as error:
        raise _encoding_error("RangeTruth", measurement, error) from error


def encode_corrected(measurement: RangeMeasurement, corrected: CorrectedRange) -> bytes:
    """Encode `RangeCorrected` in CDR for a measurement.

    Raises:
        RecordingError: a value does not fit its field.
    """
    m, c = measurement, corrected
    try:
        return _encode_header(m) + _CORRECTED.pack(
            m.tag_id, m.anchor_id, m.sequence, c.range_m, c.range_raw_m, c.correction_m, c.variance_m2, c.status,
            c.origin, c.model_id,
        )  # fmt: skip
    except (struct.error, OverflowError, UnicodeEncodeError) as error:
        raise _encoding_error("RangeCorrected", measurement, error) from error


def decode_range(data: bytes) -> RangeMeasurement:
    """Decode a measurement from the CDR of `RangeCir`. Its samples are a read-only view of `data`.

    Raises:
        RecordingError: the bytes are not a `RangeCir`; `what` is one of a few texts without values,
            so that callers can count errors by it.
    """
    stamp_ns, frame_id, offset = _decode_header(data)
    _require(data, offset + _RANGE_CIR.size)
    (tag_id, anchor_id, sequence, ticks, range_m, period, start, first_path, encoding, scale, count) = (
        _RANGE_CIR.unpack_from(data, offset)
    )
    if encoding not in _ENCODINGS:
        raise RecordingError("message with an unknown CIR encoding", where=f"encoding {encoding}")
    offset += _RANGE_CIR.size
    powers_at = offset + 2 * count + _CIR_COUNTS.size + 2 * (count % 2)
    missing = powers_at + _CIR_POWERS.size - len(data)
    if 0 < missing <= _CIR_SOURCE_BYTES:
        # Padding of an earlier version is zero, too: UNKNOWN.
        data += bytes(missing)
    _require_end(data, powers_at + _CIR_POWERS.size)
    preamble_count, noise_threshold = _CIR_COUNTS.unpack_from(data, offset + 2 * count)
    rx_power, first_path_power, channel, prf, radio, segment = _CIR_POWERS.unpack_from(data, powers_at)
    if radio not in _RADIOS or segment not in _SEGMENTS:
        raise RecordingError(
            "message with an unknown radio or segment", where=f"radio {radio}, segment {segment}"
        )
    cir = Cir(
        np.frombuffer(data, "<i2", count, offset), _ENCODINGS[encoding], start, first_path, period, scale,
        preamble_count, noise_threshold, rx_power, first_path_power, channel, prf, _RADIOS[radio], _SEGMENTS[segment],
    )  # fmt: skip
    return RangeMeasurement(stamp_ns, tag_id, anchor_id, sequence, ticks, range_m, cir, frame_id)


def decode_truth(data: bytes) -> tuple[MeasurementKey, Truth]:
    """Decode the truth from the CDR of `RangeTruth`, and the key of its measurement.

    Raises:
        RecordingError: the bytes are not a `RangeTruth`; `what` as for `decode_range`.
    """
    stamp_ns, _, offset = _decode_header(data)
    _require(data, offset + _TRUTH.size)
    tag_id, anchor_id, sequence, range_m = _TRUTH.unpack_from(data, offset)
    label, offset = _decode_string(data, offset + _TRUTH.size)
    configuration, offset = _decode_string(data, offset + -offset % 4)
    _require_end(data, offset)
    return MeasurementKey(stamp_ns, tag_id, anchor_id, sequence), Truth(range_m, label, configuration)


def decode_corrected(data: bytes) -> tuple[MeasurementKey, CorrectedRange]:
    """Decode the range from the CDR of `RangeCorrected`, and the key of its measurement.

    Raises:
        RecordingError: the bytes are not a `RangeCorrected`; `what` as for `decode_range`.
    """
    stamp_ns, _, offset = _decode_header(data)
    _require_end(data, offset + _CORRECTED.size)
    (tag_id, anchor_id, sequence, range_m, raw_m, correction_m, variance_m2, status, origin, model_id) = (
        _CORRECTED.unpack_from(data, offset)
    )
    if status not in _STATUSES:
        raise RecordingError("message with an unknown status", where=f"status {status}")
    if origin not in _ORIGINS:
        raise RecordingError("message with an unknown origin", where=f"source {origin}")
    return MeasurementKey(stamp_ns, tag_id, anchor_id, sequence), CorrectedRange(
        range_m, raw_m, correction_m, variance_m2, _STATUSES[status], _ORIGINS[origin], model_id
    )


class RangeBatch:
    """Messages `RangeCir` of the same form as columns, without a copy of each.

    Args:
        messages: one or more.

    Attributes:
        columns: the ranges.

    Raises:
        RecordingError: the first message cannot be decoded, or another one has another form: length of the message or
            frame_id, encoding, number of samples, channel, PRF, radio, segment; or its fields are not valid.
    """

    def __init__(self, messages: Sequence[bytes]) -> None:
        first, size = decode_range(messages[0]), len(messages[0])
        frame_end = _PREFIX.size + _PREFIX.unpack_from(messages[0])[3]
        start, samples = first_field_offset(frame_end), first.cir.samples
        powers = start + _RANGE_CIR.size + samples.nbytes + _CIR_COUNTS.size + samples.nbytes % 4
        if {len(message) for message in messages} != {size} or size < powers + _CIR_POWERS.size:
            raise RecordingError("messages of several lengths")
        table = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), size)
        # Encapsulation, length of frame_id, its terminator and padding; encoding, sample count, channel, PRF, radio and segment.
        fixed = np.r_[
            0:4, 12:16, frame_end - 1 : start, start + 48, start + 56 : start + 60, powers + 8 : powers + 12
        ]
        frame = table[:, _PREFIX.size : frame_end]
        if frame_end == _PREFIX.size or table[0, frame_end:start].any() or messages[0][2:4] != b"\0\0":
            raise RecordingError("messages in an unusual form")
        if (table[:, fixed] != table[0, fixed]).any() or (frame > 127).any():
            raise RecordingError("messages of several forms")

        def column(offset: int, kind: str) -> NDArray[Any]:
            values = table[:, offset : offset + np.dtype(kind).itemsize]
            return np.ascontiguousarray(values).view(kind)[:, 0]

        if (column(8, "<u4") >= NS_PER_S).any():
            raise RecordingError("message with an invalid time stamp")
        self._header = table[:, :start]
        self._sequence = column(start + 16, "<u4")
        end = start + _RANGE_CIR.size
        offsets = start + 32, start + 44, start + 52, powers, powers + 4
        range_m, first_path, scale, rx_dbm, first_path_dbm = (
            column(offset, "<f4").astype(np.float64) for offset in offsets
        )
        tags, anchors = column(start, "<u8"), column(start + 8, "<u8")
        cirs = np.ascontiguousarray(table[:, end : end + samples.nbytes]).view("<i2")
        starts, counts = column(start + 40, "<i4"), column(end + samples.nbytes, "<u2")
        shape = first.cir.encoding, cirs, starts, first_path, scale
        source = first.cir.radio, first.cir.segment, first.cir.channel
        self.columns = RangeColumns(tags, anchors, range_m, *shape, counts, rx_dbm, first_path_dbm, *source)

    @staticmethod
    def key(message: bytes) -> tuple[int, bytes]:
        """Return a key that messages of the same form share: the lengths of the message and of its frame_id."""
        return len(message), message[12:16]

    def encode_corrected(self, corrected: CorrectedColumns) -> list[bytes]:
        """Encode `RangeCorrected` in CDR for each message."""
        ranges = self.columns
        columns = (
            *(self._header, ranges.tag_id, ranges.anchor_id, self._sequence),
            *(corrected.range_m, ranges.range_m, corrected.correction_m, corrected.variance_m2),
            *(corrected.status, corrected.origin, 0, corrected.model_id),
        )
        # The fields of `_CORRECTED`, after the header.
        header = f"{self._header.shape[1]}u1"
        table = np.empty(len(ranges), f"{header},<u8,<u8,<u4,<f4,<f4,<f4,<f4,u1,u1,<u2,<u4")
        for number, column in enumerate(columns):
            table[f"f{number}"] = column
        data, size = table.tobytes(), table.itemsize
        return [data[start : start + size] for start in range(0, len(data), size)]


def decode_frame_id(data: bytes) -> str:
    """Decode the frame_id from the CDR of a message that starts with a header.

    Raises:
        RecordingError: the bytes are no such message.
    """
    return _decode_header(data)[1]


def first_field_offset(end: int) -> int:
    """Return the position of the first 8-byte field of a message whose frame_id ends at `end`."""
    return end + (4 - end) % 8


def _encode_header(measurement: RangeMeasurement) -> bytes:
    seconds, nanoseconds = divmod(measurement.stamp_ns, NS_PER_S)
    frame = measurement.frame_id.encode() + b"\0"
    prefix = _PREFIX.pack(LITTLE_ENDIAN + b"\0\0", seconds, nanoseconds, len(frame))
    return prefix + frame + bytes(-(len(prefix) - 4 + len(frame)) % 8)


def _decode_header(data: bytes) -> tuple[int, str, int]:
    """Return stamp, frame_id, and the position of the first 8-byte field after the header."""
    _require(data, _PREFIX.size)
    encapsulation, seconds, nanoseconds, _ = _PREFIX.unpack_from(data)
    if not encapsulation.startswith(LITTLE_ENDIAN):
        kind = "big-endian CDR" if encapsulation.startswith(b"\0\0") else "an unknown encapsulation"
        raise RecordingError(f"message in {kind}", where=encapsulation.hex(" "), valid="little-endian CDR")
    if nanoseconds >= NS_PER_S:
        raise RecordingError("message with an invalid time stamp", where=f"nanosec {nanoseconds}")
    frame_id, offset = _decode_string(data, _PREFIX.size - _LENGTH.size)
    return seconds * NS_PER_S + nanoseconds, frame_id, first_field_offset(offset)


def _append_string(data: bytes, text: str) -> bytes:
    encoded = text.encode() + b"\0"
    return data + bytes(-len(data) % 4) + _LENGTH.pack(len(encoded)) + encoded


def _decode_string(data: bytes, offset: int) -> tuple[str, int]:
    """Return the string at `at`, and its end."""
    _require(data, offset + _LENGTH.size)
    (length,) = _LENGTH.unpack_from(data, offset)
    offset += _LENGTH.size
    end = offset + length
    _require(data, end)
    # Some middleware sends empty strings without the terminator.
    text = data[offset:end]
    if text and text[-1] != 0:
        raise RecordingError("message with an unterminated string", where=f"byte {offset}")
    try:
        return text[:-1].decode(), end
    except UnicodeDecodeError:
        raise RecordingError("message with a string that is not UTF-8", where=f"byte {offset}") from None


def _require(data: bytes, size: int) -> None:
    if len(data) < size:
        raise RecordingError("message ends early", where=f"{len(data)} of at least {size} bytes")


def _require_end(data: bytes, size: int) -> None:
    _require(data, size)
    # A writer may round a message up to a multiple of four.
    if len(data) > size + 3:
        raise RecordingError("message longer than its type", where=f"{len(data)} instead of {size} bytes")


def _encoding_error(type_name: str, measurement: RangeMeasurement, error: Exception) -> RecordingError:
    return RecordingError(
        f"a value does not fit {type_name}: {error}",
        where=f"exchange {measurement.sequence} of anchor {format_id(measurement.anchor_id)}, tag {format_id(measurement.tag_id)}",
    )
