"""Ranges of modelled radios at all clock errors and distances, a soak test, and the model as a library."""

import json
import re
import subprocess
from pathlib import Path

from compilers import NEEDS_CC
from typer.testing import CliRunner

from benchmarks import cli as benchmarks
from benchmarks.equipment.dw1000_model.library import MODEL_FOLDER
from uwb_mitigation.mitigation.embedded.compiling import WARNINGS, c_compiler, run_tool

pytestmark = NEEDS_CC


def test_ranges_are_right_and_in_a_soak_every_chip_recovers_within_a_second(tmp_path: Path):
    output = tmp_path / "radio.json"
    words = f"radio --seconds 0.5 --exchanges 2000 --seed 3 --evb1000 0 --json {output}"
    assert CliRunner().invoke(benchmarks.app, words.split(), catch_exceptions=False).exit_code == 0
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
    soak = result["soak"]
    assert soak["exchanges"] >= 2000
    assert soak["delivered"] > 800
    assert soak["disturbances"] > 10
    assert soak["wrong"] == 0
    assert soak["longest_recovery_s"] <= 1.0
    assert min(soak["lost"]["no_answer"], soak["lost"]["damaged"]) > 0
    assert sum(soak["lost"].values()) + soak["delivered"] >= soak["exchanges"] - 1


def test_program_on_the_page_prints_the_shown_output(tmp_path: Path):
    page = (MODEL_FOLDER / "README.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    (promise,) = re.findall(r"prints `(.*?)` twice", page)
    source = tmp_path / "blink.c"
    source.write_text(text, encoding="utf-8")
    program, sources = str(tmp_path / "blink"), (*MODEL_FOLDER.glob("*.c"), source)
    options = ("-std=c11", "-O1", "-fsanitize=address,undefined", *WARNINGS, f"-I{MODEL_FOLDER}")
    run_tool([*c_compiler(), *options, *map(str, sources), "-lm", "-lpthread", "-o", program])
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [promise] * 2
