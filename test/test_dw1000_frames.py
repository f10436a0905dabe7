"""The DW1000's model, by the manual: frames on the air, their stamps, and the transmitter."""

from __future__ import annotations

import math

import dw1000_driver as dw
import numpy as np
import pytest
from compilers import NEEDS_CC
from dw1000_driver import Driver, Mode, exchange, flight_ticks, pair

from benchmarks.dw1000_model.air import Air
from benchmarks.dw1000_model.links import Link

pytestmark = NEEDS_CC


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
        assert (
            a.status & (dw.TXFRB | dw.TXPRS | dw.TXPHS | dw.TXFRS)
            == dw.TXFRB | dw.TXPRS | dw.TXPHS | dw.TXFRS
        )

    @pytest.mark.parametrize(
        ("other", "told"),
        [
            (Mode(channel=2), 0),
            (Mode(prf=16), 0),
            (Mode(code=10), 0),
            (Mode(prf=16, code=9), 0),
            (Mode(decawave_sfd=True), dw.RXSFDTO),
            (Mode(rate=0), dw.RXSFDTO),
            (Mode(long_frames=True), dw.RXPHE),
        ],
        ids=str,
    )
    def test_both_ends_must_agree(self, air: Air, other: Mode, told: int):
        a, b, *_ = pair(air, receiver=other)
        assert exchange(a, b) & (dw.RXFCG | dw.ERRORS) == told
        b.off()
        b.reset_receiver()
        b.configure(Mode())
        assert exchange(a, b) & dw.RXFCG

    def test_the_synthesiser_must_be_tuned_to_the_channel(self, air: Air):
        a, b, *_ = pair(air, mode=Mode(channel=2))
        a.set(0x2B, 7, 0x0800041D)
        assert exchange(a, b) & (dw.RXPRD | dw.RXFCG) == 0

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

    def test_a_receiver_needs_two_chunks_of_the_preamble(self, air: Air):
        """Preamble 128, chunks of 8: on until 112 symbols have gone; and 16 us to warm up."""
        a, b, *_ = pair(air)
        heard = []
        for late_us in (60, 80, 90, 95, 115, 130):
            a.send(dw.DATA)
            a.host.delay(10e-6 + late_us * 1e-6)
            b.listen()
            b.host.delay(1e-3)
            heard.append(bool(b.status & dw.RXFCG))
            b.off()
            b.reset_receiver()
        assert heard == [True, True, True, True, False, False]

    def test_a_frame_is_dropped_or_damaged_as_the_link_says(self, air: Air):
        a, b, one, two = pair(air, Link(3.0, loss=0.3))
        lost = 0
        for _ in range(100):
            status = exchange(a, b)
            lost += not status & dw.RXPRD
            assert status & dw.RXPRD == 0 or status & dw.RXFCG
            b.off()
        assert 15 < lost < 45
        air.link(one, two, Link(3.0, damage=1.0))
        kinds = set()
        for _ in range(40):
            status = exchange(a, b)
            assert not status & dw.RXFCG
            kinds.add(status & dw.ERRORS)
            b.off()
        assert kinds == {dw.RXPHE, dw.RXRFSL, dw.RXFCE, dw.RXSFDTO}

    def test_a_damaged_frame_that_is_read_differs(self, air: Air):
        a, b, *_ = pair(air, Link(3.0, damage=1.0))
        for _ in range(20):
            if exchange(a, b) & dw.RXFCE:
                assert b.status & dw.RXDFR
                assert b.get(0x10, 0, 2) & 0x7F == len(dw.DATA) + 2
                whole = b.read(0x11, 0, len(dw.DATA) + 2)
                assert whole[: len(dw.DATA)] != dw.DATA or whole[len(dw.DATA) :] != bytes(2)
                return
        pytest.fail("no damage to the check sum in 20 frames")

    def test_who_is_not_linked_hears_nothing(self, air: Air):
        a, b, one, two = pair(air)
        air.link(one, two, None)
        assert exchange(a, b) & dw.RXPRD == 0

    @pytest.mark.parametrize("apart_us", [0.0, 30.0, 140.0, 165.0])
    def test_two_at_once_spoil_each_other(self, air: Air, apart_us: float):
        a, b, _, two = pair(air)
        c = Driver(air.chip())
        c.start()
        air.link(c.host, two, Link(3.0))
        b.listen()
        now = a.time
        for sender, late_us in ((a, 0.0), (c, apart_us)):
            sender.send_at(dw.DATA, now + round((400e-6 + late_us * 1e-6) / dw.TICK_S))
        a.host.delay(6e-3)
        assert b.status & dw.RXPRD
        assert not b.status & dw.RXFCG
        assert b.status & dw.ERRORS

    def test_another_code_does_not_disturb(self, air: Air):
        a, b, _, two = pair(air)
        c = Driver(air.chip())
        c.start(Mode(code=11))
        air.link(c.host, two, Link(3.0))
        b.listen()
        now = a.time
        for sender in (a, c):
            sender.send_at(dw.DATA, now + round(400e-6 / dw.TICK_S))
        a.host.delay(2e-3)
        assert b.status & dw.RXFCG

    def test_a_much_stronger_frame_survives(self, air: Air):
        a, b, _, two = pair(air)
        c = Driver(air.chip())
        c.start()
        faint = np.zeros(2032, np.int16)
        faint[2 * 745] = 200
        air.link(c.host, two, Link(3.0, samples=faint))
        b.listen()
        now = a.time
        a.send_at(dw.DATA, now + round(400e-6 / dw.TICK_S))
        c.send_at(dw.DATA, now + round(450e-6 / dw.TICK_S))
        a.host.delay(2e-3)
        assert b.status & dw.RXFCG

    def test_a_buffer_written_while_it_is_sent_is_what_is_sent(self, air: Air):
        """Errata TX-2, as a driver would meet it."""
        a, b, *_ = pair(air)
        b.listen()
        b.host.delay(20e-6)
        a.send(dw.DATA)
        a.write(0x09, 3, b"P")
        a.host.delay(1e-3)
        assert b.received() == dw.DATA[:3] + b"P" + dw.DATA[4:]


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

    def test_an_antenna_delay_that_is_not_set_is_in_the_stamps(self, air: Air):
        a, b, *_ = pair(air, Link(10.0))
        b.set(0x2E, 0x1804, 0, 2)
        assert exchange(a, b) & dw.RXFCG
        assert flight_ticks(a, b) == pytest.approx(10.0 / dw.TICK_M + 16436, abs=1)

    @pytest.mark.parametrize("offset", [-40.0, -3.5, 0.0, 12.0, 40.0])
    @pytest.mark.parametrize("mode", [Mode(), Mode(channel=2, prf=16, rate=0, preamble=1024)], ids=str)
    def test_the_offset_of_the_other_clock_is_told_twice(self, air: Air, offset: float, mode: Mode):
        """Positive: the other's runs faster."""
        a, b, *_ = pair(air, mode=mode, ppm=(offset / 2, -offset / 2))
        assert exchange(a, b) & dw.RXFCG
        interval, raw = b.get(0x13), b.get(0x14, 0, 5) & 0x7FFFF
        assert interval == (0x01FC0000 if mode.prf == 64 else 0x01F00000)
        assert (raw ^ 0x40000) - 0x40000 == pytest.approx(offset * 1e-6 * interval, abs=1)
        carrier = (b.get(0x27, 0x28, 3) ^ 0x100000) - 0x100000
        hz = carrier * 998.4e6 / 2 / (8192 if mode.rate == 0 else 1024) / 131072
        assert -hz * 1e6 / {5: 6489.6e6, 2: 3993.6e6}[mode.channel] == pytest.approx(offset, abs=0.01)


class TestTransmitter:
    def test_status_clears_at_the_next_start(self, air: Air):
        a, *_ = pair(air)
        a.send(dw.DATA)
        a.host.delay(1e-3)
        assert a.status & dw.TXFRS
        a.command(dw.TXSTRT)
        assert a.status & (dw.TXFRB | dw.TXPRS | dw.TXPHS | dw.TXFRS) == 0

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

    def test_trxoff_ends_a_frame_that_is_being_sent(self, air: Air):
        a, b, *_ = pair(air)
        b.listen()
        b.host.delay(20e-6)
        a.send(dw.DATA * 10)
        a.host.delay(250e-6)
        a.off()
        a.host.delay(2e-3)
        assert not a.status & dw.TXFRS
        assert b.status & dw.RXRFSL

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

    def test_a_late_frame_leaves_a_turn_of_the_counter_later(self, air: Air):
        a, *_ = pair(air)
        a.send_at(dw.DATA, a.time)
        assert a.status & dw.HPDWARN
        a.set(0x0E, 0, dw.TXFRS)
        a.host.wait(20.0)
        assert a.host.now() == pytest.approx(dw.WRAP * dw.TICK_S, abs=0.05)

    def test_hpdwarn_goes_with_trxoff_and_not_by_writing(self, air: Air):
        a, *_ = pair(air)
        a.send_at(dw.DATA, a.time)
        a.set(0x0F, 0, dw.HPDWARN)
        assert a.status & dw.HPDWARN
        a.off()
        assert not a.status & dw.HPDWARN

    def test_an_enable_while_it_sends_comes_after_the_frame(self, air: Air):
        a, b, *_ = pair(air)
        b.listen()
        b.host.delay(20e-6)
        a.send(dw.DATA)
        a.listen()
        a.host.delay(300e-6)
        assert b.status & dw.RXFCG
        b.send(b"answer")
        b.host.delay(1e-3)
        assert a.status & dw.TXFRS
        assert a.status & dw.RXFCG

    def test_wait_for_response_turns_the_receiver_on(self, air: Air):
        a, b, *_ = pair(air)
        a.set(0x1A, 0, 100)
        b.listen()
        b.host.delay(20e-6)
        a.send(dw.DATA, dw.WAIT4RESP)
        a.host.delay(300e-6)
        b.off()
        b.send(b"answer")
        b.host.delay(1e-3)
        assert a.status & dw.RXFCG
        assert a.received() == b"answer"


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
