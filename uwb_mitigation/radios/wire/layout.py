"""Tables of the wire protocol: frame header, message types, fields, limits.

`messages` packs and unpacks the fields in their order; `docs/generated.py` generates the protocol's page and the C header
`firmware/src/uwb_protocol.h` from them. All integers and floats are little-endian. Every field is aligned to its own
size and every fixed part is a multiple of 8 bytes long, so that a microcontroller can read a decoded frame in place.
"""

from __future__ import annotations

import enum
import itertools
import struct
from dataclasses import dataclass

PROTOCOL_VERSION = 1
"""First byte of every frame. Its position and that of the CRC are the same in all versions."""

CRC_BYTES = 4
"""The CRC-32 of IEEE 802.3 (as zlib computes it) over header and payload, last in the frame."""

MAX_SAMPLES = 2032
"""int16 values of a RANGE_CIR: 1016 complex samples, the accumulator's length at 64 MHz PRF."""

MAX_PAYLOAD_BYTES = 4224
"""Maximum size of a payload: the largest RANGE_CIR, and 88 bytes for fields of later revisions."""


class MessageType(enum.IntEnum):
    """The second byte of a frame. A type has the same layout in both directions."""

    HELLO = 1
    RANGE_CIR = 2
    RANGE_CORRECTED = 3
    LOG = 4
    STATUS = 5
    TIME_SYNC_REPLY = 6
    RADIO = 7
    RADIO_STATUS = 8
    OFFSETS = 9
    GET_INFO = 64
    SET_MODE = 65
    TIME_SYNC = 66
    GET_RADIO = 67
    SET_RADIO = 68
    SET_OFFSETS = 69


class Flag(enum.IntFlag):
    """Bits of the header's flags; receivers ignore unknown bits."""

    ANSWER = 1
    """The frame answers a frame of the host; without this bit it is unsolicited."""


class Mode(enum.IntEnum):
    """What a board sends of its own measurements. The value 2 is reserved."""

    HOST = 0
    """RANGE_CIR only: the host corrects."""
    DEVICE = 1
    """RANGE_CORRECTED only: the board corrects."""


class OffsetScope(enum.IntEnum):
    """Scope of an offset."""

    ANCHOR = 0
    TAG = 1
    PAIR = 2


class LogLevel(enum.IntEnum):
    """Severity of a LOG; the values of Python's `logging`."""

    DEBUG = 10
    INFO = 20
    WARNING = 30
    ERROR = 40


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a layout.

    Attributes:
        name: name in the protocol and in C.
        code: format of `struct`; reserved bytes are `nx`.
        description: description, with the unit.
    """

    name: str
    code: str
    description: str


class Layout:
    """The fixed part of a header or payload, and its optional tail.

    Args:
        name: as in `MessageType`, or HEADER.
        fields: in the order of their bytes.
        tail: description of the bytes after the fixed part; empty = no tail.
    """

    def __init__(self, name: str, *fields: Field, tail: str = "") -> None:
        self.name, self.fields, self.tail = name, fields, tail

    def as_struct(self) -> struct.Struct:
        """Return the fixed part as a `struct.Struct`; reserved bytes have no value."""
        return struct.Struct("<" + "".join(field.code for field in self.fields))

    def offsets(self) -> dict[str, int]:
        """Return {field name: byte offset}, without reserved bytes."""
        sizes = [struct.calcsize("<" + field.code) for field in self.fields]
        starts = itertools.accumulate(sizes, initial=0)
        return {
            field.name: start
            for field, start in zip(self.fields, starts, strict=False)
            if not field.code.endswith("x")
        }


HEADER = Layout(
    "HEADER",
    Field("version", "B", "PROTOCOL_VERSION"),
    Field("type", "B", "MessageType"),
    Field("flags", "H", "Flag"),
    Field("sequence", "I", "number of the frame since the start of the sender, from 0; wraps"),
    Field("time_us", "Q", "uptime of the board at the reported event; 0 from the host"),
)

_RADIO_SETTINGS = (
    Field("address", "Q", "address of the radio; 0 in SET_RADIO = that of the chip"),
    Field("antenna_delay", "I", "ticks, TX + RX; 0 = OTP value"),
    Field("tx_power", "I", "register TX_POWER in smart-power format; 0 = OTP value, or that of the manual"),
    Field("reply_us", "I", "from the reception of ANSWER to FINAL; 0 in SET_RADIO = default of the firmware"),
    Field("timeout_us", "I", "timeout of a tag for an anchor; 0 in SET_RADIO = default of the firmware"),
    Field("interval_us", "I", "minimum time between the starts of two exchanges"),
    Field("pan", "H", "network; frames of other networks are ignored"),
    Field("rate", "H", "kbit/s: 110, 850, 6800"),
    Field("preamble", "H", "symbols: 64 to 4096"),
    Field("window", "H", "complex samples per measurement; 0 = none, 1016 and more = all"),
    Field("channel", "B", "1 to 5, 7"),
    Field("prf", "B", "MHz: 16, 64"),
    Field("preamble_code", "B", "0 = the first for channel and PRF"),
    Field("decawave_sfd", "B", "0 = the standard's start-of-frame delimiter, 1 = Decawave's"),
    Field("role", "B", "Role"),
    Field("report", "B", "1 = an anchor also sends its ranges to its host"),
    Field("bias_correction", "B", "1 = ranges are corrected for the received power (APS011)"),
    Field("anchor_count", "B", "anchors that a tag polls; 0 = anchors found by broadcast"),
    Field("reserved_2", "4x", ""),
)
"""Common fields of RADIO and SET_RADIO."""

RADIO_ANCHOR = Layout(
    "RADIO_ANCHOR",
    Field("address", "Q", "address of the anchor"),
    Field("tried", "I", "started exchanges"),
    Field("ranged", "I", "exchanges with a range"),
    Field("rx_power", "f", "dBm, of its last frame; NaN = unknown"),
    Field("age_ms", "I", "time since its last frame; 4294967295 = never received"),
)
"""One anchor in the tail of a RADIO_STATUS."""

OFFSET = Layout(
    "OFFSET",
    Field("tag_id", "Q", "ignored for the offset of an anchor"),
    Field("anchor_id", "Q", "ignored for the offset of a tag"),
    Field("offset", "f", "m, -10 to 10"),
    Field("scope", "B", "OffsetScope"),
    Field("reserved", "3x", ""),
)
"""One offset in the tail of a SET_OFFSETS."""

MAX_OFFSETS = 64
"""Maximum number of offsets on a board, in addition to the default."""

_TABLES = (
    Layout(
        "HELLO",
        Field("board_id", "Q", "identity of the board"),
        Field("model_id", "I", "identity of the board's model; 0 = no model"),
        Field("boot_id", "I", "differs between two starts of the firmware"),
        Field("request_sequence", "I", "with ANSWER: sequence of the host's frame answered"),
        Field("window", "H", "window length K of the board's model; 0 = no model"),
        Field("max_payload", "H", "longest payload that the board accepts, bytes"),
        Field("firmware_major", "B", "firmware version"),
        Field("firmware_minor", "B", ""),
        Field("firmware_patch", "B", ""),
        Field("mode", "B", "active Mode"),
        Field("reserved", "4x", ""),
        Field("firmware_name", "16s", "UTF-8, padded with zeros"),
    ),
    Layout(
        "RANGE_CIR",
        Field("tag_id", "Q", "identity of the tag"),
        Field("anchor_id", "Q", "identity of the anchor"),
        Field("device_time", "Q", "DW1000 ticks of 1 / (128 x 499.2 MHz) at the reception, 40 bits"),
        Field("sequence", "I", "number of the exchange; wraps"),
        Field("range", "f", "m, measured; NaN = no range"),
        Field("sample_period", "f", "s"),
        Field("first_path_index", "f", "accumulator index; NaN = unknown"),
        Field("scale", "f", "accumulator units per count of samples"),
        Field("rx_power", "f", "dBm; NaN = unknown"),
        Field("first_path_power", "f", "dBm; NaN = unknown"),
        Field("start_index", "i", "accumulator index of the first sample"),
        Field("preamble_count", "H", "RXPACC; 0 = unknown"),
        Field("noise_threshold", "H", "LDE_THRESH, accumulator units; 0 = unknown"),
        Field("samples_offset", "H", "bytes from the payload's start to the samples; even"),
        Field("sample_count", "H", "int16 values: two per complex sample"),
        Field("encoding", "B", "0 = complex, interleaved re, im; 1 = magnitude"),
        Field("channel", "B", "UWB channel; 0 = unknown"),
        Field("prf", "B", "MHz: 16 or 64; 0 = unknown"),
        Field("reserved", "5x", ""),
        tail="samples, int16, from samples_offset",
    ),
    Layout(
        "RANGE_CORRECTED",
        Field("tag_id", "Q", "as in the measurement"),
        Field("anchor_id", "Q", "as in the measurement"),
        Field("device_time", "Q", "as in the measurement, 40 bits"),
        Field("sequence", "I", "as in the measurement"),
        Field("model_id", "I", "identity of the model that corrected; 0 = none"),
        Field("range", "f", "m, corrected; NaN = no valid range"),
        Field("range_raw", "f", "m, as measured"),
        Field("correction", "f", "m, offset + predicted error; only the offset if it is passed through"),
        Field("variance", "f", "m^2; infinite if the range is invalid"),
        Field("compute_us", "I", "time that the correction took on the board"),
        Field("status", "B", "0 OK, 1 NO_CIR, 2 BAD_CIR, 3 OUT_OF_DISTRIBUTION, 4 MODEL_ERROR, 5 UNRELIABLE"),
        Field("reserved", "3x", ""),
    ),
    Layout(
        "LOG",
        Field("level", "B", "LogLevel"),
        Field("reserved", "7x", ""),
        tail="text, UTF-8, to the payload's end",
    ),
    Layout(
        "STATUS",
        Field("frames_received", "I", "intact frames from the host since the start"),
        Field("frames_dropped", "I", "damaged or unknown frames from the host since the start"),
        Field("measurements", "I", "exchanges since the start"),
        Field("measurements_lost", "I", "exchanges not sent because the link was full"),
        Field("temperature", "f", "degrees Celsius; NaN = not measured"),
        Field("mode", "B", "active Mode"),
        Field("reserved", "3x", ""),
    ),
    Layout(
        "TIME_SYNC_REPLY",
        Field("request_sequence", "I", "sequence of the TIME_SYNC answered"),
        Field("reserved", "4x", ""),
        Field("received_us", "Q", "board's uptime when the TIME_SYNC's last byte was received"),
    ),
    Layout(
        "RADIO",
        Field("request_sequence", "I", "with ANSWER: sequence of the host's frame answered"),
        Field("accepted", "B", "0 = SET_RADIO was refused; the text contains the reason"),
        Field("reserved", "3x", ""),
        *_RADIO_SETTINGS,
        tail="anchor_count addresses, u64, then text, UTF-8, to the payload's end",
    ),
    Layout(
        "RADIO_STATUS",
        Field("tried", "I", "started exchanges; the sum of the seven following counts"),
        Field("ranged", "I", "exchanges with a range"),
        Field("no_answer", "I", "lost: POLL was not answered"),
        Field("late", "I", "lost: FINAL could not be sent in time"),
        Field("timeout", "I", "lost: FINAL or REPORT was not received"),
        Field("damaged", "I", "lost: the received data was no intact frame"),
        Field("implausible", "I", "lost: implausible timestamps"),
        Field("broken", "I", "lost: the chip was reset, or its bus failed"),
        Field("refused", "I", "frames that do not belong to an exchange of this radio"),
        Field("restarts", "I", "restarts of the chip after the first"),
        Field("temperature", "f", "degrees Celsius, in the chip; NaN = not measured"),
        Field("voltage", "f", "V, supply of the chip; NaN = not measured"),
        Field("state", "B", "RadioState"),
        Field("anchor_count", "B", "anchors in the tail"),
        Field("reserved", "6x", ""),
        tail="anchor_count times RADIO_ANCHOR",
    ),
    Layout(
        "OFFSETS",
        Field("request_sequence", "I", "sequence of the SET_OFFSETS answered"),
        Field("slots", "H", "offsets that the board can store in addition to the default"),
        Field("accepted", "B", "0 = too many: the previous offsets stay in use"),
        Field("reserved", "1x", ""),
    ),
    Layout("GET_INFO"),
    Layout("SET_MODE", Field("mode", "B", "requested Mode"), Field("reserved", "7x", "")),
    Layout("TIME_SYNC"),
    Layout("GET_RADIO"),
    Layout("SET_RADIO", *_RADIO_SETTINGS, tail="anchor_count addresses, u64"),
    Layout(
        "SET_OFFSETS",
        Field("default_offset", "f", "m, for pairs without an offset in the tail, -10 to 10"),
        Field("count", "H", "offsets in the tail"),
        Field("reserved", "2x", ""),
        tail="count times OFFSET",
    ),
)
PAYLOADS = {MessageType[table.name]: table for table in _TABLES}
"""Every message type and its payload. A payload may be longer than its layout, never shorter."""

STRUCTS = {int(kind): table.as_struct() for kind, table in PAYLOADS.items()}
"""The fixed part of every payload."""

HEADER_BYTES = HEADER.as_struct().size
MAX_FRAME_BYTES = HEADER_BYTES + MAX_PAYLOAD_BYTES + CRC_BYTES
MAX_ENCODED_BYTES = MAX_FRAME_BYTES + -(-MAX_FRAME_BYTES // 254)
"""COBS adds one byte for each 254 begun; the delimiters are not counted."""
