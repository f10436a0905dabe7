"""JSON results of commands."""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import typer
from rich.console import Console

from uwb_mitigation.commands.support import console
from uwb_mitigation.types.measurement import Status


def test_result_is_written_as_json(tmp_path: Path):
    console.write_json(tmp_path / "out.json", {"n": 1})
    assert json.loads((tmp_path / "out.json").read_text()) == {"n": 1}


@dataclass(frozen=True)
class Pair:
    anchor_id: int
    errors: dict[str, float]
    status: Status = Status.NO_CIR


PAIRS = [Pair(3, {"mae": 0.25}), Pair(1 << 40, {"mae": math.nan})]


def test_dataclasses_arrays_and_unknown_values_become_json(tmp_path: Path):
    values = {"sd": np.array([1.0, np.inf]), ("7", 3): Path("a"), "n": np.int64(2)}
    console.write_json(tmp_path / "out.json", {"pairs": PAIRS[1:]}, values)
    assert json.loads((tmp_path / "out.json").read_text()) == {
        "pairs": [{"anchor_id": 1 << 40, "errors": {"mae": None}, "status": "NO_CIR"}],
        "sd": [1.0, None],
        "7-3": "a",
        "n": 2,
    }


def test_table_shows_the_rows_of_the_json_result_and_omits_optional_columns(
    monkeypatch: pytest.MonkeyPatch,
):
    columns = {"anchor": "anchor_id:id", "mean absolute error, m": "errors.mae:.2f", "status": "status"}
    texts = {}
    for width in (80, 40):
        monkeypatch.setattr(console, "out", Console(width=width, file=io.StringIO()))
        console.show_table("[Pairs]", columns, PAIRS, optional=["status"])
        texts[width] = console.out.file.getvalue()
        assert max(map(len, texts[width].splitlines()[:-1])) <= width
    assert "[Pairs]" in texts[80]
    assert "0.25" in texts[80]
    assert "0x0000010000000000" in texts[80]
    assert "  - " in texts[80]
    assert "NO_CIR" in texts[80]
    assert "status" not in texts[40].rpartition("In wider terminals")[0]


@pytest.mark.parametrize("place", ["/", ".", "absent/out.json"])
def test_unwritable_json_path_is_refused_before_the_work(place: str):
    with pytest.raises(typer.BadParameter):
        console._check_json_target(Path(place))
