"""The DW1000's model as a library, and what a wrong driver would get from it, as from the chip.

`test_radio_exchange.py` tests frames, timestamps and accumulators through the firmware's own driver.
"""

from __future__ import annotations

import math
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import dw1000_driver as dw
import numpy as np
import pytest
from compilers import NEEDS_CC
from dw1000_driver import Driver, Mode, exchange, flight_ticks, pair

from benchmarks.dw1000_model.air import Air, Chip
from benchmarks.dw1000_model.library import MODEL_FOLDER, model_objects
from benchmarks.dw1000_model.links import Link, link_of
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.firmware_export.compiling import WARNINGS, c_compiler, run
from uwb_mitigation.measurement import Cir, RangeMeasurement

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


def test_the_interrupt_line_is_status_and_mask_with_its_polarity(driver: Driver, chip: Chip):
    assert not chip.irq()
    driver.set(0x0E, 0, dw.CPLOCK)
    assert chip.irq()
    assert driver.status & 1
    driver.set(0x04, 0, 0x1000)
    assert not chip.irq(), "active low"
    driver.set(0x0F, 0, dw.CPLOCK)
    assert chip.irq()


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


class TestReceiver:
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


class TestLinks:
    def measurement(self, cir: Cir, range_m: float = 4.0) -> RangeMeasurement:
        return RangeMeasurement(0, 1, 2, 3, 4, range_m, cir)

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
    options = ("-fno-builtin", f"-I{MODEL_FOLDER}")
    run([*c_compiler(), *options, str(driver), *objects, "-lm", "-lpthread", "-o", str(program)])
    run([str(program)])


def compiled(source: Path, program: Path) -> Path:
    sources = (*MODEL_FOLDER.glob("*.c"), source)
    options = ("-std=c11", "-O1", "-g", "-fsanitize=address,undefined", *WARNINGS, f"-I{MODEL_FOLDER}")
    run([*c_compiler(), *options, *map(str, sources), "-lm", "-lpthread", "-o", str(program)])
    return program


def test_the_pages_program_prints_what_the_page_says(tmp_path: Path):
    page = (MODEL_FOLDER / "README.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    (promise,) = re.findall(r"prints `(.*?)` twice", page)
    source = tmp_path / "blink.c"
    source.write_text(text, encoding="utf-8")
    done = subprocess.run([compiled(source, tmp_path / "blink")], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [promise] * 2
