"""The DW1000's model as a library: virtual time, programs, determinism, links, sanitizers."""

from __future__ import annotations

import math
import os
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import model_material
import numpy as np
import pytest
from compilers import NEEDS_CC
from conftest import REPOSITORY
from dw1000_driver import RXRFTO, Driver, exchange, pair

from benchmarks.dw1000_model.air import Air, Host
from benchmarks.dw1000_model.library import model_folder, model_objects
from benchmarks.dw1000_model.links import Link, link_of
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.firmware_export.compiling import WARNINGS, c_compiler, firmware_folder, run
from uwb_mitigation.measurement import Cir, RangeMeasurement, Truth

pytestmark = NEEDS_CC

SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


class TestTime:
    def test_a_run_ends_with_its_time_or_with_the_last_program(self, air: Air):
        assert air.run(0.5) == pytest.approx(0.5), "nothing to wait for"
        air.program(air.chip(), lambda host: host.delay(0.25))
        air.program(air.chip(), lambda host: host.delay(0.1))
        assert air.run(10.0) == pytest.approx(0.75)
        assert air.run(10.0) == pytest.approx(10.75), "none that could end"

    def test_programs_interleave_in_the_order_of_time(self, air: Air):
        seen: list[tuple[int, int]] = []

        def program(number: int, period_s: float) -> None:
            def tick(host: Host) -> None:
                for turn in range(4):
                    host.delay(period_s)
                    seen.append((number, turn))

            air.program(air.chip(), tick)

        program(1, 0.010)
        program(2, 0.025)
        air.run(1.0)
        assert seen == [(1, 0), (1, 1), (2, 0), (1, 2), (1, 3), (2, 1), (2, 2), (2, 3)]

    def test_what_a_program_raises_is_raised_by_run_once(self, air: Air):
        def fail(host: Host) -> None:
            host.delay(0.1)
            raise LookupError("mine")

        air.program(air.chip(), fail)
        with pytest.raises(LookupError, match="mine"):
            air.run(1.0)
        air.run(1.0)

    def test_the_interrupt_wakes_a_program_at_once(self, air: Air):
        woken: list[float] = []

        def time_out(host: Host) -> None:
            driver = Driver(host)
            driver.start()
            driver.set(0x0C, 0, 10_000, 2)
            driver.set(0x04, 0, driver.get(0x04) | 1 << 28)
            driver.set(0x0E, 0, RXRFTO)
            began = host.now()
            driver.listen()
            host.wait(10.0)
            woken.append(host.now() - began)
            assert driver.status & RXRFTO

        air.program(air.chip(), time_out)
        air.run(1.0)
        assert woken == pytest.approx([10_000 * 512 / 499.2e6], abs=30e-6)


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

    @pytest.mark.parametrize(
        "changes", [{"loss": 1.1}, {"excess_m": math.inf}, {"samples": np.zeros(3, np.int16)}]
    )
    def test_what_is_out_of_range_is_refused(self, changes: dict[str, object]):
        with pytest.raises(ParameterError):
            Link(3.0, **changes)  # type: ignore[arg-type]


def test_arbitrary_transactions_break_nothing(tmp_path: Path):
    program = tmp_path / "fuzz_dw1000_model"
    sources = (firmware_folder() / "test" / "fuzz_dw1000_model.c", *model_folder().glob("*.c"))
    options = ("-std=c11", *SANITIZED, *WARNINGS, f"-I{model_folder()}")
    run([*c_compiler(), *options, *map(str, sources), "-lm", "-lpthread", "-o", str(program)])
    environment = {**os.environ, "ASAN_OPTIONS": "detect_leaks=1"}
    command = [str(program), "300", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]


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
