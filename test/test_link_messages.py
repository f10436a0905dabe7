"""Messages and payloads, including hostile ones."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.radios.wire import layout, messages
from uwb_mitigation.radios.wire.layout import MessageType, Mode
from uwb_mitigation.radios.wire.messages import BoardStatus, Correction, Hello, Log, SetMode, TimeSyncReply
from uwb_mitigation.types.measurement import Cir, CorrectedBy, CorrectedRange, RangeMeasurement, Status

HELLO = Hello(0xB0A2D, 0xCAFE, 99, 3, 157, 4224, 1, 2, 3, Mode.DEVICE, "uwb-nano33")
CORRECTED = CorrectedRange(2.5, 3.0, 0.5, 0.25, Status.OK, CorrectedBy.DEVICE, 0xCAFE)
CORRECTION = Correction(5, 1, 2, 3, 2**40 - 1, CORRECTED, 7100)
LOG, STATUS = Log(layout.LogLevel.WARNING, "antenna délay"), BoardStatus(1, 2, 3, 4, Mode.DEVICE, 41.5)
REQUESTS = [SetMode(Mode.DEVICE), MessageType.GET_INFO, MessageType.TIME_SYNC]
GROWING = [HELLO, CORRECTION, STATUS, TimeSyncReply(17, 2**60), *REQUESTS]


def measurement(samples: np.ndarray, **cir: object) -> RangeMeasurement:
    cir = Cir(np.asarray(samples, np.int16), **cir)
    return RangeMeasurement(11, 2**64 - 1, 2, 2**32 - 1, 2**40 - 1, 3.25, cir)


@pytest.mark.parametrize("message", [*GROWING, measurement([])], ids=lambda message: type(message).__name__)
def test_payload_may_grow_at_its_end_unless_its_tail_runs_to_the_end(message):
    kind, payload = messages.encode(message)

    assert type(messages.decode(kind, payload + b"later revision")) is type(message)


def test_samples_are_found_after_fields_of_a_later_revision():
    kind, payload = messages.encode(measurement([1, -2, 3, -4]))
    offset_start = layout.PAYLOADS[MessageType.RANGE_CIR].offsets()["samples_offset"]
    grown = bytearray(payload[:72] + b"newfield" + payload[72:])
    struct.pack_into("<H", grown, offset_start, 80)

    assert messages.decode(kind, bytes(grown)).cir.samples.tolist() == [1, -2, 3, -4]


@pytest.mark.parametrize("kind", [kind for kind in MessageType if layout.PAYLOADS[kind].fields])
def test_payload_that_is_too_short_is_an_error_that_names_the_type(kind):
    size = layout.PAYLOADS[kind].as_struct().size

    with pytest.raises(LinkError, match=rf"{kind.name}: .*{size - 1} bytes.*at least {size}"):
        messages.decode(kind, bytes(size - 1))


@pytest.mark.parametrize(
    ("message", "field", "code", "value", "error"),
    [
        *((measurement([1, 2]), "sample_count", "H", count, "RANGE_CIR") for count in (3, 2033)),
        *((measurement([1, 2]), "samples_offset", "H", offset, "RANGE_CIR") for offset in (70, 73, 65534)),
        (measurement([1, 2]), "encoding", "B", 2, "RANGE_CIR"),
        (measurement([1, 2]), "device_time", "Q", 2**40, "RANGE_CIR"),
        *((message, "mode", "B", 250, "250") for message in (HELLO, STATUS, REQUESTS[0])),
        (CORRECTION, "status", "B", 250, "250"),
        (LOG, "level", "B", 250, "250"),
    ],
)
def test_impossible_value_of_a_field_is_an_error(message, field, code, value, error):
    kind, payload = messages.encode(message)
    broken = bytearray(payload)
    if field == "samples_offset":
        broken += bytes(6)  # The samples still end inside the payload.
    struct.pack_into("<" + code, broken, layout.PAYLOADS[kind].offsets()[field], value)

    with pytest.raises(LinkError, match=error):
        messages.decode(kind, bytes(broken))


LARGE = {"preamble": {"preamble_count": 65536}, "float": {"rx_power_dbm": 1e39}}


@pytest.mark.parametrize(
    "message",
    [
        measurement([0] * 2034),
        *(measurement([], **fields) for fields in LARGE.values()),
        SetMode(-1),
        TimeSyncReply(2**32, 0),
    ],
    ids=["samples", *LARGE, "negative", "32 bits"],
)
def test_value_too_large_for_its_field_is_refused(message):
    with pytest.raises(ParameterError):
        messages.encode(message)


def test_text_that_is_not_utf8_is_shown_with_replacements():
    kind, payload = messages.encode(Log(layout.LogLevel.INFO, "ok"))

    assert messages.decode(kind, payload + b"\xff").text == "ok�"


def test_long_firmware_name_is_cut_between_characters():
    for text in ("ü" * 8, "x" * 15):
        hello = Hello(1, boot_id=1, firmware_name=f"{text}é")
        assert messages.decode(*messages.encode(hello)).firmware_name == text
