"""Experiment, search, range test and pruning on small data, through functions and commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from command_line import run, succeed
from model_material import dataset, integer_network

pytest.importorskip("torch", reason="training is not set up: run make setup-training")


from benchmarks.paper import experiment
from benchmarks.paper.data import Parts, shorten_windows
from benchmarks.paper.results import RESULTS, ExperimentResults, read
from uwb_mitigation.errors import DatasetError, ParameterError, UwbMitigationError
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit.options import FitOptions

QUICK = FitOptions(epochs=2, learning_rate=1e-3, weight_decay=0.0)


def parts(seed: int = 0) -> Parts:
    return Parts("made up", "by seed", dataset(6, 20, seed=seed), dataset(3, 20, seed=seed + 1))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("protocol")
    wanted = experiment.list_tasks(["remnet", "mlp"], [32], seeds=1)
    return folder, experiment.run_experiment(parts(), folder, wanted, QUICK)


# --- the experiment ---


def test_tasks_are_every_window_and_seed_of_remnet_and_the_longest_of_the_rest():
    names = [task.name for task in experiment.list_tasks(["remnet", "mlp"], [157, 8], seeds=2)]
    assert names == [
        "remnet_157_seed0",
        "remnet_157_seed1",
        "remnet_8_seed0",
        "remnet_8_seed1",
        "mlp_157_seed0",
        "mlp_157_seed1",
    ]
    for networks, lengths, seeds in ((["cnn"], [8], 1), (["mlp"], [], 1), (["mlp"], [8], 0)):
        with pytest.raises(ParameterError):
            experiment.list_tasks(networks, lengths, seeds)


def test_every_form_of_a_network_is_measured(finished):
    folder, result = finished
    assert read(ExperimentResults, folder / RESULTS) == result
    remnet, mlp = result.models
    assert remnet.mae_optimised == pytest.approx(remnet.mae_float, abs=1e-6)
    assert remnet.mae_int8 == pytest.approx(remnet.mae_float, abs=0.02)
    assert remnet.float_errors.all.n == remnet.float_errors.los.n + remnet.float_errors.nlos.n
    assert remnet.parameters == 5649
    assert set(remnet.calibration_mae) == {"max", "p99.99", "p99.9", "p99", "mse"}
    assert remnet.calibration_mae[remnet.calibration] == min(remnet.calibration_mae.values())
    for model in (remnet, mlp):
        name = folder / f"{model.network}_32_seed0"
        assert Path(f"{name}_int8.onnx").stat().st_size == model.bytes_int8 < model.bytes_float
        assert Path(f"{name}_optimised.onnx").stat().st_size == model.bytes_optimised
        test = parts().test
        left = test.error_m - integer_network(load_bundle(Path(f"{name}_int8.onnx"))).predict_m(test.inputs)
        assert np.abs(left).mean() == pytest.approx(model.mae_int8, abs=1e-9)
        assert model.int8_errors.all.box == pytest.approx(np.percentile(left, (5, 25, 50, 75, 95)))


def left(baselines, name: str) -> float:
    (found,) = (baseline for baseline in baselines if baseline.name == name)
    return found.errors.all.mae


def with_line(data: Dataset, gap_db: float = 5.0) -> Dataset:
    """Return a dataset whose errors are linear in the received power, which differs between configurations."""
    _, of = np.unique(data.configurations, return_inverse=True)
    power = (-80.0 - of + 0.1 * np.arange(len(data)) % 1).astype(np.float32)
    gap = (gap_db + of**2).astype(np.float32)
    error_m = 0.5 - 0.02 * (power + 80) + gap / 9
    return replace(data, rx_power_dbm=power, first_path_power_dbm=power - gap, error_m=error_m)


def test_baselines_are_fitted_on_the_training_part(finished):
    _, result = finished
    train, test = parts().train, parts().test
    for name, rows in (("los_median", train.labels == "LOS"), ("overall_median", train.labels != "")):
        expected = np.abs(test.error_m - np.median(train.error_m[rows])).mean()
        assert left(result.baselines, name) == pytest.approx(expected)
    train, test = with_line(dataset(8, 5)), with_line(dataset(4, 5, seed=1), gap_db=9.0)
    baselines = experiment.baselines_of(train, test)
    assert left(baselines, "line") < 0.02 < 0.2 < left(baselines, "overall_median")
    test.first_path_power_dbm[0] = np.nan  # without levels, the range is unchanged
    known = np.abs(test.error_m[0]) / len(test)
    assert left(experiment.baselines_of(train, test), "line") == pytest.approx(known, abs=0.02)


@pytest.mark.parametrize("case", ["train without power", "test without power", "few configurations"])
def test_baseline_without_data_has_a_reason(case: str):
    train = with_line(dataset(3 if case.startswith("few") else 8, 5))
    test = with_line(dataset(4, 5, seed=1))
    if not case.startswith("few"):
        (train if case.startswith("train") else test).rx_power_dbm[:] = np.nan
    line = experiment.baselines_of(train, test)[-1]
    assert (line.name, line.errors) == ("line", None)
    assert line.reason


def test_finished_tasks_are_not_repeated_unless_damaged_or_of_other_data(finished, tmp_path, monkeypatch):
    folder, first = finished
    trained = []
    train = experiment.train_task
    monkeypatch.setattr(
        experiment, "train_task", lambda task, *rest: trained.append(task) or train(task, *rest)
    )
    wanted = [experiment.Task(model.network, model.samples, model.seed) for model in first.models]
    assert experiment.run_experiment(parts(), folder, wanted, QUICK) == first
    assert not trained
    copied = copytree(folder, tmp_path / "copy")
    journal = copied / experiment.JOURNAL
    lines = journal.read_text().splitlines()
    torn = next(line for line in lines if '"mlp_32_seed0"' in line)
    journal.write_text("\n".join(["[1]", "{}", *(line for line in lines if line != torn), torn[:90]]))
    again = experiment.run_experiment(parts(), copied, wanted, QUICK)
    assert trained == wanted[-1:]
    assert again.models[-1].mae_int8 == first.models[-1].mae_int8
    other = experiment.run_experiment(parts(seed=5), copied, wanted[-1:], QUICK)
    assert other.models[0].mae_raw != first.models[-1].mae_raw


def test_two_processes_give_the_same_models(tmp_path):
    wanted = experiment.list_tasks(["mlp"], [32], seeds=2)
    shares: list[float] = []
    one_worker, together = (
        experiment.run_experiment(parts(), tmp_path / str(workers), wanted, QUICK, workers, shares.append)
        for workers in (1, 2)
    )
    assert [m.mae_int8 for m in one_worker.models] == [m.mae_int8 for m in together.models]
    assert shares == pytest.approx([0.5, 1.0, 0.5, 1.0])


@pytest.mark.parametrize("workers", [1, 2])
def test_loss_that_diverges_ends_the_run(tmp_path, workers: int):
    bad = parts()
    bad = replace(bad, train=replace(bad.train, error_m=bad.train.error_m + 3e38))
    with pytest.raises(DatasetError):
        experiment.run_experiment(bad, tmp_path, experiment.list_tasks(["mlp"], [32], 2), QUICK, workers)


def test_shorter_windows_are_scaled_by_their_own_maximum():
    data = replace(dataset(2, 5), preprocessing=Preprocessing(32, Scaling.MAX))
    data.inputs[0, 20] = 50.0
    short = shorten_windows(data, 8)
    assert short.inputs.shape == (10, 8)
    assert np.allclose(short.inputs.max(axis=1), 1.0)
    assert short.preprocessing.samples == 8
    with pytest.raises(ParameterError):
        shorten_windows(data, 64)


# --- commands ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Simulated rooms in `rooms.mcap`."""
    folder = tmp_path_factory.mktemp("commands")
    words = ("--ranges", 200, "--exchanges", 4, "-o", "rooms.mcap")
    succeed("paper", "simulate", *words, folder=folder)
    return folder


def test_command_writes_its_results(folder):
    quick = ("--networks", "remnet", "--windows", 8, "--seeds", 1, "--epochs", 1, "--workers", 1)
    words = ("protocol", "--data", "rooms.mcap", "-o", "models", "--json", "out.json", *quick)
    succeed("paper", *words, folder=folder)
    result = json.loads((folder / "out.json").read_text())
    assert json.loads((folder / "models" / RESULTS).read_text()) == result
    assert (result["data"], result["split"]) == ("rooms.mcap (simulated)", "paper")
    assert (result["train"], result["test"]) == (131, 48)  # the share of the published rows
    assert result["command"].startswith("python -m benchmarks paper protocol --data rooms.mcap")


@pytest.mark.parametrize(
    "words",
    [
        ("--windows", "a"),
        ("--windows", "0"),
        ("--networks", "cnn"),
        ("--scaling", "none"),
        ("--split", "random"),
        ("--workers", 0),
    ],
)
def test_invalid_options_are_rejected_with_one_line(folder, words):
    done = run("paper", "protocol", "--data", "rooms.mcap", "-o", "x", *words, folder=folder)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


def test_missing_or_damaged_results_are_rejected_by_name(tmp_path):
    path = tmp_path / RESULTS
    with pytest.raises(UwbMitigationError) as caught:
        read(ExperimentResults, path)
    assert caught.value.where == str(path)
    for content in ("[1", "{}", json.dumps({"models": [{}]}), "[" * 10_000):
        path.write_text(content)
        with pytest.raises(DatasetError) as caught:
            read(ExperimentResults, path)
        assert caught.value.where == str(path)
