"""The commands that train, from a bag of DeepUWB to tables, bundles and figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from bag_material import imported
from model_material import card, random_weights
from typer.testing import CliRunner

from uwb_mitigation.cli import app
from uwb_mitigation.errors import ModelError, UwbMitigationError
from uwb_mitigation.model import graph
from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.model.bundle import load_bundle, save_bundle
from uwb_mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.sources.deepuwb import DeepUwbRecording

pytest.importorskip("torch", reason="training is not set up: run make setup-training")
pandas = pytest.importorskip("pandas", reason="test tools are not set up: run make setup-training")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    return imported(DeepUwbRecording(path, trust=True), path.with_suffix(".mcap"))


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def test_protocol_then_prune(bag, tmp_path):
    folder, summary = tmp_path / "results", tmp_path / "protocol.json"
    options = ("--networks", "remnet", "--windows", "8", "--seeds", 1, "--epochs", 1, "--workers", 1)
    run("protocol", "--data", bag, "-o", folder, *options, "--json", summary)
    result = json.loads(summary.read_text())
    assert (result["split"], result["train"], result["test"]) == ("paper", 60, 30)
    assert json.loads((folder / "protocol.json").read_text()) == result
    assert load_bundle(folder / "remnet_8_seed0_int8.onnx").quantised

    smaller = tmp_path / "smaller.onnx"
    source = folder / "remnet_8_seed0_float.onnx"
    run("prune", source, "--data", bag, "-o", smaller, "--filters", 4, "--epochs", 1, "--json", summary)
    pruned, whole = load_bundle(smaller), load_bundle(source)
    assert pruned.architecture == Remnet(8, filters=4)
    # What the card tells is of the smaller network.
    told = pruned.card.training
    assert told["pruned"]["from"] == f"{whole.model_id:08x}"
    assert told["pruned"]["architecture"]["filters"] == whole.architecture.filters
    assert told["metrics_m"]["float"]["mae"] == round(json.loads(summary.read_text())["mae"]["tuned"], 4)
    assert told["metrics_m"]["raw"]["mae"] == round(result["models"][0]["mae_raw"], 4)
    assert pruned.card.variance_m2 != whole.card.variance_m2
    assert (told["split"], told["recipe"]["epochs"]) == ("paper", 1)

    with pytest.raises(ModelError, match="split paper, not all_but_room_2"):
        run("prune", source, "--data", bag, "-o", smaller, "--split", "all_but_room_2")


@pytest.mark.parametrize(
    ("training", "message"),
    [
        (
            {"data": "dataset.mcap", "split": "4 folds by configuration", "measurements": 90},
            "4 folds by config",
        ),
        ({"data": "other", "split": "paper", "measurements": 60, "tested_on": 30}, "data other"),
        ({"data": "dataset.mcap", "split": "paper", "measurements": 61, "tested_on": 30}, "measurements 61"),
        ({}, "split None"),
    ],
)
def test_a_bundle_that_may_know_the_test_part_is_not_pruned(bag, tmp_path, training, message):
    shape = Remnet(8)
    model = graph.float_model(random_weights(shape))
    changes = {"quantised": False, "preprocessing": Preprocessing(8, Scaling.MAX), "training": training}
    save_bundle(tmp_path / "trained.onnx", model, card(shape, **changes))
    pickled = ("--data", bag, "--split", "paper")
    with pytest.raises(ModelError, match=message):
        run("prune", tmp_path / "trained.onnx", *pickled, "-o", tmp_path / "pruned.onnx")
    assert not (tmp_path / "pruned.onnx").exists()


def test_search_leaves_journal_front_and_figure(bag, tmp_path):
    options = ("--random", 2, "--grid", 1, "--windows", "8", "--epochs", 1, "--workers", 1)
    run("search", "--data", bag, "-o", tmp_path, *options, "--json", tmp_path / "search.json")
    assert len((tmp_path / "journal.jsonl").read_text().splitlines()) == 3
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")
    result = json.loads((tmp_path / "search.json").read_text())
    assert len(result["trials"]) == 3
    assert 1 <= len(result["front"]) <= 3


def test_the_range_test_is_drawn(bag, tmp_path):
    summary, plot = tmp_path / "range.json", tmp_path / "range.png"
    options = ("--samples", 8, "--steps", 40, "--plot", plot, "--json", summary)
    run("train-lr-range", "--data", bag, *options)
    result = json.loads(summary.read_text())
    assert 0 < result["suggested"] <= result["highest"]
    assert plot.read_bytes().startswith(b"\x89PNG")


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
def test_options_that_cannot_be_are_refused(bag, tmp_path, arguments, message):
    with pytest.raises(UwbMitigationError, match=message):
        run("protocol", "--data", bag, "-o", tmp_path / "results", *arguments)
