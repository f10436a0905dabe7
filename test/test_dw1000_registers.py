"""The DW1000's model, by the manual: the serial interface, registers, resets, clocks, memories, sensors."""

from __future__ import annotations

import dw1000_driver as dw
import pytest
from compilers import NEEDS_CC
from dw1000_driver import Driver, exchange, pair

from benchmarks.dw1000_model.air import Air, Chip

pytestmark = NEEDS_CC

ID = bytes.fromhex("3001cade")


@pytest.fixture
def chip(air: Air) -> Chip:
    return air.chip()


@pytest.fixture
def driver(chip: Chip) -> Driver:
    return Driver(chip)


def test_a_powered_chip_is_idle_and_locked(driver: Driver):
    assert driver.status == dw.CPLOCK | dw.SLP2INIT


@pytest.mark.parametrize("header", [[0x00], [0x40, 0x00], [0x40, 0x80, 0x00]], ids=["1", "2", "3 octets"])
def test_a_header_has_one_to_three_octets(chip: Chip, header: list[int]):
    assert chip.spi(bytes([*header, 0, 0, 0, 0]), dw.FAST_HZ)[len(header) :] == ID


def test_a_sub_address_has_15_bits(driver: Driver):
    driver.set(0x2E, 0x2804, 0x3AE0, 2)
    assert driver.get(0x2E, 0x2804, 2) == 0x3AE0
    assert driver.get(0x2E, 0x2805, 1) == 0x3A
    assert driver.get(0x2E, 0x0004, 2) == 0xDEAD, "the 7 low bits alone are another register"


@pytest.mark.parametrize(
    ("file", "sub", "octets", "value"),
    [
        (0x00, 0x00, 4, 0xDECA0130),
        (0x03, 0x00, 4, 0xFFFFFFFF),
        (0x04, 0x00, 4, 0x1200),
        (0x08, 0x00, 5, 0x15400C),
        (0x1E, 0x00, 4, 0x1E080222),
        (0x1F, 0x00, 4, 0x21040055),
        (0x23, 0x12, 2, 0x0055),
        (0x27, 0x20, 2, 4161),
        (0x2B, 0x0E, 1, 0x60),
        (0x2E, 0x0806, 1, 0x6C),
        (0x36, 0x00, 4, 0xF0300200),
        (0x36, 0x04, 4, 0x81020738),
    ],
)
def test_a_reset_leaves_the_manuals_values(driver: Driver, file: int, sub: int, octets: int, value: int):
    driver.host.reset_pin()
    driver.host.delay(5e-3)
    assert driver.get(file, sub, octets) == value


def test_reserved_registers_read_0xdeaddead(driver: Driver):
    assert driver.get(0x02) == 0xDEADDEAD
    assert driver.get(0x28, 0x0C, 4) >> 24 == 0xDE, "RF_TXCTRL has three octets"


def test_a_write_in_pieces_is_a_write(driver: Driver):
    driver.set_by_octets(0x27, 0x08, 0x311A002D)
    assert driver.get(0x27, 0x08) == 0x311A002D
    driver.set(0x27, 0x0A, 0x371A, 2)
    assert driver.get(0x27, 0x08) == 0x371A002D


def test_what_is_read_only_stays(driver: Driver):
    driver.set(0x00, 0, 0)
    driver.set(0x15, 0, 0x1234, 5)
    assert driver.get(0x00) == 0xDECA0130
    assert driver.get(0x15, 0, 5) == 0


def test_ones_clear_status_octet_by_octet_and_zeros_do_not(driver: Driver):
    driver.set(0x0F, 0, 0x00, 1)
    driver.set(0x0F, 2, 0x80, 1)
    assert driver.status == dw.CPLOCK
    driver.set_by_octets(0x0F, 0, dw.CPLOCK, 5)
    assert driver.status == 0


def test_the_interrupt_line_is_status_and_mask_with_its_polarity(driver: Driver, chip: Chip):
    assert not chip.irq()
    driver.set(0x0E, 0, dw.CPLOCK)
    assert chip.irq()
    assert driver.status & 1
    driver.set(0x04, 0, 0x1000)
    assert not chip.irq(), "active low"
    driver.set(0x0F, 0, dw.CPLOCK)
    assert chip.irq()


def test_the_counter_runs_on_its_own_crystal_in_steps_of_512(air: Air):
    chip = air.chip(ppm=20.0, clock_ticks=(1 << 40) - 1000)
    driver = Driver(chip)
    began, first = chip.now(), driver.time
    chip.delay(1.0)
    ended, second = chip.now(), driver.time
    assert first % 512 == second % 512 == 0
    assert (second - first) % (1 << 40) == pytest.approx((ended - began) / dw.TICK_S * (1 + 20e-6), abs=600)


class TestClocks:
    def test_spi_that_is_too_fast_before_the_pll_has_locked_reads_garbage(self, driver: Driver):
        driver.set(0x36, 0, 0x01, 1)
        seen = {driver.read(0x00) for _ in range(8)}
        assert ID not in seen
        assert len(seen) > 1, "random, not an error"
        driver.hz = dw.SLOW_HZ
        assert driver.read(0x00) == ID
        driver.set(0x36, 0, 0x00, 1)
        driver.host.delay(10e-6)
        driver.hz = dw.FAST_HZ
        assert driver.read(0x00) == ID

    def test_what_is_written_too_fast_is_lost(self, driver: Driver):
        driver.set(0x36, 0, 0x01, 1)
        driver.set(0x18, 0, 0x1234, 2)
        driver.hz = dw.SLOW_HZ
        assert driver.get(0x18, 0, 2) == 0

    def test_no_spi_is_faster_than_20_mhz(self, driver: Driver):
        driver.hz = 25_000_000
        assert driver.read(0x00) != ID

    def test_a_driver_that_does_not_wait_after_a_reset_reads_nothing(self, driver: Driver):
        driver.hz = dw.SLOW_HZ
        driver.host.reset_pin()
        assert driver.read(0x00) != ID
        driver.host.delay(5e-3)
        assert driver.read(0x00) == ID
        assert driver.status == dw.CPLOCK | dw.SLP2INIT


class TestResets:
    def test_a_soft_reset_takes_everything_back(self, driver: Driver):
        driver.set(0x18, 0, 0x1234, 2)
        driver.hz = dw.SLOW_HZ
        driver.set(0x36, 0, 0x01, 1)
        driver.set(0x36, 3, 0x00, 1)
        driver.host.delay(20e-6)
        driver.set(0x36, 3, 0xF0, 1)
        assert driver.get(0x18, 0, 2) == 0
        assert driver.get(0x36, 0) == 0xF0300200
        driver.host.delay(20e-6)
        driver.hz = dw.FAST_HZ
        assert driver.read(0x00) == ID

    def test_rstn_driven_high_destroys_the_chip(self, driver: Driver, chip: Chip):
        chip.reset_drive(0)
        chip.delay(1e-3)
        assert chip.fault is None
        chip.reset_drive(2)
        chip.delay(5e-3)
        driver.hz = dw.SLOW_HZ
        assert driver.read(0x00) != ID
        assert "RSTn driven high" in str(chip.fault)


class TestMemories:
    def read_otp(self, driver: Driver, address: int) -> int:
        driver.set(0x2D, 4, address, 2)
        driver.set(0x2D, 6, 0x03, 1)
        driver.set(0x2D, 6, 0x01, 1)
        value = driver.get(0x2D, 0x0A)
        driver.set(0x2D, 6, 0x00, 1)
        return value

    def test_the_otp_memory_holds_what_a_driver_needs(self, air: Air):
        driver = Driver(air.chip(tx_delay_ticks=16400, rx_delay_ticks=16450))
        driver.hz = dw.SLOW_HZ
        driver.set(0x36, 0, 0x01, 1)
        assert self.read_otp(driver, 0x1C) == 32850 << 16 | 32850
        assert self.read_otp(driver, 0x1E) & 0x1F == 0x10
        assert self.read_otp(driver, 0x04) & 0xFF, "an LDO tuning value"
        eui = self.read_otp(driver, 0) | self.read_otp(driver, 1) << 32
        assert driver.get(0x01, 0, 8) == eui

    def test_the_otp_memory_is_not_read_from_the_pll(self, driver: Driver):
        values = {self.read_otp(driver, 0x1E) for _ in range(3)}
        assert 0x0110 not in values

    @pytest.mark.parametrize("wrong", ["nothing", "no clock", "no time"])
    def test_without_the_microcode_a_frame_has_no_stamp(self, air: Air, wrong: str):
        a, b, *_ = pair(air)
        b.hz = dw.SLOW_HZ
        b.start(load_lde=False)
        b.hz = dw.SLOW_HZ
        if wrong == "no clock":
            b.set(0x2D, 6, 0x8000, 2)
            b.host.delay(1e-3)
        elif wrong == "no time":
            b.set(0x36, 0, 0x0301, 2)
            b.set(0x2D, 6, 0x8000, 2)
            b.host.delay(50e-6)
            b.set(0x36, 0, 0x0200, 2)
            b.host.delay(50e-6)
        b.hz = dw.FAST_HZ
        stamps = []
        for _ in range(2):
            b.listen()
            b.host.delay(20e-6)
            a.send(b"hello")
            a.host.delay(1e-3)
            assert b.status & dw.RX_GOOD == dw.RX_GOOD & ~(1 << 10), "RXDFR without LDEDONE"
            stamps.append((b.rx_stamp - b.time) % (1 << 40))
        # Stamps lie a millisecond in the past where they mean something.
        assert min((-stamp) % (1 << 40) for stamp in stamps) > 1e9


def test_temperature_and_voltage_by_the_manuals_formulas(driver: Driver, chip: Chip):
    chip.environment(41.0, 3.1)
    driver.set(0x28, 0x11, 0x80, 1)
    driver.set(0x28, 0x12, 0x0A, 1)
    driver.set(0x28, 0x12, 0x0F, 1)
    driver.set(0x2A, 0, 1, 1)
    driver.host.delay(50e-6)
    assert driver.read(0x2A, 3, 2) == bytes(2), "with the PLL as clock it takes a millisecond"
    driver.host.delay(1e-3)
    driver.set(0x2A, 0, 0, 1)
    volts, celsius = driver.read(0x2A, 3, 2)
    driver.set(0x36, 0, 0x01, 1)
    driver.hz = dw.SLOW_HZ
    otp = TestMemories().read_otp
    assert 23 + 1.14 * (celsius - (otp(driver, 9) & 0xFF)) == pytest.approx(41.0, abs=0.6)
    assert 3.3 + (volts - (otp(driver, 8) & 0xFF)) / 173 == pytest.approx(3.1, abs=0.003)


class TestStart:
    def test_a_soft_reset_at_full_speed_is_heard_though_other_registers_are_not(self, air: Air):
        """Drivers without a reset line write four octets at a time, and leave SPI fast; it works on boards."""
        driver = Driver(air.chip())
        driver.set(0x18, 0, 0x1234, 2)
        driver.set(0x36, 0, 0xF0300201)
        driver.set(0x36, 0, 0x00300201)
        driver.host.delay(10e-3)
        driver.set(0x18, 0, 0x4321, 2)
        driver.set(0x36, 0, 0xF0300200)
        driver.host.delay(5e-3)
        assert driver.get(0x00) == 0xDECA0130
        assert driver.get(0x18, 0, 2) == 0
        assert driver.get(0x36, 0) == 0xF0300200

    @pytest.mark.parametrize("wait_us", [100, 120])
    def test_microcode_takes_as_long_as_decawaves_drivers_wait(self, air: Air, wait_us: int):
        a, b, *_ = pair(air)
        b.hz = dw.SLOW_HZ
        b.start(load_lde=False)
        b.hz = dw.SLOW_HZ
        b.set(0x36, 0, 0xF0300301)
        b.set(0x2D, 6, 0x8000, 2)
        b.host.delay(wait_us * 1e-6)
        b.set(0x36, 0, 0x00, 1)  # the second octet stays 0x03
        b.host.delay(10e-6)
        b.hz = dw.FAST_HZ
        assert bool(exchange(a, b) & dw.LDEDONE) == (wait_us == 120)
