"""Experiment, search, range test and pruning on small data, through functions and commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run, succeed
from model_material import dataset, integer_network, windows

pytest.importorskip("torch", reason="training is not set up: run make setup-training")

import torch

from benchmarks.paper import experiment, training
from benchmarks.paper.data import Parts, shorten_windows
from benchmarks.paper.results import RESULTS, ExperimentResults, read
from benchmarks.paper.search import CHOICE, SPACE, search
from benchmarks.paper.training import NetworkStack
from uwb_mitigation.errors import DatasetError, ParameterError, UwbMitigationError
from uwb_mitigation.mitigation.model import floating
from uwb_mitigation.mitigation.model.architecture import Mlp, Remnet
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.training.fit import fitting
from uwb_mitigation.training.fit.options import FitOptions

QUICK = FitOptions(epochs=2, learning_rate=1e-3, weight_decay=0.0)
SHAPES = [Remnet(13, 3, 3, 4, 3), Remnet(16, 5, 5, 4, 2), Mlp(16, (8, 4))]


def parts(seed: int = 0) -> Parts:
    return Parts("made up", "by seed", dataset(6, 20, seed=seed), dataset(3, 20, seed=seed + 1))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("protocol")
    wanted = experiment.list_tasks(["remnet", "remnet_k5", "remnet_attention", "mlp"], [32], seeds=2)
    return folder, experiment.run_experiment(parts(), folder, wanted, QUICK)


# --- networks that are trained together ---


@pytest.mark.parametrize("shape", SHAPES)
def test_stack_computes_each_of_its_networks(shape):
    stack = NetworkStack(shape, 3, 0.5)
    stack.fit(dataset(2, 20, samples=shape.samples), QUICK)
    inputs = windows(20, shape.samples)
    outputs = [floating.predict_m(stack.weights_of(seed), inputs) for seed in range(3)]
    assert np.allclose(stack.predict_m(inputs), outputs, atol=1e-6)
    assert len({output.tobytes() for output in outputs}) == 3


@pytest.mark.parametrize("shape", SHAPES)
def test_stack_is_trained_like_single_networks(shape):
    data = dataset(2, 20, samples=shape.samples)
    # With one batch per epoch, the order has no effect.
    options = replace(QUICK, epochs=30, batch=len(data), dropout=0.0)
    stack = NetworkStack(shape, 2, options.dropout)
    single = [
        fitting.fit(shape, data.inputs, data.error_m, options, start=stack.weights_of(seed))
        for seed in range(2)
    ]
    losses = stack.fit(data, options)
    for seed, expected in enumerate(single):
        for name, weight in stack.weights_of(seed).weight.items():
            assert weight == pytest.approx(expected.weight[name], abs=1e-4)
    assert (losses[-1] < losses[0]).all()


def test_weights_of_a_seed_do_not_depend_on_the_number_of_seeds():
    one, three = (NetworkStack(SHAPES[0], seeds, 0.5).weights_of(0).weight for seeds in (1, 3))
    for name, weight in one.items():
        assert np.array_equal(weight, three[name])


def test_self_attention_scales_channels_by_a_function_of_their_means():
    plain, stack = (NetworkStack(SHAPES[0], 1, 0.0, attention=attention) for attention in (False, True))
    inputs = windows(20, 13)
    for network in (plain, stack):
        torch.nn.init.constant_(network.head.weight, 0.1)
    for block in stack.attention.values():
        # A sigmoid of a large number is 1, which changes nothing; of 0, it is a half.
        torch.nn.init.constant_(block[3].bias, 40.0)
    assert stack.predict_m(inputs) == pytest.approx(plain.predict_m(inputs), abs=1e-5)
    for block in stack.attention.values():
        torch.nn.init.zeros_(block[3].weight)
        torch.nn.init.zeros_(block[3].bias)
    assert np.abs(stack.predict_m(inputs) - plain.predict_m(inputs)).max() > 0.01


def test_pruned_weights_stay_zero_and_each_network_has_the_share():
    data, stack = dataset(2, 20, samples=13), NetworkStack(SHAPES[0], 2, 0.0)
    stack.fit(data, QUICK)
    before = [stack.weights_of(seed).weight for seed in range(2)]
    stack.mask_smallest(0.5)
    stack.fit(data, QUICK)
    removed = stack.fix_pruned()
    for seed in range(2):
        weights = stack.weights_of(seed).weight
        zeros = np.concatenate([weight.ravel() == 0 for weight in weights.values()])
        magnitudes = np.concatenate([np.abs(weight).ravel() for weight in before[seed].values()])
        assert zeros.sum() == removed == pytest.approx(len(zeros) / 2, abs=1)
        assert magnitudes[zeros].max() <= magnitudes[~zeros].min()


# --- before the training ---


def test_range_test_finds_the_rates_that_train(monkeypatch):
    monkeypatch.setattr(training, "RANGE_TEST_RATES", np.geomspace(1e-6, 10.0, 300))
    result = training.range_test(dataset(6, 20, samples=13), QUICK, seeds=2)
    assert 1e-6 < result.falls_from < result.falls_to < 1.0
    assert max(result.losses_m) > 2 * min(result.losses_m)  # the highest rates diverge
    assert len(result.rates) == len(result.losses_m)


def test_search_is_random_then_a_grid_around_the_best_network():
    data = dataset(10, 10, samples=16)
    found = search(data, 3, QUICK)
    assert [trial.stage for trial in found] == ["random"] * 3 + ["grid"] * 3
    assert found[0].shape == CHOICE
    best = min(found[:3], key=lambda trial: trial.mae).shape
    for trial in found[3:]:
        assert trial.shape["modules"] == best["modules"]
        for name, values in SPACE.items():
            assert abs(values.index(trial.shape[name]) - values.index(best[name])) <= 1
    costs = np.array([(trial.mae, trial.multiply_accumulates) for trial in found])
    for trial, cost in zip(found, costs, strict=True):
        is_better = (costs <= cost).all(axis=1) & (costs < cost).any(axis=1)
        assert trial.is_on_front == (not is_better.any())
    assert search(data, 3, QUICK) == found


# --- the experiment ---


def test_tasks_are_every_window_of_remnet_and_the_longest_of_the_rest():
    tasks = experiment.list_tasks(["remnet", "remnet_k5", "remnet_attention", "mlp"], [157, 8], seeds=2)
    assert [(task.network, task.samples, task.prune) for task in tasks] == [
        ("remnet", 157, True),
        ("remnet", 8, False),
        ("remnet_k5", 157, False),
        ("remnet_attention", 157, False),
        ("mlp", 157, False),
    ]
    assert [task.architecture.parameters for task in tasks] == [5905, 5601, 5937, 5905, 54401]
    for networks, lengths, seeds in ((["cnn"], [8], 1), (["mlp"], [], 1), (["mlp"], [8], 0)):
        with pytest.raises(ParameterError):
            experiment.list_tasks(networks, lengths, seeds)


def test_every_form_of_a_network_is_measured(finished):
    folder, result = finished
    assert read(ExperimentResults, folder / RESULTS) == result
    networks = ["remnet", *(f"remnet_pruned_{share}" for share in (25, 50, 75))]
    networks += ["remnet_k5", "remnet_attention", "mlp"]
    assert [model.network for model in result.models] == [name for name in networks for _ in range(2)]
    for model in result.models:
        errors = model.errors
        assert errors["float"].all.n == errors["float"].los.n + errors["float"].nlos.n
        if model.network == "remnet_attention":
            assert list(errors) == ["float"]
            continue
        assert errors["optimised"].all.mae == pytest.approx(errors["float"].all.mae, abs=1e-6)
        assert errors["int8"].all.mae == pytest.approx(errors["float"].all.mae, abs=0.02)
        name = folder / f"{model.network}_32_seed{model.seed}"
        assert Path(f"{name}_int8.onnx").stat().st_size == model.bytes["int8"] < model.bytes["float"]
        assert Path(f"{name}_optimised.onnx").stat().st_size == model.bytes["optimised"]
        test = parts().test
        left = test.error_m - integer_network(load_bundle(Path(f"{name}_int8.onnx"))).predict_m(test.inputs)
        assert np.abs(left).mean() == pytest.approx(errors["int8"].all.mae, abs=1e-9)
        assert errors["int8"].all.box == pytest.approx(np.percentile(left, (5, 25, 50, 75, 95)))


def test_pruned_networks_have_fewer_parameters_and_smaller_compressed_files(finished):
    _, result = finished
    networks = ["remnet", *(f"remnet_pruned_{share}" for share in (25, 50, 75))]
    rows = [result.of(network, 32)[0] for network in networks]
    weights = 5649 - 161  # without the biases of ten layers and the head
    assert [row.parameters for row in rows] == pytest.approx(
        [5649 - weights * n / 4 for n in range(4)], abs=2
    )
    assert np.diff([row.bytes["zipped"] for row in rows]).max() < 0


def test_self_attention_of_the_paper_has_squeeze_and_excitation_in_each_module(finished):
    _, result = finished
    # Two dense layers with 2 hidden units in three modules.
    assert result.of("remnet_attention", 32)[0].parameters == 5649 + 3 * (16 * 2 + 2 + 2 * 16 + 16)


def test_median_of_the_training_part_is_the_baseline(finished):
    _, result = finished
    train, test = parts().train, parts().test
    expected = np.abs(test.error_m - np.median(train.error_m)).mean()
    assert result.median.all.mae == pytest.approx(expected)


def test_finished_tasks_are_not_repeated_unless_of_other_data(tmp_path):
    wanted = experiment.list_tasks(["mlp"], [32], seeds=1)
    first = experiment.run_experiment(parts(), tmp_path, wanted, QUICK)
    written = (tmp_path / "mlp_32_seed0_float.onnx").stat().st_mtime_ns
    assert experiment.run_experiment(parts(), tmp_path, wanted, QUICK) == first
    assert (tmp_path / "mlp_32_seed0_float.onnx").stat().st_mtime_ns == written
    other = experiment.run_experiment(parts(seed=5), tmp_path, wanted, QUICK)
    assert other.models[0].errors != first.models[0].errors


def test_two_processes_give_the_same_models(tmp_path):
    wanted = experiment.list_tasks(["remnet", "mlp"], [32], seeds=1)
    shares: list[float] = []
    one_worker, together = (
        experiment.run_experiment(parts(), tmp_path / str(workers), wanted, QUICK, 0, workers, shares.append)
        for workers in (1, 2)
    )
    assert [model.errors for model in one_worker.models] == [model.errors for model in together.models]
    assert shares == [0.5, 1.0, 0.5, 1.0]


def test_loss_that_diverges_ends_the_run(tmp_path):
    bad, tasks = parts(), experiment.list_tasks(["mlp"], [32], 2)
    bad = replace(bad, train=replace(bad.train, error_m=bad.train.error_m + 3e38))
    with pytest.raises(DatasetError):
        experiment.run_experiment(bad, tmp_path, tasks, QUICK)


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
    quick = "--networks mlp --windows 8 --seeds 1 --epochs 1 --trials 0 --workers 1"
    words = f"protocol --data rooms.mcap -o models --json out.json {quick}".split()
    succeed("paper", *words, folder=folder)
    result = json.loads((folder / "out.json").read_text())
    assert json.loads((folder / "models" / RESULTS).read_text()) == result
    assert (result["data"], result["split"]) == ("rooms.mcap (simulated)", "paper")
    assert (result["train"], result["test"]) == (131, 48)  # the share of the published rows
    assert result["command"].startswith("python -m benchmarks paper protocol --data rooms.mcap")


@pytest.mark.parametrize(
    "words", [("--windows", "a"), ("--windows", "0"), ("--networks", "cnn"), ("--workers", 0)]
)
def test_invalid_options_are_rejected_with_one_line(folder, words):
    done = run("paper", "protocol", "--data", "rooms.mcap", "-o", "x", *words, folder=folder)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


def test_missing_or_damaged_results_are_rejected_by_name(tmp_path):
    path = tmp_path / RESULTS
    for content in (None, "[1", "{}", json.dumps({"models": [{}]}), "[" * 10_000):
        if content is not None:
            path.write_text(content)
        with pytest.raises(UwbMitigationError) as caught:
            read(ExperimentResults, path)
        assert caught.value.where == str(path)
