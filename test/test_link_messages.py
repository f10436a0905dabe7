"""Messages of the wire protocol: golden vectors for the tests of Python and C, and hostile payloads.

`python test/test_link_messages.py` rewrites the vectors; use it only for a deliberate change of the protocol.
"""

import binascii
import math
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.radios.settings import (
    AGE_UNKNOWN_MS,
    AnchorStatus,
    RadioSettings,
    RadioState,
    RadioStatus,
    Role,
)
from uwb_mitigation.radios.wire import layout, messages
from uwb_mitigation.radios.wire.framing import FrameDecoder, WireFrame, encode_frame
from uwb_mitigation.radios.wire.layout import Flag, LogLevel, MessageType, Mode
from uwb_mitigation.radios.wire.messages import Hello, OffsetsAnswer, TimeSyncReply
from uwb_mitigation.types.measurement import (
    Cir,
    CorrectedBy,
    CorrectedRange,
    Encoding,
    RangeMeasurement,
    Status,
)
from uwb_mitigation.types.offsets import Offsets

FILE = Path(__file__).parent / "data" / "link_vectors.txt"

PREAMBLE = """\
# Golden vectors of the wire protocol, version 1; docs/reference/protocol.md says what they mean. One per line:
#   frame NAME TYPE FLAGS SEQUENCE TIME_US PAYLOAD WIRE   decodes to these fields; WIRE holds both delimiters
#   value NAME FIELD NUMBER                               a field of that frame's payload; floats as their 32 bits
#   reject NAME KIND WIRE                                 gives no frame; KIND is the count that it raises
# Numbers are decimal and unsigned, bytes are hexadecimal, - is no bytes.
"""


def measured(range_m: float, cir: Cir) -> RangeMeasurement:
    return RangeMeasurement(0, 1, 2, 3, 4, range_m, cir)


def correction(values: CorrectedRange, compute_us: int = 0) -> messages.Correction:
    return messages.Correction(0, 1, 2, 3, 4, values, compute_us)


IDS = {"tag_id": 0x0123456789ABCDEF, "anchor_id": 0xFEDCBA9876543210, "sequence": 0xFFFFFFFE}
SAMPLES = np.array([0, 0, 256, -256, 32767, -32768, 1, -1], np.int16)
LEVELS = {"noise_threshold": 1800, "rx_power_dbm": -81.5, "first_path_power_dbm": math.nan, "scale": 0.1}
RADIO = {"preamble_count": 1021, "channel": 2, "prf_mhz": 64}
CIR = Cir(SAMPLES, start_index=-3, first_path_index=745.671875, **LEVELS, **RADIO)
MEASUREMENT = RangeMeasurement(0, **IDS, device_time=0xFF00FF00FF, cir=CIR, range_m=7.3125)
MAGNITUDES = Cir(np.arange(1, 158, dtype=np.int16), Encoding.MAGNITUDE)
FULL = Cir(np.zeros(layout.MAX_SAMPLES, np.int16), preamble_count=1)
CORRECTED = CorrectedRange(6.75, 7.3125, 0.5625, 0.0625, Status.OK, CorrectedBy.DEVICE, 0xDEADBEEF)
INVALID = CorrectedRange(math.nan, math.nan, 0.0, math.inf, Status.BAD_CIR, CorrectedBy.DEVICE, 0)
HELLO = Hello(0x1122334455667788, 0xDEADBEEF, 42, 1, 157, 4224, 1, 2, 3, Mode.DEVICE, "nano33")
OFFSETS = Offsets(0.125, {2: 0.25}, {2**63 + 1: -0.5}, {(7, 3): 10.0})
NETWORK = {"role": Role.ANCHOR, "address": 0x0102030405060708, "pan": 0x1234, "anchors": (1, 2**63 + 1)}
CHANNEL = {"channel": 2, "prf_mhz": 16, "preamble": 1024, "preamble_code": 4, "rate_kbps": 110}
FRAMES = {"decawave_sfd": True, "tx_power": 0x15355575, "antenna_delay": 32872, "window": 1016}
DELAYS = {"reply_us": 15_000, "timeout_us": 60_000, "interval_us": 100_000}
SETTINGS = RadioSettings(**NETWORK, **CHANNEL, **FRAMES, **DELAYS, report=True, bias_correction=True)
REFUSED = messages.RadioConfigured(RadioSettings(), 3, False, "more anchors than 32")
ANCHORS = AnchorStatus(1, 20, 7, -80.5, 12), AnchorStatus(2**64 - 2, 8, 0, math.nan, AGE_UNKNOWN_MS)
STATUS = RadioStatus(28, 7, 6, 5, 4, 3, 2, 1, 9, 10, 31.5, 3.25, RadioState.BUS, ANCHORS)
SENT = {
    "get_info": (MessageType.GET_INFO, 0, 0, 0),
    "set_mode": (Mode.DEVICE, 0, 1, 0),
    "time_sync": (MessageType.TIME_SYNC, 0, 0xFFFFFFFF, 0),
    "hello": (HELLO, Flag.ANSWER, 0, 1_000_000),
    "time_sync_reply": (TimeSyncReply(0xFFFFFFFF, 2**40 + 17), Flag.ANSWER, 1, 2**40 + 20),
    "log": (messages.Log(LogLevel.WARNING, "first path outside the window"), 0, 2, 3_000_000),
    "log_empty": (messages.Log(LogLevel.DEBUG, ""), 0, 3, 3_000_000),
    "status": (messages.BoardStatus(1, 2, 3, 4, Mode.DEVICE, 41.5), 0, 4, 4_000_000),
    "range_cir": (MEASUREMENT, 0, 5, 2**63 + 1),
    "range_cir_magnitude": (measured(-0.25, MAGNITUDES), 0, 6, 5_000_000),
    "range_cir_full": (measured(math.nan, FULL), 0, 7, 6_000_000),
    "range_corrected": (correction(CORRECTED, 7040), 0, 8, 7_000_000),
    "range_corrected_invalid": (correction(INVALID), Flag.ANSWER, 9, 0),
    "set_offsets": (OFFSETS, 0, 4, 0),
    "offsets": (OffsetsAnswer(4, 64, True), Flag.ANSWER, 13, 9_000_000),
    "get_radio": (MessageType.GET_RADIO, 0, 2, 0),
    "set_radio": (SETTINGS, 0, 3, 0),
    "radio": (messages.RadioConfigured(SETTINGS, 3), Flag.ANSWER, 10, 8_000_000),
    "radio_refused": (REFUSED, Flag.ANSWER, 11, 8_000_000),
    "radio_status": (STATUS, 0, 12, 9_000_000),
}


def sent_frames() -> Iterator[tuple[str, WireFrame]]:
    for name, (message, flags, sequence, time_us) in SENT.items():
        kind, payload = messages.encode(message)
        yield name, WireFrame(int(kind), int(flags), sequence, time_us, payload)
    # A receiver counts and skips unknown types; blocks of 254 bytes are a special case of COBS.
    for size in (253, 254, 255, 508):
        yield f"unknown_{size}", WireFrame(200, 0x8000, size, 0, bytes(1 + i % 255 for i in range(size)))
    yield "unknown_zeros", WireFrame(200, 0, 0, 0, bytes(300))


def rejected() -> Iterator[tuple[str, str, bytes]]:
    log = encode_frame(dict(sent_frames())["log"])
    yield "flipped_bit", "bad_crc", log[:30] + bytes([log[30] ^ 0x10]) + log[31:]
    yield "cut_short", "bad_cobs", log[:-8] + b"\0"
    yield "too_short_for_a_header", "bad_length", b"\0\x05boot\0"
    yield "endless", "oversize", b"\0" + b"\1" * (layout.MAX_ENCODED_BYTES + 1) + b"\0"
    body = bytes([2, MessageType.HELLO]) + bytes(14)
    yield "version_2", "foreign_version", b"\0" + cobs.encode(body + crc(body)) + b"\0"


def value_lines(name: str, frame: WireFrame) -> Iterator[str]:
    if frame.type not in layout.PAYLOADS:
        return
    table = layout.PAYLOADS[MessageType(frame.type)]
    unsigned = {"B": "B", "H": "H", "I": "I", "Q": "Q", "i": "I", "f": "I"}
    codes = {field.name: field.code for field in table.fields}
    for field, offset in table.offsets().items():
        if codes[field] in unsigned:
            (number,) = struct.unpack_from("<" + unsigned[codes[field]], frame.payload, offset)
            yield f"value {name} {field} {number}"


def render() -> str:
    lines = []
    for name, frame in sent_frames():
        lines.append(
            f"frame {name} {frame.type} {frame.flags} {frame.sequence} {frame.time_us} "
            f"{frame.payload.hex() or '-'} {encode_frame(frame).hex()}"
        )
        lines += value_lines(name, frame)
    lines += [f"reject {name} {kind} {wire.hex()}" for name, kind, wire in rejected()]
    return PREAMBLE + "\n".join(lines) + "\n"


def crc(body: bytes) -> bytes:
    return struct.pack("<I", binascii.crc32(body))


def lines_of(kind: str) -> list[list[str]]:
    return [line.split() for line in FILE.read_text().splitlines() if line.startswith(kind + " ")]


def test_file_equals_the_output_of_the_protocol():
    assert render() == FILE.read_text()


@pytest.mark.parametrize("line", lines_of("frame"), ids=lambda line: line[1])
def test_vector_equals_the_specification_byte_by_byte(line):
    _, _, kind, flags, sequence, time_us, payload, wire = line
    body = bytes([1, int(kind)]) + struct.pack("<HIQ", int(flags), int(sequence), int(time_us))
    body += bytes.fromhex(payload) if payload != "-" else b""

    assert bytes.fromhex(wire) == b"\0" + cobs.encode(body + crc(body)) + b"\0"


@pytest.mark.parametrize("line", lines_of("reject"), ids=lambda line: line[1])
def test_rejected_vector_increments_its_counter(line):
    _, _, kind, wire = line
    decoder = FrameDecoder()

    assert decoder.feed(bytes.fromhex(wire)) == []
    assert decoder.counts[kind] == 1
    assert decoder.corrupt == (kind != "foreign_version")


@pytest.mark.parametrize("name", SENT)
def test_encoded_message_is_decoded_unchanged(name: str):
    kind, payload = messages.encode(SENT[name][0])
    assert messages.encode(messages.decode(kind, payload)) == (kind, payload)


GROWING = "get_info set_mode time_sync hello time_sync_reply status range_cir range_corrected"


@pytest.mark.parametrize("name", GROWING.split())
def test_payload_may_grow_at_its_end_unless_its_tail_runs_to_the_end(name: str):
    message = SENT[name][0]
    kind, payload = messages.encode(message)

    assert type(messages.decode(kind, payload + b"later revision")) is type(message)


def test_samples_are_found_after_fields_of_a_later_revision():
    kind, payload = messages.encode(MEASUREMENT)
    grown = bytearray(payload[:72] + b"newfield" + payload[72:])
    struct.pack_into("<H", grown, layout.PAYLOADS[MessageType.RANGE_CIR].offsets()["samples_offset"], 80)

    assert messages.decode(kind, bytes(grown)).cir.samples.tolist() == SAMPLES.tolist()


@pytest.mark.parametrize("kind", [kind for kind in MessageType if layout.PAYLOADS[kind].fields])
def test_payload_that_is_too_short_is_an_error_that_names_the_type(kind):
    size = layout.PAYLOADS[kind].as_struct().size

    with pytest.raises(LinkError, match=rf"{kind.name}: .*{size - 1} bytes.*at least {size}"):
        messages.decode(kind, bytes(size - 1))


@pytest.mark.parametrize(
    ("name", "field", "code", "value", "error"),
    [
        *(("range_cir", "sample_count", "H", count, "RANGE_CIR") for count in (9, 2033)),
        *(("range_cir", "samples_offset", "H", offset, "RANGE_CIR") for offset in (70, 73, 65534)),
        ("range_cir", "encoding", "B", 2, "RANGE_CIR"),
        ("range_cir", "device_time", "Q", 2**40, "RANGE_CIR"),
        *((name, "mode", "B", 250, "250") for name in ("hello", "status", "set_mode")),
        ("range_corrected", "status", "B", 250, "250"),
        ("log", "level", "B", 250, "250"),
    ],
)
def test_impossible_value_of_a_field_is_an_error(name, field, code, value, error):
    kind, payload = messages.encode(SENT[name][0])
    broken = bytearray(payload)
    if field == "samples_offset":
        broken += bytes(6)  # The samples still end inside the payload.
    struct.pack_into("<" + code, broken, layout.PAYLOADS[kind].offsets()[field], value)

    with pytest.raises(LinkError, match=error):
        messages.decode(kind, bytes(broken))


@pytest.mark.parametrize(
    "message",
    [
        measured(1.0, Cir(np.zeros(2034, np.int16))),
        *(
            measured(1.0, replace(CIR, **large))
            for large in ({"preamble_count": 65536}, {"rx_power_dbm": 1e39})
        ),
        TimeSyncReply(-1, 0),
        TimeSyncReply(2**32, 0),
    ],
    ids=["samples", "preamble", "float", "negative", "32 bits"],
)
def test_value_too_large_for_its_field_is_refused(message):
    with pytest.raises(ParameterError):
        messages.encode(message)


def test_text_that_is_not_utf8_is_shown_with_replacements():
    kind, payload = messages.encode(messages.Log(LogLevel.INFO, "ok"))

    assert messages.decode(kind, payload + b"\xff").text == "ok�"


def test_long_firmware_name_is_cut_between_characters():
    for text in ("ü" * 8, "x" * 15):
        hello = Hello(1, boot_id=1, firmware_name=f"{text}é")
        assert messages.decode(*messages.encode(hello)).firmware_name == text


if __name__ == "__main__":
    FILE.write_text(render())
