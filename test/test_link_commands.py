"""`python -m benchmarks emulate-board`, and the benchmark of the link."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bag_material import Foreign
from typer.testing import CliRunner

from benchmarks.cli import app
from uwb_mitigation.errors import ParameterError, RecordingError


def run(*arguments: str) -> str:
    return CliRunner().invoke(app, list(arguments), catch_exceptions=False).output


def test_emulated_board_runs_for_the_given_duration(tmp_path):
    result = tmp_path / "board.json"
    output = run("emulate-board", "--duration", "0.5", "--rate", "100", "--json", str(result))

    assert "simulated" in output
    assert "/dev/" in output
    assert json.loads(result.read_text())["sent"] > 0


@pytest.mark.parametrize(
    "option",
    ["--mode neither", "--rate 0", "--duration -1", "--lose nan", "--seed -1", "--link /nonexistent/board"],
)
def test_option_out_of_its_range_is_refused(option):
    with pytest.raises(ParameterError):
        run("emulate-board", *option.split())


def test_empty_recording_is_reported_before_a_port_is_opened(tmp_path: Path):
    bag = Foreign(tmp_path / "empty.mcap").ours().finish()
    result = CliRunner().invoke(app, ["emulate-board", str(bag), "--duration", "1"])

    assert isinstance(result.exception, RecordingError)
    assert "no measurements" in str(result.exception)
    assert "/dev/" not in result.output
