"""Ranging between the PyPI package `dw1000-spi` and the firmware on modelled chips: two independent drivers.

The exchange for the other driver is written here from the layout of the frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
from compilers import NEEDS_CC
from firmware_on_model import CLOCK, REPLY_US, begin, host, ranging, use_virtual_time

from benchmarks.equipment.dw1000_model.air import ANTENNA_DELAY_TICKS, Air, Host
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.radios.settings import RadioSettings, Role
from uwb_mitigation.types.measurement import RangeMeasurement

pytest.importorskip("spidev", reason="spidev is for Linux")
dw1000 = pytest.importorskip("dw1000_spi.dw1000", reason="the develop requirements bring dw1000-spi")

pytestmark = NEEDS_CC
OTHERS = 0x0123456789ABCDEF
POLL, ANSWER, FINAL, REPORT = 3, 4, 5, 6
TXSTRT, TXDLYS, WAIT4RESP = 2, 4, 0x80
WRAP, TICK_M = 1 << 40, 299_792_458 / (128 * 499.2e6)


SYSTEM_CALL_S = 60e-6
"""Approximate duration of a transaction with Python on a Raspberry Pi."""


class FakeSpiDev:
    """Replacement for `spidev.SpiDev`; the program that opens it determines the chip."""

    max_speed_hz = 0
    mode = 0

    def open(self, _bus: int, _select: int) -> None:
        self._host = host()

    def xfer2(self, data: list[int]) -> list[int]:
        self._host.delay(SYSTEM_CALL_S)
        return list(self._host.spi(bytes(data), self.max_speed_hz))

    def close(self) -> None:
        pass


def program(run: Callable[[dw1000.DW1000, Host], None]) -> Callable[[Host], None]:
    """Return a program that opens the driver and passes it to `run`."""

    def started(running: Host) -> None:
        begin(running)
        with dw1000.DW1000(0, 0, 5, 64, 6.8, 128, 9, False) as driver:
            driver.write_register([0x98], list(ANTENNA_DELAY_TICKS.to_bytes(2, "little")))
            driver.write_register([0xEE, 0x84, 0x30], list(ANTENNA_DELAY_TICKS.to_bytes(2, "little")))
            run(driver, running)

    return started


@pytest.fixture
def air(monkeypatch: pytest.MonkeyPatch) -> Iterator[Air]:
    monkeypatch.setattr(dw1000, "spidev", SimpleNamespace(SpiDev=FakeSpiDev))
    monkeypatch.setattr(dw1000, "time", CLOCK)
    use_virtual_time(monkeypatch)
    with Air(2) as air:
        yield air


def frame(
    kind: int, pan: int, to: int, numbers: tuple[int, int], stamps: tuple[int, ...] = (0, 0, 0)
) -> list[int]:
    """Return a frame with the layout of `firmware/src/uwb_twr_frame.c`."""
    head = b"\x41\xcc" + bytes((numbers[0] & 0xFF,)) + pan.to_bytes(2, "little")
    body = to.to_bytes(8, "little") + OTHERS.to_bytes(8, "little") + bytes((0x75, kind))
    body += b"".join(number.to_bytes(4, "little") for number in numbers)
    return list(head + body + b"".join(stamp.to_bytes(5, "little") for stamp in stamps))


def parsed(octets: list[int] | None) -> SimpleNamespace | None:
    data = bytes(octets or b"")
    if len(data) != 46 or data[:2] != b"\x41\xcc":
        return None

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], "little")

    ids = {"pan": number(3, 2), "source": number(13, 8), "tag": number(23, 4), "anchor": number(27, 4)}
    return SimpleNamespace(**ids, kind=data[22], stamps=tuple(number(31 + 5 * k, 5) for k in range(3)))


def await_kind(driver: dw1000.DW1000, kind: int, seconds: float) -> tuple[SimpleNamespace, int] | None:
    data, stamp = driver.listen(True, seconds)
    heard = parsed(data)
    return None if heard is None or heard.kind != kind else (heard, stamp)


@pytest.mark.parametrize("distance_m", [2.0, 40.0])
def test_tag_ranges_with_an_independent_anchor(air: Air, distance_m: float):
    tag, anchor = air.chip(ppm=12.0, clock_ticks=WRAP - 10**9), air.chip(ppm=-9.0)
    air.set_pair(tag, anchor, Pair(distance_m, excess_m=0.5))
    ranges: list[RangeMeasurement] = []

    def attend(driver: dw1000.DW1000, host: Host) -> None:
        while host.now() < 0.3:
            polled = await_kind(driver, POLL, 0.05)
            if polled is None:
                continue
            poll, poll_received = polled
            numbers = (poll.tag, 0x5EED)
            _, answered = driver.transmit(frame(ANSWER, poll.pan, poll.source, numbers), ranging=True)
            final = await_kind(driver, FINAL, 0.02)
            if final is not None and (final[0].tag, final[0].anchor) == numbers:
                stamps = (poll_received, answered, final[1])
                driver.transmit(frame(REPORT, poll.pan, poll.source, numbers, stamps), ranging=False)

    air.program(tag, ranging(RadioSettings(anchors=(OTHERS,)), ranges, 0.3))
    air.program(anchor, program(attend))
    air.run(1.0)
    assert len(ranges) > 5
    assert {measured.anchor_id for measured in ranges} == {OTHERS}
    found = [measured.range_m for measured in ranges]
    assert sum(found) / len(found) == pytest.approx(distance_m + 0.5, abs=0.005)
    assert max(found) - min(found) < 0.02
    assert all(len(measured.cir) == 157 for measured in ranges)


def test_anchor_ranges_with_an_independent_tag(air: Air):
    """The package cannot send with a delay or receive immediately after sending: write SYS_CTRL and DX_TIME."""
    tag, anchor = air.chip(ppm=-15.0), air.chip(ppm=15.0, clock_ticks=WRAP - 10**9)
    air.set_pair(tag, anchor, Pair(12.5))
    own = 0xA000000000000001
    found: list[float] = []

    def ask(
        driver: dw1000.DW1000, host: Host, data: list[int], command: int
    ) -> tuple[SimpleNamespace | None, int]:
        driver.write_register([0x8F], [0xFF] * 4)
        driver.write_register([0x89], data)
        driver.write_register([0x88], [len(data) + 2])
        driver.write_register([0x8D], [command])
        until = host.now() + 0.02
        while host.now() < until:
            if driver.packet_available():
                heard, stamp = driver.receive_packet()
                return parsed(heard), stamp
        driver.disable_rx_tx()
        return None, 0

    def sent(driver: dw1000.DW1000) -> int:
        return int.from_bytes(bytes(driver.read_register([0x17], 5, return_ints=True)), "little")

    def range_to(driver: dw1000.DW1000, host: Host) -> None:
        pan = RadioSettings().pan
        for turn in range(8):
            host.delay(20e-3)
            number = 0x7A600000 + turn
            poll = frame(POLL, pan, own, (number, 0), (REPLY_US, 0, 0))
            answer, answered = ask(driver, host, poll, TXSTRT | WAIT4RESP)
            if answer is None or answer.kind != ANSWER:
                continue
            leaves = (answered + REPLY_US * 63898) % WRAP & ~511
            stamps = (sent(driver), answered, (leaves + ANTENNA_DELAY_TICKS) % WRAP)
            driver.write_register([0x8A], list(leaves.to_bytes(5, "little")))
            final = frame(FINAL, pan, own, (number, answer.anchor), stamps)
            report, _ = ask(driver, host, final, TXSTRT | TXDLYS | WAIT4RESP)
            if report is None or report.kind != REPORT:
                continue
            assert sent(driver) == stamps[2]
            their = report.stamps
            round_1, reply_2 = (stamps[1] - stamps[0]) % WRAP, (stamps[2] - stamps[1]) % WRAP
            reply_1, round_2 = (their[1] - their[0]) % WRAP, (their[2] - their[1]) % WRAP
            flight = (round_1 * round_2 - reply_1 * reply_2) / (round_1 + round_2 + reply_1 + reply_2)
            found.append(flight * TICK_M)

    air.program(anchor, ranging(RadioSettings(role=Role.ANCHOR, address=own), [], 0.3))
    air.program(tag, program(range_to))
    air.run(1.0)
    assert len(found) >= 6
    assert sum(found) / len(found) == pytest.approx(12.5, abs=0.005)
