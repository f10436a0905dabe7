"""Experiment of the paper on small data, and the report of its results, through functions and commands."""

import json
import re
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from command_line import run, succeed
from model_material import dataset, integer_network

pytest.importorskip("torch", reason="training is not set up: run make setup-training")


import torch

from benchmarks.paper import experiment, report, tables, training
from benchmarks.paper.data import Parts, shorten_windows
from benchmarks.paper.report import Report, Study, build_report
from benchmarks.paper.results import RESULTS, ExperimentResults, FirmwareRow, read
from benchmarks.paper.search import CHOICE, SPACE
from benchmarks.paper.training import NetworkStack
from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.mitigation.model.architecture import Mlp, Remnet
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.training.fit import fitting
from uwb_mitigation.training.fit.options import FitOptions

QUICK = FitOptions(epochs=2, learning_rate=1e-3, weight_decay=0.0)
SHAPES = [Remnet(13, 3, 3, 4, 3), Remnet(16, 5, 5, 4, 2), Mlp(16, (8, 4))]


def parts(seed: int = 0) -> Parts:
    train, test = (dataset(count, 20, 157, seed + row) for row, count in enumerate((6, 3)))
    return Parts("made up", "by seed", train, test)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, ExperimentResults]:
    folder = tmp_path_factory.mktemp("protocol")
    wanted = experiment.list_tasks(["remnet", "remnet_k5", "remnet_attention", "mlp"], [157], seeds=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "RANGE_TEST_RATES", np.geomspace(1e-6, 10.0, 60))
        patch.setattr(training, "UNCHANGED", 20)
        return folder, experiment.run_experiment(parts(), folder, wanted, QUICK, trials=3)


@pytest.mark.parametrize("shape", SHAPES)
def test_stack_is_trained_like_single_networks(shape, monkeypatch):
    data = dataset(2, 20, samples=shape.samples)
    # With one batch per epoch, the order has no effect.
    options = replace(QUICK, epochs=30, batch=len(data), dropout=0.0)
    stack = NetworkStack(shape, 2, options.dropout)
    single = []
    for start in map(stack.weights_of, range(2)):
        network = fitting.networks.Network(shape, options.dropout)
        values = chain.from_iterable(zip(start.weight.values(), start.bias.values(), strict=True))
        for parameter, value in zip(network.parameters(), values, strict=True):
            parameter.data = torch.from_numpy(value).reshape(parameter.shape)
        monkeypatch.setattr(fitting.networks, "Network", lambda shape, dropout, network=network: network)
        single.append(fitting.fit(shape, data.inputs, data.error_m, options))
        monkeypatch.undo()
    losses = stack.fit(data, options)
    for seed, expected in enumerate(single):
        for name, weight in stack.weights_of(seed).weight.items():
            assert weight == pytest.approx(expected.weight[name], abs=1e-4)
    assert (losses[-1] < losses[0]).all()


def test_pruned_weights_stay_zero_and_each_network_has_the_share():
    data, stack = dataset(2, 20, samples=13), NetworkStack(SHAPES[0], 2, 0.0)
    stack.fit(data, QUICK)
    before = [stack.weights_of(seed).weight for seed in range(2)]
    stack.mask_smallest(0.5)
    stack.fit(data, QUICK)
    removed = stack.fix_pruned()
    for seed in range(2):
        zeros = np.concatenate([weight.ravel() == 0 for weight in stack.weights_of(seed).weight.values()])
        magnitudes = np.concatenate([np.abs(weight).ravel() for weight in before[seed].values()])
        assert zeros.sum() == removed == pytest.approx(len(zeros) / 2, abs=1)
        assert magnitudes[zeros].max() <= magnitudes[~zeros].min()


def test_search_is_random_then_a_grid_around_the_best_network(finished):
    found = finished[1].trials
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
    train, test = parts().train, parts().test
    assert result.median.all.mae == pytest.approx(np.abs(test.error_m - np.median(train.error_m)).mean())
    # Squeeze and excitation: two dense layers with 2 hidden units in three modules.
    attention = result.of("remnet_attention", 157)[0].parameters
    assert attention == 5905 + 3 * (16 * 2 + 2 + 2 * 16 + 16)
    zipped = [result.of(network, 157)[0].bytes["zipped"] for network in networks[:4]]
    assert zipped == sorted(zipped, reverse=True)
    for model in result.models:
        errors = model.errors
        assert errors["float"].all.n == errors["float"].los.n + errors["float"].nlos.n
        if model.network == "remnet_attention":
            assert list(errors) == ["float"]
            continue
        assert errors["optimised"].all.mae == pytest.approx(errors["float"].all.mae, abs=1e-6)
        assert errors["int8"].all.mae == pytest.approx(errors["float"].all.mae, abs=0.02)
        name = folder / f"{model.network}_157_seed{model.seed}"
        assert Path(f"{name}_int8.onnx").stat().st_size == model.bytes["int8"] < model.bytes["float"]
        assert Path(f"{name}_optimised.onnx").stat().st_size == model.bytes["optimised"]
        left = test.error_m - integer_network(load_bundle(Path(f"{name}_int8.onnx"))).predict_m(test.inputs)
        assert np.abs(left).mean() == pytest.approx(errors["int8"].all.mae, abs=1e-9)
        assert errors["int8"].all.box == pytest.approx(np.percentile(left, (5, 25, 50, 75, 95)))


def test_finished_tasks_are_not_repeated_unless_of_other_data(tmp_path):
    wanted = experiment.list_tasks(["mlp"], [32], seeds=1)
    first = experiment.run_experiment(parts(), tmp_path, wanted, QUICK)
    written = (tmp_path / "mlp_32_seed0_float.onnx").stat().st_mtime_ns
    assert experiment.run_experiment(parts(), tmp_path, wanted, QUICK) == first
    assert (tmp_path / "mlp_32_seed0_float.onnx").stat().st_mtime_ns == written
    other = experiment.run_experiment(parts(seed=5), tmp_path, wanted, QUICK)
    assert other.models[0].errors != first.models[0].errors


def test_shorter_windows_are_scaled_by_their_own_maximum():
    data = replace(dataset(2, 5), preprocessing=Preprocessing(32, Scaling.MAX))
    data.inputs[0, 20] = 50.0
    short = shorten_windows(data, 8)
    assert short.inputs.shape == (10, 8)
    assert np.allclose(short.inputs.max(axis=1), 1.0)
    assert short.preprocessing.samples == 8
    with pytest.raises(ParameterError):
        shorten_windows(data, 64)


PARTS = ["method", "data", "table1", "table2", "search", "table3", "fig3", "fig4a", "fig4b", "fig5", "lr"]
HOSTILE = "<script>alert(1)</script>_$\\frac{$"


def study(name: str = "logs", simulated: bool = False) -> Study:
    data = parts().test
    named = replace(data, configurations=np.char.add(name, data.configurations))
    return Study(Path(name), name, simulated, named, "python -m benchmarks paper report")


def firmware_row() -> FirmwareRow:
    which = {"model": "remnet", "k": 157, "k0": 3, "kernels": "cortex_m4", "mismatches": 0, "inputs": 5000}
    memory = {"instructions": 389_000, "ram_bytes": 10_700, "flash_bytes": 17_600}
    return FirmwareRow.model_validate(which | memory | {"hz": 142.2, "energy_mj": 0.375})


def row_of(made: Report, table: str, *heads: str) -> tuple[tables.Cell, ...]:
    (found,) = (one for one in made.tables if one.id == table)
    return next(row for row in found.rows if [cell.text for cell in row[: len(heads)]] == list(heads))


@pytest.fixture(scope="module")
def full(finished) -> Report:
    return build_report(study(simulated=True), finished[1], [firmware_row()])


def test_page_contains_all_tables_and_figures_and_no_external_references(full):
    html = full.html()
    assert sorted(re.findall(r'<section id="(\w+)"', html)) == sorted(PARTS)
    assert full.lacking == {}
    assert not re.search(r"<(script|link|iframe|object|base)\b|url\(|@import|https?:", html)
    targets = re.findall(r'(?:src|href)="([^"]*)"', html)
    assert all(target.startswith(("data:image/", "#")) for target in targets)


def test_measured_numbers_are_means_over_seeds_next_to_those_of_the_paper_and_baselines(full, finished):
    result, row = finished[1], row_of(full, "table1", "REMNet", "157")
    assert [cell.value for cell in row if cell.kind == "paper"] == [5905, 0.0687, 0.0687, 0.0690]
    maes = [model.errors["float"].all.mae for model in result.of("remnet", 157)]
    assert (row[7].kind, row[7].n) == ("measured", 2)
    assert row[7].text == f"{np.mean(maes):.4f} ± {np.std(maes, ddof=1):.4f}"
    sizes = [model.bytes["int8"] for model in result.of("remnet", 157)]
    assert row_of(full, "table2", "REMNet", "157")[-2].value == pytest.approx(np.mean(sizes) / 1000)
    median, raw = (
        row_of(full, "table1", name)[7].value
        for name in ("Median error of the training part", "No correction")
    )
    assert (median, raw) == (result.median.all.mae, result.median.all.mae_raw)


def test_hostile_names_are_only_text_and_simulated_results_are_marked(full, finished, monkeypatch):
    # Fig. 4 takes most of the time.
    monkeypatch.setattr(report.figures, "scatter", lambda *_: "data:image/png;base64,")
    named = finished[1].model_copy(update={"data": HOSTILE, "split": HOSTILE})
    page = build_report(study(HOSTILE), named).html()
    assert "<script" not in page
    assert "Simulated data" not in page
    assert full.html().count("Simulated data, not comparable") >= 3


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


def test_missing_or_damaged_results_are_rejected_by_name(tmp_path):
    path = tmp_path / RESULTS
    for content in (None, "[1", "{}", json.dumps({"models": [{}]}), "[" * 10_000):
        if content is not None:
            path.write_text(content)
        with pytest.raises(UwbMitigationError) as caught:
            read(ExperimentResults, path)
        assert caught.value.where == str(path)


def test_command_writes_the_page_and_rejects_wrong_files(apartment, tmp_path):
    log = sorted((apartment / "logs").glob("*.log*"))[0]
    words = ("paper", "report", "--data", log, "-o", "out", "--json", "out.json")
    succeed(*words, folder=tmp_path)
    assert "<img" in (tmp_path / "out" / "report.html").read_text()
    values = json.loads((tmp_path / "out.json").read_text())
    assert [one["id"] for one in values["figures"]] == ["fig3", "fig4a", "fig4b"]
    (tmp_path / "bench.json").write_text("{}")
    for option in (("--firmware", "bench.json"), ("--models", "nowhere")):
        refused = run("paper", "report", "--data", log, "-o", "other", *option, folder=tmp_path)
        assert refused.returncode == 1
        assert option[1] in refused.stderr
        assert not (tmp_path / "other").exists()
