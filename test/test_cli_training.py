"""The commands that train, from a DeepUWB pickle to tables, bundles and figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from uwb_mitigation.cli import app
from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.model.bundle import load_bundle

pytest.importorskip("torch", reason="training is not set up: run make setup-training")
pandas = pytest.importorskip("pandas", reason="test tools are not set up: run make setup-training")


@pytest.fixture(scope="module")
def pickle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """90 rows in three rooms."""
    path = tmp_path_factory.mktemp("deepuwb") / "dataset.pkl"
    generator = np.random.default_rng(0)
    frame = pandas.DataFrame(
        {
            "CIR": list(generator.random((90, 157))),
            "Error": generator.normal(0.1, 0.1, 90),
            "Room": np.repeat([1, 2, 3], 30),
            "Obstacles": ["0000000000", "1000000000", "0000001000"] * 30,
        }
    )
    frame.to_pickle(path)
    return path


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def test_protocol_then_prune(pickle, tmp_path):
    folder, summary = tmp_path / "results", tmp_path / "protocol.json"
    options = ("--networks", "remnet", "--windows", "8", "--seeds", 1, "--epochs", 1, "--workers", 1)
    run("protocol", "--data", pickle, "-o", folder, *options, "--json", summary)
    result = json.loads(summary.read_text())
    assert (result["split"], result["train"], result["test"]) == ("paper", 60, 30)
    assert json.loads((folder / "protocol.json").read_text()) == result
    assert load_bundle(folder / "remnet_8_seed0_int8.onnx").quantised

    smaller = tmp_path / "smaller.onnx"
    source = folder / "remnet_8_seed0_float.onnx"
    run("prune", source, "--data", pickle, "-o", smaller, "--filters", 4, "--epochs", 1)
    assert load_bundle(smaller).architecture == Remnet(8, filters=4)


def test_search_leaves_journal_front_and_figure(pickle, tmp_path):
    options = ("--random", 2, "--grid", 1, "--windows", "8", "--epochs", 1, "--workers", 1)
    run("search", "--data", pickle, "-o", tmp_path, *options, "--json", tmp_path / "search.json")
    assert len((tmp_path / "journal.jsonl").read_text().splitlines()) == 3
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")
    result = json.loads((tmp_path / "search.json").read_text())
    assert len(result["trials"]) == 3
    assert 1 <= len(result["front"]) <= 3


def test_the_range_test_is_drawn(pickle, tmp_path):
    summary, plot = tmp_path / "range.json", tmp_path / "range.png"
    options = ("--samples", 8, "--steps", 40, "--plot", plot, "--json", summary)
    run("train-lr-range", "--data", pickle, *options)
    result = json.loads(summary.read_text())
    assert 0 < result["suggested"] <= result["highest"]
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_the_bench_names_both_speeds(tmp_path):
    summary = tmp_path / "bench.json"
    run("bench", "training", "--samples", 8, "--rounds", 1, "--processes", 1, "--json", summary)
    result = json.loads(summary.read_text())
    assert min(result[key] for key in ("torch_module", "learner", "together", "ratio")) > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--windows", "a"), "numbers with commas"),
        (("--windows", "0"), "1 to 1016"),
        (("--networks", "cnn"), "network 'cnn'"),
        (("--scaling", "none"), "max, preamble"),
        (("--split", "random"), "split 'random'"),
        (("--workers", 0), "1 to 256"),
    ],
)
def test_options_that_cannot_be_are_refused(pickle, tmp_path, arguments, message):
    with pytest.raises(UwbMitigationError, match=message):
        run("protocol", "--data", pickle, "-o", tmp_path / "results", *arguments)
