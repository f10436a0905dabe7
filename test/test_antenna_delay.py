"""`uwb-mitigation board antenna-delay` with emulated boards."""

from __future__ import annotations

import json
from pathlib import Path

import command_line
import numpy as np
import pytest
import yaml
from compilers import NEEDS_CC

from benchmarks.equipment.dw1000_model.evb1000 import EmulatedEvb1000s
from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.radios.dw1000.antenna_delay import delay_from_ranges
from uwb_mitigation.radios.dw1000.bus import bus_opener
from uwb_mitigation.radios.dw1000.driver import RadioDriver
from uwb_mitigation.radios.settings import RadioSettings, Role

NOMINAL = 2 * 16436


def around(middle_m: float, sd_m: float, n: int = 400) -> np.ndarray:
    return middle_m + sd_m * np.random.default_rng(1).standard_normal(n)


@pytest.mark.parametrize("radios", [1, 2])
def test_offset_is_divided_among_the_calibrated_radios(radios: int):
    # One tick less in one radio lengthens the range by 2.35 mm (APS014).
    found = delay_from_ranges(around(5.01 + 0.235, 0.001), np.full(400, 3.0), 5.01, [NOMINAL] * radios)
    assert abs(found.antenna_delay - NOMINAL - 100 / radios) <= 1
    assert abs(found.offset_m - 0.235) < 0.001


@pytest.mark.parametrize(
    ("ranges", "gap_db", "says"),
    [
        (around(5.0, 0.3), 3.0, "standard deviation"),
        (np.where(np.arange(400) % 3 > 0, 5.0, 6.0), 3.0, "standard deviation"),
        (around(5.0, 0.02), 9.0, "line of sight"),
        (around(5.0, 0.02), float("nan"), "line of sight"),
        (around(200.0, 0.02), 3.0, "an antenna delay of"),
    ],
)
def test_invalid_calibration_is_refused(ranges: np.ndarray, gap_db: float, says: str):
    with pytest.raises(UwbMitigationError, match=says):
        delay_from_ranges(ranges, np.full(400, gap_db), 5.01, [NOMINAL, NOMINAL])


@NEEDS_CC
def test_antenna_delay_of_a_pair_is_estimated_and_written(tmp_path: Path):
    # The OTP memory of the modelled chips contains the delay: the settings override it.
    truth = NOMINAL + 173
    with EmulatedEvb1000s(boards=2, antenna_delay=truth) as boards:
        done = command_line.start(
            "board", "antenna-delay", "--distance", 3.0, "--port", ",".join(boards.ports), "--exchanges", 40, "--start", NOMINAL,
            "-o", "found.yaml", "--json", "found.json", folder=tmp_path,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    written = yaml.safe_load((tmp_path / "found.yaml").read_text())["/**"]["ros__parameters"]
    assert abs(written["radio.antenna_delay"] - truth) <= 2
    result = json.loads((tmp_path / "found.json").read_text())
    assert result["before"] == NOMINAL
    assert result["antenna_delay"] == written["radio.antenna_delay"]
    assert "--params-file found.yaml" in done.stdout


@NEEDS_CC
def test_single_tag_compensates_the_complete_offset(tmp_path: Path):
    with EmulatedEvb1000s(boards=2, antenna_delay=NOMINAL + 60, distance_m=5.01) as boards:
        anchor = RadioDriver(
            bus_opener("evb1000", boards.ports[1]), RadioSettings(role=Role.ANCHOR, antenna_delay=NOMINAL)
        )
        try:
            done = command_line.run(
                "board", "antenna-delay", "--distance", 5.01, "--port", boards.ports[0], "--exchanges", 40, "--start", NOMINAL,
                "--json", "found.json", folder=tmp_path,
            )  # fmt: skip
        finally:
            anchor.close()
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "found.json").read_text())
    assert abs(result["antenna_delay"] - (NOMINAL + 120)) <= 2
    assert f"radio.antenna_delay: {result['antenna_delay']}" in done.stdout


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--distance", "0", "--port", "/dev/a"), "0.3 to 100 m"),
        (("--distance", "5", "--port", "/dev/a,/dev/a"), "tag and anchor"),
        (("--distance", "5", "--port", ","), "tag and anchor"),
        (("--distance", "5", "--port", "/dev/a", "--channel", "6"), "channel"),
        (("--distance", "5", "--port", "/dev/a", "--anchor", "xyz"), "hexadecimal"),
        (("--distance", "5", "--port", "/dev/a", "-o", "absent/file"), "an existing folder"),
    ],
)
def test_implausible_options_are_refused_immediately(options: tuple[str, ...], says: str, tmp_path: Path):
    done = command_line.run("board", "antenna-delay", *options, folder=tmp_path)
    assert done.returncode == 1
    assert says in done.stderr
