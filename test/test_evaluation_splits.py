"""Datasets, splits by configuration, intervals, baselines, and models that were not fitted to the data."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_material import bundle, changed, dataset, record, window_of

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset, build_dataset
from uwb_mitigation.training.evaluation import zero_shot
from uwb_mitigation.training.evaluation.intervals import MIN_DEVIATION_M, fit_intervals, fit_scale
from uwb_mitigation.training.evaluation.metrics import bootstrap_interval, mae_after_rejection
from uwb_mitigation.types.measurement import CirFault, RadioType, Segment, Truth

NAMES = np.repeat([f"c{number}" for number in range(40)], 5)


def test_bootstrap_draws_configurations_not_ranges():
    spread = np.random.default_rng(0).normal(0, 1, 40)
    few, many = (
        bootstrap_interval(np.repeat(spread, n), np.repeat(np.arange(40).astype(str), n)) for n in (1, 50)
    )
    assert few == pytest.approx(many)
    assert few[0] < np.abs(spread).mean() < few[1]


def test_largest_variances_are_rejected_first():
    errors = np.array([1.0, -5.0, 2.0, 4.0])
    assert mae_after_rejection(errors, np.array([1.0, 4.0, 2.0, 3.0]), 0.5) == 1.5
    assert mae_after_rejection(errors, errors**2, 0.0) == 3.0


def test_intervals_cover_unseen_configurations():
    generator = np.random.default_rng(1)
    narrow, wide = [], []
    for _ in range(60):
        errors = np.repeat(generator.standard_t(3, 40), 5) * 0.2
        found = fit_intervals(errors[:100], np.zeros(100), NAMES[:100])
        ratio = np.abs(errors[100:]) / np.sqrt(found.variance_m2)
        narrow.append(np.mean(ratio <= 1))
        wide.append(np.mean(ratio <= found.sigmas95))
    assert 0.60 <= np.mean(narrow) <= 0.76
    assert 0.90 <= np.mean(wide) <= 0.98


def test_configurations_have_equal_weight():
    errors = np.where(NAMES == "c0", 3.0, 0.1)
    long = np.concatenate([errors, np.full(2000, 3.0)])
    names = np.concatenate([NAMES, np.full(2000, "c0")])
    assert fit_intervals(long, np.zeros(2200), names).sigmas95 < 100
    assert fit_intervals(errors, np.zeros(200), NAMES).variance_m2 == pytest.approx(0.01, rel=1e-3)


def test_scale_follows_the_size_of_the_predicted_error():
    generator = np.random.default_rng(1)
    predicted = generator.uniform(-1.0, 1.0, 20_000)
    # The upper half has no weight.
    deviation = np.where(predicted > 0.0, 9.0, np.maximum(np.abs(predicted) / 2.0, 0.01))
    residual = generator.laplace(0.0, deviation / np.sqrt(2.0))
    sizes, scale = np.transpose(fit_scale(residual, predicted, (predicted < 0.0).astype(float)))
    assert scale[0] == pytest.approx(MIN_DEVIATION_M, abs=1e-3)
    assert np.interp([0.5, 0.8], sizes, scale) == pytest.approx([0.25, 0.4], rel=0.1)
    assert (np.diff(scale) >= 0.0).all()


def test_record_becomes_a_row():
    others = {"radio": RadioType.DW3000, "segment": Segment.STS, "channel": 5}
    records = [record(0, "c0"), record(1, "c1", **others), record(2, "c2", rx_power_dbm=-math.inf)]
    built = build_dataset(records, Preprocessing())
    _, expected = window_of(records[1].measurement.cir, Preprocessing(157))
    assert np.array_equal(built.inputs[1], expected)
    assert built.error_m.tolist() == [0.25] * 3
    assert built.rx_power_dbm == pytest.approx([-82.0, -82.0, math.nan], nan_ok=True)
    assert built.first_path_power_dbm.tolist() == [-88.0] * 3
    assert built.configurations.tolist() == ["c0", "c1", "c2"]
    assert built.labels.tolist() == ["LOS"] * 3
    assert built.radios == (RadioType.DW1000, RadioType.DW3000)
    assert (built.segments, built.channels) == ((Segment.IPATOV, Segment.STS), (2, 5))


def test_skipped_records_are_counted_by_reason():
    records = [
        record(),
        replace(record(), truth=None),
        replace(record(), truth=Truth(math.nan)),
        changed(record(), range_m=math.nan),
        record(preamble_count=0),
        record(samples=np.zeros(0, np.int16)),
    ]
    assert build_dataset(records, Preprocessing(157)).skipped == {
        "no true range": 2,
        "no valid range": 1,
        CirFault.NO_PREAMBLE_COUNT.text: 1,
        CirFault.EMPTY.text: 1,
    }


def test_data_without_usable_records_is_refused_with_the_reason():
    with pytest.raises(DatasetError, match="1 x no true range"):
        build_dataset([replace(record(), truth=None)], Preprocessing(157))
    with pytest.raises(DatasetError, match="no measurements"):
        build_dataset([], Preprocessing(157))
    with pytest.raises(DatasetError):
        fit_intervals(np.array([np.nan]), np.array([0.0]), np.array(["a"]))


@settings(max_examples=60)
@given(
    names=st.lists(st.sampled_from("abcdefgh"), min_size=4, max_size=80),
    folds=st.integers(2, 8),
    seed=st.integers(0, 1000),
)
def test_each_configuration_is_held_out_once_and_never_in_training(names, folds, seed):
    configurations = np.array(names)
    if len(set(names)) < folds:
        with pytest.raises(DatasetError):
            splits.by_configuration(configurations, folds, seed)
        return
    parts = splits.by_configuration(configurations, folds, seed)
    for part in parts:
        assert not set(configurations[part.train]) & set(configurations[part.test])
        assert len(part.train) + len(part.test) == len(names)
    assert np.array_equal(np.sort(np.concatenate([part.test for part in parts])), np.arange(len(names)))


def test_thinning_keeps_a_maximum_number_per_configuration():
    names = np.array(["a"] * 50 + ["b"] * 3)
    rows = splits.subsample(names, 10, 0)
    assert np.count_nonzero(names[rows] == "a") == 10
    assert np.count_nonzero(names[rows] == "b") == 3
    assert (np.diff(rows) > 0).all()


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Bundle:
    return bundle(tmp_path_factory.mktemp("zero"), linear_bias=LinearBiasModel(0.0))


@pytest.fixture(scope="module")
def data() -> Dataset:
    return dataset(8, 6)


def test_offsets_remove_a_constant_of_the_boards_but_not_of_the_same_placement(model, data):
    still, moved = (
        zero_shot.evaluate_zero_shot(replace(data, error_m=data.error_m + added_m), model)
        for added_m in (0.0, 3.0)
    )
    maes, others = (
        [np.abs(found.errors[name]).mean() for name in zero_shot.NAMES] for found in (still, moved)
    )
    assert others[1:] == pytest.approx(maes[1:])
    assert others[0] > maes[0] + 1.0
    odd = data.configurations == data.names[0]
    moved = zero_shot.evaluate_zero_shot(replace(data, error_m=data.error_m + 50.0 * odd), model)
    assert np.abs(moved.errors["universal_offset"][odd]).min() > 45.0


def test_refused_ranges_are_unchanged(tmp_path, data):
    narrow_limits = bundle(
        tmp_path, linear_bias=LinearBiasModel(0.0), correction_limits_m=(-(2.0**-20), 2.0**-20)
    )
    found = zero_shot.evaluate_zero_shot(data, narrow_limits)
    assert found.passed_through.all()
    assert (found.errors["universal"] == data.error_m).all()
    assert (found.variance_m2 == np.float32(narrow_limits.card.variance_uncorrected_m2)).all()
