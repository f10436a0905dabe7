"""Messages, and the encoding and decoding of their payloads, whose fields are declared in `layout`. No I/O.

Each function packs or unpacks the fields in the order of its table. A measurement is sent as `RangeMeasurement` itself. Floats are IEEE-754 binary32 on the wire, as in the ROS messages:
a correction computed on either side of the link starts from the same bits.
"""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any, TypeVar

import numpy as np

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.radios.settings import (
    MAX_ANCHORS,
    AnchorStatus,
    RadioSettings,
    RadioState,
    RadioStatus,
    Role,
)
from uwb_mitigation.radios.wire import layout
from uwb_mitigation.radios.wire.layout import LogLevel, MessageType, Mode, OffsetScope
from uwb_mitigation.types.measurement import (
    DEVICE_TIME_WRAP,
    Cir,
    CorrectedBy,
    CorrectedRange,
    Encoding,
    RadioType,
    RangeMeasurement,
    Segment,
    Status,
)
from uwb_mitigation.types.offsets import Offsets


@dataclass(frozen=True, slots=True)
class Hello:
    """Identity and state of a board; the fields of `layout.PAYLOADS[HELLO]`, in the same order.

    `firmware_name` has at most 16 bytes of UTF-8; longer names are truncated.
    """

    board_id: int = 0
    model_id: int = 0
    boot_id: int = 0
    request_sequence: int = 0
    window: int = 0
    max_payload: int = 0
    firmware_major: int = 0
    firmware_minor: int = 0
    firmware_patch: int = 0
    mode: Mode = Mode.HOST
    firmware_name: str = ""

    @property
    def firmware_version(self) -> str:
        """Firmware version as `major.minor.patch`."""
        return f"{self.firmware_major}.{self.firmware_minor}.{self.firmware_patch}"


@dataclass(frozen=True, slots=True)
class Correction:
    """A range that the board corrected, and the measurement that it belongs to.

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
    """A log message of the board."""

    level: LogLevel
    text: str


@dataclass(frozen=True, slots=True)
class BoardStatus:
    """Heartbeat and counts since the board's start; the fields of `layout.PAYLOADS[STATUS]`.

    `temperature_c` is NaN if the board does not measure it.
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
class RadioConfigured:
    """The settings of a board's radio.

    Attributes:
        settings: active settings, or those that become active next; includes the chip's own values once the chip has started.
        request_sequence: sequence number of the host's frame that this answers.
        accepted: False if the requested settings are refused.
        text: reason of the refusal.
    """

    settings: RadioSettings
    request_sequence: int = 0
    accepted: bool = True
    text: str = ""


@dataclass(frozen=True, slots=True)
class OffsetsAnswer:
    """The answer to requested `Offsets`; the fields of `layout.PAYLOADS[OFFSETS]`."""

    request_sequence: int
    slots: int
    accepted: bool


Message = object
"""An object of a type in `_ENCODERS`, or the `MessageType` of a request without content: GET_INFO, TIME_SYNC, GET_RADIO.

Other requests are the requested values themselves. A board answers a `Mode` with a HELLO that contains the active mode,
`RadioSettings` with a RADIO that accepts or refuses them, and `Offsets`, which it subtracts from its ranges, with an
`OffsetsAnswer`.
"""


def encode(message: Message) -> tuple[MessageType, bytes]:
    """Return the message's type and payload.

    The stamp and the frame id of a measurement are left out: the frame's header contains the time.

    Raises:
        ParameterError: a value does not fit its field.
    """
    if isinstance(message, MessageType):
        return message, b""
    kind, fields = _ENCODERS[type(message)]
    try:
        *values, tail = fields(message)
        return kind, layout.STRUCTS[kind].pack(*values) + tail
    except (struct.error, OverflowError) as error:
        name = type(message).__name__
        raise ParameterError(f"a value of {name} does not fit its field: {error}") from error


def decode(kind: int, payload: bytes, *, stamp_ns: int = 0) -> Message | None:
    """Return the message of type `kind` in `payload`; None if this version of the protocol has no such type.

    `stamp_ns` becomes the stamp of a measurement or correction. The samples of a measurement are a read-only view of
    `payload`.

    Raises:
        LinkError: the payload is too short for its type, or a field has a value outside its range.
    """
    if kind not in layout.STRUCTS:
        return None
    name, size = MessageType(kind).name, layout.STRUCTS[kind].size
    if len(payload) < size:
        raise LinkError(f"a payload of {len(payload)} bytes", where=name, valid=f"at least {size}")
    if kind not in _DECODERS:
        return MessageType(kind)
    try:
        return _DECODERS[kind](layout.STRUCTS[kind].unpack_from(payload), payload, stamp_ns)
    except (LinkError, ParameterError) as error:
        raise LinkError(error.what, where=name, valid=error.valid) from error


_Member = TypeVar("_Member", bound=enum.IntEnum)


def _member(kind: type[_Member], value: int) -> _Member:
    """Return a member of an enumeration; raise LinkError for an invalid value."""
    try:
        return kind(value)
    except ValueError:
        valid = ", ".join(f"{member.value} {member.name}" for member in kind)
        raise LinkError(f"the value {value} of {kind.__name__}", valid=valid) from None


def _device_time(ticks: int) -> int:
    if ticks >= DEVICE_TIME_WRAP:
        raise LinkError(f"a device time of {ticks}", valid="40 bits")
    return ticks


def _truncate_utf8(text: str, size: int) -> bytes:
    """Return at most `size` bytes of UTF-8, without a partial character at the end."""
    return text.encode("utf-8", "replace")[:size].decode("utf-8", "ignore").encode()


def _text(payload: bytes, start: int) -> str:
    return payload[start:].decode("utf-8", "replace")


def _rows(row: struct.Struct, count: int, maximum: int, payload: bytes, kind: int) -> list[tuple[Any, ...]]:
    """Return the rows of a tail; raise LinkError if it does not contain them."""
    start = layout.STRUCTS[kind].size
    end = start + count * row.size
    if count > maximum or end > len(payload):
        raise LinkError(
            f"{count} rows of {row.size} bytes in a payload of {len(payload)} bytes",
            valid=f"at most {maximum}, from byte {start}",
        )
    return list(row.iter_unpack(payload[start:end]))


_RANGE_BYTES = layout.STRUCTS[MessageType.RANGE_CIR].size
_ANCHOR_ROW, _OFFSET_ROW = layout.RADIO_ANCHOR.as_struct(), layout.OFFSET.as_struct()
_ADDRESS = struct.Struct("<Q")

# Functions that return the values of the fields of a message and its tail, and messages from values and the payload.


def _hello(values: tuple[Any, ...], payload: bytes, stamp_ns: int) -> Hello:
    *numbers, mode, name = values
    fields: tuple[Any, ...] = (*numbers, _member(Mode, mode), _text(name.rstrip(b"\0"), 0))
    return Hello(*fields)


def _range_fields(m: RangeMeasurement) -> tuple[Any, ...]:
    cir, samples = m.cir, m.cir.samples
    if len(samples) > layout.MAX_SAMPLES:
        raise ParameterError(
            f"a CIR of {len(samples)} values", where="RANGE_CIR", valid=f"at most {layout.MAX_SAMPLES}"
        )
    exchange = m.tag_id, m.anchor_id, m.device_time, m.sequence, m.range_m
    shape = cir.sample_period_s, cir.first_path_index, cir.scale
    levels = cir.rx_power_dbm, cir.first_path_power_dbm, cir.start_index
    counts = cir.preamble_count, cir.noise_threshold, _RANGE_BYTES, len(samples)
    tail = np.asarray(samples, dtype="<i2").tobytes()
    return (*exchange, *shape, *levels, *counts, cir.encoding, cir.channel, cir.prf_mhz, tail)


def _range(values: tuple[Any, ...], payload: bytes, stamp_ns: int) -> RangeMeasurement:
    tag, anchor, ticks, sequence, range_m, period_s, first_path, scale, rx_dbm, first_path_dbm = values[:10]
    first_index, preambles, threshold, offset, count, encoding, channel, prf_mhz = values[10:]
    is_inside = _RANGE_BYTES <= offset <= len(payload) - 2 * count
    if count > layout.MAX_SAMPLES or offset % 2 or not is_inside:
        raise LinkError(
            f"{count} samples at byte {offset} of a payload of {len(payload)} bytes",
            valid=f"at most {layout.MAX_SAMPLES}, inside the payload, at an even byte from {_RANGE_BYTES}",
        )
    samples = np.frombuffer(payload, "<i2", count, offset)
    shape = _member(Encoding, encoding), first_index, first_path, period_s, scale
    levels, radio = (rx_dbm, first_path_dbm), (RadioType.DW1000, Segment.IPATOV)
    cir = Cir(samples, *shape, preambles, threshold, *levels, channel, prf_mhz, *radio)
    return RangeMeasurement(stamp_ns, tag, anchor, sequence, _device_time(ticks), range_m, cir)


def _corrected_fields(m: Correction) -> tuple[Any, ...]:
    c = m.corrected
    exchange = m.tag_id, m.anchor_id, m.device_time, m.sequence, c.model_id
    ranges = c.range_m, c.range_raw_m, c.correction_m, c.variance_m2
    return (*exchange, *ranges, m.compute_us, c.status, b"")


def _corrected(values: tuple[Any, ...], payload: bytes, stamp_ns: int) -> Correction:
    tag, anchor, ticks, sequence, model_id, range_m, raw_m, correction_m, variance_m2, us, status = values
    ranges = range_m, raw_m, correction_m, variance_m2
    corrected = CorrectedRange(*ranges, _member(Status, status), CorrectedBy.DEVICE, model_id)
    return Correction(stamp_ns, tag, anchor, sequence, _device_time(ticks), corrected, us)


def _settings_fields(s: RadioSettings) -> tuple[Any, ...]:
    """Return the common fields of RADIO and SET_RADIO, and their tail."""
    *fixed, anchors = astuple(s)
    return (*fixed, len(anchors), b"".join(map(_ADDRESS.pack, anchors)))


def _settings(values: tuple[Any, ...], payload: bytes, kind: int) -> RadioSettings:
    """Return the settings in the common fields and the tail."""
    *numbers, decawave_sfd, role, report, bias_correction, count = values
    anchors = tuple(anchor for (anchor,) in _rows(_ADDRESS, count, MAX_ANCHORS, payload, kind))
    flags = bool(decawave_sfd), _member(Role, role), bool(report), bool(bias_correction)
    fields: tuple[Any, ...] = (*numbers, *flags, anchors)
    return RadioSettings(*fields)


def _radio_fields(m: RadioConfigured) -> tuple[Any, ...]:
    *settings, anchors = _settings_fields(m.settings)
    return (m.request_sequence, m.accepted, *settings, anchors + m.text.encode("utf-8", "replace"))


def _radio(values: tuple[Any, ...], payload: bytes, stamp_ns: int) -> RadioConfigured:
    settings = _settings(values[2:], payload, MessageType.RADIO)
    start = layout.STRUCTS[MessageType.RADIO].size + _ADDRESS.size * len(settings.anchors)
    return RadioConfigured(settings, values[0], bool(values[1]), _text(payload, start))


def _radio_status_fields(m: RadioStatus) -> tuple[Any, ...]:
    *fixed, anchors = (getattr(m, name) for name in RadioStatus.__slots__)
    return (*fixed, len(anchors), b"".join(_ANCHOR_ROW.pack(*astuple(anchor)) for anchor in anchors))


def _radio_status(values: tuple[Any, ...], payload: bytes, stamp_ns: int) -> RadioStatus:
    rows = _rows(_ANCHOR_ROW, values[13], MAX_ANCHORS, payload, MessageType.RADIO_STATUS)
    anchors = tuple(AnchorStatus(*row) for row in rows)
    fields: tuple[Any, ...] = (*values[:12], _member(RadioState, values[12]), anchors)
    return RadioStatus(*fields)


def _offsets_fields(o: Offsets) -> tuple[Any, ...]:
    rows = [(tag, anchor, offset_m, OffsetScope.PAIR) for (tag, anchor), offset_m in o.pairs.items()]
    rows += [(0, anchor, offset_m, OffsetScope.ANCHOR) for anchor, offset_m in o.anchors.items()]
    rows += [(tag, 0, offset_m, OffsetScope.TAG) for tag, offset_m in o.tags.items()]
    return o.default, len(rows), b"".join(_OFFSET_ROW.pack(*row) for row in rows)


def _offsets(values: tuple[Any, ...], payload: bytes, stamp_ns: int) -> Offsets:
    by_scope: dict[OffsetScope, dict[Any, float]] = {scope: {} for scope in OffsetScope}
    for tag, anchor, offset_m, number in _rows(
        _OFFSET_ROW, values[1], 0xFFFF, payload, MessageType.SET_OFFSETS
    ):
        scope = _member(OffsetScope, number)
        key = {OffsetScope.ANCHOR: anchor, OffsetScope.TAG: tag, OffsetScope.PAIR: (tag, anchor)}[scope]
        by_scope[scope].setdefault(key, offset_m)
    anchors, tags, pairs = by_scope.values()
    return Offsets(values[0], anchors, tags, pairs)


_ENCODERS: dict[type, tuple[MessageType, Callable[[Any], tuple[Any, ...]]]] = {
    Hello: (MessageType.HELLO, lambda m: (*astuple(m)[:-1], _truncate_utf8(m.firmware_name, 16), b"")),
    RangeMeasurement: (MessageType.RANGE_CIR, _range_fields),
    Correction: (MessageType.RANGE_CORRECTED, _corrected_fields),
    Log: (MessageType.LOG, lambda m: (m.level, m.text.encode("utf-8", "replace"))),
    BoardStatus: (MessageType.STATUS, lambda m: (*astuple(m)[:4], m.temperature_c, m.mode, b"")),
    TimeSyncReply: (MessageType.TIME_SYNC_REPLY, lambda m: (m.request_sequence, m.received_us, b"")),
    RadioConfigured: (MessageType.RADIO, _radio_fields),
    RadioStatus: (MessageType.RADIO_STATUS, _radio_status_fields),
    OffsetsAnswer: (MessageType.OFFSETS, lambda m: (*astuple(m), b"")),
    Mode: (MessageType.SET_MODE, lambda mode: (mode, b"")),
    RadioSettings: (MessageType.SET_RADIO, _settings_fields),
    Offsets: (MessageType.SET_OFFSETS, _offsets_fields),
}
_DECODERS: dict[int, Callable[[tuple[Any, ...], bytes, int], Message]] = {
    MessageType.HELLO: _hello,
    MessageType.RANGE_CIR: _range,
    MessageType.RANGE_CORRECTED: _corrected,
    MessageType.LOG: lambda v, payload, _: Log(
        _member(LogLevel, v[0]), _text(payload, layout.STRUCTS[MessageType.LOG].size)
    ),
    MessageType.STATUS: lambda v, *_: BoardStatus(v[0], v[1], v[2], v[3], _member(Mode, v[5]), v[4]),
    MessageType.TIME_SYNC_REPLY: lambda v, *_: TimeSyncReply(*v),
    MessageType.RADIO: _radio,
    MessageType.RADIO_STATUS: _radio_status,
    MessageType.OFFSETS: lambda v, *_: OffsetsAnswer(v[0], v[1], bool(v[2])),
    MessageType.SET_MODE: lambda v, *_: _member(Mode, v[0]),
    MessageType.SET_RADIO: lambda v, payload, _: _settings(v, payload, MessageType.SET_RADIO),
    MessageType.SET_OFFSETS: _offsets,
}
