"""Splits by configuration, intervals, and baselines."""

from __future__ import annotations

import numpy as np
import pytest
from model_material import dataset

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.training.evaluation import baselines
from uwb_mitigation.training.evaluation.intervals import MIN_DEVIATION_M, fit_intervals, fit_scale
from uwb_mitigation.training.evaluation.metrics import bootstrap_interval, mae_after_rejection

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
    once = fit_intervals(errors, np.zeros(200), NAMES)
    long = np.concatenate([errors, np.full(2000, 3.0)])
    names = np.concatenate([NAMES, np.full(2000, "c0")])
    assert fit_intervals(long, np.zeros(2200), names).sigmas95 < 100
    assert once.variance_m2 == pytest.approx(0.01, rel=1e-3)


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


def test_intervals_without_data_are_refused():
    with pytest.raises(DatasetError):
        fit_intervals(np.array([np.nan]), np.array([0.0]), np.array(["a"]))


def test_features_are_finite_if_header_fields_are_missing():
    data = dataset(3, 4, samples=64)
    data.rx_power_dbm[:] = np.nan
    data.inputs[0] = 0
    assert baselines.baseline_features(data, header=True).shape == (12, 15)
    assert np.isfinite(baselines.baseline_features(data, header=True)).all()


def test_regressions_use_the_header(monkeypatch):
    monkeypatch.setattr(baselines, "TREES", 20)
    pytest.importorskip("sklearn", reason="run `make setup-training`")
    data = dataset(30, 8, samples=32)
    spread = np.abs(data.error_m - np.median(data.error_m)).mean()
    for predict in (baselines.ridge(data, header=True), baselines.gradient_boosting(data, 0)):
        assert np.abs(data.error_m - predict(data)).mean() < 0.5 * spread
