"""The commands of docs/tutorials/first_steps.md that need no nodes, and the output that pages quote from them."""

from __future__ import annotations

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
    "track": re.search(r"correction only.\n\n```text\n(.*?)```", TUTORIAL, re.S)[1],
    "process": re.search(r"gives:\n\n```text\n(┏.*?bag .*?)```", RECORDINGS, re.S)[1],
}


def run(folder: Path, line: str) -> str:
    command = [sys.executable, "-m", "uwb_mitigation.commands.cli", *shlex.split(line)]
    environment = os.environ | {"COLUMNS": "80"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    assert max((len(line) for line in done.stdout.splitlines() if line[0] in "┃│"), default=0) <= 80
    return done.stdout


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The output of each command, by its name; the last one of a name."""
    folder = tmp_path_factory.mktemp("tutorial")
    return {line.split()[0]: run(folder, line) for line in COMMANDS}


@pytest.mark.parametrize("name", QUOTES)
def test_quoted_output_is_printed(outputs: dict[str, str], name: str):
    printed, quoted = (
        [re.sub(r"model [0-9a-f]{8}", "model ID", line.rstrip()) for line in text.splitlines()]
        for text in (outputs[name], QUOTES[name])
    )
    assert [line for line in quoted if line not in printed] == []
