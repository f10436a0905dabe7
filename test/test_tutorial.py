"""The commands of docs/tutorials/first_steps.md that need no nodes, and the output and figures that pages quote from them."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY

TUTORIAL = (REPOSITORY / "docs" / "tutorials" / "first_steps.md").read_text(encoding="utf-8")
RECORDINGS = (REPOSITORY / "docs" / "guides" / "recordings.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^uwb-mitigation (?!doctor|view)(.*)$", TUTORIAL, re.M)
QUOTES = {
    "evaluate": re.search(r"`evaluate` prints:\n\n```text\n(.*?)```", TUTORIAL, re.S)[1],
    "process": re.search(r"gives:\n\n```text\n(┏.*?bag .*?)```", RECORDINGS, re.S)[1],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tutorial")


def run(folder: Path, line: str) -> str:
    command = [sys.executable, "-m", "uwb_mitigation.commands.cli", *shlex.split(line)]
    environment = os.environ | {"COLUMNS": "80"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    assert max((len(line) for line in done.stdout.splitlines() if line[0] in "┃│"), default=0) <= 80
    return done.stdout


@pytest.fixture(scope="module")
def outputs(folder: Path) -> dict[str, str]:
    """The output of each command, by its name; the last one of a name."""
    return {line.split()[0]: run(folder, f"{line} --json {line.split()[0]}.json") for line in COMMANDS}


@pytest.mark.parametrize("name", QUOTES)
def test_quoted_output_is_printed(outputs: dict[str, str], name: str):
    printed = {line.rstrip() for line in outputs[name].splitlines()}
    assert [line for line in QUOTES[name].splitlines() if line.rstrip() not in printed] == []


def test_quoted_contributions_to_the_position_are_measured(outputs: dict[str, str], folder: Path):
    assert "Horizontal errors" in outputs["track"]
    run(folder, "track drive.mcap --anchors drive.anchors.yaml --height 0 -o raw.mcap --json raw.json")
    raw, corrected = (json.loads((folder / f"{name}.json").read_text()) for name in ("raw", "track"))
    rows = (raw["snapshot"], raw["live"], corrected["live"], corrected["smoothed"])
    quoted = re.findall(r"^\| (?:raw|corrected) \| .* \| (0\.\d+) \|$", TUTORIAL, re.M)
    assert quoted == [f"{row['horizontal_rmse_m']:.3f}" for row in rows]
    coverage = re.search(r"raw ranges (\d+) % of the true .*?corrected ranges (\d+) %", TUTORIAL, re.S)
    assert list(coverage.groups()) == [f"{100 * row['coverage95']:.0f}" for row in rows[1:3]]
