"""The terminal: tables and JSON results, help, and wrong usage of all commands."""

import io
import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from bag_material import Foreign
from command_line import run, succeed
from rich.console import Console

from uwb_mitigation.commands import cli
from uwb_mitigation.commands.support import console
from uwb_mitigation.types.measurement import Status


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


def test_table_shows_the_rows_of_the_json_result_and_omits_optional_columns(monkeypatch: pytest.MonkeyPatch):
    columns = {"anchor": "anchor_id:id", "mean absolute error, m": "errors.mae:.2f", "status": "status"}
    texts = {}
    for width in (80, 40):
        monkeypatch.setattr(console, "out", Console(width=width, file=io.StringIO()))
        console.show_table("[Pairs]", columns, PAIRS, optional=["status"])
        texts[width] = console.out.file.getvalue()
        assert max(map(len, texts[width].splitlines()[:-1])) <= width
    for shown in ("[Pairs]", "0.25", "0x0000010000000000", "  - ", "NO_CIR"):
        assert shown in texts[80]
    narrow = texts[40].rpartition("In wider terminals")[0]
    assert "status" not in narrow
    # Words are not broken.
    assert set(re.findall(r"[^\W\d_]+", narrow)) <= set(re.findall(r"[^\W\d_]+", texts[80]))


def commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    yield path
    for name, subcommand in getattr(command, "commands", {}).items():
        yield from commands(subcommand, (*path, name))


@pytest.mark.parametrize("words", list(commands(typer.main.get_command(cli.app))), ids=" ".join)
def test_help_fits_80_columns_and_needs_no_checkout(words: tuple[str, ...], tmp_path: Path):
    done = succeed(*words, "--help", folder=tmp_path, columns=80)
    assert not re.search(r"<str>|<bool>|docs/|\.md\b|…", done.stdout)
    wrapped_examples = [line for line in done.stdout.splitlines() if re.match(r" (-|/)", line)]
    assert wrapped_examples == []


SIMULATE, EVALUATE, OFFSET = "data simulate -o x.mcap", "evaluate --data x.mcap", "offset x.mcap"
TRAIN, UNIVERSAL = "train --data x.mcap", "train-universal -o x.onnx"
REPORT, PROTOCOL = "field-report --source uci --port a --distance 3", "paper protocol --data x.mcap -o x"
WRONG_USAGE = {
    "trakc": "No such command 'trakc'",
    "track": "Missing argument 'BAG'",
    "track a.mcap -o b.mcap --rat 3": "No such option: --rat",
    f"{SIMULATE} --like drone": "'drone' is not one of 'drive'",
    f"{SIMULATE} --ranges 0": "0 ranges (1 or more",
    f"{SIMULATE} --like buildings --ranges 30": "a multiple of",
    f"{SIMULATE} --like buildings --exchanges 0": "a multiple of",
    f"{SIMULATE} --channel 6": "unknown channel 6",
    f"{EVALUATE} --folds 3 --scaling max": "--folds, --scaling without --cross-validate",
    f"{EVALUATE} --seeds 3": "--seeds without --cross-validate",
    f"{EVALUATE} --cross-validate configuration --offsets 0": "--offsets with --cross-validate",
    f"{EVALUATE} --cross-validate configuration --model x": "--model with --cross-validate",
    f"{OFFSET} --distance 5 --truth": "either --distance or --truth",
    f"{OFFSET} --distance nan": "distance = nan",
    f"{OFFSET} --truth -o none/o.yaml": "a file in an existing folder",
    f"{OFFSET} --truth --anchor door": "anchor = 'door'",
    "process x.mcap -o y.mcap --jobs 0": "jobs = 0",
    f"{TRAIN} -o none/x.onnx": "none/x.onnx: cannot be written",
    f"{TRAIN} -o x.txt": "x.txt: cannot be written",
    f"{TRAIN} -o .": ".: cannot be written",
    f"{UNIVERSAL} --samples 2000": "2000 samples (1 to 1016)",
    f"{UNIVERSAL} --scaling loud": "'loud' is not one of 'preamble'",
    f"{UNIVERSAL} --radio dw1001": "'dw1001' is not one of 'dw1000'",
    f"{UNIVERSAL} --seed -1": "--seed",
    **{f"{UNIVERSAL} --{name} 0": f"--{name}" for name in ("blocks", "workers")},
    f"{REPORT} --source radio": "'radio' is not one of 'uci'",
    f"{REPORT} --port ''": "0 ports",
    f"{REPORT} --port a,b,c": "3 ports",
    f"{REPORT} --distance nan": "--distance nan",
    f"{REPORT} -o report.txt": "report.txt: cannot be written",
    f"{PROTOCOL} --windows a": "windows 'a'",
    f"{PROTOCOL} --windows 0": "0 samples (1 to 1016)",
    f"{PROTOCOL} --workers 0": "'--workers'",
    "data info x.mcap --json /absent/x.json": "its folder does not exist",
    "data info x.mcap --json /": "is a folder",
    "data info x.mcap --json .": "is a folder",
    "emulate-board --mode neither": "mode",
    "emulate-board --rate 0": "rate",
    "emulate-board --duration -1": "duration",
    "emulate-board --lose nan": "lose",
    "emulate-board --seed -1": "seed",
    "emulate-board --link /no/board": "link",
}


@pytest.mark.parametrize("words", WRONG_USAGE)
def test_wrong_usage_has_one_line_and_one_exit_code(words: str, tmp_path: Path):
    done = run(words, folder=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert WRONG_USAGE[words] in line
    assert done.stdout == ""
    assert not list(tmp_path.iterdir())


def test_emulated_board_runs_for_the_given_duration_if_its_recording_is_not_empty(tmp_path: Path):
    done = succeed("emulate-board --duration 0.5 --rate 100 --json board.json", folder=tmp_path)
    assert "simulated" in done.stdout
    assert "/dev/" in done.stdout
    assert json.loads((tmp_path / "board.json").read_text())["sent"] > 0
    bag = Foreign(tmp_path / "empty.mcap").ours().finish()
    refused = run("emulate-board --duration 1", bag, folder=tmp_path)
    assert "no measurements" in refused.stderr
    assert "/dev/" not in refused.stdout, "before a port is opened"
