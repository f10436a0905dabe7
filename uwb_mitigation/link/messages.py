"""Payloads to typed values and back. A measurement travels as `RangeMeasurement` itself.

Floats travel as IEEE-754 binary32, as in the ROS messages: a correction computed on either side of the
link starts from the same bits.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.link.layout import MAX_SAMPLES, PAYLOADS, LogLevel, MessageType, Mode
from uwb_mitigation.link.offsets import (
    OffsetsAnswer,
    SetOffsets,
    decode_offsets,
    decode_set_offsets,
    encode_offsets,
)
from uwb_mitigation.link.radio import (
    GetRadio,
    Radio,
    RadioStatus,
    SetRadio,
    decode_radio,
    decode_radio_status,
    decode_set_radio,
    encode_radio,
    encode_radio_status,
)
from uwb_mitigation.measurement import (
    DEVICE_TIME_WRAP,
    Cir,
    CorrectedRange,
    Encoding,
    Origin,
    RangeMeasurement,
    Status,
)

_packing = {kind: layout.packing() for kind, layout in PAYLOADS.items()}
_SAMPLES_OFFSET = _packing[MessageType.RANGE_CIR].size
_FIRMWARE_NAME_BYTES = 16

_Enum = TypeVar("_Enum", Mode, LogLevel, Encoding, Status)


@dataclass(frozen=True, slots=True)
class Hello:
    """Who the board is and what it does.

    Attributes:
        board_id: 64-bit identity of the board.
        model_id: identity of the board's model; 0 = it has none.
        window: window length K of the board's model; 0 = it has none.
        mode: what the board sends of its own measurements.
        boot_id: differs from one start of the firmware to the next.
        request_sequence: of the host's frame that this answers; of no meaning if it answers none.
        max_payload: longest payload the board accepts, bytes.
        firmware_version: major, minor, patch.
        firmware_name: at most 16 bytes of UTF-8; more is cut off.
    """

    board_id: int
    model_id: int
    window: int
    mode: Mode
    boot_id: int
    request_sequence: int = 0
    max_payload: int = 0
    firmware_version: tuple[int, int, int] = (0, 0, 0)
    firmware_name: str = ""


@dataclass(frozen=True, slots=True)
class Correction:
    """A range that the board corrected, and which measurement it belongs to.

    Attributes:
        stamp_ns, tag_id, anchor_id, sequence, device_time: as in `RangeMeasurement`.
        corrected: the result; its origin is DEVICE.
        compute_us: time that the correction took on the board.
    """

    stamp_ns: int
    tag_id: int
    anchor_id: int
    sequence: int
    device_time: int
    corrected: CorrectedRange
    compute_us: int = 0


@dataclass(frozen=True, slots=True)
class Log:
    """A line of text for a person."""

    level: LogLevel
    text: str


@dataclass(frozen=True, slots=True)
class BoardStatus:
    """Sign of life and counts since the board's start; the fields of `layout.PAYLOADS[STATUS]`.

    `temperature_c` is NaN where the board measures none.
    """

    frames_received: int
    frames_dropped: int
    measurements: int
    measurements_lost: int
    mode: Mode
    temperature_c: float = math.nan


@dataclass(frozen=True, slots=True)
class TimeSyncReply:
    """When the board received a TIME_SYNC, in microseconds of its uptime."""

    request_sequence: int
    received_us: int


@dataclass(frozen=True, slots=True)
class SetMode:
    """Asks for a mode; the board answers with a HELLO that tells the mode then in force."""

    mode: Mode


@dataclass(frozen=True, slots=True)
class GetInfo:
    """Asks for a HELLO."""


@dataclass(frozen=True, slots=True)
class TimeSync:
    """Asks for a TIME_SYNC_REPLY."""


Message = (
    Hello
    | RangeMeasurement
    | Correction
    | Log
    | BoardStatus
    | TimeSyncReply
    | Radio
    | RadioStatus
    | SetMode
    | GetInfo
    | TimeSync
    | GetRadio
    | SetRadio
    | OffsetsAnswer
    | SetOffsets
)


def encode(message: Message) -> tuple[MessageType, bytes]:
    """The message's type and payload.

    Of a measurement, the stamp and the frame id stay behind: the frame's header carries the time.

    Raises:
        ParameterError: a value does not fit its field.
    """
    try:
        return _encode(message)
    except (struct.error, OverflowError) as error:
        kind = type(message).__name__
        raise ParameterError(f"a value of {kind} does not fit its field: {error}") from error


def _encode(message: Message) -> tuple[MessageType, bytes]:
    if isinstance(message, RangeMeasurement):
        return MessageType.RANGE_CIR, _encode_measurement(message)
    if isinstance(message, Correction):
        corrected = message.corrected
        return _pack(
            MessageType.RANGE_CORRECTED,
            message.tag_id,
            message.anchor_id,
            message.device_time,
            message.sequence,
            corrected.model_id,
            corrected.range_m,
            corrected.range_raw_m,
            corrected.correction_m,
            corrected.variance_m2,
            message.compute_us,
            corrected.status,
        )
    if isinstance(message, Hello):
        return _pack(
            MessageType.HELLO,
            message.board_id,
            message.model_id,
            message.boot_id,
            message.request_sequence,
            message.window,
            message.max_payload,
            *message.firmware_version,
            message.mode,
            _cut_utf8(message.firmware_name, _FIRMWARE_NAME_BYTES),
        )
    if isinstance(message, Log):
        kind, fixed = _pack(MessageType.LOG, message.level)
        return kind, fixed + message.text.encode("utf-8", "replace")
    if isinstance(message, BoardStatus):
        return _pack(
            MessageType.STATUS,
            message.frames_received,
            message.frames_dropped,
            message.measurements,
            message.measurements_lost,
            message.temperature_c,
            message.mode,
        )
    if isinstance(message, TimeSyncReply):
        return _pack(MessageType.TIME_SYNC_REPLY, message.request_sequence, message.received_us)
    if isinstance(message, Radio | SetRadio):
        return encode_radio(message)
    if isinstance(message, RadioStatus):
        return encode_radio_status(message)
    if isinstance(message, SetOffsets | OffsetsAnswer):
        return encode_offsets(message)
    if isinstance(message, SetMode):
        return _pack(MessageType.SET_MODE, message.mode)
    if isinstance(message, GetInfo):
        return _pack(MessageType.GET_INFO)
    if isinstance(message, GetRadio):
        return _pack(MessageType.GET_RADIO)
    return _pack(MessageType.TIME_SYNC)


def decode(kind: int, payload: bytes, *, stamp_ns: int = 0) -> Message | None:
    """The message of type `kind` in `payload`; None if this version of the protocol has no such type.

    `stamp_ns` becomes the stamp of a measurement or correction. The samples of a measurement are a
    read-only view of `payload`.

    Raises:
        LinkError: the payload is too short for its type, or a field has a value outside its range.
    """
    packing = _packing.get(kind)  # type: ignore[call-overload]
    if packing is None:
        return None
    if len(payload) < packing.size:
        raise LinkError(
            f"a payload of {len(payload)} bytes",
            where=MessageType(kind).name,
            valid=f"at least {packing.size}",
        )
    values = packing.unpack_from(payload)
    return _decoders[MessageType(kind)](payload, values, stamp_ns)


def _encode_measurement(measurement: RangeMeasurement) -> bytes:
    cir = measurement.cir
    if len(cir.samples) > MAX_SAMPLES:
        raise ParameterError(
            f"a CIR of {len(cir.samples)} values", where="RANGE_CIR", valid=f"at most {MAX_SAMPLES}"
        )
    fixed = _packing[MessageType.RANGE_CIR].pack(
        measurement.tag_id,
        measurement.anchor_id,
        measurement.device_time,
        measurement.sequence,
        measurement.range_m,
        cir.sample_period_s,
        cir.first_path_index,
        cir.scale,
        cir.rx_power_dbm,
        cir.first_path_power_dbm,
        cir.start_index,
        cir.preamble_count,
        cir.noise_threshold,
        _SAMPLES_OFFSET,
        len(cir.samples),
        cir.encoding,
        cir.channel,
        cir.prf_mhz,
    )
    return fixed + np.asarray(cir.samples, dtype="<i2").tobytes()


def _decode_measurement(payload: bytes, values: tuple[Any, ...], stamp_ns: int) -> RangeMeasurement:
    (
        tag_id,
        anchor_id,
        device_time,
        sequence,
        range_m,
        sample_period_s,
        first_path_index,
        scale,
        rx_power_dbm,
        first_path_power_dbm,
        start_index,
        preamble_count,
        noise_threshold,
        samples_offset,
        sample_count,
        encoding,
        channel,
        prf_mhz,
    ) = values
    _check_device_time("RANGE_CIR", device_time)
    if (
        sample_count > MAX_SAMPLES
        or samples_offset < _SAMPLES_OFFSET
        or samples_offset % 2
        or samples_offset + 2 * sample_count > len(payload)
    ):
        raise LinkError(
            f"{sample_count} samples at byte {samples_offset} of a payload of {len(payload)} bytes",
            where="RANGE_CIR",
            valid=f"at most {MAX_SAMPLES}, inside the payload, at an even byte from {_SAMPLES_OFFSET}",
        )
    cir = Cir(
        samples=np.frombuffer(payload, "<i2", sample_count, samples_offset),
        encoding=_member(Encoding, encoding, "RANGE_CIR encoding"),
        start_index=start_index,
        first_path_index=first_path_index,
        sample_period_s=sample_period_s,
        scale=scale,
        preamble_count=preamble_count,
        noise_threshold=noise_threshold,
        rx_power_dbm=rx_power_dbm,
        first_path_power_dbm=first_path_power_dbm,
        channel=channel,
        prf_mhz=prf_mhz,
    )
    return RangeMeasurement(stamp_ns, tag_id, anchor_id, sequence, device_time, range_m, cir)


def _decode_correction(_: bytes, values: tuple[Any, ...], stamp_ns: int) -> Correction:
    (
        tag_id,
        anchor_id,
        device_time,
        sequence,
        model_id,
        range_m,
        range_raw_m,
        correction_m,
        variance_m2,
        compute_us,
        status,
    ) = values
    _check_device_time("RANGE_CORRECTED", device_time)
    corrected = CorrectedRange(
        range_m=range_m,
        range_raw_m=range_raw_m,
        correction_m=correction_m,
        variance_m2=variance_m2,
        status=_member(Status, status, "RANGE_CORRECTED status"),
        origin=Origin.DEVICE,
        model_id=model_id,
    )
    return Correction(stamp_ns, tag_id, anchor_id, sequence, device_time, corrected, compute_us)


def _decode_hello(_: bytes, values: tuple[Any, ...], __: int) -> Hello:
    board_id, model_id, boot_id, request_sequence, window, max_payload, *version, mode, name = values
    major, minor, patch = version
    return Hello(
        board_id=board_id,
        model_id=model_id,
        window=window,
        mode=_member(Mode, mode, "HELLO mode"),
        boot_id=boot_id,
        request_sequence=request_sequence,
        max_payload=max_payload,
        firmware_version=(major, minor, patch),
        firmware_name=name.rstrip(b"\0").decode("utf-8", "replace"),
    )


def _decode_log(payload: bytes, values: tuple[Any, ...], _: int) -> Log:
    text = payload[_packing[MessageType.LOG].size :].decode("utf-8", "replace")
    return Log(_member(LogLevel, values[0], "LOG level"), text)


def _decode_status(_: bytes, values: tuple[Any, ...], __: int) -> BoardStatus:
    frames_received, frames_dropped, measurements, measurements_lost, temperature_c, mode = values
    return BoardStatus(
        frames_received,
        frames_dropped,
        measurements,
        measurements_lost,
        _member(Mode, mode, "STATUS mode"),
        temperature_c,
    )


def _decode_set_mode(_: bytes, values: tuple[Any, ...], __: int) -> SetMode:
    return SetMode(_member(Mode, values[0], "SET_MODE mode"))


_decoders: dict[MessageType, Callable[[bytes, tuple[Any, ...], int], Message]] = {
    MessageType.RANGE_CIR: _decode_measurement,
    MessageType.RANGE_CORRECTED: _decode_correction,
    MessageType.HELLO: _decode_hello,
    MessageType.LOG: _decode_log,
    MessageType.STATUS: _decode_status,
    MessageType.TIME_SYNC_REPLY: lambda _, values, __: TimeSyncReply(*values),
    MessageType.SET_MODE: _decode_set_mode,
    MessageType.GET_INFO: lambda *_: GetInfo(),
    MessageType.TIME_SYNC: lambda *_: TimeSync(),
    MessageType.RADIO: decode_radio,
    MessageType.RADIO_STATUS: decode_radio_status,
    MessageType.GET_RADIO: lambda *_: GetRadio(),
    MessageType.SET_RADIO: decode_set_radio,
    MessageType.OFFSETS: decode_offsets,
    MessageType.SET_OFFSETS: decode_set_offsets,
}


def _pack(kind: MessageType, *values: Any) -> tuple[MessageType, bytes]:
    return kind, _packing[kind].pack(*values)


def _member(enumeration: type[_Enum], value: int, where: str) -> _Enum:
    try:
        return enumeration(value)
    except ValueError:
        valid = ", ".join(f"{member.value} {member.name}" for member in enumeration)
        raise LinkError(f"the value {value}", where=where, valid=valid) from None


def _check_device_time(where: str, ticks: int) -> None:
    if ticks >= DEVICE_TIME_WRAP:
        raise LinkError(f"a device time of {ticks} ticks", where=where, valid="40 bits")


def _cut_utf8(text: str, size: int) -> bytes:
    """At most `size` bytes of UTF-8, without half a character at the end."""
    return text.encode("utf-8", "replace")[:size].decode("utf-8", "ignore").encode()
