"""JSON results of commands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from uwb_mitigation.commands.support import console
from uwb_mitigation.errors import UwbMitigationError


def test_result_is_written_as_json(tmp_path: Path):
    console.write_json(tmp_path / "out.json", {"n": 1})
    assert json.loads((tmp_path / "out.json").read_text()) == {"n": 1}


def test_result_that_json_cannot_hold_is_refused(tmp_path: Path):
    with pytest.raises(UwbMitigationError, match="cannot write the result"):
        console.write_json(tmp_path / "out.json", {"n": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("place", ["/", ".", "absent/out.json"])
def test_unwritable_json_path_is_refused_before_the_work(place: str):
    with pytest.raises(typer.BadParameter):
        console._check_json_target(Path(place))
