"""The paper's experiment on small data: resumable, whole, and the same on one process or two."""

from __future__ import annotations

import json
from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
from model_material import dataset, integer_network
from typer.testing import CliRunner

from uwb_mitigation.cli import app
from uwb_mitigation.dataset import Dataset
from uwb_mitigation.errors import DatasetError, ParameterError, UwbMitigationError
from uwb_mitigation.evaluation.results import RESULTS, read_experiment
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.training import experiment
from uwb_mitigation.training.options import FitOptions
from uwb_mitigation.training.parts import Parts, narrowed

QUICK = FitOptions(epochs=2, learning_rate=1e-3, weight_decay=0.0)


def parts(seed: int = 0) -> Parts:
    return Parts("made up", "by seed", dataset(6, 20, seed=seed), dataset(3, 20, seed=seed + 1))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("protocol")
    wanted = experiment.tasks(["remnet", "remnet_attention", "mlp"], [32], seeds=1)
    return folder, experiment.run(parts(), folder, wanted, QUICK)


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


@pytest.mark.parametrize(
    ("networks", "windows", "seeds"), [(["cnn"], [8], 1), (["mlp"], [], 1), (["mlp"], [8], 0)]
)
def test_tasks_that_cannot_be_are_refused(networks, windows, seeds):
    with pytest.raises(ParameterError):
        experiment.tasks(networks, windows, seeds)


def test_every_form_of_a_network_is_measured(finished):
    _, result = finished
    model = next(model for model in result.models if model.network == "remnet" and model.samples == 32)
    assert model.mae_optimised == pytest.approx(model.mae_float, abs=1e-6)
    assert model.mae_int8 == pytest.approx(model.mae_float, abs=0.02)
    assert model.bytes_int8 < model.bytes_float
    assert model.float_errors.all.n == model.float_errors.los.n + model.float_errors.nlos.n
    assert model.parameters == 5649


def test_attention_is_in_float_alone(finished):
    _, result = finished
    (model,) = (model for model in result.models if model.network == "remnet_attention")
    assert model.mae_float > 0
    assert model.mae_int8 is None
    assert model.parameters == 5649 + 3 * 82


def test_sizes_are_those_of_the_files(finished):
    folder, result = finished
    for model in result.models:
        if model.bytes_int8 is not None:
            name = f"{model.network}_{model.samples}_seed{model.seed}"
            assert (folder / f"{name}_int8.onnx").stat().st_size == model.bytes_int8
            assert (folder / f"{name}_optimised.onnx").stat().st_size == model.bytes_optimised


def test_the_bundles_give_the_measured_errors(finished):
    folder, result = finished
    test = parts().test
    for model in result.models:
        if model.network != "remnet_attention":
            bundle = load_bundle(folder / f"{model.network}_{model.samples}_seed0_int8.onnx")
            inputs = narrowed(test, model.samples).inputs
            left = test.error_m - integer_network(bundle).predict_m(inputs)
            assert np.abs(left).mean() == pytest.approx(model.mae_int8, abs=1e-9)


def test_the_best_calibration_on_the_training_part_is_taken(finished):
    _, result = finished
    model = result.models[0]
    assert set(model.calibration_mae) == {"max", "p99.99", "p99.9", "p99", "mse"}
    assert model.calibration_mae[model.calibration] == min(model.calibration_mae.values())


def test_results_are_read_as_they_were_written(finished):
    folder, result = finished
    assert read_experiment(folder) == result


def left(baselines, name: str) -> float:
    (found,) = (baseline for baseline in baselines if baseline.name == name)
    return found.errors.all.mae


def test_medians_and_the_line_stand_beside_the_networks(finished):
    _, result = finished
    assert [baseline.name for baseline in result.baselines] == ["los_median", "overall_median", "line"]
    train, test = parts().train, parts().test
    for name, rows in (("los_median", train.labels == "LOS"), ("overall_median", train.labels != "")):
        expected = np.abs(test.error_m - np.median(train.error_m[rows])).mean()
        assert left(result.baselines, name) == pytest.approx(expected)


def with_line(data: Dataset, gap_db: float = 5.0) -> Dataset:
    """Errors that are a line in the received power, which differs between configurations."""
    _, of = np.unique(data.configurations, return_inverse=True)
    power = (-80.0 - of + 0.1 * np.arange(len(data)) % 1).astype(np.float32)
    gap = (gap_db + of**2).astype(np.float32)
    return replace(
        data,
        rx_power_dbm=power,
        first_path_power_dbm=power - gap,
        error_m=0.5 - 0.02 * (power + 80) + gap / 9,
    )


def test_the_line_is_fitted_on_the_training_part_and_told_on_the_test_part():
    train, test = with_line(dataset(8, 5)), with_line(dataset(4, 5, seed=1), gap_db=9.0)
    baselines = experiment.baselines_of(train, test)
    assert left(baselines, "line") < 0.02 < 0.2 < left(baselines, "overall_median")


def test_a_range_whose_power_is_unknown_counts_as_measured():
    train, test = with_line(dataset(8, 5)), with_line(dataset(4, 5, seed=1))
    test.first_path_power_dbm[0] = np.nan
    known = np.abs(test.error_m[0]) / len(test)
    assert left(experiment.baselines_of(train, test), "line") == pytest.approx(known, abs=0.02)


@pytest.mark.parametrize("part", ["train", "test"])
def test_data_without_powers_has_no_line_and_says_why(part: str):
    two = {"train": with_line(dataset(8, 5)), "test": with_line(dataset(4, 5, seed=1))}
    two[part].rx_power_dbm[:] = np.nan
    line = experiment.baselines_of(**two)[-1]
    assert (line.name, line.errors) == ("line", None)
    assert "no received power" in line.reason


def test_too_few_configurations_have_no_line():
    line = experiment.baselines_of(with_line(dataset(3, 5)), with_line(dataset(4, 5, seed=1)))[-1]
    assert line.errors is None
    assert "too few configurations" in line.reason


def test_what_is_done_is_not_done_again(finished, monkeypatch):
    folder, result = finished
    monkeypatch.setattr(experiment, "train_task", lambda *_: pytest.fail("trained again"))
    wanted = [experiment.Task(model.network, model.samples, model.seed) for model in result.models]
    assert experiment.run(parts(), folder, wanted, QUICK) == result


MLP = experiment.Task("mlp", 32, 0)


@pytest.mark.parametrize(
    "damage", ["", "{", '{"fingerprint": 1}', '{"fingerprint": 1, "model": {"network": 3}}']
)
def test_a_damaged_result_is_done_again(finished, tmp_path, damage):
    folder, first = finished
    copied = copytree(folder, tmp_path / "copy")
    (copied / f"{MLP.name}.json").write_text(damage)
    (again,) = experiment.run(parts(), copied, [MLP], QUICK).models
    assert again.mae_int8 == first.models[-1].mae_int8


def test_other_data_is_trained_on_anew(finished, tmp_path):
    folder, first = finished
    (other,) = experiment.run(parts(seed=5), copytree(folder, tmp_path / "copy"), [MLP], QUICK).models
    assert other.mae_raw != first.models[-1].mae_raw


def test_one_command_trains_on_simulated_rooms_and_calls_them_so(tmp_path):
    data, folder = str(tmp_path / "rooms.mcap"), tmp_path / "models"
    simulate = ["data", "simulate", "-o", data, "--ranges", "200", "--exchanges", "4"]
    train = ["protocol", "--data", data, "-o", str(folder), "--networks", "mlp", "--windows", "8"]
    for words in (simulate, [*train, "--seeds", "1", "--epochs", "1", "--workers", "1"]):
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, done.output
    assert "L1 line" in done.output
    result = read_experiment(folder)
    assert (result.data, result.split) == ("rooms.mcap (simulated)", "paper")
    # As many as the paper's split has of so many rows.
    assert (result.train, result.test) == (131, 48)
    assert left(result.baselines, "line") > 0


def test_two_processes_give_the_same_models(tmp_path):
    wanted = experiment.tasks(["mlp"], [32], seeds=2)
    shares: list[float] = []
    alone, together = (
        experiment.run(parts(), tmp_path / str(workers), wanted, QUICK, workers, shares.append)
        for workers in (1, 2)
    )
    assert [m.mae_int8 for m in alone.models] == [m.mae_int8 for m in together.models]
    assert shares[-1] == pytest.approx(1.0)


def test_a_loss_that_diverges_ends_the_run(tmp_path):
    bad = parts()
    bad = replace(bad, train=replace(bad.train, error_m=bad.train.error_m + 3e38))
    with pytest.raises(DatasetError, match="the loss is"):
        experiment.run(bad, tmp_path, experiment.tasks(["mlp"], [32], 2), QUICK)


def test_shorter_windows_are_scaled_by_their_own_maximum():
    data = replace(dataset(2, 5), preprocessing=Preprocessing(32, Scaling.MAX))
    data.inputs[0, 20] = 50.0
    short = narrowed(data, 8)
    assert short.inputs.shape == (10, 8)
    assert np.allclose(short.inputs.max(axis=1), 1.0)
    assert short.preprocessing.samples == 8


def test_longer_windows_cannot_be_made():
    with pytest.raises(ParameterError, match="window of 64"):
        narrowed(dataset(2, 5), 64)


def test_results_that_are_none_are_named(tmp_path):
    with pytest.raises(UwbMitigationError, match="what `uwb-mitigation protocol`"):
        read_experiment(tmp_path)
    (tmp_path / RESULTS).write_text(json.dumps({"models": [{}]}))
    with pytest.raises(UwbMitigationError, match="Field required"):
        read_experiment(tmp_path)
