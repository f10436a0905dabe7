"""Local radios: emulated EVB1000s with their USB-to-SPI protocol in real time, and spidev."""

import contextlib
import errno
import itertools
import os
import re
import sys
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial
from compilers import NEEDS_CC
from conftest import REPOSITORY
from port_events import PortEvents, terminal, wait_until

from benchmarks.equipment.dw1000_model.air import Air, Chip
from benchmarks.equipment.dw1000_model.evb1000 import ROUND_TRIP_S, EmulatedEvb1000s
from uwb_mitigation.errors import LinkError, MissingDependencyError, ParameterError
from uwb_mitigation.radios import evb1000
from uwb_mitigation.radios import spi as spidev_bus
from uwb_mitigation.radios.dw1000.native import NativeRadio
from uwb_mitigation.radios.dw1000.port import ChipSettings
from uwb_mitigation.radios.evb1000 import Evb1000Bus
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.settings import RadioSettings, RadioState, Role
from uwb_mitigation.radios.spi import SpidevBus
from uwb_mitigation.types.measurement import RangeMeasurement

pytestmark = NEEDS_CC

GENEROUS_S = 120.0


def bus(path: object) -> Callable[[], Evb1000Bus]:
    return lambda: Evb1000Bus(PortAddress.parse(str(path)))


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[EmulatedEvb1000s, Path]]:
    prefix = tmp_path_factory.mktemp("ports with spaces") / "radio"
    with EmulatedEvb1000s(None, boards=2, port_links=prefix) as emulated:
        yield emulated, prefix


def settings(path: object, **radio: object) -> ChipSettings:
    return ChipSettings(str(path), RadioSettings(**radio))


def test_tag_and_anchor_on_usb_recover_from_unplugging(boards: tuple[EmulatedEvb1000s, Path]):
    emulated, prefix = boards
    pair = settings(f"{prefix}0"), settings(f"{prefix}1", role=Role.ANCHOR)
    with PortEvents(evb1000, *pair) as events:
        tag, anchor = events.ports
        for measured in events.wait_for(RangeMeasurement, 10):
            assert abs(measured.range_m - 3) < 0.05
            assert (measured.tag_id, measured.anchor_id) == (tag.settings.address, anchor.settings.address)
            assert len(measured.cir) == 157
            assert abs(time.time_ns() - measured.stamp_ns) < GENEROUS_S * 1e9
        assert (tag.settings.antenna_delay, tag.settings.reply_us) == (2 * 16436, 16_500)
        wait_until(lambda: tag.problem == "")

        taken: list[int] = []
        # USB requests of 0.4 s and the pause before a retry restart a radio within a second. A busy computer
        # exceeds the timeout of a request and needs more than one try.
        while len(taken) < 10 and not (taken and taken[-1] < 0.4 / ROUND_TRIP_S):
            emulated.unplug(0)
            wait_until(lambda: "radio0" in tag.problem and "is not there" in tag.problem)
            before = emulated.requests[0]
            emulated.plug(0)
            wait_until(lambda: tag.settings is not None)
            taken.append(emulated.requests[0] - before)
        assert 50 < min(taken) < 0.4 / ROUND_TRIP_S
        events.wait_for(RangeMeasurement, 2)

        openings = anchor.openings
        emulated.unplug(1)
        wait_until(lambda: "is not there" in anchor.problem)
        before = tag.status
        wait_until(lambda: tag.status.no_answer > before.no_answer)
        wait_until(lambda: tag.status.state is RadioState.RUNNING)
        silent = "no range for.*no answer: no anchor answers"
        wait_until(lambda: re.search(silent, tag.report().warning, re.DOTALL))
        emulated.plug(1)
        events.wait_for(RangeMeasurement, 2)
        assert anchor.openings > openings
        wait_until(lambda: not tag.report().warning)


def test_board_that_modem_manager_has_written_to_is_opened(boards: tuple[EmulatedEvb1000s, Path]):
    _, prefix = boards
    with serial.Serial(f"{prefix}1") as port:
        port.write(b"AT+GCAP\r")
    with contextlib.closing(bus(f"{prefix}1")()) as opened:
        assert opened.version == "EVB1000 USB2SPI 2.0"
        assert opened.transfer(b"\x00", None, 4) == bytes.fromhex("3001cade")


def test_modem_manager_ignores_the_boards():
    rules = (REPOSITORY / "udev" / "60-uwb-mitigation.rules").read_text(encoding="utf-8")
    ignored = [line for line in rules.splitlines() if 'ENV{ID_MM_DEVICE_IGNORE}="1"' in line]
    for vendor, product in (("0483", "5740"), ("2341", "805a")):
        matches = (f'ATTRS{{idVendor}}=="{vendor}"', f'ATTRS{{idProduct}}=="{product}"')
        assert any(all(match in line for match in matches) for line in ignored), vendor


@pytest.mark.parametrize("damage", [b"\x55", b"\x02", b"\x55" * 9])
@pytest.mark.parametrize("position", [0, 3, 100])
def test_stray_octets_in_an_answer_repeat_the_request(damage: bytes, position: int, monkeypatch):
    # No answer is too short; on a busy machine, one could be late.
    monkeypatch.setattr(evb1000, "ANSWER_TIMEOUT_S", 30.0)
    monkeypatch.setattr(evb1000, "REPEATED_TIMEOUT_S", 30.0)
    answers = {b"deca?": b"yEVB1000 USB2SPI 2.0\0"}
    remaining = [2]

    def answer(request: bytes) -> bytes:
        good = answers.get(request, b"\x02\x00" + bytes.fromhex("3001cade") + b"\x03")
        if request in answers or not remaining[0]:
            return good
        remaining[0] -= 1
        return good[:position] + damage + good[position:]

    with terminal(answer) as name, contextlib.closing(bus(name)()) as board:
        assert board.transfer(b"\x00", None, 4) == bytes.fromhex("3001cade")
        assert remaining == [0]
        assert board.transfer(b"\x00", None, 4) == bytes.fromhex("3001cade")
        remaining[0] = 3
        with pytest.raises(LinkError, match=r"the board answered|received"):
            board.transfer(b"\x00", None, 4)


def test_board_in_standalone_mode_is_reported_with_the_switch_to_change():
    with (
        EmulatedEvb1000s(None, boards=2, ranging=frozenset({0})) as emulated,
        pytest.raises(LinkError, match=r"is in ranging mode .*S1-3 off"),
    ):
        bus(emulated.ports[0])()


def test_other_usb_device_is_reported(tmp_path: Path):
    with pytest.raises(LinkError, match=r"nowhere: is not there \(plug"):
        bus(tmp_path / "nowhere")()
    (tmp_path / "file").write_text("")
    with pytest.raises(LinkError, match="cannot be opened"):
        bus(tmp_path / "file")()
    for answer, problem in ((None, "does not answer deca"), (lambda _: b"\x02\x05\0", "answers .* to deca")):
        with terminal(answer) as name, pytest.raises(LinkError, match=problem):
            bus(name)()


class FakeSpi:
    """`spidev.SpiDev` on a modelled chip in real time."""

    air: Air | None = None

    def open(self, number: int, select: int) -> None:
        if number:
            raise FileNotFoundError(2, "No such file or directory")
        self.air = Air(1)
        self.began = time.monotonic()
        self.chip = self.air.chip()

    def xfer2(self, octets: list[int]) -> list[int]:
        late = time.monotonic() - self.began - self.chip.now()
        if late > 0:
            self.air.run(late)
        return list(self.chip.spi(bytes(octets), self.max_speed_hz))

    def close(self) -> None:
        if self.air is not None:
            self.air.close()


class FakeGpio:
    """The kernel interface of a GPIO line at the RSTn pin of a modelled chip (linux/gpio.h, version 1)."""

    INPUT, OUTPUT, OPEN_DRAIN = 1, 2, 8
    GET_LINE = 0xC16CB403
    O_RDWR, O_CLOEXEC = os.O_RDWR, os.O_CLOEXEC

    def __init__(self) -> None:
        self.chip: Chip | None = None
        self.requests: list[tuple[int, int]] = []
        self._held: dict[int, int] = {}
        self._free = itertools.count(1000)

    def open(self, path: str, flags: int) -> int:
        assert path == "/dev/gpiochip0"
        return next(self._free)

    def ioctl(self, fd: int, request: int, octets: bytearray) -> None:
        assert request == self.GET_LINE
        line, flags, value = octets[0], int.from_bytes(octets[256:260], "little"), octets[260]
        if line == 7 or self._held:
            raise OSError(errno.EBUSY, "Device or resource busy")
        self.requests.append((line, flags))
        handle = next(self._free)
        self._held[handle] = flags
        octets[-4:] = handle.to_bytes(4, "little")
        if self.chip is not None and flags & self.OUTPUT:
            assert flags & self.OPEN_DRAIN or value == 0, "a level that is driven must not be high"
            self.chip.reset_drive(0)

    def close(self, fd: int) -> None:
        flags = self._held.pop(fd, 0)
        if self.chip is not None and flags & self.OUTPUT:
            self.chip.reset_drive(1)


def test_reset_line_is_pulled_low_and_never_driven_high(monkeypatch: pytest.MonkeyPatch):
    gpio = FakeGpio()
    monkeypatch.setitem(sys.modules, "spidev", types.SimpleNamespace(SpiDev=FakeSpi))
    for name in ("os", "fcntl"):
        monkeypatch.setattr(spidev_bus, name, gpio)
    spi = SpidevBus("/dev/spidev0.0", "gpiochip0:25")
    gpio.chip = spi._spi.chip
    assert spi.has_reset
    assert gpio.requests == [(25, gpio.INPUT)], "until then it floats"
    spi.speed(True)
    spi.transfer(b"\x98", b"\x34\x12", 0)
    assert spi.transfer(b"\x18", None, 2) == b"\x34\x12"
    radio = NativeRadio(spi, RadioSettings())
    try:
        wait_until(lambda: radio.exchange(0.1) or radio.address)
        low = (25, gpio.OUTPUT | gpio.OPEN_DRAIN)
        assert gpio.requests[:3] == [(25, gpio.INPUT), low, (25, gpio.INPUT)]
        assert gpio.chip.fault is None
        spi.reset()
        spi.speed(False)
        wait_until(lambda: spi.transfer(b"\x00", None, 4) == bytes.fromhex("3001cade"))
        assert spi.transfer(b"\x18", None, 2) == bytes(2), "a reset takes what was written"
    finally:
        radio.close()
        gpio.chip = None
        spi.close()
        spi.close()
    with pytest.raises(LinkError, match=r"gpiochip0.*line 7: .*busy.*an unused GPIO"):
        SpidevBus("/dev/spidev0.0", "gpiochip0:7")


def test_missing_spidev_requirements_are_reported(monkeypatch: pytest.MonkeyPatch):
    for device, reset in (("/dev/ttyACM0", ""), ("/dev/spidev0.0", "25")):
        with pytest.raises(ParameterError, match=r"SPI device|reset line"):
            SpidevBus(device, reset)
    monkeypatch.setitem(sys.modules, "spidev", types.SimpleNamespace(SpiDev=FakeSpi))
    with pytest.raises(LinkError, match="enable SPI"):
        SpidevBus("/dev/spidev1.0")
    monkeypatch.setitem(sys.modules, "spidev", None)
    with pytest.raises(MissingDependencyError, match="spidev is not installed"):
        SpidevBus("/dev/spidev0.0")
