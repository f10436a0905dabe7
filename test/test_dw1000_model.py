"""The DW1000's model against the facts of the manual on which the firmware's driver relies, and as a library."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import dw1000_driver as dw
import model_material
import numpy as np
import pytest
from compilers import NEEDS_CC
from conftest import REPOSITORY
from dw1000_driver import Driver, Mode, exchange, flight_ticks, pair

from benchmarks.dw1000_model.air import Air, Chip
from benchmarks.dw1000_model.library import model_folder, model_objects
from benchmarks.dw1000_model.links import Link, link_of
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.firmware_export.compiling import WARNINGS, c_compiler, run
from uwb_mitigation.measurement import Cir, RangeMeasurement, Truth
from uwb_mitigation.sources.simulated import SimulatedSurvey

pytestmark = NEEDS_CC

ID = bytes.fromhex("3001cade")
TX_GOOD = dw.TXFRB | dw.TXPRS | dw.TXPHS | dw.TXFRS
MS_TICKS = 63_897_600


@pytest.fixture
def chip(air: Air) -> Chip:
    return air.chip()


@pytest.fixture
def driver(chip: Chip) -> Driver:
    return Driver(chip)


@pytest.mark.parametrize("header", [[0x00], [0x40, 0x00], [0x40, 0x80, 0x00]], ids=["1", "2", "3 octets"])
def test_a_header_has_one_to_three_octets(chip: Chip, header: list[int]):
    assert chip.spi(bytes([*header, 0, 0, 0, 0]), dw.FAST_HZ)[len(header) :] == ID


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


class TestFrames:
    @pytest.mark.parametrize(
        "mode",
        [Mode(channel=channel, prf=prf) for channel in (1, 2, 3, 4, 5, 7) for prf in (16, 64)]
        + [Mode(rate=rate, preamble=p) for rate, p in ((0, 1024), (0, 2048), (1, 256), (1, 512), (2, 64))]
        + [Mode(preamble=1536), Mode(preamble=4096), Mode(rate=1, decawave_sfd=True)]
        + [Mode(rate=0, preamble=2048, decawave_sfd=True), Mode(long_frames=True)],
        ids=str,
    )
    def test_in_every_mode_a_frame_arrives_whole_and_in_time(self, air: Air, mode: Mode):
        a, b, *_ = pair(air, Link(30.0), mode)
        data = dw.DATA * (80 if mode.long_frames else 5)
        assert exchange(a, b, data) & (dw.RX_GOOD | dw.ERRORS) == dw.RX_GOOD
        assert b.received() == data
        assert flight_ticks(a, b) == pytest.approx(30.0 / dw.TICK_M, abs=1)
        assert a.status & TX_GOOD == TX_GOOD

    @pytest.mark.parametrize(
        ("mode", "octets", "air_time_us"),
        [
            # Symbols of 993.59 or 1017.63 ns, 21 of the header, 48 bits more for each 330 bits of data.
            (Mode(prf=16), 12, 136 * 0.99359 + 21 * 1.02564 + (96 + 48) * 0.128205),
            (Mode(), 127, 136 * 1.01763 + 21 * 1.02564 + (1016 + 4 * 48) * 0.128205),
            (Mode(rate=0, preamble=1024), 12, 1088 * 1.01763 + 21 * 8.20513 + (96 + 48) * 8.20513),
        ],
        ids=str,
    )
    def test_a_frame_takes_its_air_time(self, air: Air, mode: Mode, octets: int, air_time_us: float):
        a, *_ = pair(air, mode=mode)
        a.set(0x0E, 0, dw.TXFRS)
        a.load(bytes(octets - 2))
        a.command(dw.TXSTRT)
        began = a.host.now()
        a.host.wait(10e-3)
        # The transmitter takes 10 us to start, and waits for the grid.
        assert (a.host.now() - began) * 1e6 == pytest.approx(air_time_us + 10, abs=0.5)


class TestStamps:
    @pytest.mark.parametrize("ppm", [(-20.0, 20.0), (0.0, 0.0), (20.0, -20.0)])
    def test_a_stamp_is_the_marker_at_the_antenna_on_the_grid(self, air: Air, ppm: tuple[float, float]):
        a, b, *_ = pair(air, Link(10.0, excess_m=1.5), ppm=ppm, clocks=(dw.WRAP - 10**9, 0))
        flights = []
        for _ in range(3):
            assert exchange(a, b) & dw.RXFCG
            assert a.get(0x17, 5, 5) % 512 == 0
            assert (a.tx_stamp - a.get(0x17, 5, 5)) % dw.WRAP == 16436
            flights.append(flight_ticks(a, b))
        # Between clocks that differ a flight means little, but its change over 6 ms is their difference.
        if ppm == (0.0, 0.0):
            expected = (11.5 / dw.TICK_M - (dw.WRAP - 10**9) + dw.WRAP // 2) % dw.WRAP - dw.WRAP // 2
            assert flights == pytest.approx([expected] * 3, abs=1)

    def test_a_delayed_frame_leaves_at_its_time_on_the_grid(self, air: Air):
        a, b, *_ = pair(air, Link(10.0), clocks=(12345, 12345))
        b.listen()
        wanted = a.time + 64_000_000 + 333
        a.send_at(dw.DATA, wanted)
        a.host.delay(2e-3)
        assert a.tx_stamp == wanted - wanted % 512 + 16436
        assert b.rx_stamp == pytest.approx(a.tx_stamp + 10.0 / dw.TICK_M, abs=1)


class TestTransmitter:
    def test_a_start_while_the_receiver_is_on_is_dropped_without_a_word(self, air: Air):
        a, b, *_ = pair(air)
        a.listen()
        before = a.status
        a.send(dw.DATA)
        a.host.delay(2e-3)
        assert a.status == before
        a.off()
        assert exchange(a, b) & dw.RXFCG

    def test_a_start_with_trxoff_in_one_write_sends_nothing(self, air: Air):
        a, b, *_ = pair(air)
        b.listen()
        a.load(dw.DATA)
        a.command(dw.TXSTRT | dw.TRXOFF)
        a.host.delay(2e-3)
        assert not a.status & (dw.TXFRB | dw.TXFRS)
        assert not b.status & dw.RXPRD

    def send_with_lead(self, a: Driver, lead_us: float, *, held_clock: bool = False) -> int:
        """A delayed send with so much time from the command to the start of the preamble; the status after it."""
        header = (128 + 8) * 65024
        a.load(dw.DATA)
        a.set(0x36, 0, 0x20 if held_clock else 0x00, 1)
        write_s = (5 + 1) * 8 / a.hz + (4 + 1) * 8 / a.hz + 2 * 96e-9
        now = a.host.now() + write_s
        # The counter began at 0, with the air.
        wanted = math.ceil((now + lead_us * 1e-6) / dw.TICK_S + header)
        a.set(0x0A, 0, -(-wanted // 512) * 512 % dw.WRAP, 5)
        a.command(dw.TXSTRT | dw.TXDLYS)
        a.host.delay(5e-3)
        status = a.status
        a.off()
        return status

    @pytest.mark.parametrize(
        ("lead_us", "told"),
        [
            (-400.0, dw.HPDWARN),
            (-0.1, dw.HPDWARN),
            (0.5, dw.TXPUTE),
            (9.8, dw.TXPUTE),
            (10.1, 0),
            (10.3, 0),
            (10.5, dw.TXFRS),
        ],
    )
    def test_a_late_frame_is_told_or_lost(self, air: Air, lead_us: float, told: int):
        a, *_ = pair(air)
        assert self.send_with_lead(a, lead_us) & (dw.HPDWARN | dw.TXPUTE | dw.TXFRS) == told

    def test_the_window_of_errata_tx_1_closes_with_the_clock_held(self, air: Air):
        a, *_ = pair(air)
        assert self.send_with_lead(a, 10.2) & dw.TXFRS == 0, (
            "a driver without the work-around and a time-out hangs"
        )
        assert self.send_with_lead(a, 10.2, held_clock=True) & dw.TXFRS


@pytest.mark.parametrize(
    ("smart", "rate", "preamble", "octet"),
    [
        (True, 2, 64, 3),
        (True, 2, 128, 2),
        (True, 2, 256, 1),
        (True, 2, 1024, 0),
        (True, 0, 128, 0),
        (False, 2, 64, 2),
    ],
)
def test_transmit_power_has_two_formats(air: Air, smart: bool, rate: int, preamble: int, octet: int):
    a, _, sender, _ = pair(air, mode=Mode(rate=rate, preamble=preamble))
    a.set(0x04, 0, a.get(0x04) | (not smart) << 18)
    word = 0x25456585
    a.set(0x1E, 0, word)
    a.send(dw.DATA)
    a.host.delay(20e-3)
    level_db = [8.5, 11.5, 14.5, 17.5]
    assert sender.sent_power_db == (level_db[octet], level_db[octet if smart else 1])


class TestReceiver:
    def test_the_frame_wait_time_out(self, air: Air):
        _, b, *_ = pair(air)
        b.set(0x0C, 0, 1000, 2)
        b.set(0x04, 0, b.get(0x04) | 1 << 28)
        b.set(0x0E, 0, dw.RXRFTO)
        b.listen()
        began = b.host.now()
        b.host.wait(1.0)
        assert b.host.now() - began == pytest.approx(1000 * 512 / 499.2e6, abs=2e-6)
        assert b.status & dw.ERRORS == dw.RXRFTO

    @pytest.mark.parametrize("error", ["header", "time-out"])
    def test_without_a_receiver_reset_after_an_error_the_next_stamp_is_wrong(self, air: Air, error: str):
        a, b, *_ = pair(air)

        def fail() -> None:
            if error == "header":
                b.configure(Mode(long_frames=True))
                assert exchange(a, b) & dw.RXPHE
                b.configure(Mode())
            else:
                b.set(0x0C, 0, 100, 2)
                b.set(0x04, 0, b.get(0x04) | 1 << 28)
                b.listen()
                b.host.delay(1e-3)
                assert b.status & dw.RXRFTO
                b.set(0x04, 0, b.get(0x04) & ~(1 << 28))

        fail()
        assert exchange(a, b) & dw.RXFCG
        assert abs(flight_ticks(a, b) - 3.0 / dw.TICK_M) * dw.TICK_M > 1.0
        fail()
        b.reset_receiver()
        assert exchange(a, b) & dw.RXFCG
        assert flight_ticks(a, b) == pytest.approx(3.0 / dw.TICK_M, abs=1)

    def test_turned_off_in_a_frame_it_may_still_tell_of_it(self, air: Air):
        """The glitch that drivers mask the interrupt for."""
        a, b, _, two = pair(air)
        b.set(0x0E, 0, dw.RXPHE | dw.RXFCG)
        b.listen()
        b.host.delay(20e-6)
        a.send(dw.DATA)
        b.host.delay(100e-6)
        b.off()
        two.wait(100e-6)
        assert two.irq(), "a driver that did not mask it is interrupted by a receiver that is off"
        b.set(0x0F, 0, 0xFFFFFFFF)
        b.listen()
        b.off()
        two.wait(100e-6)
        assert not two.irq(), "without a frame there is nothing to tell"


class TestSending:
    def test_flags_of_the_frame_before_stand_until_a_delayed_one_starts(self, air: Air):
        a, *_ = pair(air)
        a.send(dw.DATA)
        a.host.delay(1e-3)
        a.send_at(dw.DATA, a.time + 5 * MS_TICKS)
        a.host.delay(1e-3)
        assert a.status & TX_GOOD == TX_GOOD, "a driver that waits for TXFRS now takes it for the new frame's"
        a.host.delay(3.95e-3)
        assert a.status & (dw.TXFRB | dw.TXFRS) == dw.TXFRB
        a.host.delay(1e-3)
        a.set(0x0F, 0, TX_GOOD)
        a.send_at(dw.DATA, a.time + 5 * MS_TICKS)
        assert not a.status & TX_GOOD
        a.host.delay(1e-3)
        assert a.status & TX_GOOD == 0
        a.host.delay(5e-3)
        assert a.status & TX_GOOD == TX_GOOD


class TestChannel:
    def simulated(self, seed: int = 3) -> Iterator[tuple[Link, object]]:
        for record in SimulatedSurvey(seed=seed, configurations=4, exchanges=1):
            yield link_of(record.measurement, record.truth), record.measurement

    def test_the_accumulator_is_the_links_bit_for_bit_whole_and_in_part(self, air: Air):
        a, b, one, two = pair(air)
        for link, _ in self.simulated():
            air.link(one, two, link)
            assert exchange(a, b) & dw.RXFCG
            whole = np.frombuffer(b.accumulator(0, 1016), "<i2")
            assert np.array_equal(whole, link.samples)
            first = b.get(0x15, 5, 2) // 64 - 5
            part = np.frombuffer(b.accumulator(first, 157), "<i2")
            assert np.array_equal(part, link.samples[2 * first : 2 * (first + 157)])

    def test_the_first_octet_of_every_read_is_a_dummy(self, air: Air):
        a, b, *_ = pair(air, Link(3.0, samples=np.arange(2032, dtype=np.int16)))
        assert exchange(a, b) & dw.RXFCG
        b.set(0x36, 0, 0x8248, 2)
        for sample in (0, 100, 745):
            dummy, *octets = b.read(0x25, 4 * sample, 5)
            assert bytes(octets) == np.array([2 * sample, 2 * sample + 1], "<i2").tobytes()
            assert dummy not in (octets[0], 0)

    def test_without_its_clocks_the_accumulator_reads_nothing(self, air: Air):
        a, b, *_ = pair(air)
        assert exchange(a, b) & dw.RXFCG
        assert not any(b.accumulator(740, 20, clocks=False))
        b.set(0x36, 0, 0x48, 1)
        assert not any(b.read(0x25, 4 * 740, 81)[1:]), "FACE without AMCE"
        b.set(0x36, 0, 0x8208, 2)
        assert not any(b.read(0x25, 4 * 740, 81)[1:]), "AMCE without FACE"

    def test_the_next_enable_wipes_it_even_while_it_is_read(self, air: Air):
        a, b, *_ = pair(air, Link(3.0, samples=np.full(2032, 77, np.int16)))
        a.set(0x1A, 0, 0)
        assert exchange(b, a) & dw.RXFCG
        assert any(a.accumulator(0, 1016))
        a.load(dw.DATA)
        a.command(dw.TXSTRT | dw.WAIT4RESP)
        a.hz = 8_000_000
        torn = np.frombuffer(a.accumulator(0, 1016), "<i2")
        assert torn[0] == 77
        assert torn[-1] == 0
        a.off()
        a.listen()
        assert not any(a.accumulator(0, 1016))

    def test_the_registers_follow_from_the_accumulator(self, air: Air):
        a, b, one, two = pair(air)
        for link, measurement in self.simulated():
            air.link(one, two, link)
            assert exchange(a, b) & dw.RXFCG
            cir = measurement.cir
            samples = cir.samples.astype(np.float64)
            magnitude = np.hypot(samples[0::2], samples[1::2])
            index = b.get(0x15, 5, 2) / 64
            assert index == pytest.approx(cir.first_path_index, abs=1 / 64)
            first = int(index)
            told = [b.get(0x15, 7, 2), b.get(0x12, 2, 2), b.get(0x12, 4, 2)]
            assert told == pytest.approx(magnitude[first + 1 : first + 4], abs=0.51)
            assert b.get(0x2E, 0, 2) == cir.noise_threshold
            assert b.get(0x12, 0, 2) == pytest.approx(cir.noise_threshold / 13, abs=1)
            count = b.get(0x10) >> 20
            assert count == cir.preamble_count
            assert b.get(0x27, 0x2C, 2) > count, "accumulation stopped early"
            # One step of CIR_PWR is what a level cannot be told better than.
            step = b.get(0x12, 6, 2)
            receive = 10 * math.log10(step * 2**17 / count**2) - 121.74
            near = 10 * math.log10(sum(f * f for f in told) / count**2) - 121.74
            assert receive == pytest.approx(cir.rx_power_dbm, abs=1e-3)
            assert near == pytest.approx(cir.first_path_power_dbm, abs=1e-3)


def history(seed: int) -> list[int]:
    """What three frames a link met that loses and damages."""
    with Air(seed) as air:
        a, b, *_ = pair(air, Link(3.0, loss=0.3, damage=0.3))
        seen = []
        for _ in range(30):
            seen.append(exchange(a, b))
            seen.append(b.rx_stamp)
            b.off()
            b.reset_receiver()
        return seen


def test_the_seed_decides():
    assert history(5) == history(5)
    assert history(5) != history(6)


class TestLinks:
    def measurement(self, cir: Cir, range_m: float = 4.0) -> RangeMeasurement:
        return RangeMeasurement(0, 1, 2, 3, 4, range_m, cir)

    def test_the_error_is_the_links_excess(self):
        link = link_of(self.measurement(model_material.cir(1)), Truth(3.5))
        assert (link.distance_m, link.excess_m) == (3.5, 0.5)
        assert link_of(self.measurement(model_material.cir(1))).excess_m == 0

    def test_a_part_of_an_accumulator_lies_where_it_was(self):
        part = Cir(np.arange(1, 9, dtype=np.int16), start_index=740, first_path_index=741.5, scale=2.0)
        samples = link_of(self.measurement(part)).samples
        assert samples[1480:1488].tolist() == [2, 4, 6, 8, 10, 12, 14, 16]
        assert not samples[:1480].any()
        assert not samples[1488:].any()

    @pytest.mark.parametrize(
        ("changes", "range_m", "told"),
        [
            ({"samples": np.zeros(0, np.int16)}, 4.0, "samples"),
            ({"start_index": 1000}, 4.0, "samples 1000"),
            ({"start_index": -1}, 4.0, "samples -1"),
            ({"scale": math.nan}, 4.0, "scale"),
            ({}, math.nan, "distance_m = nan"),
            ({}, -1.0, "distance_m = -1"),
            ({"preamble_count": 5000}, 4.0, "preamble_count = 5000"),
        ],
    )
    def test_what_no_chip_could_measure_is_refused(
        self, changes: dict[str, object], range_m: float, told: str
    ):
        cir = replace(Cir(np.ones(40, np.int16), start_index=700), **changes)
        with pytest.raises(ParameterError, match=told):
            link_of(self.measurement(cir, range_m))


def test_a_driver_may_define_any_name_without_the_models_prefix(tmp_path: Path):
    objects = model_objects()
    defined = run(["nm", "-g", "--defined-only", "-P", *objects]).splitlines()
    names = [line.split()[0] for line in defined if not line.endswith(":")]
    assert len(names) > 50
    assert [name for name in names if not name.startswith("dw1000_")] == []
    short = sorted({"get", "put", "wake", "control", *(name.removeprefix("dw1000_") for name in names)})
    driver = tmp_path / "driver.c"
    driver.write_text(
        "".join(f"int {name}(void);\nint {name}(void) {{ return 0; }}\n" for name in short)
        + '#include "dw1000_model.h"\nint main(void) { dw1000_air_free(dw1000_air_new(1)); return 0; }\n'
    )
    program = tmp_path / "driver"
    options = ("-fno-builtin", f"-I{model_folder()}")
    run([*c_compiler(), *options, str(driver), *objects, "-lm", "-lpthread", "-o", str(program)])
    run([str(program)])


def compiled(source: Path, program: Path) -> Path:
    sources = (*model_folder().glob("*.c"), source)
    options = ("-std=c11", "-O1", "-g", "-fsanitize=address,undefined", *WARNINGS, f"-I{model_folder()}")
    run([*c_compiler(), *options, *map(str, sources), "-lm", "-lpthread", "-o", str(program)])
    return program


def test_the_pages_program_prints_what_the_page_says(tmp_path: Path):
    page = (REPOSITORY / "docs" / "dw1000_model.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    (promise,) = re.findall(r"prints `(.*?)` twice", page)
    source = tmp_path / "blink.c"
    source.write_text(text, encoding="utf-8")
    done = subprocess.run([compiled(source, tmp_path / "blink")], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [promise] * 2
