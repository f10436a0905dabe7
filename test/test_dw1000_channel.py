"""The DW1000's model, by the manual: the accumulator, and what the registers say of it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from compilers import NEEDS_CC
from dw1000_driver import DATA, RXFCG, TXSTRT, WAIT4RESP, Mode, exchange, pair

from benchmarks.dw1000_model.air import Air
from benchmarks.dw1000_model.links import Link, link_of
from uwb_mitigation.sources.simulated import SimulatedSurvey

pytestmark = NEEDS_CC


class TestChannel:
    def simulated(self, seed: int = 3) -> Iterator[tuple[Link, object]]:
        for record in SimulatedSurvey(seed=seed, configurations=4, exchanges=1):
            yield link_of(record.measurement, record.truth), record.measurement

    def test_the_accumulator_is_the_links_bit_for_bit_whole_and_in_part(self, air: Air):
        a, b, one, two = pair(air)
        for link, _ in self.simulated():
            air.link(one, two, link)
            assert exchange(a, b) & RXFCG
            whole = np.frombuffer(b.accumulator(0, 1016), "<i2")
            assert np.array_equal(whole, link.samples)
            first = b.get(0x15, 5, 2) // 64 - 5
            part = np.frombuffer(b.accumulator(first, 157), "<i2")
            assert np.array_equal(part, link.samples[2 * first : 2 * (first + 157)])

    def test_at_16_mhz_there_are_992_samples(self, air: Air):
        link = Link(3.0, samples=np.full(2032, 1000, np.int16), first_path_index=745.5)
        a, b, *_ = pair(air, link, Mode(prf=16))
        assert exchange(a, b) & RXFCG
        whole = np.frombuffer(b.accumulator(0, 1016), "<i2")
        assert (whole[: 2 * 992] == 1000).all()
        assert not whole[2 * 992 :].any()

    def test_the_first_octet_of_every_read_is_a_dummy(self, air: Air):
        a, b, *_ = pair(air, Link(3.0, samples=np.arange(2032, dtype=np.int16)))
        assert exchange(a, b) & RXFCG
        b.set(0x36, 0, 0x8248, 2)
        for sample in (0, 100, 745):
            dummy, *octets = b.read(0x25, 4 * sample, 5)
            assert bytes(octets) == np.array([2 * sample, 2 * sample + 1], "<i2").tobytes()
            assert dummy not in (octets[0], 0)

    def test_without_its_clocks_the_accumulator_reads_nothing(self, air: Air):
        a, b, *_ = pair(air)
        assert exchange(a, b) & RXFCG
        assert not any(b.accumulator(740, 20, clocks=False))
        b.set(0x36, 0, 0x48, 1)
        assert not any(b.read(0x25, 4 * 740, 81)[1:]), "FACE without AMCE"
        b.set(0x36, 0, 0x8208, 2)
        assert not any(b.read(0x25, 4 * 740, 81)[1:]), "AMCE without FACE"

    def test_the_next_enable_wipes_it_even_while_it_is_read(self, air: Air):
        a, b, *_ = pair(air, Link(3.0, samples=np.full(2032, 77, np.int16)))
        a.set(0x1A, 0, 0)
        assert exchange(b, a) & RXFCG
        assert any(a.accumulator(0, 1016))
        a.load(DATA)
        a.command(TXSTRT | WAIT4RESP)
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
            assert exchange(a, b) & RXFCG
            cir = measurement.cir
            samples = cir.samples.astype(np.float64)
            magnitude = np.hypot(samples[0::2], samples[1::2])
            index = b.get(0x15, 5, 2) / 64
            assert index == pytest.approx(cir.first_path_index, abs=1 / 64)
            first = int(index)
            told = [b.get(0x15, 7, 2), b.get(0x12, 2, 2), b.get(0x12, 4, 2)]
            assert told == pytest.approx(magnitude[first + 1 : first + 4], abs=0.51)
            assert b.get(0x2E, 0x1000, 2) == magnitude.argmax()
            assert b.get(0x2E, 0x1002, 2) == pytest.approx(magnitude.max(), abs=0.51)
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
        assert exchange(a, b) & RXFCG
        count = b.get(0x10) >> 20
        assert count == b.get(0x27, 0x2C, 2)
        assert 256 - 2 * 16 <= count <= 256 + 8

    def test_a_clean_link_has_a_first_path_and_a_threshold_by_ntm(self, air: Air):
        a, b, *_ = pair(air)
        assert exchange(a, b) & RXFCG
        index = b.get(0x15, 5, 2) / 64
        assert 740 < index < 750
        assert 0.3 < b.get(0x2E, 0x1000, 2) - index < 2.5
        assert b.get(0x2E, 0, 2) == 13 * b.get(0x12, 0, 2)
        b.set(0x2E, 0x0806, 0x67, 1)
        assert exchange(a, b) & RXFCG
        assert b.get(0x2E, 0, 2) == 7 * b.get(0x12, 0, 2)

    def test_a_frame_says_how_it_was_sent(self, air: Air):
        a, b, *_ = pair(air, mode=Mode(preamble=1024, rate=1, prf=16))
        assert exchange(a, b) & RXFCG
        info = b.get(0x10)
        assert info & 0x7F == len(DATA) + 2
        assert info >> 13 & 3 == 1
        assert info >> 15 & 1 == 1
        assert info >> 16 & 3 == 1
        assert info >> 18 & 3 == 2
