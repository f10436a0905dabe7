"""The DW1000's model under what drivers of many hands do: sequences of registers that work on the chip, and that do not."""

from __future__ import annotations

from collections.abc import Iterator

import dw1000_driver as dw
import pytest
from compilers import NEEDS_CC
from dw1000_driver import Driver, Mode, double_buffered, exchange, flight_ticks, pair, send_whole

from benchmarks.dw1000_model.air import Air

pytestmark = NEEDS_CC

TX_GOOD = dw.TXFRB | dw.TXPRS | dw.TXPHS | dw.TXFRS
SWINGING = dw.RXDFR | dw.RXFCG | dw.LDEDONE
MS_TICKS = 63_897_600


@pytest.fixture
def air() -> Iterator[Air]:
    with Air(3) as air:
        yield air


def status_when_read_by(driver: Driver) -> int:
    driver.host.delay(1e-3)
    return driver.status


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

    def test_a_clock_that_is_forced_to_the_pll_serves_everything(self, air: Air):
        a, b, *_ = pair(air)
        for driver in (a, b):
            driver.set(0x36, 0, 0x02, 1)
        assert exchange(a, b) & dw.RX_GOOD == dw.RX_GOOD

    def test_whole_register_files_read_as_their_parts(self, air: Air):
        a, b, *_ = pair(air)
        exchange(a, b)
        for file, length, sub, octets in ((0x15, 14, 9, 5), (0x0F, 5, 1, 2), (0x27, 46, 0x28, 3)):
            assert b.read(file, 0, length)[sub : sub + octets] == b.read(file, sub, octets)
        assert b.read(0x11, 0, 1024)[: len(dw.DATA)] == dw.DATA
        assert b.read(0x11, 3, 4) == dw.DATA[3:7]


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
        assert status_when_read_by(a) & TX_GOOD == 0
        a.host.delay(5e-3)
        assert a.status & TX_GOOD == TX_GOOD

    def test_flags_go_at_once_where_nothing_is_delayed(self, air: Air):
        a, *_ = pair(air)
        a.send(dw.DATA)
        a.host.delay(1e-3)
        a.command(dw.TXSTRT)
        assert not a.status & dw.TXFRS

    def test_a_command_may_be_told_in_steps_and_its_warnings_read_from_the_middle(self, air: Air):
        a, b, *_ = pair(air)
        a.load(dw.DATA)
        a.set(0x0D, 0, dw.WAIT4RESP, 1)
        a.set(0x0A, 0, a.time + 2 * MS_TICKS, 5)
        a.set(0x0D, 0, dw.WAIT4RESP | dw.TXSTRT | dw.TXDLYS, 1)
        assert not a.get(0x0F, 3, 2) << 24 & (dw.HPDWARN | dw.TXPUTE)
        b.listen()
        a.host.delay(3e-3)
        assert b.status & dw.RXFCG
        b.send(dw.DATA)
        assert status_when_read_by(a) & dw.RXFCG, "the receiver came on after the frame"
        a.set(0x0A, 0, a.time, 5)
        a.set(0x0D, 0, dw.TXSTRT | dw.TXDLYS, 1)
        assert a.get(0x0F, 3, 2) << 24 & (dw.HPDWARN | dw.TXPUTE)

    @pytest.mark.parametrize("checked", [True, False])
    def test_a_buffer_written_while_its_frame_goes_out_unchecked_is_an_error(self, air: Air, checked: bool):
        a, *_ = pair(air)
        a.send(dw.DATA, 0 if checked else 1)
        a.host.delay(60e-6)
        a.write(0x09, 0, b"late")
        assert bool(a.status & dw.TXBERR) == (not checked)


class TestReceiving:
    def test_each_status_bit_is_cleared_by_its_own_one(self, air: Air):
        a, b, *_ = pair(air)
        b.send(dw.DATA)
        b.host.delay(1e-3)
        left = exchange(a, b)
        assert left & (dw.RX_GOOD | TX_GOOD) == dw.RX_GOOD | TX_GOOD
        for bit in (1 << number for number in range(1, 35)):
            if left & bit:
                b.set(0x0F, 0, bit, 5)
                left &= ~bit
                assert b.status == left

    @pytest.mark.parametrize("lost", [0.0, 1.0])
    def test_a_good_frame_may_have_no_leading_edge(self, air: Air, lost: float):
        """LDEERR. A driver that looks at RXFCG alone takes a number for a stamp."""
        a, b, _, two = pair(air)
        two.lose_edges(lost)
        status = exchange(a, b)
        off_m = abs(flight_ticks(a, b) - 3.0 / dw.TICK_M) * dw.TICK_M
        assert b.received() == dw.DATA
        if not lost:
            assert status & (dw.RXFCG | dw.LDEDONE | dw.LDEERR) == dw.RXFCG | dw.LDEDONE
            assert off_m < 0.01
            return
        assert status & (dw.RXFCG | dw.LDEDONE | dw.LDEERR) == dw.RXFCG | dw.LDEERR
        assert off_m > 100
        two.lose_edges(0.0)
        assert exchange(a, b) & dw.LDEDONE
        assert abs(flight_ticks(a, b) - 3.0 / dw.TICK_M) * dw.TICK_M > 1.0, "without a receiver reset"
        b.set(0x0F, 0, dw.LDEERR)
        b.reset_receiver()
        assert exchange(a, b) & (dw.LDEDONE | dw.LDEERR) == dw.LDEDONE
        assert flight_ticks(a, b) == pytest.approx(3.0 / dw.TICK_M, abs=1)

    @pytest.mark.parametrize(
        ("preamble", "off", "heard"), [(1024, 24, True), (1024, 255, True), (64, 255, False)]
    )
    def test_a_receiver_that_sniffs_hears_what_lasts_longer_than_it_is_off(
        self, air: Air, preamble: int, off: int, heard: bool
    ):
        mode = Mode(preamble=preamble)
        a, b, *_ = pair(air, mode=mode)
        b.set(0x27, 0x08, 0x313B006B)  # chunks of 8, in which it sniffs
        b.set(0x27, 0x20, 4161, 2)
        b.set(0x1D, 0, off << 8 | 3)
        statuses = []
        for late_us in range(0, 300, 37):
            b.listen()
            b.host.delay(50e-6 + late_us * 1e-6)
            a.send(dw.DATA)
            a.host.delay(3e-3)
            statuses.append(b.status & (dw.RXFCG | dw.ERRORS))
            b.off()
        assert all(status == dw.RXFCG for status in statuses) == heard
        b.set(0x1D, 0, 0)
        assert exchange(a, b) & dw.RXFCG


class TestDoubleBuffer:
    def test_pointers_are_aligned_by_their_octet_alone(self, air: Air):
        a, b = double_buffered(air)
        send_whole(a, dw.DATA)
        side = b.get(0x0F, 3, 1)
        assert (side >> 7 & 1) != (side >> 6 & 1)
        b.set(0x0D, 3, 1, 1)
        side = b.get(0x0F, 3, 1)
        assert (side >> 7 & 1) == (side >> 6 & 1)

    def test_an_enable_leaves_the_flags_of_a_frame_that_waits(self, air: Air):
        """Drivers turn the receiver on again before they read."""
        a, b = double_buffered(air)
        b.set(0x04, 0, b.get(0x04) & ~(1 << 29))
        b.off()
        b.listen()
        b.host.delay(20e-6)
        send_whole(a, dw.DATA)
        b.command(dw.RXENAB)
        assert b.status & SWINGING == SWINGING
        assert b.received() == dw.DATA

    def test_an_overrun_ends_with_the_hosts_pointer_and_the_receiver_goes_on(self, air: Air):
        a, b = double_buffered(air)
        for data in (b"first", b"second"):
            send_whole(a, data)
        stamp = b.rx_stamp
        send_whole(a, b"third")
        assert b.status & (1 << 20)
        assert b.rx_stamp != stamp, "what was known of the first frame"
        assert b.get(0x19, 0, 4) >> 16 & 15 == 5, "RXAUTR"
        b.command(1 << 24)
        assert not b.status & (1 << 20)

    @pytest.mark.parametrize("masked", [True, False])
    def test_clearing_what_swings_makes_a_pulse_unless_it_is_masked(self, air: Air, masked: bool):
        """Errata IRQ-1: an interrupt that tells of nothing."""
        a, b = double_buffered(air)
        b.set(0x0E, 0, dw.RXFCG)
        send_whole(a, dw.DATA)
        assert b.host.irq()
        if masked:
            b.set(0x0E, 0, 0)
        b.set(0x0F, 0, SWINGING | dw.RXPRD)
        assert b.host.irq() == (not masked)
        assert not b.status & SWINGING
        if masked:
            b.set(0x0E, 0, dw.RXFCG)
        b.host.delay(2e-6)
        assert not b.host.irq()

    def test_with_one_buffer_there_is_no_pulse(self, air: Air):
        a, b, *_ = pair(air)
        b.set(0x0E, 0, dw.RXFCG)
        exchange(a, b)
        b.set(0x0F, 0, SWINGING)
        assert not b.host.irq()

    @pytest.mark.parametrize(("written", "spoilt"), [(128, False), (129, True)])
    def test_a_long_answer_spoils_the_second_frame_that_was_not_read(
        self, air: Air, written: int, spoilt: bool
    ):
        """Errata RX-1: octet 128 of the second buffer."""
        a, b = double_buffered(air, Mode(long_frames=True))
        long = bytes(range(200))
        send_whole(a, long)
        send_whole(a, long)
        b.command(1 << 24)
        assert not b.status & dw.ICRBP
        b.write(0x09, 0, bytes(written))
        data = b.received()
        assert (data == long) == (not spoilt)
        assert data[:128] + data[129:] == long[:128] + long[129:]


class TestSleep:
    def sleep(self, driver: Driver, keep: int = 0x0840, wake: int = 0x07, counter: int = 0) -> None:
        driver.set(0x2C, 0, keep, 2)
        driver.set(0x2C, 6, counter << 16 | wake)
        driver.set(0x2C, 0x0A, 1 if counter else 0, 1)
        driver.set(0x2C, 2, 0x00, 1)
        driver.set(0x2C, 2, 0x02, 1)

    @pytest.mark.parametrize(("wake", "wakes"), [(0x09, True), (0x07, False)])
    def test_a_counter_wakes_where_it_may(self, air: Air, wake: int, wakes: bool):
        driver = Driver(air.chip())
        self.sleep(driver, wake=wake, counter=2)
        driver.hz = dw.SLOW_HZ
        driver.host.delay(0.7)
        assert driver.get(0x00) != 0xDECA0130
        driver.host.delay(0.2)
        assert (driver.get(0x00) == 0xDECA0130) == wakes

    @pytest.mark.parametrize("listens", [True, False])
    def test_it_may_listen_as_it_wakes(self, air: Air, listens: bool):
        a, b, _, two = pair(air)
        self.sleep(b, keep=0x0842 if listens else 0x0840)
        two.wakeup_pin()
        two.delay(5e-3)
        a.send(dw.DATA)
        assert bool(status_when_read_by(b) & dw.RXFCG) == listens

    @pytest.mark.parametrize("measures", [True, False])
    def test_it_may_measure_as_it_wakes(self, air: Air, measures: bool):
        chip = air.chip()
        driver = Driver(chip)
        chip.environment(40.0, 3.0)
        self.sleep(driver, keep=0x0841 if measures else 0x0840)
        chip.wakeup_pin()
        chip.delay(5e-3)
        assert (driver.get(0x2A, 6, 2) != 0) == measures


def test_a_receiver_that_is_turned_off_sends_no_more_than_it_was_told(air: Air):
    """TXSTRT with TRXOFF sets the SFD up for acknowledgements, and nothing goes out."""
    a, b, *_ = pair(air)
    b.listen()
    b.host.delay(20e-6)
    a.load(dw.DATA)
    a.set(0x0D, 0, dw.TXSTRT | dw.TRXOFF, 1)
    a.host.delay(1e-3)
    assert not b.status & dw.RXPRD
    assert not a.status & dw.TXFRB
