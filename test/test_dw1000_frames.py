"""The DW1000's model against the facts of the manual on which the firmware's driver relies: frames, timestamps, errors, accumulator."""

from __future__ import annotations

import math
from collections.abc import Iterator

import dw1000_driver as dw
import numpy as np
import pytest
from compilers import NEEDS_CC
from dw1000_driver import Driver, Mode, exchange, flight_ticks, pair

from benchmarks.dw1000_model.air import Air
from benchmarks.dw1000_model.links import Link, link_of
from uwb_mitigation.sources.simulated import SimulatedSurvey

pytestmark = NEEDS_CC

TX_GOOD = dw.TXFRB | dw.TXPRS | dw.TXPHS | dw.TXFRS
MS_TICKS = 63_897_600


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

    def test_hpdwarn_goes_with_trxoff_and_not_by_writing(self, air: Air):
        a, *_ = pair(air)
        a.send_at(dw.DATA, a.time)
        a.set(0x0F, 0, dw.HPDWARN)
        assert a.status & dw.HPDWARN
        a.off()
        assert not a.status & dw.HPDWARN

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


class TestReceiver:
    def test_status_clears_at_the_next_enable(self, air: Air):
        a, b, *_ = pair(air)
        assert exchange(a, b) & dw.RX_GOOD == dw.RX_GOOD
        b.listen()
        assert b.status & (dw.RX_GOOD | dw.ERRORS) == 0

    def test_after_a_good_frame_the_receiver_is_off(self, air: Air):
        a, b, *_ = pair(air)
        assert exchange(a, b) & dw.RXFCG
        b.set(0x0F, 0, 0xFFFFFFFF)
        a.send(dw.DATA)
        a.host.delay(1e-3)
        assert not b.status & dw.RXPRD

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

    def test_the_way_round_the_glitch(self, air: Air):
        a, b, _, two = pair(air)
        b.set(0x0E, 0, dw.RXPHE | dw.RXFCG)
        b.listen()
        b.host.delay(20e-6)
        a.send(dw.DATA)
        b.host.delay(100e-6)
        b.set(0x0E, 0, 0)
        b.off()
        b.set(0x0F, 0, 0xFFFFFFFF)
        b.set(0x0E, 0, dw.RXPHE | dw.RXFCG)
        two.wait(1e-3)
        assert not two.irq()


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


class TestLeadingEdge:
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

    def test_at_16_mhz_there_are_992_samples(self, air: Air):
        link = Link(3.0, samples=np.full(2032, 1000, np.int16), first_path_index=745.5)
        a, b, *_ = pair(air, link, Mode(prf=16))
        assert exchange(a, b) & dw.RXFCG
        whole = np.frombuffer(b.accumulator(0, 1016), "<i2")
        assert (whole[: 2 * 992] == 1000).all()
        assert not whole[2 * 992 :].any()

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

    def test_of_a_whole_preamble_the_count_holds_the_sfd(self, air: Air):
        a, b, *_ = pair(air, mode=Mode(preamble=256))
        assert exchange(a, b) & dw.RXFCG
        count = b.get(0x10) >> 20
        assert count == b.get(0x27, 0x2C, 2)
        assert 256 - 2 * 16 <= count <= 256 + 8
