"""The wire protocol and the logic of the board in C: golden vectors, and the same bytes as `link.board.Board`."""

import ctypes
from dataclasses import replace
from pathlib import Path

import firmware_models
import numpy as np
import pytest
from compilers import NEEDS_CC

from benchmarks.equipment.board import Board
from benchmarks.equipment.emulated_board import EMULATED
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.embedded.compiled import link
from uwb_mitigation.mitigation.embedded.compiling import BOARD, firmware_folder
from uwb_mitigation.mitigation.embedded.export import export_bundle
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.framing import FrameDecoder, FrameEncoder, WireFrame, encode_frame
from uwb_mitigation.radios.wire.layout import HEADER, MAX_OFFSETS, MAX_PAYLOAD_BYTES, Flag, MessageType, Mode
from uwb_mitigation.types.measurement import RangeMeasurement
from uwb_mitigation.types.offsets import Offsets

pytestmark = NEEDS_CC

VECTORS = Path(__file__).parent / "data" / "link_vectors.txt"
SANITIZED = ("-O1", "-fsanitize=undefined", "-fno-sanitize-recover=all")
KINDS = ("frames", "bad_cobs", "bad_length", "bad_crc", "oversize", "foreign_version")


class BoardInC:
    """`firmware/test/native_board.c`; each method returns the bytes that the board sends."""

    def __init__(self, library: ctypes.CDLL, mode: Mode, with_model: bool = True, queue: int = 16384) -> None:
        self._library = library
        self._board = library.native_board_new(int(mode), int(with_model), queue)
        self.sent = self._output()

    def receive(self, data: bytes, now_us: int, *, read: bool = True) -> bytes:
        self._library.native_board_receive(self._board, data, len(data), now_us)
        return self._output() if read else b""

    def measure(self, data: bytes, now_us: int, *, read: bool = True) -> bytes:
        self._library.native_board_receive_from_radio(self._board, data, len(data), now_us)
        return self._output() if read else b""

    def tick(self, now_us: int) -> bytes:
        self._library.native_board_tick(self._board, now_us)
        return self._output()

    def __del__(self) -> None:
        self._library.native_board_free(self._board)

    def read(self, limit: int) -> bytes:
        out = ctypes.create_string_buffer(limit)
        count = self._library.native_board_output(self._board, out, limit)
        return out.raw[:count]

    def _output(self) -> bytes:
        return self.read(1 << 16)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    return firmware_models.strict_bundle(tmp_path_factory.mktemp("bundle"))


@pytest.fixture(scope="module")
def library(bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("board")
    export_bundle(bundle, folder)
    program = firmware_folder() / "test" / "native_board.c"
    library = ctypes.CDLL(str(link(program, folder, folder / "board.so", SANITIZED, BOARD, shared=True)))
    size, time, pointer, data = ctypes.c_size_t, ctypes.c_uint64, ctypes.c_void_p, ctypes.c_char_p
    for name, result, *arguments in (
        ("board_new", pointer, ctypes.c_int, ctypes.c_int, size),
        ("board_free", None, pointer),
        ("board_receive", None, pointer, data, size, time),
        ("board_receive_from_radio", None, pointer, data, size, time),
        ("board_tick", None, pointer, time),
        ("board_output", size, pointer, pointer, size),
        ("decode", ctypes.c_int, data, size, pointer, pointer, pointer),
        ("encode", size, data, data, size, pointer),
    ):
        function = getattr(library, f"native_{name}")
        function.restype, function.argtypes = result, arguments
    return library


def decode(library: ctypes.CDLL, wire: bytes) -> tuple[WireFrame | None, dict[str, int]]:
    header, payload = ctypes.create_string_buffer(16), ctypes.create_string_buffer(MAX_PAYLOAD_BYTES)
    counts = (ctypes.c_uint32 * len(KINDS))()
    length = library.native_decode(wire, len(wire), header, payload, counts)
    counted = dict(zip(KINDS, counts, strict=True))
    if length < 0:
        return None, counted
    _, *fields = HEADER.as_struct().unpack(header.raw)
    return WireFrame(*fields, payload.raw[:length]), counted


def encode(library: ctypes.CDLL, frame: WireFrame) -> bytes:
    header = HEADER.as_struct().pack(1, *frame[:4])
    wire = ctypes.create_string_buffer(8192)
    count = library.native_encode(header, frame.payload, len(frame.payload), wire)
    return wire.raw[:count]


def golden(kind: str) -> list[bytes]:
    """Return the frames that are to be accepted ("frame") or rejected ("reject")."""
    lines = (line.split(" ") for line in VECTORS.read_text().splitlines())
    return [bytes.fromhex(line[-1]) for line in lines if line[0] == kind]


def test_frames_of_any_length_and_content_are_encoded_as_in_python(library: ctypes.CDLL):
    random = np.random.default_rng(1)
    frames = FrameDecoder().feed(b"".join(golden("frame")))
    assert len(frames) > 20
    lengths = [*range(225, 260), *range(490, 520), MAX_PAYLOAD_BYTES, *random.integers(0, 4224, 100).tolist()]
    for length in lengths:
        payload = random.integers(0, random.choice([2, 256]), length, np.uint8)
        if length % 2:
            payload[:] = np.maximum(payload, 1)
        frames.append(WireFrame(2, 0, 0x01010101, 0x0101010101010101, payload.tobytes()))
    for frame in frames:
        assert encode(library, frame) == encode_frame(frame)


def test_golden_and_damaged_streams_give_the_frames_and_counts_that_python_gives(library: ctypes.CDLL):
    random = np.random.default_rng(2)
    streams = golden("frame") + golden("reject")
    for _ in range(300):
        frames = [WireFrame(3, 0, i, i, random.bytes(random.integers(0, 600))) for i in range(3)]
        stream = bytearray(b"".join(map(encode_frame, frames)))
        for at in random.integers(0, len(stream), random.integers(0, 4)):
            stream[at] = random.choice([0, 1, 255, random.integers(0, 256)])
        if random.random() < 0.1:
            stream[:0] = bytes([1]) * int(random.integers(4255, 4270)) + b"\0"
        streams.append(bytes(stream))
    for data in streams:
        decoder = FrameDecoder()
        expected = decoder.feed(data)
        frame, counts = decode(library, data)
        assert frame == (expected[-1] if expected else None)
        assert counts == {kind: decoder.counts[kind] for kind in KINDS}


def python_board(bundle: Bundle, mode: Mode) -> Board:
    identity = replace(EMULATED, model_id=bundle.model_id, window=bundle.card.architecture.samples)
    return Board(identity, Mitigation(bundle), mode=mode)


def same(sent: bytes, expected: bytes) -> bool:
    """Compare frames byte by byte, except for the measured computing time."""

    def frames(data: bytes) -> list[WireFrame]:
        decoded = []
        for frame in FrameDecoder().feed(data):
            if frame.type == MessageType.RANGE_CORRECTED:
                frame = frame._replace(payload=frame.payload[:48] + bytes(4) + frame.payload[52:])
            decoded.append(frame)
        return decoded

    return frames(sent) == frames(expected)


def some_offsets(random: np.random.Generator) -> Offsets:
    """Draw offsets, up to a few more than a board stores, for known and other radios."""
    default, *values = random.uniform(-1.0, 1.0, 4)
    most = {100 + i: 0.5 for i in range(int(random.choice([0, 3, MAX_OFFSETS - 2, MAX_OFFSETS])))}
    tags, anchors = ({}, {}) if random.random() < 0.5 else ({1: values[0]}, {2: values[1]})
    pairs = {(1, 2): values[2]} if random.random() < 0.3 else {}
    return Offsets(default, most | anchors, tags, pairs)


def damaged(payload: bytes, random: np.random.Generator) -> bytes:
    """Draw a truncated message, or one with NaN or an invalid field."""
    if random.random() < 0.5:
        return payload[: int(random.integers(0, len(payload)))]
    at = int(random.choice([0, *range(8 + 16, len(payload), 24)]))
    wrong = (b"\0\0\xc0\x7f", b"\0\0\x80\x41\x07")[int(random.integers(0, 2))]
    return payload[:at] + wrong + payload[at + len(wrong) :]


@pytest.mark.parametrize("mode", list(Mode))
def test_board_in_c_sends_what_the_board_in_python_sends(library: ctypes.CDLL, bundle: Bundle, mode: Mode):
    random = np.random.default_rng(5)
    python, c = python_board(bundle, mode), BoardInC(library, mode)
    host, radio = FrameEncoder(), FrameEncoder()
    assert same(c.sent, python.hello(0))
    for step in range(250):
        now_us = 20_000 * step
        measured = firmware_models.random_measurement(random)
        wire = radio.encode(*messages.encode(measured))
        assert same(c.measure(wire, now_us), python.measure(measured, now_us))
        changes = Mode(int(random.integers(0, 2))), some_offsets(random)
        requests = [MessageType.GET_INFO, MessageType.TIME_SYNC, measured, *changes, None]
        request = requests[int(random.choice(6, p=[0.1, 0.1, 0.3, 0.1, 0.2, 0.2]))]
        if request is None:
            kind, payload = int(random.integers(0, 256)), random.bytes(int(random.integers(0, 120)))
            if random.random() < 0.5:
                kind, payload = messages.encode(some_offsets(random))
                payload = damaged(payload, random)
        else:
            kind, payload = messages.encode(request)
        data = host.encode(kind, payload)
        if random.random() < 0.1:
            data = data[:5] + b"\x05" + data[6:]
        if step % 50 == 0:
            data = FrameEncoder(version=9).encode(MessageType.GET_INFO, b"")
        assert same(c.receive(data, now_us), python.receive(data, now_us))
        assert same(c.tick(now_us), python.tick(now_us))


def test_board_without_a_model_stays_in_host_mode(library: ctypes.CDLL):
    c = BoardInC(library, Mode.DEVICE, with_model=False)
    (frame,) = FrameDecoder().feed(c.receive(FrameEncoder().encode(*messages.encode(Mode.DEVICE)), 1))
    hello = messages.decode(frame.type, frame.payload)
    assert (hello.mode, hello.model_id, hello.window, frame.flags) == (Mode.HOST, 0, 0, Flag.ANSWER)


def test_slow_host_loses_complete_measurements_but_no_status(library: ctypes.CDLL):
    c = BoardInC(library, Mode.HOST, queue=9000)
    measured = firmware_models.random_measurement(np.random.default_rng(3))
    wire = FrameEncoder().encode(*messages.encode(measured))
    for _ in range(200):
        c.measure(wire, 5, read=False)
    frames = FrameDecoder().feed(c.tick(2_000_000))
    *ranges, status = [messages.decode(frame.type, frame.payload) for frame in frames]
    assert all(isinstance(message, RangeMeasurement) for message in ranges)
    assert status.measurements == 200
    assert status.measurements_lost == 200 - len(ranges) > 0
    assert [frame.sequence for frame in frames] == list(range(1, len(frames) + 1))


def test_clock_request_is_answered_before_queued_messages(library: ctypes.CDLL):
    c = BoardInC(library, Mode.HOST)
    measured = firmware_models.random_measurement(np.random.default_rng(6))
    wire = FrameEncoder().encode(*messages.encode(measured))
    for _ in range(3):
        c.measure(wire, 5, read=False)
    sent = c.read(100)
    c.receive(FrameEncoder().encode(*messages.encode(MessageType.TIME_SYNC)), 70, read=False)
    c.measure(b"", 900, read=False)
    frames = FrameDecoder().feed(sent + c.read(1 << 16))

    # A part of the first frame was already sent.
    kinds = [MessageType.RANGE_CIR, MessageType.TIME_SYNC_REPLY, MessageType.RANGE_CIR, MessageType.RANGE_CIR]
    assert [frame.type for frame in frames] == kinds
    assert [frame.sequence for frame in frames] == [1, 2, 3, 4]
    reply = messages.decode(frames[1].type, frames[1].payload)
    assert (reply.received_us, frames[1].time_us) == (70, 900)


def test_damage_on_the_side_of_the_radio_is_logged(library: ctypes.CDLL):
    c = BoardInC(library, Mode.HOST)
    assert c.measure(b"\0\x05ab\0", 5) == b""
    status, log = FrameDecoder().feed(c.tick(1_000_000))
    assert status.type == MessageType.STATUS
    assert b"radio" in log.payload
    assert len(FrameDecoder().feed(c.tick(2_000_000))) == 1
