"""The DW1000 model as a library, and its reactions to driver errors.

`test_radio_exchange.py` tests frames, timestamps and accumulators with the firmware.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import dw1000_driver as dw
import pytest
from compilers import NEEDS_CC
from dw1000_driver import Driver, Mode, exchange, flight_ticks, pair

from benchmarks.equipment.dw1000_model.air import Air, Chip
from benchmarks.equipment.dw1000_model.library import MODEL_FOLDER, model_objects
from uwb_mitigation.mitigation.embedded.compiling import WARNINGS, c_compiler, run_tool

pytestmark = NEEDS_CC

ID = bytes.fromhex("3001cade")


@pytest.fixture
def chip(air: Air) -> Chip:
    return air.chip()


@pytest.fixture
def driver(chip: Chip) -> Driver:
    return Driver(chip)


def test_interrupt_line_is_status_and_mask_with_its_polarity(driver: Driver, chip: Chip):
    assert not chip.irq()
    driver.set(0x0E, 0, dw.CPLOCK)
    assert chip.irq()
    assert driver.status & 1
    driver.set(0x04, 0, 0x1000)
    assert not chip.irq(), "active low"
    driver.set(0x0F, 0, dw.CPLOCK)
    assert chip.irq()


class TestClocks:
    def test_spi_faster_than_3_mhz_before_the_pll_lock_reads_garbage(self, driver: Driver):
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


def test_driver_may_define_any_name_without_the_prefix_of_the_model(tmp_path: Path):
    objects = model_objects()
    defined = run_tool(["nm", "-g", "--defined-only", "-P", *objects]).splitlines()
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
    run_tool([*c_compiler(), *options, str(driver), *objects, "-lm", "-lpthread", "-o", str(program)])
    run_tool([str(program)])


def compiled(source: Path, program: Path) -> Path:
    sources = (*MODEL_FOLDER.glob("*.c"), source)
    options = ("-std=c11", "-O1", "-g", "-fsanitize=address,undefined", *WARNINGS, f"-I{MODEL_FOLDER}")
    run_tool([*c_compiler(), *options, *map(str, sources), "-lm", "-lpthread", "-o", str(program)])
    return program


def test_program_on_the_page_prints_the_shown_output(tmp_path: Path):
    page = (MODEL_FOLDER / "README.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    (promise,) = re.findall(r"prints `(.*?)` twice", page)
    source = tmp_path / "blink.c"
    source.write_text(text, encoding="utf-8")
    done = subprocess.run([compiled(source, tmp_path / "blink")], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [promise] * 2
