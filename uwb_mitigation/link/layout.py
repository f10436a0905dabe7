"""The wire protocol as one table: frame header, message types, fields, limits.

Python packs and parses from this table, and `c_header` renders it as the C header that firmware
includes, so the two sides cannot differ. All integers and floats are little-endian; every field lies at
a multiple of its own size and every fixed part is a multiple of 8 bytes long, so that a microcontroller
can read a decoded frame in place.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass

PROTOCOL_VERSION = 1
"""First byte of every frame. Its place, and that of the CRC, are the same in all versions."""

CRC_BYTES = 4
"""The CRC-32 of IEEE 802.3 (as zlib computes it) over header and payload, last in the frame."""

MAX_SAMPLES = 2032
"""int16 values of a RANGE_CIR: 1016 complex samples, the accumulator's length at 64 MHz PRF."""

MAX_PAYLOAD_BYTES = 4224
"""Ceiling of a payload: the largest RANGE_CIR, and 88 bytes for the fields of later revisions."""


class MessageType(enum.IntEnum):
    """The second byte of a frame. A type means one layout, whichever side sends it."""

    HELLO = 1
    RANGE_CIR = 2
    RANGE_CORRECTED = 3
    LOG = 4
    STATUS = 5
    TIME_SYNC_REPLY = 6
    GET_INFO = 64
    SET_MODE = 65
    TIME_SYNC = 66


class Flag(enum.IntFlag):
    """Bits of the header's flags; a receiver ignores those it does not know."""

    ANSWER = 1
    """The frame answers one from the host; without it the board spoke of its own accord."""


class Mode(enum.IntEnum):
    """What a board sends of its own measurements."""

    HOST = 0
    """RANGE_CIR only: the host corrects."""
    DEVICE = 1
    """RANGE_CORRECTED only: the board corrects."""
    BOTH = 2
    """RANGE_CIR, then the RANGE_CORRECTED that belongs to it."""


class LogLevel(enum.IntEnum):
    """Severity of a LOG; the values of Python's `logging`."""

    DEBUG = 10
    INFO = 20
    WARNING = 30
    ERROR = 40


@dataclass(frozen=True, slots=True)
class Field:
    """One field: its name, its `struct` code (a reserved run of `n` bytes is `nx`), its meaning."""

    name: str
    code: str
    meaning: str


@dataclass(frozen=True, slots=True)
class Layout:
    """The fixed part of a header or payload, and what may follow it.

    Attributes:
        name: as in `MessageType`, or HEADER.
        fields: in the order of their bytes.
        tail: what the bytes after the fixed part are; empty = nothing.
    """

    name: str
    fields: tuple[Field, ...]
    tail: str = ""

    def packing(self) -> struct.Struct:
        """The fixed part as a `struct.Struct`; reserved bytes take no value."""
        return struct.Struct("<" + "".join(field.code for field in self.fields))

    def offsets(self) -> dict[str, int]:
        """{field name: byte offset}, reserved bytes left out."""
        offsets = {}
        at = 0
        for field in self.fields:
            if not field.code.endswith("x"):
                offsets[field.name] = at
            at += struct.calcsize("<" + field.code)
        return offsets


HEADER = Layout(
    "HEADER",
    (
        Field("version", "B", "PROTOCOL_VERSION"),
        Field("type", "B", "MessageType"),
        Field("flags", "H", "Flag"),
        Field("sequence", "I", "counts the sender's frames from 0 at its start; wraps"),
        Field("time_us", "Q", "board's uptime at the event that the frame tells of; 0 from the host"),
    ),
)

PAYLOADS = {
    MessageType.HELLO: Layout(
        "HELLO",
        (
            Field("board_id", "Q", "identity of the board"),
            Field("model_id", "I", "identity of the board's model; 0 = it has none"),
            Field("boot_id", "I", "differs from one start of the firmware to the next"),
            Field("request_sequence", "I", "with ANSWER: sequence of the host's frame answered"),
            Field("window", "H", "window length K of the board's model; 0 = it has none"),
            Field("max_payload", "H", "longest payload that the board accepts, bytes"),
            Field("firmware_major", "B", "firmware version"),
            Field("firmware_minor", "B", ""),
            Field("firmware_patch", "B", ""),
            Field("mode", "B", "Mode in force"),
            Field("reserved", "4x", ""),
            Field("firmware_name", "16s", "UTF-8, filled up with zeros"),
        ),
    ),
    MessageType.RANGE_CIR: Layout(
        "RANGE_CIR",
        (
            Field("tag_id", "Q", "identity of the tag"),
            Field("anchor_id", "Q", "identity of the anchor"),
            Field("device_time", "Q", "DW1000 ticks of 1 / (128 x 499.2 MHz) at the reception, 40 bits"),
            Field("sequence", "I", "counts the exchanges; wraps"),
            Field("range", "f", "m, measured; NaN = the exchange gave none"),
            Field("sample_period", "f", "s"),
            Field("first_path_index", "f", "accumulator index; NaN = unknown"),
            Field("scale", "f", "accumulator units per count of samples"),
            Field("rx_power", "f", "dBm; NaN = unknown"),
            Field("first_path_power", "f", "dBm; NaN = unknown"),
            Field("start_index", "i", "accumulator index of the first sample"),
            Field("preamble_count", "H", "RXPACC; 0 = unknown"),
            Field("noise_threshold", "H", "LDE_THRESH, accumulator units; 0 = unknown"),
            Field("samples_offset", "H", "bytes from the payload's start to the samples; even"),
            Field("sample_count", "H", "int16 values: two for a complex sample"),
            Field("encoding", "B", "0 = complex, interleaved re, im; 1 = magnitude"),
            Field("channel", "B", "UWB channel; 0 = unknown"),
            Field("prf", "B", "MHz: 16 or 64; 0 = unknown"),
            Field("reserved", "5x", ""),
        ),
        tail="samples, int16, from samples_offset",
    ),
    MessageType.RANGE_CORRECTED: Layout(
        "RANGE_CORRECTED",
        (
            Field("tag_id", "Q", "of the measurement"),
            Field("anchor_id", "Q", "of the measurement"),
            Field("device_time", "Q", "of the measurement, 40 bits"),
            Field("sequence", "I", "of the measurement"),
            Field("model_id", "I", "identity of the model that corrected; 0 = none"),
            Field("range", "f", "m, corrected; NaN = no valid range"),
            Field("range_raw", "f", "m, as measured"),
            Field("correction", "f", "m, predicted error; 0 when passed through"),
            Field("variance", "f", "m^2; infinite where the range is not valid"),
            Field("compute_us", "I", "time that the correction took on the board"),
            Field("status", "B", "0 OK, 1 NO_CIR, 2 BAD_CIR, 3 OUT_OF_DISTRIBUTION, 4 MODEL_ERROR"),
            Field("reserved", "3x", ""),
        ),
    ),
    MessageType.LOG: Layout(
        "LOG",
        (Field("level", "B", "LogLevel"), Field("reserved", "7x", "")),
        tail="text, UTF-8, to the payload's end",
    ),
    MessageType.STATUS: Layout(
        "STATUS",
        (
            Field("frames_received", "I", "intact frames from the host since the start"),
            Field("frames_dropped", "I", "damaged or unknown frames from the host since the start"),
            Field("measurements", "I", "exchanges since the start"),
            Field("measurements_lost", "I", "exchanges not sent because the link was full"),
            Field("temperature", "f", "degrees Celsius; NaN = not measured"),
            Field("mode", "B", "Mode in force"),
            Field("reserved", "3x", ""),
        ),
    ),
    MessageType.TIME_SYNC_REPLY: Layout(
        "TIME_SYNC_REPLY",
        (
            Field("request_sequence", "I", "sequence of the TIME_SYNC answered"),
            Field("reserved", "4x", ""),
            Field("received_us", "Q", "board's uptime when the TIME_SYNC's last byte was received"),
        ),
    ),
    MessageType.GET_INFO: Layout("GET_INFO", ()),
    MessageType.SET_MODE: Layout(
        "SET_MODE", (Field("mode", "B", "Mode wanted"), Field("reserved", "7x", ""))
    ),
    MessageType.TIME_SYNC: Layout("TIME_SYNC", ()),
}
"""Every message type and its payload. A payload may be longer than its layout, never shorter."""

HEADER_BYTES = HEADER.packing().size
MAX_FRAME_BYTES = HEADER_BYTES + MAX_PAYLOAD_BYTES + CRC_BYTES
MAX_ENCODED_BYTES = MAX_FRAME_BYTES + -(-MAX_FRAME_BYTES // 254)
"""COBS adds one byte for each 254 begun; the delimiters are not counted."""

_C_TYPES = {"B": "uint8_t", "H": "uint16_t", "I": "uint32_t", "Q": "uint64_t", "i": "int32_t", "f": "float"}


def c_header() -> str:
    """The table as the C header `uwb_protocol.h`: constants, structs, and assertions on their layout."""
    lines = [
        "/* Wire protocol between board and host: docs/protocol.md.",
        "   Generated by uwb_mitigation.link.layout.c_header; do not edit. */",
        "#ifndef UWB_PROTOCOL_H",
        "#define UWB_PROTOCOL_H",
        "",
        "#include <stddef.h>",
        "#include <stdint.h>",
        "",
        "#ifdef __cplusplus",
        "#define UWB_STATIC_ASSERT(condition) static_assert(condition, #condition)",
        "#elif __STDC_VERSION__ >= 201112L",
        "#define UWB_STATIC_ASSERT(condition) _Static_assert(condition, #condition)",
        "#else",
        "#define UWB_STATIC_ASSERT(condition) extern char uwb_static_assertion[(condition) ? 1 : -1]",
        "#endif",
        "",
        f"#define UWB_PROTOCOL_VERSION {PROTOCOL_VERSION}",
        f"#define UWB_HEADER_BYTES {HEADER_BYTES}",
        f"#define UWB_CRC_BYTES {CRC_BYTES}",
        f"#define UWB_MAX_SAMPLES {MAX_SAMPLES}",
        f"#define UWB_MAX_PAYLOAD_BYTES {MAX_PAYLOAD_BYTES}",
        f"#define UWB_MAX_FRAME_BYTES {MAX_FRAME_BYTES}",
        f"#define UWB_MAX_ENCODED_BYTES {MAX_ENCODED_BYTES}",
        "",
    ]
    for prefix, members in (
        ("TYPE", MessageType),
        ("FLAG", Flag),
        ("MODE", Mode),
        ("LOG_LEVEL", LogLevel),
    ):
        lines += [f"#define UWB_{prefix}_{member.name} {member.value}" for member in members]
        lines.append("")
    for layout in (HEADER, *PAYLOADS.values()):
        if layout.fields:
            lines += _c_struct(layout)
    lines += ["#endif", ""]
    return "\n".join(lines)


def _c_struct(layout: Layout) -> list[str]:
    name = f"uwb_{layout.name.lower()}_t"
    lines = ["typedef struct {"]
    for field in layout.fields:
        if field.code[:-1]:
            element = "char" if field.code.endswith("s") else "uint8_t"
            member = f"{element} {field.name}[{field.code[:-1]}];"
        else:
            member = f"{_C_TYPES[field.code]} {field.name};"
        lines.append(f"    {member} /* {field.meaning} */" if field.meaning else f"    {member}")
    if layout.tail:
        lines.append(f"    /* then {layout.tail} */")
    lines += [f"}} {name};", f"UWB_STATIC_ASSERT(sizeof({name}) == {layout.packing().size});"]
    lines += [
        f"UWB_STATIC_ASSERT(offsetof({name}, {field}) == {offset});"
        for field, offset in layout.offsets().items()
    ]
    lines.append("")
    return lines
