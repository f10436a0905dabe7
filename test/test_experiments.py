"""Each script in `docs/experiments` runs, with little data; its figures are not checked."""

import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
from bag_material import write_records
from conftest import REPOSITORY

from uwb_mitigation.mitigation import early_path
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.simulation.simulated import SimulatedBuildings

pytestmark = pytest.mark.slow
SCRIPTS = REPOSITORY / "docs" / "experiments"
SMALL = """
calibrate_drives geometry --seeds 1 --force --data DATA --only level_square.*2-D | position_data.DRIVE_S -> 40.0
copy_bag BAG
early_peaks | 3_000_003, 60 -> 3_000_003, 1 | (0.0, 0.02, 0.05) -> (0.05,)
few_configurations LOGS/evk1000_apartment 1 | (6, 9, 12, 15, 18, 21) -> (3,) | , 6, 0) -> , 2, 0)
other_channels MODEL | , 40, -> , 1, | (*CHANNELS.values(), *SHORT_PULSES) -> SHORT_PULSES[:1]
process_memory 100
processor_digest BAG
python_speed | 1024 -> 64
second_simulator | count=1000 -> count=20
simulated_sites MODEL | , 40 -> , 1
simulator_against_logs LOGS | in KINDS -> in KINDS[:1] | range(4) -> range(1) | 60.0, -> 10.0, | 6000 -> 400 | 256 -> 2
static_noise BAG MODEL
survey_real_runs DATA/hanyang_outdoor 1 | *_* -> LOS_A1 | , run.ranges -> , run.ranges.take(slice(1500))
unseen_places BAG MODEL
weaker_radio BAG 1 universal
when_worth_it | product(FLATS, COUNTS) -> [("brick", 4)] | 906 -> 901 | 924 -> 901 | 60.0, -> 15.0,
"""
"""Scripts with arguments, and replacements of text that needs less time."""
CASES = {line.split()[0]: line.split(" | ") for line in SMALL.strip().splitlines()}
TOO_LONG = {"kernel_cycles", "rejoin_time", "viewer_load"}
"""Scripts that only mypy checks: of an emulator, nodes and a browser."""


def test_scripts_are_known():
    assert {script.stem for script in SCRIPTS.glob("*.py")} == CASES.keys() | TOO_LONG


@pytest.fixture
def model() -> Path:
    return default_model_path()


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("experiments") / "ranges.mcap"
    return write_records(path, SimulatedBuildings(seed=1, placements=24, exchanges=4))


@pytest.fixture
def logs(data: Path, tmp_path: Path) -> Path:
    """Return a folder with six of the real logs."""
    name, ignored = "evk1000_apartment", shutil.ignore_patterns("??.log.xz")
    return shutil.copytree(data / name, tmp_path / "logs" / name, ignore=ignored).parent


@pytest.mark.parametrize("name", CASES)
def test_script_runs(name: str, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch):
    command, *replacements = CASES[name]
    # Another process could not import the script.
    text = (SCRIPTS / f"{name}.py").read_text(encoding="utf-8").replace("pool.map", "map")
    for old, new in (replacement.split(" -> ") for replacement in replacements):
        assert old in text
        text = text.replace(old, new)
    script = tmp_path / f"{name}.py"
    script.write_text(text)

    def place(fixture: re.Match[str]) -> str:
        return str(request.getfixturevalue(fixture[0].lower()))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [re.sub("[A-Z]{3,}", place, word) for word in command.split()])
    monkeypatch.setattr(early_path, "SEARCH_TAPS", early_path.SEARCH_TAPS)  # One script changes it.
    runpy.run_path(str(script), run_name="__main__")
