"""Metrics, and the commands train, quantize and evaluate."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from model_material import Recorded, bundle, changed, record
from typer.testing import CliRunner

from uwb_mitigation.commands.cli import app
from uwb_mitigation.errors import DatasetError, ModelError, ParameterError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.recordings import formats
from uwb_mitigation.training.evaluation.accuracy import evaluate_accuracy
from uwb_mitigation.training.evaluation.metrics import ErrorStatistics


def run(*arguments: object):
    return CliRunner().invoke(app, [str(value) for value in arguments], catch_exceptions=True)


@pytest.fixture
def recording(monkeypatch):
    records = [
        record(10 * place + number, f"c{place}", rx_power_dbm=-78.0 - place)
        for place in range(8)
        for number in range(6)
    ]
    records = [
        replace(item, truth=replace(item.truth, label="NLOS" if index >= 24 else "LOS"))
        for index, item in enumerate(records)
    ]
    monkeypatch.setattr(formats, "open_recording", lambda path: Recorded(records))
    return records


def test_statistics_of_known_errors():
    found = ErrorStatistics.of(np.array([1.0, -1.0, 3.0, -3.0]))
    assert found.mae == 2.0
    assert found.std == pytest.approx(np.sqrt(5.0))
    assert found.p95 == pytest.approx(3.0)


@pytest.mark.parametrize("errors", [[], [np.nan], [1.0, np.inf]])
def test_statistics_without_data_are_refused(errors):
    with pytest.raises(DatasetError):
        ErrorStatistics.of(np.array(errors))


def test_evaluation_equals_live_correction(tmp_path, recording):
    mitigation = Mitigation(bundle(tmp_path, Remnet(samples=157)))
    outcome = evaluate_accuracy(mitigation, recording)
    left = [mitigation.correct([item.measurement])[0].range_m - item.truth.range_m for item in recording]
    assert outcome.n == 48
    assert outcome.raw.mae == 0.25
    assert outcome.corrected.mae == pytest.approx(np.abs(left).mean())
    assert outcome.statuses == {"OK": 48}


def test_passed_through_range_counts_unchanged(tmp_path):
    mitigation = Mitigation(bundle(tmp_path, Remnet(samples=157)))
    outcome = evaluate_accuracy(mitigation, [record(preamble_count=0)])
    assert outcome.corrected.mae == 0.25
    assert outcome.statuses == {"BAD_CIR": 1}


@pytest.mark.parametrize(("sigmas", "covered"), [(2.0, 0.0), (3.0, 1.0)])
def test_intervals_are_those_of_the_bundle(tmp_path, sigmas, covered):
    # Every range passes through with an error of 0.25 m: 2.8 standard deviations.
    promised = {"interval95_sigmas": sigmas, "variance_uncorrected_m2": 1 / 128}
    mitigation = Mitigation(bundle(tmp_path, Remnet(samples=157), **promised))
    outcome = evaluate_accuracy(mitigation, [record(preamble_count=0)])
    assert (outcome.coverage68, outcome.coverage95) == (0.0, covered)


def test_records_without_truth_or_range_are_skipped(tmp_path):
    mitigation = Mitigation(bundle(tmp_path, Remnet(samples=157)))
    without_range = changed(record(), range_m=np.nan)
    assert evaluate_accuracy(mitigation, [record(), replace(record(), truth=None), without_range]).n == 1
    with pytest.raises(DatasetError, match="none of 1 measurements"):
        evaluate_accuracy(mitigation, [replace(record(), truth=None)])


def test_evaluate_writes_the_documented_keys(tmp_path, recording):
    saved = bundle(tmp_path, Remnet(samples=157))
    result = run("evaluate", "--data", "any", "--model", saved.path, "--json", tmp_path / "e.json")
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "e.json").read_text())
    assert found["n"] == 48
    for part in ("raw", "corrected"):
        assert set(found[part]) == {"mae", "std", "p95"}
    assert set(found["by_label"]) == {"LOS", "NLOS"}
    assert set(found["by_label"]["LOS"]) == {"n", "raw_mae", "corrected_mae"}
    assert found["model_id"] == saved.model_id
    assert found["trained_on"] == []
    assert "optimistic" not in result.output


def test_train_quantize_evaluate_from_end_to_end(tmp_path, recording):
    pytest.importorskip("torch", reason="run `make setup-training`")
    floats, integers = tmp_path / "float.onnx", tmp_path / "int8.onnx"
    result = run(
        "train", "--data", "any", "-o", floats, "--samples", 8, "--epochs", 1, "--folds", 2,
        "--recipe", "line+network", "--json", tmp_path / "t.json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    names = [row["name"] for row in json.loads((tmp_path / "t.json").read_text())["rows"]]
    assert names == ["raw", "overall_median", "l1_line", "float", "int8"]
    assert run("quantise", floats, "--data", "any", "-o", integers).exit_code == 0
    again = ("quantise", floats, "--data", "any", "-o", integers)
    assert "exists already" in str(run(*again).exception)
    assert run(*again, "--force").exit_code == 0
    assert load_bundle(integers).quantised
    assert load_bundle(integers).linear_bias == load_bundle(floats).linear_bias
    result = run("evaluate", "--data", "any", "--model", integers, "--json", tmp_path / "e.json")
    assert result.exit_code == 0
    found = json.loads((tmp_path / "e.json").read_text())
    assert found["trained_on"] == sorted(found["by_configuration"])
    assert "optimistic" in result.output


def test_int8_bundle_is_not_quantised_again(tmp_path, recording):
    saved = bundle(tmp_path)
    result = run("quantise", saved.path, "--data", "any", "-o", tmp_path / "y.onnx")
    assert isinstance(result.exception, ModelError)


@pytest.mark.parametrize("output", ["nowhere/x.onnx", "x.txt", "."])
def test_unwritable_output_is_refused_before_training(tmp_path, recording, output):
    result = run("train", "--data", "any", "-o", tmp_path / output)
    assert isinstance(result.exception, ParameterError)
