"""Metrics, and the commands train, quantize and evaluate."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import run, succeed
from model_material import Recorded, bundle, changed, record

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.recordings import formats
from uwb_mitigation.training.evaluation.accuracy import evaluate_accuracy
from uwb_mitigation.training.evaluation.metrics import ErrorStatistics


@pytest.fixture
def recording(monkeypatch):
    records = []
    for number in range(48):
        place = number // 6
        item = record(number, f"c{place}", rx_power_dbm=-78.0 - place)
        records.append(replace(item, truth=replace(item.truth, label="NLOS" if place > 3 else "LOS")))
    monkeypatch.setattr(formats, "open_recording", lambda path: Recorded(records))
    return records


@pytest.fixture
def mitigation(tmp_path) -> Mitigation:
    return Mitigation(bundle(tmp_path, Remnet(samples=157)))


def test_statistics_of_known_errors():
    found = ErrorStatistics.of(np.array([1.0, -1.0, 3.0, -3.0]))
    assert (found.mae, found.std, found.p95) == (2.0, pytest.approx(np.sqrt(5.0)), pytest.approx(3.0))
    for errors in ([], [np.nan], [1.0, np.inf]):
        with pytest.raises(DatasetError):
            ErrorStatistics.of(np.array(errors))


def test_evaluation_equals_live_correction(mitigation, recording):
    outcome = evaluate_accuracy(mitigation, recording)
    left = [mitigation.correct([item.measurement])[0].range_m - item.truth.range_m for item in recording]
    assert outcome.n == 48
    assert outcome.raw.mae == 0.25
    assert outcome.corrected.mae == pytest.approx(np.abs(left).mean())
    assert outcome.statuses == {"OK": 48}


@pytest.mark.parametrize(("sigmas", "covered"), [(2.0, 0.0), (3.0, 1.0)])
def test_intervals_are_those_of_the_bundle(tmp_path, sigmas, covered):
    # Every range passes through with an error of 0.25 m: 2.8 standard deviations.
    promised = {"interval95_sigmas": sigmas, "variance_uncorrected_m2": 1 / 128}
    mitigation = Mitigation(bundle(tmp_path, Remnet(samples=157), **promised))
    outcome = evaluate_accuracy(mitigation, [record(preamble_count=0)])
    assert outcome.corrected.mae == 0.25
    assert outcome.statuses == {"BAD_CIR": 1}
    assert (outcome.coverage68, outcome.coverage95) == (0.0, covered)


def test_records_without_truth_or_range_are_skipped(mitigation):
    without_range = changed(record(), range_m=np.nan)
    assert evaluate_accuracy(mitigation, [record(), replace(record(), truth=None), without_range]).n == 1
    with pytest.raises(DatasetError, match="none of 1 measurements"):
        evaluate_accuracy(mitigation, [replace(record(), truth=None)])


def test_evaluate_writes_the_documented_keys(tmp_path, recording):
    saved = bundle(tmp_path, Remnet(samples=157))
    done = succeed("evaluate --data any --json e.json --model", saved.path, folder=tmp_path)
    found = json.loads((tmp_path / "e.json").read_text())
    assert set(found["raw"]) == set(found["corrected"]) == {"mae", "std", "p95"}
    assert set(found["by_label"]) == {"LOS", "NLOS"}
    assert set(found["by_label"]["LOS"]) == {"n", "raw_mae", "corrected_mae"}
    assert (found["n"], found["model_id"], found["trained_on"]) == (48, saved.model_id, [])
    assert "optimistic" not in done.stdout + done.stderr


def test_train_quantize_evaluate_from_end_to_end(tmp_path, recording):
    pytest.importorskip("torch", reason="run `make setup-training`")
    words = "--samples 8 --epochs 1 --folds 2 --recipe line+network --json t.json"
    succeed(f"train --data any -o float.onnx {words}", folder=tmp_path)
    names = [row["name"] for row in json.loads((tmp_path / "t.json").read_text())["rows"]]
    assert names == ["raw", "overall_median", "l1_line", "float", "int8"]
    quantise = "quantise float.onnx --data any -o int8.onnx"
    succeed(quantise, folder=tmp_path)
    assert "exists already" in run(quantise, folder=tmp_path).stderr
    succeed(quantise, "--force", folder=tmp_path)
    floats, integers = (load_bundle(tmp_path / name).card for name in ("float.onnx", "int8.onnx"))
    assert integers.quantised
    assert integers.linear_bias == floats.linear_bias
    done = succeed("evaluate --data any --model int8.onnx --json e.json", folder=tmp_path)
    found = json.loads((tmp_path / "e.json").read_text())
    assert found["trained_on"] == sorted(found["by_configuration"])
    assert "optimistic" in done.stdout + done.stderr
    again = run("quantise int8.onnx --data any -o y.onnx", folder=tmp_path)
    assert (again.returncode, "already quantised" in again.stderr) == (1, True)
