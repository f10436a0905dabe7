"""Each script in `docs/experiments` runs, with little data; its figures are not checked."""

import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY

from uwb_mitigation.mitigation import early_path
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.simulation.simulated import SimulatedBuildings

pytestmark = pytest.mark.slow
SCRIPTS = REPOSITORY / "docs" / "experiments"
SMALL = {
    "calibrate_drives": (
        "geometry --seeds 1 --force --data DATA --only level_square.*2-D", {"position_data.DRIVE_S": "40.0"}
    ),
    "copy_bag": ("BAG", {}),
    "early_peaks": ("", {"3_000_003, 60": "3_000_003, 1", "(0.0, 0.02, 0.05)": "(0.05,)"}),
    "few_configurations": (
        "LOGS/evk1000_apartment 1",
        {"(6, 9, 12, 15, 18, 21)": "(3,)", ", 6, 0)": ", 2, 0)"},
    ),
    "other_channels": (
        "MODEL",
        {", 40,": ", 1,", "(*CHANNELS.values(), *SHORT_PULSES)": "SHORT_PULSES[:1]", "pool.map": "map"},
    ),
    "process_memory": ("100", {}),
    "processor_digest": ("BAG", {}),
    "python_speed": ("", {"1024": "64"}),
    "second_simulator": ("", {"count=1000": "count=20"}),
    "simulated_sites": ("MODEL", {", 40": ", 1"}),
    "simulator_against_logs": (
        "LOGS",
        {
            '"open", "plasterboard", "brick", "concrete", "site", "drone_room"': '"open",', "range(4)": "range(1)",
            "6000": "400", "60.0, kind": "10.0, kind", "placements=256": "placements=2",
        },
    ),
    "static_noise": ("BAG MODEL", {}),
    "survey_real_runs": ("DATA/hanyang_outdoor 1", {'"*_*"': '"LOS_A1"', "run.ranges\n": "run.ranges.take(slice(1500))\n"}),
    "unseen_places": ("BAG MODEL", {}),
    "weaker_radio": ("BAG 1 universal", {}),
    "when_worth_it": (
        "",
        {
            "list(product(FLATS, COUNTS))": '[("brick", 4)]', "906": "901", "924": "901", "pool.map": "map",
            "60.0, building": "15.0, building",
        },
    ),
}  # fmt: skip
"""{script: (arguments, {text: replacement that needs less time})}."""
TOO_LONG = {"kernel_cycles", "rejoin_time", "viewer_load"}
"""Scripts that only mypy checks: of an emulator, nodes and a browser."""


def test_scripts_are_known():
    assert {script.stem for script in SCRIPTS.glob("*.py")} == SMALL.keys() | TOO_LONG


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("experiments") / "ranges.mcap"
    with BagWriter(path, {"source": "simulated", "simulated": "true"}) as writer:
        for record in SimulatedBuildings(seed=1, placements=24, exchanges=4):
            writer.write(record)
    return path


@pytest.fixture(scope="module")
def logs(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with six of the real logs."""
    folder = tmp_path_factory.mktemp("data")
    names = shutil.ignore_patterns("??.log.xz")
    shutil.copytree(data / "evk1000_apartment", folder / "evk1000_apartment", ignore=names)
    return folder


@pytest.mark.parametrize("name", SMALL)
def test_script_runs(name: str, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch):
    words, replacements = SMALL[name]
    values = {"MODEL": str(default_model_path())}
    for fixture in ("data", "logs", "bag"):
        if fixture.upper() in words:
            values[fixture.upper()] = str(request.getfixturevalue(fixture))
    arguments = [re.sub("[A-Z]{3,}", lambda name: values[name[0]], word) for word in words.split()]
    text = (SCRIPTS / f"{name}.py").read_text(encoding="utf-8")
    for old, new in replacements.items():
        assert old in text
        text = text.replace(old, new)
    script = tmp_path / f"{name}.py"
    script.write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), *arguments])
    monkeypatch.setattr(early_path, "SEARCH_TAPS", early_path.SEARCH_TAPS)  # One script changes it.
    runpy.run_path(str(script), run_name="__main__")
