"""Ranges of modelled radios at all clock errors and distances, a soak test, and the model as a library."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

from compilers import NEEDS_CC
from typer.testing import CliRunner

from benchmarks import cli as benchmarks
from benchmarks import radio
from benchmarks.equipment.dw1000_model.library import MODEL_FOLDER
from uwb_mitigation.mitigation.embedded.compiling import WARNINGS, c_compiler, run_tool

pytestmark = NEEDS_CC


def test_soak_yields_no_wrong_range_and_every_chip_recovers_within_a_second():
    soaked = radio.soak(2000, seed=3, advance=lambda _: None)
    assert soaked.exchanges >= 2000
    assert soaked.delivered > 800
    assert soaked.disturbances > 10
    assert soaked.wrong == 0
    assert soaked.longest_recovery_s <= 1.0
    assert soaked.lost["no_answer"] > 0
    assert soaked.lost["damaged"] > 0
    assert sum(soaked.lost.values()) + soaked.delivered >= soaked.exchanges - 1


def test_benchmark_writes_what_it_measured(tmp_path: Path):
    output = tmp_path / "radio.json"
    arguments = ["radio", "--seconds", "0.5", "--exchanges", "300", "--evb1000", "0", "--json", str(output)]
    assert CliRunner().invoke(benchmarks.app, arguments, catch_exceptions=False).exit_code == 0
    result = json.loads(output.read_text())
    assert len(result["ranging"]) == 25
    for row in result["ranging"]:
        # The counter of the tag wraps after 0.05 s.
        assert row["exchanges"] > 100
        assert abs(row["mean_error_m"]) <= 0.005
        assert row["sd_m"] <= 0.005
    assert result["host_rate_hz"] >= 100
    assert result["device_rate_hz"] >= 80
    assert result["evb1000_rate_hz"] is None
    assert result["soak"]["wrong"] == 0


def test_program_on_the_page_prints_the_shown_output(tmp_path: Path):
    page = (MODEL_FOLDER / "README.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    (promise,) = re.findall(r"prints `(.*?)` twice", page)
    source = tmp_path / "blink.c"
    source.write_text(text, encoding="utf-8")
    program, sources = str(tmp_path / "blink"), (*MODEL_FOLDER.glob("*.c"), source)
    options = ("-std=c11", "-O1", "-g", "-fsanitize=address,undefined", *WARNINGS, f"-I{MODEL_FOLDER}")
    run_tool([*c_compiler(), *options, *map(str, sources), "-lm", "-lpthread", "-o", program])
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [promise] * 2
