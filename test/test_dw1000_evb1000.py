"""Modelled chips behind the EVB1000's USB-to-SPI protocol: the protocol, the ports, and ranging in wall-clock time."""

from __future__ import annotations

import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import serial
from compilers import NEEDS_CC
from dw1000_driver import DATA, HPDWARN, RXFCG, TICK_M, TICK_S, TXFRS, TXPUTE, WRAP, Driver

from benchmarks.dw1000_model.evb1000 import EmulatedEvb1000s
from benchmarks.dw1000_model.usb2spi import FAST_HZ, SLOW_HZ, STALE, Bridge
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.sources.simulated import SimulatedSource

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

    @pytest.mark.parametrize("size", [1, 7, 64, 1000])
    def test_requests_may_come_in_any_pieces(self, bridge: Bridge, size: int):
        for sent, answer in (
            (request(b"\x00", read=2), b"\x02\x00\x01\x02\x03"),
            (request(b"\x89", write=bytes(120)), b"\x02\x00\x03"),
        ):
            pieces = (sent[at : at + size] for at in range(0, len(sent), size))
            assert [a for piece in pieces for a in bridge.receive(piece)] == [answer]

    def test_any_octets_in_any_order_do_no_harm(self, bridge: Bridge):
        random = np.random.default_rng(5)
        for _ in range(300):
            data = random.choice([0, 2, 3, 7, 8, 100, 255], int(random.integers(1, 60))).astype(np.uint8)
            bridge.receive(data.tobytes())
        bridge.receive(b"deca?")
        assert bridge.receive(b"deca?") == [ANSWER]


class UsbHost:
    """A computer with an EVB1000 at a port: a `Host` in wall-clock time."""

    def __init__(self, port: str) -> None:
        self.port = serial.Serial(port, timeout=PATIENCE_S)

    def spi(self, out: bytes, hz: int) -> bytes:
        header = 1 if not out[0] & 0x40 else 2 if not out[1] & 0x80 else 3
        if out[0] & 0x80:
            self.port.write(request(out[:header], write=out[header:], fast=hz > 3e6))
            assert self.port.read(3) == b"\x02\x00\x03"
            return bytes(len(out))
        count = len(out) - header
        self.port.write(request(out[:header], read=count, fast=hz > 3e6))
        answer = self.port.read(count + 3)
        assert answer[:2] == b"\x02\x00"
        assert answer[-1] == 3
        return out[:header] + answer[2:-1]

    def reset_pin(self) -> None:
        """The bridge has no reset: a soft one."""
        low = Driver(self)
        low.hz = 2_000_000
        low.set(0x36, 0, 0x01, 1)
        low.set(0x36, 3, 0x00, 1)
        low.set(0x36, 3, 0xF0, 1)
        low.set(0x36, 0, 0x00, 1)

    def irq(self) -> bool:
        return bool(Driver(self).status & 1)

    def wait(self, at_most_s: float) -> None:
        raise NotImplementedError("no interrupt line")

    def delay(self, seconds: float) -> None:
        time.sleep(seconds)

    def now(self) -> float:
        return time.monotonic()

    def close(self) -> None:
        self.port.close()


def until(driver: Driver, bits: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not driver.status & bits:
        assert time.monotonic() < deadline


@pytest.fixture
def boards() -> Iterator[EmulatedEvb1000s]:
    with EmulatedEvb1000s(boards=2) as boards:
        yield boards


def measure(a: Driver, b: Driver, reply_s: float) -> float | None:
    """One range, m; None where a reply was too late."""
    reply = round(reply_s / TICK_S)
    b.listen()
    a.send(b"poll")
    until(b, RXFCG)
    t2 = b.rx_stamp
    a.listen()
    b.send_at(b"answer", t2 + reply)
    if b.status & (HPDWARN | TXPUTE):
        return None
    until(a, RXFCG)
    t1, t4 = a.tx_stamp, a.rx_stamp
    t3 = b.tx_stamp
    b.listen()
    a.send_at(b"final", t4 + reply)
    if a.status & (HPDWARN | TXPUTE):
        return None
    until(b, RXFCG)
    t5, t6 = a.tx_stamp, b.rx_stamp
    round_1, reply_2, reply_1, round_2 = ((y - x) % WRAP for x, y in ((t1, t4), (t4, t5), (t2, t3), (t3, t6)))
    return TICK_M * (round_1 * round_2 - reply_1 * reply_2) / (round_1 + round_2 + reply_1 + reply_2)


def test_two_boards_range(boards: EmulatedEvb1000s):
    hosts = [UsbHost(port) for port in boards.ports]
    a, b = (Driver(host) for host in hosts)
    for driver in (a, b):
        driver.start()
    # A busy computer answers late.
    for reply_s in (0.05, 0.2, 0.8, 3.2):
        measured = measure(a, b, reply_s)
        if measured is not None:
            break
        for driver in (a, b):
            driver.off()
            driver.reset_receiver()
    assert measured == pytest.approx(3.0, abs=0.01)
    assert len(b.accumulator(0, 1016)) == 4064
    for host in hosts:
        host.close()


def test_an_answer_takes_the_round_trip_and_time_passes_as_on_the_wall():
    with EmulatedEvb1000s(boards=2, round_trip_s=20e-3) as boards:
        host = UsbHost(boards.ports[0])
        driver = Driver(host)
        began, first = time.monotonic(), driver.time
        took = [-time.monotonic() + (driver.time, time.monotonic())[1] for _ in range(10)]
        ended, second = time.monotonic(), driver.time
        assert min(took) >= 20e-3
        passed = (second - first) % WRAP * TICK_S
        assert passed == pytest.approx(ended - began, abs=5.0)
        assert passed >= statistics.median(took) * 10
        host.close()


def test_links_come_from_the_source():
    source = SimulatedSource(seed=1, rate_hz=20.0)
    first = next(iter(source))
    with EmulatedEvb1000s(source, boards=2, rate_hz=0.1) as boards:
        hosts = [UsbHost(port) for port in boards.ports]
        a, b = (Driver(host) for host in hosts)
        a.start()
        b.start()
        deadline = time.monotonic() + PATIENCE_S
        while True:
            b.listen()
            a.send(DATA)
            until(a, TXFRS)
            if b.status & RXFCG:
                break
            b.off()
            assert time.monotonic() < deadline
        samples = np.frombuffer(b.accumulator(0, 1016), "<i2")
        assert np.array_equal(samples, first.measurement.cir.samples)
        for host in hosts:
            host.close()


def test_a_board_that_is_unplugged_is_gone_and_comes_back_anew(boards: EmulatedEvb1000s, tmp_path: Path):
    host = UsbHost(boards.ports[1])
    driver = Driver(host)
    driver.set(0x18, 0, 16436, 2)
    boards.unplug(1)
    assert boards.ports[1] == ""
    with pytest.raises((serial.SerialException, OSError, AssertionError)):
        driver.get(0x18, 0, 2)
    host.close()
    boards.plug(1)
    host = UsbHost(boards.ports[1])
    host.port.write(b"deca?")
    assert host.port.read(22) == ANSWER
    time.sleep(5e-3)
    assert Driver(host).get(0x18, 0, 2) == 0
    host.close()


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


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--boards", "1"], "boards = 1"),
        (["--ranging", "5"], "ranging = [5]"),
        (["--duration", "0"], "duration"),
    ],
)
def test_the_command_refuses_in_one_line(options: list[str], told: str):
    command = [sys.executable, "-m", "benchmarks", "emulate-evb1000", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 1
    assert told in done.stderr
    assert len(done.stderr.splitlines()) == 1
