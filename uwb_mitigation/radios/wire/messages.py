"""Messages, and the encoding and decoding of their payloads with the tables of `layout`. No I/O.

A measurement is sent as `RangeMeasurement` itself. Floats are IEEE-754 binary32 on the wire, as in the ROS messages:
a correction computed on either side of the link starts from the same bits.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.radios.settings import MAX_ANCHORS, AnchorStatus, RadioSettings, RadioStatus
from uwb_mitigation.radios.wire import layout
from uwb_mitigation.radios.wire.layout import Field, LogLevel, MessageType, Mode, OffsetScope
from uwb_mitigation.types.measurement import Cir, CorrectedBy, CorrectedRange, RangeMeasurement
from uwb_mitigation.types.offsets import Offsets


@dataclass(frozen=True, slots=True)
class Hello:
    """Identity and state of a board; the fields of `layout.PAYLOADS[HELLO]`.

    `firmware_name` has at most 16 bytes of UTF-8; longer names are truncated.
    """

    board_id: int = 0
    model_id: int = 0
    window: int = 0
    mode: Mode = Mode.HOST
    boot_id: int = 0
    request_sequence: int = 0
    max_payload: int = 0
    firmware_major: int = 0
    firmware_minor: int = 0
    firmware_patch: int = 0
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
    """The answer to a `SetOffsets`; the fields of `layout.PAYLOADS[OFFSETS]`."""

    request_sequence: int
    slots: int
    accepted: bool


@dataclass(frozen=True, slots=True)
class GetInfo:
    """Requests a HELLO."""


@dataclass(frozen=True, slots=True)
class SetMode:
    """Requests a mode; the board answers with a HELLO that contains the active mode."""

    mode: Mode


@dataclass(frozen=True, slots=True)
class TimeSync:
    """Requests a TIME_SYNC_REPLY."""


@dataclass(frozen=True, slots=True)
class GetRadio:
    """Requests a RADIO."""


@dataclass(frozen=True, slots=True)
class SetRadio:
    """Requests settings; the board answers with a RADIO that accepts or refuses them."""

    settings: RadioSettings


@dataclass(frozen=True, slots=True)
class SetOffsets:
    """Requests that the board subtracts these offsets from its ranges; it answers with an `OffsetsAnswer`."""

    offsets: Offsets


Message = (
    Hello
    | RangeMeasurement
    | Correction
    | Log
    | BoardStatus
    | TimeSyncReply
    | RadioConfigured
    | RadioStatus
    | OffsetsAnswer
    | GetInfo
    | SetMode
    | TimeSync
    | GetRadio
    | SetRadio
    | SetOffsets
)

Values = dict[str, Any]


def encode(message: Message) -> tuple[MessageType, bytes]:
    """Return the message's type and payload.

    The stamp and the frame id of a measurement are left out: the frame's header contains the time.

    Raises:
        ParameterError: a value does not fit its field.
    """
    codec = _by_class[type(message)]
    try:
        return codec.kind, codec.encode(message)
    except (struct.error, OverflowError) as error:
        kind = type(message).__name__
        raise ParameterError(f"a value of {kind} does not fit its field: {error}") from error


def decode(kind: int, payload: bytes, *, stamp_ns: int = 0) -> Message | None:
    """Return the message of type `kind` in `payload`; None if this version of the protocol has no such type.

    `stamp_ns` becomes the stamp of a measurement or correction. The samples of a measurement are a read-only view of
    `payload`.

    Raises:
        LinkError: the payload is too short for its type, or a field has a value outside its range.
    """
    codec = _by_type.get(kind)
    return None if codec is None else codec.decode(payload, stamp_ns)


class _Tail:
    """Tail after the fixed part: rows of equal size, then text; empty by default.

    Args:
        row: format of a row for `struct`; empty = no rows.
        count: name of the field with the number of rows.
        max_rows: a larger number is invalid.
        rows: returns the rows of a message.
        attributes: returns the attributes in decoded rows.
        has_text: the rest of the payload is the attribute `text`.
    """

    def __init__(
        self,
        row: struct.Struct | None = None,
        count: str = "anchor_count",
        max_rows: int = MAX_ANCHORS,
        rows: Callable[[Any], Iterable[tuple[Any, ...]]] = lambda _: (),
        attributes: Callable[[Iterable[tuple[Any, ...]]], Values] = lambda _: {},
        has_text: bool = False,
    ) -> None:
        self._row, self._count, self._max_rows = row, count, max_rows
        self._rows, self._attributes, self._has_text = rows, attributes, has_text

    def encode(self, message: Any) -> tuple[Values, bytes]:
        """Return the computed fields of the fixed part, and the bytes of the tail."""
        rows = [self._row.pack(*row) for row in self._rows(message)] if self._row else []
        text = message.text.encode("utf-8", "replace") if self._has_text else b""
        return {self._count: len(rows)}, b"".join(rows) + text

    def decode(self, payload: bytes, start: int, computed: Values) -> Values:
        """Return the attributes in the tail, which begins at byte `start`; raise LinkError if it is invalid."""
        values: Values = {}
        if self._row is not None:
            count = computed[self._count]
            end = start + count * self._row.size
            if count > self._max_rows or end > len(payload):
                raise LinkError(
                    f"{count} rows of {self._row.size} bytes in a payload of {len(payload)} bytes",
                    valid=f"at most {self._max_rows}, from byte {start}",
                )
            values = self._attributes(self._row.iter_unpack(payload[start:end]))
            start = end
        if self._has_text:
            values["text"] = payload[start:].decode("utf-8", "replace")
        return values


class _Samples(_Tail):
    def encode(self, message: RangeMeasurement) -> tuple[Values, bytes]:
        samples = message.cir.samples
        if len(samples) > layout.MAX_SAMPLES:
            raise ParameterError(
                f"a CIR of {len(samples)} values", where="RANGE_CIR", valid=f"at most {layout.MAX_SAMPLES}"
            )
        computed = {"samples_offset": _by_type[MessageType.RANGE_CIR].size, "sample_count": len(samples)}
        return computed, np.asarray(samples, dtype="<i2").tobytes()

    def decode(self, payload: bytes, start: int, computed: Values) -> Values:
        at, count = computed["samples_offset"], computed["sample_count"]
        if count > layout.MAX_SAMPLES or at < start or at % 2 or at + 2 * count > len(payload):
            raise LinkError(
                f"{count} samples at byte {at} of a payload of {len(payload)} bytes",
                where="RANGE_CIR",
                valid=f"at most {layout.MAX_SAMPLES}, inside the payload, at an even byte from {start}",
            )
        return {"samples": np.frombuffer(payload, "<i2", count, at)}


def _anchors_tail(has_text: bool) -> _Tail:
    return _Tail(
        struct.Struct("<Q"),
        rows=lambda message: ((address,) for address in message.settings.anchors),
        attributes=lambda rows: {"anchors": tuple(address for (address,) in rows)},
        has_text=has_text,
    )


def _offsets_to_rows(message: SetOffsets) -> Iterator[tuple[int, int, float, OffsetScope]]:
    offsets = message.offsets
    yield from ((tag, anchor, m, OffsetScope.PAIR) for (tag, anchor), m in offsets.pairs.items())
    yield from ((0, anchor, m, OffsetScope.ANCHOR) for anchor, m in offsets.anchors.items())
    yield from ((tag, 0, m, OffsetScope.TAG) for tag, m in offsets.tags.items())


def _decode_offsets(rows: Iterable[tuple[Any, ...]]) -> Values:
    found: dict[str, dict[Any, float]] = {"anchors": {}, "tags": {}, "pairs": {}}
    for tag, anchor, offset_m, kind in rows:
        if kind not in set(OffsetScope):
            raise LinkError(f"an offset of {kind}", where="SET_OFFSETS", valid="0 to 2")
        name = f"{OffsetScope(kind).name.lower()}s"
        found[name].setdefault({"anchors": anchor, "tags": tag}.get(name, (tag, anchor)), offset_m)
    return found


class _Codec:
    """Encodes and decodes the payloads of one type of message.

    Args:
        kind: type of the message.
        message_class: class of the message.
        inner: name and class of an attribute whose own attributes are fields of the payload.
        tail: tail after the fixed part.

    Attributes:
        size: bytes of the fixed part.
    """

    def __init__(
        self,
        kind: MessageType,
        message_class: type,
        inner: tuple[str, Callable[..., Any]] = ("", dict),
        tail: _Tail | None = None,
    ) -> None:
        table = layout.PAYLOADS[kind]
        self.kind = kind
        self.message_class, self._inner, self._tail = message_class, inner, tail or _Tail()
        self._class_attributes = {attribute.name for attribute in dataclasses.fields(message_class)}
        self._struct = table.as_struct()
        self.size = self._struct.size
        self._names = [field.attribute or field.name for field in table.value_fields]
        self._getters = [(field.name, self._getter(field)) for field in table.value_fields]
        self._converted = [
            (field.attribute or field.name, field)
            for field in table.value_fields
            if field.convert is not None or field.is_text
        ]
        self._computed = [field.name for field in table.value_fields if field.computed]
        self._inner_names = [
            name for name in self._names if name not in (*self._class_attributes, *self._computed)
        ]

    def _getter(self, field: Field) -> Callable[[Any], Any] | None:
        if field.computed:
            return None
        name = field.attribute or field.name
        get = attrgetter(name if name in self._class_attributes else f"{self._inner[0]}.{name}")
        return (lambda message: _truncate_utf8(get(message), int(field.code[:-1]))) if field.is_text else get

    def encode(self, message: Any) -> bytes:
        """Return the payload; raise struct.error or OverflowError if a value does not fit its field."""
        computed, tail = self._tail.encode(message)
        values = [computed[name] if get is None else get(message) for name, get in self._getters]
        return self._struct.pack(*values) + tail

    def decode(self, payload: bytes, stamp_ns: int) -> Message:
        """Return the message in `payload`; raise LinkError if it contains none."""
        if len(payload) < self.size:
            raise LinkError(
                f"a payload of {len(payload)} bytes", where=self.kind.name, valid=f"at least {self.size}"
            )
        values: Values = dict(zip(self._names, self._struct.unpack_from(payload), strict=True))
        for name, field in self._converted:
            values[name] = self._convert(field, values[name])
        computed = {name: values.pop(name) for name in self._computed}
        if "stamp_ns" in self._class_attributes:
            values["stamp_ns"] = stamp_ns
        try:
            tail = self._tail.decode(payload, self.size, computed)
            attribute, inner_class = self._inner
            if attribute:
                inner = {name: values.pop(name) for name in self._inner_names}
                inner |= {name: tail.pop(name) for name in [*tail] if name not in self._class_attributes}
                values[attribute] = inner_class(**inner)
            message: Message = self.message_class(**values, **tail)
        except (LinkError, ParameterError) as error:
            raise LinkError(error.what, where=self.kind.name, valid=error.valid) from error
        return message

    def _convert(self, field: Field, value: Any) -> Any:
        if field.convert is None:
            return value.rstrip(b"\0").decode("utf-8", "replace")
        try:
            return field.convert(value)
        except ValueError as error:
            valid = str(error)
            if isinstance(field.convert, type(enum.IntEnum)):
                valid = ", ".join(f"{number} {name}" for name, number in field.convert.__members__.items())
            where = f"{self.kind.name} {field.name}"
            raise LinkError(f"the value {value}", where=where, valid=valid) from None


_CODECS = (
    _Codec(MessageType.HELLO, Hello),
    _Codec(MessageType.RANGE_CIR, RangeMeasurement, ("cir", Cir), _Samples()),
    _Codec(
        MessageType.RANGE_CORRECTED,
        Correction,
        ("corrected", partial(CorrectedRange, origin=CorrectedBy.DEVICE)),
    ),
    _Codec(MessageType.LOG, Log, tail=_Tail(has_text=True)),
    _Codec(MessageType.STATUS, BoardStatus),
    _Codec(MessageType.TIME_SYNC_REPLY, TimeSyncReply),
    _Codec(MessageType.RADIO, RadioConfigured, ("settings", RadioSettings), _anchors_tail(has_text=True)),
    _Codec(
        MessageType.RADIO_STATUS,
        RadioStatus,
        tail=_Tail(
            layout.RADIO_ANCHOR.as_struct(),
            rows=lambda status: map(dataclasses.astuple, status.anchors),
            attributes=lambda rows: {"anchors": tuple(AnchorStatus(*row) for row in rows)},
        ),
    ),
    _Codec(MessageType.OFFSETS, OffsetsAnswer),
    _Codec(MessageType.GET_INFO, GetInfo),
    _Codec(MessageType.SET_MODE, SetMode),
    _Codec(MessageType.TIME_SYNC, TimeSync),
    _Codec(MessageType.GET_RADIO, GetRadio),
    _Codec(MessageType.SET_RADIO, SetRadio, ("settings", RadioSettings), _anchors_tail(has_text=False)),
    _Codec(
        MessageType.SET_OFFSETS,
        SetOffsets,
        ("offsets", Offsets),
        _Tail(layout.OFFSET.as_struct(), "count", 0xFFFF, _offsets_to_rows, _decode_offsets),
    ),
)
_by_type: dict[int, _Codec] = {codec.kind: codec for codec in _CODECS}
_by_class = {codec.message_class: codec for codec in _CODECS}


def _truncate_utf8(text: str, size: int) -> bytes:
    """Return at most `size` bytes of UTF-8, without a partial character at the end."""
    return text.encode("utf-8", "replace")[:size].decode("utf-8", "ignore").encode()
