"""Where results go: whole, to where they were asked for, and nowhere else."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from command_line import run

from uwb_mitigation.commands import cli, console
from uwb_mitigation.errors import UwbMitigationError


def test_a_result_is_written_as_json(tmp_path: Path):
    console.write_json(tmp_path / "out.json", {"n": 1})
    assert json.loads((tmp_path / "out.json").read_text()) == {"n": 1}


def test_a_result_that_json_cannot_hold_is_refused(tmp_path: Path):
    with pytest.raises(UwbMitigationError, match="cannot write the result"):
        console.write_json(tmp_path / "out.json", {"n": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("place", ["/", ".", "absent/out.json"])
def test_a_place_that_can_hold_no_result_is_refused_before_the_work(place: str):
    with pytest.raises(typer.BadParameter):
        console._check_json_target(Path(place))


def with_examples(command: Any, *name: str) -> Iterator[tuple[tuple[str, ...], list[str]]]:
    """Commands, and the indented lines of their docstrings."""
    examples = [line for line in inspect.cleandoc(command.help or "").splitlines() if line.startswith("    ")]
    if examples:
        yield name, examples
    for sub, below in getattr(command, "commands", {}).items():
        yield from with_examples(below, *name, sub)


EXAMPLES = dict(with_examples(typer.main.get_command(cli.app)))


def test_help_takes_the_width_of_the_terminal(tmp_path: Path):
    assert "and record some hundred ranges." in run("offset", "--help", folder=tmp_path).stdout


@pytest.mark.parametrize("columns", [60, 100, 160])
@pytest.mark.parametrize("command", EXAMPLES, ids=" ".join)
def test_help_shows_each_example_on_a_line_of_its_own_indented(
    command: tuple[str, ...], columns: int, tmp_path: Path
):
    shown = run(*command, "--help", folder=tmp_path, columns=columns).stdout.splitlines()
    # All text is one column in; of an example that is longer than a line, its first.
    indented = [line[1:].rstrip() for line in shown if re.match(r" {5}\S", line)]
    assert len(indented) == len(EXAMPLES[command])
    for line, example in zip(indented, EXAMPLES[command], strict=True):
        assert example.startswith(line)
        assert line == example or len(example) > columns - 2
