"""Modelled chips behind the EVB1000's USB-to-SPI protocol: the protocol, the ports, and ranging in wall-clock time."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import serial
from compilers import NEEDS_CC

from benchmarks.dw1000_model.evb1000 import EmulatedEvb1000s
from benchmarks.dw1000_model.usb2spi import FAST_HZ, SLOW_HZ, STALE, Bridge
from uwb_mitigation.errors import ParameterError

pytestmark = NEEDS_CC

PATIENCE_S = 240
ANSWER = b"yEVB1000 USB2SPI 2.0\0" + STALE


def request(header: bytes, *, write: bytes = b"", read: int = 0, fast: bool = True, end: int = 3) -> bytes:
    flags = bool(write) | fast << 1
    total = 7 + len(header) + len(write)
    body = bytes((2, flags)) + total.to_bytes(2, "little") + (len(write) or read).to_bytes(2, "little")
    return body + header + write + bytes((end,))


class TestBridge:
    @pytest.fixture
    def seen(self) -> list[tuple[bytes, int]]:
        return []

    @pytest.fixture
    def bridge(self, seen: list[tuple[bytes, int]]) -> Bridge:
        def spi(out: bytes, hz: int) -> bytes:
            seen.append((out, hz))
            return bytes(octet & 255 for octet in range(len(out)))

        return Bridge(spi)

    def test_a_read_gives_status_and_data(self, bridge: Bridge, seen: list[tuple[bytes, int]]):
        assert bridge.receive(request(b"\x40\x01", read=3)) == [bytes((2, 0, 2, 3, 4, 3))]
        assert seen == [(b"\x40\x01" + bytes(3), FAST_HZ)]

    def test_a_write_gives_a_status(self, bridge: Bridge, seen: list[tuple[bytes, int]]):
        assert bridge.receive(request(b"\x84", write=b"ab", fast=False)) == [b"\x02\x00\x03"]
        assert seen == [(b"\x84ab", SLOW_HZ)]

    def test_the_question_is_answered(self, bridge: Bridge):
        assert bridge.receive(b"deca?") == [ANSWER]
        assert bridge.receive(b"de") + bridge.receive(b"ca?") == [ANSWER]

    @pytest.mark.parametrize(
        "stray", [b"AT", b"AT\r\n", b"ATZ\rATE1\r", request(b"\x00", read=4)[:-1], bytes(200)]
    )
    def test_after_stray_octets_the_first_question_is_ignored(self, bridge: Bridge, stray: bytes):
        assert bridge.receive(stray) == []
        assert bridge.receive(request(b"\x00", read=1)) == [], "they stay in the buffer"
        assert bridge.receive(b"deca?") == []
        assert bridge.receive(b"deca?") == [ANSWER]
        assert bridge.receive(request(b"\x00", read=1)) == [b"\x02\x00\x01\x03"]

    def test_in_ranging_mode_it_says_so_and_no_more(self):
        bridge = Bridge(lambda out, _: out, ranging=True)
        assert bridge.receive(b"deca?") == [b"n" + ANSWER[1:]]
        assert bridge.receive(request(b"\x00", read=4)) == []

    def test_a_wrong_end_is_refused_and_nothing_is_done(self, bridge: Bridge, seen: list[tuple[bytes, int]]):
        # A read that fails has the length of one that succeeds.
        assert bridge.receive(request(b"\x00", read=4, end=4)) == [b"\x02\x01" + bytes(4) + b"\x03"]
        assert bridge.receive(request(b"\x84", write=b"ab", end=4)) == [b"\x02\x01\x03"]
        assert not seen

    @pytest.mark.parametrize("length", [0, 5, 6, 7, 300, 65535])
    def test_a_request_of_another_length_than_it_says_is_waited_for(
        self, bridge: Bridge, seen: list[object], length: int
    ):
        bad = b"\x02\x02" + length.to_bytes(2, "little") + b"\x04\x00" + b"\x00\x03"
        assert bridge.receive(bad) == []
        assert not seen

    def test_more_than_4093_octets_are_not_read(self, bridge: Bridge):
        (whole,) = bridge.receive(request(b"\x25", read=4065))
        assert len(whole) == 4068
        (refused,) = bridge.receive(request(b"\x25", read=4094))
        assert (refused[:2], len(refused)) == (b"\x02\x01", 4097)

    def test_any_octets_in_any_order_do_no_harm(self, bridge: Bridge):
        random = np.random.default_rng(5)
        for _ in range(300):
            data = random.choice([0, 2, 3, 7, 8, 100, 255], int(random.integers(1, 60))).astype(np.uint8)
            bridge.receive(data.tobytes())
        bridge.receive(b"deca?")
        assert bridge.receive(b"deca?") == [ANSWER]


def test_ports_have_links_and_replace_no_file(tmp_path: Path):
    with EmulatedEvb1000s(boards=2, port_links=tmp_path / "evb") as boards:
        assert [str((tmp_path / f"evb{n}").readlink()) for n in (0, 1)] == list(boards.ports)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "evb1").write_text("mine")
    with pytest.raises(ParameterError, match="evb1"):
        EmulatedEvb1000s(boards=2, port_links=tmp_path / "evb")
    assert (tmp_path / "evb1").read_text() == "mine"


@pytest.mark.parametrize(
    "arguments", [{"boards": 1}, {"boards": 34}, {"rate_hz": 0.0}, {"round_trip_s": -1.0}, {"loss": 1.5}]
)
def test_arguments_out_of_range_are_refused_by_name(arguments: dict[str, float]):
    with pytest.raises(ParameterError, match=next(iter(arguments))):
        EmulatedEvb1000s(**arguments)  # type: ignore[arg-type]


def test_the_command_prints_its_ports_unplugs_on_a_signal_and_ends(tmp_path: Path):
    command = [
        sys.executable,
        "-m",
        "benchmarks",
        "emulate-evb1000",
        "--boards",
        "3",
        "--ranging",
        "2",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline().split(" at ") for _ in range(3)]
        assert [what for what, _ in lines] == ["tag", "anchor 1", "anchor 2"]
        with serial.Serial(lines[2][1].strip(), timeout=PATIENCE_S) as port:
            port.write(b"deca?")
            assert port.read(1) == b"n"
        process.send_signal(signal.SIGUSR1)
        assert process.stdout.readline().startswith("board 0 plugged in again at /dev/")
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(PATIENCE_S) == 130
        finally:
            process.kill()
