"""The DW1000's model, by the manual: time-outs, errors, double buffering, frame filtering."""

from __future__ import annotations

import dw1000_driver as dw
import pytest
from compilers import NEEDS_CC
from dw1000_driver import Driver, Mode, double_buffered, exchange, flight_ticks, pair, send_whole

from benchmarks.dw1000_model.air import Air

pytestmark = NEEDS_CC


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

    def test_a_frame_ends_with_the_time_out_too(self, air: Air):
        a, b, *_ = pair(air)
        b.set(0x0C, 0, 200, 2)
        b.set(0x04, 0, b.get(0x04) | 1 << 28)
        b.listen()
        b.host.delay(40e-6)
        a.send(dw.DATA * 10)
        a.host.delay(1e-3)
        assert b.status & (dw.RXPRD | dw.RXFCG | dw.RXRFTO) == dw.RXPRD | dw.RXRFTO

    def test_the_preamble_time_out_counts_chunks_and_one_more(self, air: Air):
        a, b, *_ = pair(air)
        b.set(0x27, 0x24, 9, 2)
        b.set(0x0E, 0, dw.RXPTO)
        b.listen()
        began = b.host.now()
        b.host.wait(1.0)
        assert b.host.now() - began == pytest.approx(10 * 8 * 1017.63e-9 + 16e-6, abs=2e-6)
        assert exchange(a, b) & dw.RXFCG, "and not once there is a preamble"

    def test_the_sfd_time_out_may_be_too_short_or_none(self, air: Air):
        a, b, *_ = pair(air)
        b.set(0x27, 0x20, 50, 2)
        assert exchange(a, b) & (dw.RXSFDTO | dw.RXFCG) == dw.RXSFDTO
        b.configure(Mode(decawave_sfd=True))
        b.set(0x27, 0x20, 0, 2)
        status = exchange(a, b)
        assert status & dw.RXPRD
        assert not status & dw.ERRORS, "0 waits for ever"
        assert b.get(0x19, 0, 4) >> 16 & 15 == 5

    def test_a_delayed_reception_begins_at_its_time(self, air: Air):
        a, b, *_ = pair(air)
        b.set(0x0A, 0, b.time + 640_000_000, 5)
        b.set(0x0D, 0, dw.RXENAB | 1 << 9)
        a.send(dw.DATA)
        a.host.delay(5e-3)
        assert not b.status & dw.RXPRD
        b.host.delay(6e-3)
        a.send(dw.DATA)
        a.host.delay(1e-3)
        assert b.status & dw.RXFCG

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

    @pytest.mark.parametrize("error", [dw.RXPTO, dw.RXSFDTO])
    def test_some_errors_need_no_receiver_reset(self, air: Air, error: int):
        a, b, *_ = pair(air)
        if error == dw.RXPTO:
            b.set(0x27, 0x24, 5, 2)
            b.listen()
            b.host.delay(1e-3)
        else:
            b.configure(Mode(decawave_sfd=True))
            exchange(a, b)
        assert b.status & dw.ERRORS == error
        b.configure(Mode())
        b.set(0x27, 0x24, 0, 2)
        assert exchange(a, b) & dw.RXFCG
        assert flight_ticks(a, b) == pytest.approx(3.0 / dw.TICK_M, abs=1)

    def test_rxautr_goes_on_after_errors_alone_and_swallows_what_is_sent(self, air: Air):
        a, b, *_ = pair(air)
        b.configure(Mode(long_frames=True))
        b.set(0x04, 0, b.get(0x04) | 1 << 29)
        assert exchange(a, b) & dw.RXPHE
        assert b.get(0x19, 0, 4) >> 16 & 15 == 5, "on again by itself"
        b.send(dw.DATA)
        b.host.delay(2e-3)
        assert not b.status & dw.TXFRS, "a driver that takes the receiver for off loses this one"
        b.off()
        b.reset_receiver()
        b.configure(Mode())
        b.set(0x04, 0, b.get(0x04) | 1 << 29)
        assert exchange(a, b) & dw.RXFCG
        assert b.get(0x19, 0, 4) >> 16 & 15 == 1, "off after a good frame"

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


class TestDoubleBuffer:
    def test_a_second_frame_arrives_while_the_first_is_read(self, air: Air):
        a, b = double_buffered(air)
        send_whole(a, b"first")
        assert b.status & dw.ICRBP
        send_whole(a, b"second")
        for expected in (b"first", b"second"):
            assert b.status & (dw.RXFCG | dw.LDEDONE | dw.RXOVRR) == dw.RXFCG | dw.LDEDONE
            assert b.received() == expected
            b.set(0x0F, 0, dw.RXFCG | dw.RXDFR | dw.LDEDONE)
            b.command(dw.HRBPT)
        assert not b.status & dw.RXFCG
        send_whole(a, b"third")
        assert b.received() == b"third"

    def test_a_third_one_spoils_them_and_calls_for_a_reset(self, air: Air):
        a, b = double_buffered(air)
        for data in (b"first", b"second"):
            send_whole(a, data)
        stamp = b.rx_stamp
        send_whole(a, b"third")
        assert b.status & dw.RXOVRR
        assert b.rx_stamp != stamp, "of what was not read yet"
        b.set(0x0F, 0, dw.RXOVRR)
        assert b.status & dw.RXOVRR, "read-only"
        b.off()
        b.listen()
        b.host.delay(20e-6)
        send_whole(a, b"fourth")
        b.command(dw.HRBPT)
        assert abs(flight_ticks(a, b) - 3.0 / dw.TICK_M) * dw.TICK_M > 1.0, "without a receiver reset"
        b.off()
        b.reset_receiver()
        assert not b.status & dw.RXOVRR


class TestFilter:
    OWN = 0x0102
    PAN = 0xDECA

    def frame(self, kind: int, pan: int | None, to: bytes = b"", *, ack: bool = False) -> bytes:
        mode = {0: 0, 2: 2, 8: 3}[len(to)]
        control = kind | ack << 5 | 1 << 6 | mode << 10 | 2 << 14
        head = control.to_bytes(2, "little") + b"\x2a"
        if pan is not None:
            head += pan.to_bytes(2, "little") + to
        return head + b"\x99\x99data"

    def listener(self, air: Air, bits: int) -> tuple[Driver, Driver]:
        a, b, *_ = pair(air)
        b.set(0x03, 0, self.PAN << 16 | self.OWN)
        b.set(0x04, 0, b.get(0x04) | bits)
        return a, b

    @pytest.mark.parametrize(
        ("kind", "pan", "to", "bits", "passes"),
        [
            (1, PAN, b"\x02\x01", 0b1001, True),
            (1, PAN, b"\xff\xff", 0b1001, True),
            (1, 0xFFFF, b"\x02\x01", 0b1001, True),
            (1, PAN, b"\x03\x01", 0b1001, False),
            (1, 0xBEEF, b"\x02\x01", 0b1001, False),
            (1, PAN, b"\x02\x01", 0b0101, False),
            (1, PAN, b"EUI", 0b1001, True),
            (1, PAN, bytes(8), 0b1001, False),
            (0, PAN, b"", 0b0101, False),
            (3, PAN, b"\x02\x01", 1 | 1 << 5, True),
            (4, None, b"", 1 | 1 << 7, True),
            (4, None, b"", 1 | 1 << 8, False),
            (1, PAN, b"\x03\x01", 0b1000, True),
        ],
    )
    def test_what_passes(self, air: Air, kind: int, pan: int | None, to: bytes, bits: int, passes: bool):
        a, b = self.listener(air, bits)
        if to == b"EUI":
            to = b.read(0x01, 0, 8)
        status = exchange(a, b, self.frame(kind, pan, to))
        assert status & (dw.RXFCG | dw.AFFREJ) == (dw.RXFCG if passes else dw.AFFREJ)

    def test_a_frame_too_short_for_its_addresses_does_not_pass(self, air: Air):
        a, b = self.listener(air, 0b1001)
        assert exchange(a, b, self.frame(1, self.PAN, b"\x02\x01")[:6]) & dw.AFFREJ
        b.off()
        assert exchange(a, b, b"\x41") & dw.AFFREJ

    def test_after_a_rejected_frame_the_receiver_and_its_time_out_continue(self, air: Air):
        a, b = self.listener(air, 0b1001)
        b.set(0x0C, 0, 10_000, 2)
        b.set(0x04, 0, b.get(0x04) | 1 << 28)
        rejected = self.frame(1, self.PAN, b"\x03\x01")
        assert exchange(a, b, rejected) & (dw.AFFREJ | dw.RXRFTO) == dw.AFFREJ
        assert b.accumulator(740, 16) == bytes(64), "a receiver that is on owns the accumulator"
        a.send(self.frame(1, self.PAN, b"\x02\x01"))
        a.host.delay(1e-3)
        assert b.status & (dw.RXFCG | dw.LDEDONE) == dw.RXFCG | dw.LDEDONE, "without another enable"
        assert flight_ticks(a, b) == pytest.approx(3.0 / dw.TICK_M, abs=1), "and without a receiver reset"
        b.set(0x0F, 0, 0xFFFFFFFF)
        b.set(0x0E, 0, dw.RXRFTO)
        began = b.host.now()
        assert exchange(a, b, rejected) & dw.AFFREJ
        b.host.wait(1.0)
        assert b.host.now() - began == pytest.approx(10_000 * 512 / 499.2e6, abs=20e-6)

    def test_a_frame_of_a_version_to_come_does_not_pass(self, air: Air):
        a, b = self.listener(air, 0b1001)
        frame = bytearray(self.frame(1, self.PAN, b"\x02\x01"))
        frame[1] |= 0x20
        assert exchange(a, b, bytes(frame)) & dw.AFFREJ

    def test_a_frame_that_asks_for_it_is_acknowledged(self, air: Air):
        a, b = self.listener(air, 0b1001 | 1 << 30)
        b.set(0x1A, 3, 3, 1)
        b.load(b"")
        b.listen()
        b.host.delay(20e-6)
        a.send(self.frame(1, self.PAN, b"\x02\x01", ack=True), dw.WAIT4RESP)
        a.host.delay(2e-3)
        assert b.status & (dw.AAT | dw.TXFRS) == dw.AAT | dw.TXFRS
        assert a.status & dw.RXFCG
        assert a.received() == b"\x02\x00\x2a"

    def test_aat_may_be_false(self, air: Air):
        a, b = self.listener(air, 0)
        assert exchange(a, b, self.frame(1, self.PAN, b"\x02\x01", ack=True)) & (dw.AAT | dw.TXFRS) == dw.AAT
