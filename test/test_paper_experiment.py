"""Experiment, search, range test and pruning on small data, through functions and commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from command_line import run
from model_material import card, dataset, integer_network, random_weights, windows

pytest.importorskip("torch", reason="training is not set up: run make setup-training")

from uwb_mitigation.errors import DatasetError, ModelError, ParameterError, UwbMitigationError
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.model import floating, graph
from uwb_mitigation.model.architecture import HEAD, Mlp, Remnet
from uwb_mitigation.model.bundle import load_bundle, save_bundle
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.paper import experiment
from uwb_mitigation.paper import search as searches
from uwb_mitigation.paper.learning_rate import range_test
from uwb_mitigation.paper.parts import Parts, narrowed
from uwb_mitigation.paper.pruning import prune, prune_bundle
from uwb_mitigation.paper.results import RESULTS, ExperimentResults, read
from uwb_mitigation.paper.search import Trial, front, search
from uwb_mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.training.fitting import fit
from uwb_mitigation.training.options import FitOptions

QUICK = FitOptions(epochs=2, learning_rate=1e-3, weight_decay=0.0)


def parts(seed: int = 0) -> Parts:
    return Parts("made up", "by seed", dataset(6, 20, seed=seed), dataset(3, 20, seed=seed + 1))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("protocol")
    wanted = experiment.tasks(["remnet", "remnet_attention", "mlp"], [32], seeds=1)
    return folder, experiment.run(parts(), folder, wanted, QUICK)


# --- the experiment ---


def test_tasks_are_every_window_and_seed_of_remnet_and_the_longest_of_the_rest():
    names = [task.name for task in experiment.tasks(["remnet", "mlp"], [157, 8], seeds=2)]
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
            experiment.tasks(networks, lengths, seeds)


def test_every_form_of_a_network_is_measured(finished):
    folder, result = finished
    assert read(ExperimentResults, folder / RESULTS) == result
    remnet, attention, mlp = result.models
    assert remnet.mae_optimised == pytest.approx(remnet.mae_float, abs=1e-6)
    assert remnet.mae_int8 == pytest.approx(remnet.mae_float, abs=0.02)
    assert remnet.float_errors.all.n == remnet.float_errors.los.n + remnet.float_errors.nlos.n
    assert (remnet.parameters, attention.parameters) == (5649, 5649 + 3 * 82)
    assert attention.mae_float > 0
    assert attention.mae_int8 is None
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
    """Errors that are linear in the received power, which differs between configurations."""
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
    test.first_path_power_dbm[0] = np.nan  # without power, the range stays as measured
    known = np.abs(test.error_m[0]) / len(test)
    assert left(experiment.baselines_of(train, test), "line") == pytest.approx(known, abs=0.02)


@pytest.mark.parametrize("case", ["train without power", "test without power", "few configurations"])
def test_a_line_that_the_data_does_not_allow_has_a_reason(case: str):
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
    assert experiment.run(parts(), folder, wanted, QUICK) == first
    assert not trained
    copied = copytree(folder, tmp_path / "copy")
    journal = copied / experiment.JOURNAL
    lines = journal.read_text().splitlines()
    torn = next(line for line in lines if '"mlp_32_seed0"' in line)
    journal.write_text("\n".join(["[1]", "{}", *(line for line in lines if line != torn), torn[:90]]))
    again = experiment.run(parts(), copied, wanted, QUICK)
    assert trained == wanted[-1:]
    assert again.models[-1].mae_int8 == first.models[-1].mae_int8
    other = experiment.run(parts(seed=5), copied, wanted[-1:], QUICK)
    assert other.models[0].mae_raw != first.models[-1].mae_raw


def test_two_processes_give_the_same_models(tmp_path):
    wanted = experiment.tasks(["mlp"], [32], seeds=2)
    shares: list[float] = []
    alone, together = (
        experiment.run(parts(), tmp_path / str(workers), wanted, QUICK, workers, shares.append)
        for workers in (1, 2)
    )
    assert [m.mae_int8 for m in alone.models] == [m.mae_int8 for m in together.models]
    assert shares == pytest.approx([0.5, 1.0, 0.5, 1.0])


@pytest.mark.parametrize("workers", [1, 2])
def test_a_loss_that_diverges_ends_the_run(tmp_path, workers: int):
    bad = parts()
    bad = replace(bad, train=replace(bad.train, error_m=bad.train.error_m + 3e38))
    with pytest.raises(DatasetError):
        experiment.run(bad, tmp_path, experiment.tasks(["mlp"], [32], 2), QUICK, workers)


def test_shorter_windows_are_scaled_by_their_own_maximum():
    data = replace(dataset(2, 5), preprocessing=Preprocessing(32, Scaling.MAX))
    data.inputs[0, 20] = 50.0
    short = narrowed(data, 8)
    assert short.inputs.shape == (10, 8)
    assert np.allclose(short.inputs.max(axis=1), 1.0)
    assert short.preprocessing.samples == 8
    with pytest.raises(ParameterError):
        narrowed(data, 64)


# --- search ---

KNOWN = dataset(9, 10, samples=16)
ONCE = FitOptions(epochs=1, weight_decay=0.0)


def searched(journal, known: Dataset = KNOWN, **changes):
    return search(known, journal, ONCE, **({"random": 4, "grid": 3} | changes))


def test_a_search_tries_random_networks_then_neighbours_of_the_best(tmp_path, monkeypatch):
    trials = searched(tmp_path / "journal.jsonl")
    assert [trial.stage for trial in trials] == ["random"] * 4 + ["grid"] * 3
    best = min((t for t in trials if t.stage == "random"), key=lambda t: t.mae_m).architecture
    for trial in trials[4:]:
        for name, values in searches.SPACE.items():
            steps = values.index(getattr(trial.architecture, name)) - values.index(getattr(best, name))
            assert abs(steps) <= 1
    # A seed draws the same networks; an interrupted search continues where it stopped.
    lines = (tmp_path / "journal.jsonl").read_text().split("\n\n")
    (tmp_path / "torn.jsonl").write_text("\n".join([*lines[:2], lines[2][:30]]))
    fits = []
    monkeypatch.setattr(searches, "fit", lambda *arguments: fits.append(1) or fit(*arguments))
    assert searched(tmp_path / "torn.jsonl") == trials
    assert len(fits) == 5
    assert searched(tmp_path / "journal.jsonl") == trials
    assert len(fits) == 5
    searched(tmp_path / "journal.jsonl", dataset(9, 10, samples=16, seed=4), grid=0)
    assert len(fits) == 9


def test_windows_are_searched_over(tmp_path):
    trials = searched(tmp_path / "journal.jsonl", random=8, grid=0, windows=[16, 8])
    assert {trial.architecture.samples for trial in trials} == {16, 8}


def test_invalid_searches_are_rejected(tmp_path):
    with pytest.raises(DatasetError):  # every network diverges
        searched(tmp_path / "a", replace(KNOWN, error_m=KNOWN.error_m + 3e38), random=2, grid=0)
    for change in ({"random": 0}, {"grid": -1}, {"windows": [17]}, {"windows": [0]}, {"workers": 0}):
        with pytest.raises(ParameterError):
            searched(tmp_path / "b", **change)


def test_the_front_contains_only_networks_that_no_other_dominates():
    shapes = [Remnet(16, filters=filters) for filters in (4, 8, 12, 16)]
    trials = [Trial(shape, mae, "random") for shape, mae in zip(shapes, (0.5, None, 0.6, 0.4), strict=True)]
    assert front(trials) == [trials[0], trials[3]]


# --- range test ---


def learnable() -> tuple[np.ndarray, np.ndarray]:
    inputs = windows(400, 16)
    return inputs, inputs[:, :4].mean(axis=1) - 0.3


def test_the_range_test_finds_rates_that_train_and_ends_when_the_loss_explodes():
    result = range_test(Remnet(16), *learnable(), ONCE, low=1e-6, high=3.0, steps=300)
    assert 1e-5 < result.suggested <= result.highest < 1.0
    assert len(result.rates) == len(result.losses_m) <= 300
    assert list(result.rates) == sorted(result.rates)
    result = range_test(Remnet(16), *learnable(), ONCE, low=1e-3, high=10.0, steps=400)
    assert result.diverged
    assert result.rates[-1] < 10.0
    for change in ({"low": 0.0}, {"low": 1.0, "high": 0.1}, {"steps": 3}):
        with pytest.raises(ParameterError):
            range_test(Remnet(16), *learnable(), ONCE, **change)


# --- pruning ---


def test_pruning_removes_channels_that_contribute_nothing():
    weights = random_weights(Remnet(32, filters=8))
    dead = {0: 1, 1: 4, 2: 0, 3: 7}
    for name in weights.weight:
        if name != HEAD:
            module = 0 if name == "first" else int(name[6])
            channels = 0 if name == "first" else module - 1 if name.endswith("residual") else module
            weights.weight[name][dead[channels]] = 0
            weights.bias[name][dead[channels]] = 0
    smaller = prune(weights, 7)
    assert smaller.architecture == Remnet(32, filters=7)
    inputs = windows(20, 32)
    assert np.allclose(floating.predict_m(smaller, inputs), floating.predict_m(weights, inputs), atol=1e-5)


def test_training_after_pruning_reduces_the_error():
    data = dataset(10, 20)
    weights = random_weights(Remnet(32))
    targets = floating.predict_m(weights, data.inputs)
    options = FitOptions(epochs=8, learning_rate=2e-3, dropout=0.0, weight_decay=0.0)
    smaller = prune(weights, 8)
    errors = [
        np.abs(targets - floating.predict_m(network, data.inputs)).mean()
        for network in (smaller, fit(smaller.architecture, data.inputs, targets, options, start=smaller))
    ]
    assert errors[1] < 0.5 * errors[0]


def test_networks_that_cannot_be_pruned_are_rejected():
    for filters in (0, 16, 17):
        with pytest.raises(ParameterError):
            prune(random_weights(Remnet(16)), filters)
    weight = {"dense1": np.zeros((3, 4), np.float32), HEAD: np.zeros((3, 1), np.float32)}
    bias = {"dense1": np.zeros(3, np.float32), HEAD: np.zeros(1, np.float32)}
    with pytest.raises(ModelError):
        prune(FloatWeights(Mlp(4, (3,)), weight, bias), 2)


@pytest.mark.parametrize(
    "change", [{"data": "other"}, {"split": "other"}, {"measurements": 1}, {"tested_on": 1}]
)
def test_a_bundle_that_possibly_saw_the_test_part_is_rejected(tmp_path, change):
    here = {"data": "made up", "split": "by seed", "measurements": 120, "tested_on": 60}
    model = graph.float_model(random_weights(Remnet(32)))
    for training, fits in ((here, True), (here | change, False), ({}, False)):
        path = tmp_path / "trained.onnx"
        bundle = save_bundle(path, model, card(Remnet(32), quantised=False, training=training))
        if fits:
            pruned, _ = prune_bundle(bundle, parts(), 4, QUICK, tmp_path / "smaller.onnx")
            assert pruned.architecture == Remnet(32, filters=4)
        else:
            with pytest.raises(ModelError):
                prune_bundle(bundle, parts(), 4, QUICK, tmp_path / "smaller.onnx")


# --- commands ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Simulated rooms in `rooms.mcap`."""
    folder = tmp_path_factory.mktemp("commands")
    words = ("--ranges", 200, "--exchanges", 4, "-o", "rooms.mcap")
    assert run("paper", "simulate", *words, folder=folder).returncode == 0
    return folder


def paper(*words: object, folder: Path) -> dict:
    done = run("paper", *words, "--json", "out.json", folder=folder)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "out.json").read_text())


def test_protocol_then_prune(folder):
    quick = ("--networks", "remnet", "--windows", 8, "--seeds", 1, "--epochs", 1, "--workers", 1)
    result = paper("protocol", "--data", "rooms.mcap", "-o", "models", *quick, folder=folder)
    assert json.loads((folder / "models" / RESULTS).read_text()) == result
    assert (result["data"], result["split"]) == ("rooms.mcap (simulated)", "paper")
    assert (result["train"], result["test"]) == (131, 48)  # the share of the published rows
    assert result["command"].startswith("uwb-mitigation paper protocol --data rooms.mcap")
    source = folder / "models" / "remnet_8_seed0_float.onnx"
    words = ("--data", "rooms.mcap", "-o", "smaller.onnx", "--filters", 4, "--epochs", 1)
    summary = paper("prune", source, *words, folder=folder)
    pruned, whole = load_bundle(folder / "smaller.onnx"), load_bundle(source)
    assert pruned.architecture == Remnet(8, filters=4)
    # The card describes the smaller network.
    training = pruned.card.training
    assert training["pruned"]["from"] == f"{whole.model_id:08x}"
    assert training["pruned"]["architecture"]["filters"] == whole.architecture.filters
    assert training["metrics_m"]["float"]["mae"] == round(summary["mae"]["tuned"], 4)
    assert training["metrics_m"]["raw"]["mae"] == round(result["models"][0]["mae_raw"], 4)
    assert pruned.card.variance_m2 != whole.card.variance_m2


def test_search_and_range_test_draw_figures(folder):
    quick = ("--random", 2, "--grid", 1, "--windows", 8, "--epochs", 1, "--workers", 1)
    result = paper("search", "--data", "rooms.mcap", "-o", "search", *quick, folder=folder)
    assert len(result["trials"]) == 3
    assert 1 <= len(result["front"]) <= 3
    words = ("--data", "rooms.mcap", "--samples", 8, "--steps", 40, "--plot", "range.png")
    result = paper("lr-range", *words, folder=folder)
    assert 0 < result["suggested"] <= result["highest"]
    for name in ("search/front.png", "range.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


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
    assert done.returncode == 1
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
