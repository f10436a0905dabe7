"""Search, range test and pruning: resumable, honest about what diverges, and smaller where they say so."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from model_material import dataset, random_weights, windows

from uwb_mitigation.errors import DatasetError, ModelError, ParameterError
from uwb_mitigation.model import floating
from uwb_mitigation.model.architecture import HEAD, Mlp, Remnet
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training import search as searches
from uwb_mitigation.training.options import FitOptions
from uwb_mitigation.training.search import Trial, front, search

pytest.importorskip("torch", reason="training is not set up: run make setup-training")

from uwb_mitigation.training.fitting import fit
from uwb_mitigation.training.learning_rate import range_test
from uwb_mitigation.training.pruning import prune

QUICK = FitOptions(epochs=1, weight_decay=0.0)
KNOWN = dataset(9, 10, samples=16)


def run(journal, **changes):
    options = {"random": 4, "grid": 3} | changes
    return search(KNOWN, journal, QUICK, **options)


def test_a_search_tries_random_networks_then_neighbours_of_the_best(tmp_path):
    trials = run(tmp_path / "journal.jsonl")
    assert [trial.stage for trial in trials] == ["random"] * 4 + ["grid"] * 3
    best = min((t for t in trials if t.stage == "random"), key=lambda t: t.mae_m).architecture
    for trial in trials[4:]:
        for name, values in searches.SPACE.items():
            steps = values.index(getattr(trial.architecture, name)) - values.index(getattr(best, name))
            assert abs(steps) <= 1


def test_a_finished_search_is_not_run_again(tmp_path, monkeypatch):
    first = run(tmp_path / "journal.jsonl")
    monkeypatch.setattr(searches, "fit", lambda *_: pytest.fail("trained again"))
    assert run(tmp_path / "journal.jsonl") == first


def test_an_interrupted_search_goes_on_where_it_stopped(tmp_path, monkeypatch):
    whole = run(tmp_path / "whole.jsonl")
    lines = (tmp_path / "whole.jsonl").read_text().splitlines(keepends=True)
    torn = tmp_path / "torn.jsonl"
    torn.write_text("".join(lines[:2]) + lines[2][:30] + "\n[1]\n{}\n")
    calls = []
    fit = searches.fit
    monkeypatch.setattr(searches, "fit", lambda *arguments: calls.append(1) or fit(*arguments))
    assert set(run(torn)) == set(whole)
    assert len(calls) == 5


def test_a_seed_draws_the_same_networks(tmp_path):
    assert run(tmp_path / "1.jsonl") == run(tmp_path / "2.jsonl")


def test_other_data_is_searched_anew(tmp_path):
    journal = tmp_path / "journal.jsonl"
    run(journal)
    search(dataset(9, 10, samples=16, seed=4), journal, QUICK, random=4, grid=0)
    assert len(journal.read_text().splitlines()) == 7 + 4


def test_windows_are_searched_over(tmp_path):
    trials = run(tmp_path / "journal.jsonl", random=8, grid=0, windows=[16, 8])
    assert {trial.architecture.samples for trial in trials} == {16, 8}


def test_networks_that_diverge_are_recorded_and_left_out(tmp_path):
    bad = replace(KNOWN, error_m=KNOWN.error_m + 3e38)
    journal = tmp_path / "journal.jsonl"
    with pytest.raises(DatasetError, match="every network diverged"):
        search(bad, journal, QUICK, random=2, grid=0)
    assert [json.loads(line)["mae_m"] for line in journal.read_text().splitlines()] == [None, None]


@pytest.mark.parametrize("change", [{"random": 0}, {"grid": -1}, {"windows": [17]}, {"windows": [0]}])
def test_searches_that_cannot_be_are_refused(tmp_path, change):
    with pytest.raises(ParameterError):
        run(tmp_path / "journal.jsonl", **change)


def test_the_front_holds_what_no_other_network_beats():
    shapes = [Remnet(16, filters=filters) for filters in (4, 8, 12, 16)]
    trials = [Trial(shape, mae, "random") for shape, mae in zip(shapes, (0.5, None, 0.6, 0.4), strict=True)]
    assert front(trials) == [trials[0], trials[3]]


def test_pruning_drops_what_adds_nothing():
    shape = Remnet(32, filters=8)
    weights = random_weights(shape)
    dead = {0: 1, 1: 4, 2: 0, 3: 7}
    for name in weights.weight:
        if name != HEAD:
            module = 0 if name == "first" else int(name[6])
            written = 0 if name == "first" else module - 1 if name.endswith("residual") else module
            weights.weight[name][dead[written]] = 0
            weights.bias[name][dead[written]] = 0
    smaller = prune(weights, 7)
    assert smaller.architecture == Remnet(32, filters=7)
    inputs = windows(20, 32)
    expected = floating.predict_m(weights, inputs)
    assert np.allclose(floating.predict_m(smaller, inputs), expected, atol=1e-5)


def test_tuning_mends_what_pruning_broke():
    data = dataset(10, 20)
    weights = random_weights(Remnet(32))
    inputs = data.inputs
    targets = floating.predict_m(weights, inputs)
    options = FitOptions(epochs=8, learning_rate=2e-3, dropout=0.0, weight_decay=0.0)
    smaller = prune(weights, 8)
    errors = [
        np.abs(targets - floating.predict_m(network, inputs)).mean()
        for network in (smaller, fit(smaller.architecture, inputs, targets, options, start=smaller))
    ]
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("filters", [0, 16, 17])
def test_pruning_to_no_fewer_filters_is_refused(filters):
    with pytest.raises(ParameterError, match="1 to 15"):
        prune(random_weights(Remnet(16)), filters)


def test_an_mlp_cannot_be_pruned():
    shape = Mlp(4, (3,))
    weight = {"dense1": np.zeros((3, 4), np.float32), HEAD: np.zeros((3, 1), np.float32)}
    bias = {"dense1": np.zeros(3, np.float32), HEAD: np.zeros(1, np.float32)}
    with pytest.raises(ModelError, match="only a REMNet"):
        prune(FloatWeights(shape, weight, bias), 2)


def learnable() -> tuple[np.ndarray, np.ndarray]:
    inputs = windows(400, 16)
    return inputs, inputs[:, :4].mean(axis=1) - 0.3


def test_the_range_test_finds_rates_that_train():
    inputs, targets = learnable()
    result = range_test(Remnet(16), inputs, targets, QUICK, low=1e-6, high=3.0, steps=300)
    assert 1e-5 < result.suggested <= result.highest < 1.0
    assert len(result.rates) == len(result.losses_m) <= 300
    assert list(result.rates) == sorted(result.rates)


def test_the_range_test_ends_where_the_loss_explodes():
    inputs, targets = learnable()
    result = range_test(Remnet(16), inputs, targets, QUICK, low=1e-3, high=10.0, steps=400)
    assert result.diverged
    assert result.rates[-1] < 10.0


@pytest.mark.parametrize("change", [{"low": 0.0}, {"low": 1.0, "high": 0.1}, {"steps": 3}])
def test_range_tests_that_cannot_be_are_refused(change):
    with pytest.raises(ParameterError, match="0 < low < high"):
        range_test(Remnet(16), *learnable(), QUICK, **change)
