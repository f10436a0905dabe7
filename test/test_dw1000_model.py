"""The DW1000 model as a library, and its reactions to driver errors.

`test_radio_exchange.py` tests frames, timestamps and accumulators with the firmware.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from compilers import NEEDS_CC

from benchmarks.equipment.dw1000_model.air import ANTENNA_DELAY_TICKS, Air, Chip
from benchmarks.equipment.dw1000_model.library import MODEL_FOLDER, model_objects
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.mitigation.embedded.compiling import WARNINGS, c_compiler, run_tool

pytestmark = NEEDS_CC

ID = bytes.fromhex("3001cade")
SLOW_HZ, FAST_HZ = 2_000_000, 16_000_000
WRAP, TICK_M = 1 << 40, 299_792_458 / (128 * 499.2e6)
TXSTRT, RXENAB = 2, 0x100
CPLOCK, RXPHE, RXFCG, RXRFTO = (1 << bit for bit in (1, 12, 14, 17))


class Driver:
    """Registers and sequences of a DW1000 on channel 5 with 64 MHz, 6.8 Mbit/s and 128 symbols, from the user manual."""

    def __init__(self, chip: Chip) -> None:
        self.chip, self.hz = chip, FAST_HZ

    def read(self, file: int, sub: int = 0, octets: int = 4) -> bytes:
        header = self._header(file, sub)
        return self.chip.spi(header + bytes(octets), self.hz)[len(header) :]

    def get(self, file: int, octets: int = 4) -> int:
        return int.from_bytes(self.read(file, 0, octets), "little")

    def set(self, file: int, sub: int, value: int, octets: int = 4) -> None:
        self.write(file, sub, value.to_bytes(octets, "little"))

    def write(self, file: int, sub: int, data: bytes) -> None:
        self.chip.spi(self._header(0x80 | file, sub) + data, self.hz)

    def _header(self, file: int, sub: int) -> bytes:
        if sub == 0:
            return bytes([file])
        return bytes([0x40 | file, sub] if sub < 0x80 else [0x40 | file, 0x80 | (sub & 0x7F), sub >> 7])

    @property
    def status(self) -> int:
        return self.get(0x0F, 5)

    def start(self) -> None:
        """Reset and configure."""
        self.hz = SLOW_HZ
        self.chip.reset_pin()
        self.chip.delay(5e-3)
        assert self.read(0x00) == ID
        self.set(0x36, 0, 0x0301, 2)
        self.set(0x2D, 6, 0x8000, 2)
        self.chip.delay(150e-6)
        self.set(0x36, 0, 0x0200, 2)
        self.chip.delay(1e-3)
        self.hz = FAST_HZ
        self.configure()
        self.set(0x18, 0, ANTENNA_DELAY_TICKS, 2)
        self.set(0x2E, 0x1804, ANTENNA_DELAY_TICKS, 2)

    def configure(self, long_frames: bool = False) -> None:
        self.set(0x1F, 0, 0x55 | 2 << 18 | 9 << 22 | 9 << 27)
        self.set(0x2B, 7, 0x0800041D)
        self.set(0x27, 8, 0x313B006B)  # acquisition chunks of 8 symbols
        self.set(0x27, 0x20, 129, 2)
        self.set(0x2E, 0x0806, 0x6D, 1)
        self.set(0x04, 0, 0x1200 | (3 if long_frames else 0) << 16)

    def listen(self) -> None:
        self.set(0x0D, 0, RXENAB)

    def send(self, data: bytes) -> None:
        """Send immediately, without waiting for the end."""
        self.write(0x09, 0, data)
        self.set(0x08, 0, 2 << 13 | 0x8000 | 2 << 16 | 0x5 << 18 | (len(data) + 2))
        self.set(0x0D, 0, TXSTRT)


def exchange(sender: Driver, receiver: Driver) -> tuple[int, float]:
    """Send a frame; return the status of the receiver, and the difference of the stamps as distance."""
    receiver.listen()
    receiver.chip.delay(20e-6)
    sender.send(bytes.fromhex("4188") + b"\x07payload")
    sender.chip.delay(6e-3)
    ticks = (receiver.get(0x15, 5) - sender.get(0x17, 5) + WRAP // 2) % WRAP - WRAP // 2
    return receiver.status, ticks * TICK_M


@pytest.fixture
def driver(air: Air) -> Driver:
    return Driver(air.chip())


def test_interrupt_line_is_status_and_mask_with_its_polarity(driver: Driver):
    assert not driver.chip.irq()
    driver.set(0x0E, 0, CPLOCK)
    assert driver.chip.irq()
    assert driver.status & 1
    driver.set(0x04, 0, 0x1000)
    assert not driver.chip.irq(), "active low"
    driver.set(0x0F, 0, CPLOCK)
    assert driver.chip.irq()


def test_spi_faster_than_3_mhz_before_the_pll_lock_reads_garbage(driver: Driver):
    driver.set(0x36, 0, 0x01, 1)
    seen = {driver.read(0x00) for _ in range(8)}
    assert ID not in seen
    assert len(seen) > 1, "random, not an error"
    driver.hz = SLOW_HZ
    assert driver.read(0x00) == ID
    driver.set(0x36, 0, 0x00, 1)
    driver.chip.delay(10e-6)
    driver.hz = FAST_HZ
    assert driver.read(0x00) == ID


@pytest.mark.parametrize("error", ["header", "time-out"])
def test_without_a_receiver_reset_after_an_error_the_next_stamp_is_wrong(air: Air, error: str):
    chips = air.chip(), air.chip()
    air.set_pair(*chips, Pair(3.0))
    sender, receiver = map(Driver, chips)
    sender.start()
    receiver.start()

    def fail() -> None:
        if error == "header":
            receiver.configure(long_frames=True)
            assert exchange(sender, receiver)[0] & RXPHE
            receiver.configure()
        else:
            receiver.set(0x0C, 0, 100, 2)
            receiver.set(0x04, 0, receiver.get(0x04) | 1 << 28)
            receiver.listen()
            receiver.chip.delay(1e-3)
            assert receiver.status & RXRFTO
            receiver.set(0x04, 0, receiver.get(0x04) & ~(1 << 28))

    fail()
    status, range_m = exchange(sender, receiver)
    assert status & RXFCG
    assert abs(range_m - 3.0) > 1.0
    fail()
    for value in (0xE0, 0xF0):
        receiver.set(0x36, 3, value, 1)
    status, range_m = exchange(sender, receiver)
    assert status & RXFCG
    assert range_m == pytest.approx(3.0, abs=TICK_M)


def test_driver_may_define_any_name_without_the_prefix_of_the_model():
    defined = run_tool(["nm", "-g", "--defined-only", "-P", *model_objects()]).splitlines()
    names = [line.split()[0] for line in defined if not line.endswith(":")]
    assert len(names) > 50
    assert [name for name in names if not name.startswith("dw1000_")] == []


def test_program_on_the_page_prints_the_shown_output(tmp_path: Path):
    page = (MODEL_FOLDER / "README.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    (promise,) = re.findall(r"prints `(.*?)` twice", page)
    source = tmp_path / "blink.c"
    source.write_text(text, encoding="utf-8")
    program, sources = str(tmp_path / "blink"), (*MODEL_FOLDER.glob("*.c"), source)
    options = ("-std=c11", "-O1", "-g", "-fsanitize=address,undefined", *WARNINGS, f"-I{MODEL_FOLDER}")
    run_tool([*c_compiler(), *options, *map(str, sources), "-lm", "-lpthread", "-o", program])
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [promise] * 2
