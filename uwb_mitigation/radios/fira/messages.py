"""Contents of UCI packets: commands, range notifications and range diagnostics. No I/O.

The layouts are public facts about Qorvo's firmware. No real diagnostics notification was available: its parser
skips unknown fields by their size, and takes the sizes of taps and windows from the notification.
"""

from __future__ import annotations

import math
import struct
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios.fira.codes import STATUS_OK, PacketType


@dataclass(frozen=True, slots=True)
class RangeRecord:
    """One range of a notification.

    Attributes:
        peer: address of the other board.
        status: 0, or the status that `codes.exchange_cause` explains.
        range_m: NaN = invalid.
        rssi_dbm: receive level; NaN = unknown.
    """

    peer: int
    status: int
    range_m: float
    rssi_dbm: float


@dataclass(frozen=True, slots=True)
class RangeNotification:
    """The ranges of one round of a session."""

    handle: int
    sequence: int
    records: tuple[RangeRecord, ...]


@dataclass(frozen=True, slots=True)
class SegmentMetrics:
    """Levels and positions of one segment of a received frame.

    Attributes:
        receiver: antenna port.
        segment: 0 = Ipatov, 1 to 4 = STS0 to STS3.
        primary: the segment that the range is based on.
        rx_dbm, first_path_dbm: levels.
        first_path_index, peak_index: whole taps of the segment's accumulator.
        first_path: fractional tap index.
    """

    receiver: int
    segment: int
    primary: bool
    rx_dbm: float
    first_path_dbm: float
    first_path_index: int
    first_path: float
    peak_index: int


@dataclass(frozen=True, slots=True, eq=False)
class CirBlock:
    """A window of the accumulator.

    Attributes:
        receiver, segment, primary: see `SegmentMetrics`.
        offset: as received: start of the window relative to the first path, or index of the first path in the window.
        taps: int32 (n, 2), real and imaginary parts.
    """

    receiver: int
    segment: int
    primary: bool
    offset: int
    taps: NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class FrameReport:
    """Diagnostics of one frame of an exchange.

    Attributes:
        frame: `msg_id`; 0 to 2: initiation, response and final frame.
        received: the board received the frame; otherwise it transmitted it.
        emitter: address of the transmitter; None = unknown.
        clock_offset_ppm: carrier frequency offset; NaN = unknown.
        confidence: the report has confidence values, which only a QM35 sends.
    """

    frame: int
    received: bool
    emitter: int | None
    clock_offset_ppm: float
    metrics: tuple[SegmentMetrics, ...]
    cirs: tuple[CirBlock, ...]
    confidence: bool


@dataclass(frozen=True, slots=True, eq=False)
class Diagnostics:
    """Diagnostics of the frames of one round of a session."""

    handle: int
    sequence: int
    frames: tuple[FrameReport, ...]


_RANGE_HEADER = struct.Struct("<IIxIBxBI4xB")
_RANGE_RECORD_BYTES = 31
_DIAGNOSTICS_HEADER = struct.Struct("<IIB")
_REPORT = struct.Struct("<4B")
_FIELD = struct.Struct("<BH")
_METRICS = struct.Struct("<BhHHHHHHH")
_CIR = struct.Struct("<BbBB")
_TAP_BYTES = (4, 6, 8)
_INVALID_CM = 0xFFFF


def parse_ranges(payload: bytes) -> RangeNotification:
    """Parse a range notification.

    Bytes after the last range are ignored, unless they look like the next packet: then the length is damaged.

    Raises:
        LinkError: its length does not fit its number of ranges.
    """
    if len(payload) < _RANGE_HEADER.size:
        raise LinkError(f"range notification of {len(payload)} bytes", valid=f"{_RANGE_HEADER.size} or more")
    sequence, handle, _, _, extended, _, count = _RANGE_HEADER.unpack_from(payload)
    expected = _RANGE_HEADER.size + count * _RANGE_RECORD_BYTES
    surplus = payload[expected : expected + 1]
    if len(payload) < expected or (
        surplus and surplus[0] >> 5 in (PacketType.RESPONSE, PacketType.NOTIFICATION)
    ):
        raise LinkError(f"range notification of {len(payload)} bytes", valid=f"{expected}")
    width = 8 if extended else 2
    records = []
    for start in range(_RANGE_HEADER.size, expected, _RANGE_RECORD_BYTES):
        status, _, distance_cm = struct.unpack_from("<BBH", payload, start + width)
        rssi = payload[start + width + 17]
        peer = int.from_bytes(payload[start : start + width], "little")
        range_m = distance_cm / 100 if status == STATUS_OK and distance_cm != _INVALID_CM else math.nan
        records.append(RangeRecord(peer, status, range_m, -rssi / 2 if rssi else math.nan))
    return RangeNotification(handle, sequence, tuple(records))


def parse_diagnostics(payload: bytes) -> Diagnostics:
    """Parse a diagnostics notification, assembled from its fragments.

    Raises:
        LinkError: it ends early, or has bytes after its last report.
    """
    try:
        handle, sequence, count = _DIAGNOSTICS_HEADER.unpack_from(payload)
        start, frames = _DIAGNOSTICS_HEADER.size, []
        for _ in range(count):
            frame, action, _, fields = _REPORT.unpack_from(payload, start)
            start += _REPORT.size
            contents: defaultdict[int, bytes] = defaultdict(bytes)
            for _ in range(fields):
                kind, size = _FIELD.unpack_from(payload, start)
                start += _FIELD.size
                if start + size > len(payload):
                    raise LinkError(f"diagnostics field {kind} of {size} bytes ends after the notification")
                contents[kind] += payload[start : start + size]
                start += size
            frames.append(_frame(frame, action, contents))
    except struct.error as error:
        raise LinkError(f"diagnostics notification of {len(payload)} bytes ends early") from error
    if any(payload[start:]):
        raise LinkError(f"diagnostics notification with {len(payload) - start} further bytes")
    return Diagnostics(handle, sequence, tuple(frames))


def merge(first: Diagnostics, second: Diagnostics) -> Diagnostics:
    """Return the diagnostics of an exchange that a board reports in two notifications."""
    frames = {(frame.frame, frame.received): frame for frame in first.frames}
    for frame in second.frames:
        old = frames.get((frame.frame, frame.received), frame)
        if old is not frame:
            frame = replace(
                old,
                emitter=old.emitter if frame.emitter is None else frame.emitter,
                clock_offset_ppm=min(old.clock_offset_ppm, frame.clock_offset_ppm, key=math.isnan),
                metrics=old.metrics + frame.metrics,
                cirs=old.cirs + frame.cirs,
                confidence=old.confidence or frame.confidence,
            )
        frames[frame.frame, frame.received] = frame
    return replace(first, frames=tuple(frames.values()))


def _frame(frame: int, action: int, fields: Mapping[int, bytes]) -> FrameReport:
    # A field of a size that its type does not have is skipped, like a field of an unknown type.
    address, offset, segments = fields.get(5, b""), fields.get(4, b""), fields.get(6, b"")
    emitter = int.from_bytes(address, "little") if len(address) in (2, 8) else None
    offset_ppm = math.nan
    if len(offset) == 4:
        offset_ppm = int.from_bytes(offset, "little", signed=True) / (1 << 26) * 1e6
    starts = range(0, len(segments), _METRICS.size) if len(segments) % _METRICS.size == 0 else ()
    metrics = tuple(_metrics(segments, start) for start in starts)
    cirs = _cir_blocks(fields.get(7, b""))
    return FrameReport(frame, action == 0, emitter, offset_ppm, metrics, cirs, 8 in fields or 9 in fields)


def _metrics(data: bytes, start: int) -> SegmentMetrics:
    receiver, _, rx, index, level, position, peak, _, _ = _METRICS.unpack_from(data, start)
    rx_dbm, first_path_dbm = (-value / 256 if value else math.nan for value in (rx, level))
    return SegmentMetrics(*_source(receiver), rx_dbm, first_path_dbm, index, position / 64, peak)


def _source(receiver: int) -> tuple[int, int, bool]:
    """Return the antenna port, the segment, and whether it is the primary one."""
    return receiver >> 4, receiver & 7, bool(receiver & 8)


def _cir_blocks(data: bytes) -> tuple[CirBlock, ...]:
    blocks, start = [], 0
    # A field of another layout is skipped: the frame keeps its metrics.
    while start + _CIR.size <= len(data):
        receiver, offset, count, tap_bytes = _CIR.unpack_from(data, start)
        start += _CIR.size
        if tap_bytes not in _TAP_BYTES or start + count * tap_bytes > len(data):
            return ()
        taps = _taps(data[start : start + count * tap_bytes], tap_bytes // 2)
        start += count * tap_bytes
        blocks.append(CirBlock(*_source(receiver), offset, taps))
    return tuple(blocks)


def _taps(data: bytes, width: int) -> NDArray[np.int32]:
    """Return signed little-endian numbers of `width` bytes, int32 (n, 2)."""
    octets = np.frombuffer(data, np.uint8).reshape(-1, width)
    filled = np.zeros((len(octets), 4), np.uint8)
    filled[:, 4 - width :] = octets
    numbers: NDArray[np.int32] = filled.view("<i4")[:, 0] >> (8 * (4 - width))
    return numbers.reshape(-1, 2)


def app_config(handle: int, entries: Sequence[tuple[int, bytes]]) -> bytes:
    """Return the payload of SET_APP_CONFIG."""
    packed = b"".join(bytes([tag, len(value)]) + value for tag, value in entries)
    return struct.pack("<IB", handle, len(entries)) + packed


def rejected_tags(payload: bytes) -> dict[int, int]:
    """Return the parameters that a response to SET_APP_CONFIG rejects, {tag: status}."""
    count = payload[1] if len(payload) > 1 else 0
    pairs = payload[2 : 2 + 2 * count]
    return dict(zip(pairs[::2], pairs[1::2], strict=False))


def set_calibration(key: str, value: int, count_bytes: int) -> bytes:
    """Return the payload of SET_CALIBRATION for a 16-bit value; firmware versions differ in the size of the count."""
    count = (1).to_bytes(count_bytes, "little")
    return count + bytes([len(key)]) + key.encode() + b"\2" + value.to_bytes(2, "little")


def get_calibration(keys: Sequence[str]) -> bytes:
    """Return the payload of GET_CALIBRATION."""
    packed = b"".join(bytes([len(key)]) + key.encode() for key in keys)
    return len(keys).to_bytes(2, "little") + packed


def calibration_values(payload: bytes) -> dict[str, int]:
    """Return the values in a response to GET_CALIBRATION that the board knows, {key: value}."""
    values: dict[str, int] = {}
    start = 3
    while start < len(payload):
        key = payload[start + 1 : start + 1 + payload[start]]
        start += 1 + len(key)
        status, length = (*payload[start : start + 2], 0, 0)[:2]
        value = payload[start + 2 : start + 2 + length]
        start += 2 + length
        if status == STATUS_OK and len(value) == length > 0:
            values[key.decode("ascii", "replace")] = int.from_bytes(value, "little")
    return values
