"""The firmware on a modelled chip ranges with an anchor that runs the independent PyPI package `dw1000-spi`.

The exchange of the anchor is written here from the layout of the frames.
"""

import struct
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from compilers import NEEDS_CC
from firmware_on_model import CLOCK, begin, host, ranging, use_virtual_time

from benchmarks.equipment.dw1000_model.air import ANTENNA_DELAY_TICKS, Air, Host
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.radios.settings import RadioSettings
from uwb_mitigation.types.measurement import RangeMeasurement

pytest.importorskip("spidev", reason="spidev is for Linux")
dw1000 = pytest.importorskip("dw1000_spi.dw1000", reason="the develop requirements bring dw1000-spi")

pytestmark = NEEDS_CC
OTHERS = 0x0123456789ABCDEF
POLL, ANSWER, FINAL, REPORT = 3, 4, 5, 6
WRAP = 1 << 40
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


@pytest.fixture
def air(monkeypatch: pytest.MonkeyPatch) -> Iterator[Air]:
    monkeypatch.setattr(dw1000, "spidev", SimpleNamespace(SpiDev=FakeSpiDev))
    monkeypatch.setattr(dw1000, "time", CLOCK)
    use_virtual_time(monkeypatch)
    with Air(2) as air:
        yield air


FRAME = struct.Struct("<2s B H Q Q 2B 2I 15s")
"""Layout of `firmware/src/uwb_twr_frame.c`."""


def frame(kind: int, poll: SimpleNamespace, anchor: int, stamps: tuple[int, ...] = (0, 0, 0)) -> list[int]:
    ids = poll.tag & 0xFF, poll.pan, poll.source, OTHERS
    ticks = b"".join(stamp.to_bytes(5, "little") for stamp in stamps)
    return list(FRAME.pack(b"\x41\xcc", *ids, 0x75, kind, poll.tag, anchor, ticks))


def parsed(octets: list[int] | None) -> SimpleNamespace | None:
    data = bytes(octets or b"")
    if len(data) != FRAME.size or data[:2] != b"\x41\xcc":
        return None
    _, _, pan, _, source, _, kind, tag, anchor, _ = FRAME.unpack(data)
    return SimpleNamespace(pan=pan, source=source, kind=kind, tag=tag, anchor=anchor)


def test_tag_ranges_with_an_independent_anchor(air: Air):
    tag, anchor = air.chip(ppm=12.0, clock_ticks=WRAP - 10**9), air.chip(ppm=-9.0)
    air.set_pair(tag, anchor, Pair(40.0, excess_m=0.5))
    ranges: list[RangeMeasurement] = []

    def attend(host: Host) -> None:
        begin(host)
        with dw1000.DW1000(0, 0, 5, 64, 6.8, 128, 9, False) as driver:
            for register in ([0x98], [0xEE, 0x84, 0x30]):
                driver.write_register(register, list(ANTENNA_DELAY_TICKS.to_bytes(2, "little")))
            while host.now() < 0.3:
                octets, polled = driver.listen(True, 0.05)
                poll = parsed(octets)
                if poll is None or poll.kind != POLL:
                    continue
                _, answered = driver.transmit(frame(ANSWER, poll, 0x5EED), ranging=True)
                octets, finished = driver.listen(True, 0.02)
                final = parsed(octets)
                if final is not None and (final.kind, final.tag, final.anchor) == (FINAL, poll.tag, 0x5EED):
                    stamps = (polled, answered, finished)
                    driver.transmit(frame(REPORT, poll, 0x5EED, stamps), ranging=False)

    air.program(tag, ranging(RadioSettings(anchors=(OTHERS,)), ranges, 0.3))
    air.program(anchor, attend)
    air.run(1.0)
    assert len(ranges) > 5
    assert {measured.anchor_id for measured in ranges} == {OTHERS}
    found = [measured.range_m for measured in ranges]
    assert sum(found) / len(found) == pytest.approx(40.5, abs=0.005)
    assert max(found) - min(found) < 0.02
    assert all(len(measured.cir) == 157 for measured in ranges)
