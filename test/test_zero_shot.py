"""Evaluation of a model that was not fitted to the data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from model_material import bundle, dataset

from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.evaluation import zero_shot
from uwb_mitigation.training.evaluation.zero_shot import NAMES, ZeroShot


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Bundle:
    return bundle(tmp_path_factory.mktemp("zero"), linear_bias=LinearBiasModel(0.0))


@pytest.fixture(scope="module")
def data() -> Dataset:
    return dataset(8, 6)


def maes(found: ZeroShot) -> list[float]:
    return [float(np.abs(found.errors[name]).mean()) for name in NAMES]


def test_offsets_remove_a_constant_of_the_boards(model, data):
    moved = zero_shot.evaluate_zero_shot(replace(data, error_m=data.error_m + 3.0), model)
    still = zero_shot.evaluate_zero_shot(data, model)
    assert moved.los_offset_m == pytest.approx(still.los_offset_m + 3.0)
    assert maes(moved)[1:] == pytest.approx(maes(still)[1:])
    assert maes(moved)[0] > maes(still)[0] + 1.0


def test_offset_of_a_placement_is_from_the_other_placements(model, data):
    odd = data.configurations == data.names[0]
    moved = zero_shot.evaluate_zero_shot(
        replace(data, error_m=data.error_m + np.where(odd, 50.0, 0.0)), model
    )
    assert np.abs(moved.errors["universal_offset"][odd]).min() > 45.0


def test_without_a_los_placement_there_is_no_offset(model, data):
    blind = zero_shot.evaluate_zero_shot(replace(data, labels=np.full(len(data), "NLOS")), model)
    assert blind.los_offset_m == 0.0
    assert (blind.errors["universal_los_offset"] == blind.errors["universal"]).all()


def test_refused_ranges_are_unchanged(tmp_path, data):
    narrow_limits = bundle(
        tmp_path, linear_bias=LinearBiasModel(0.0), correction_limits_m=(-(2.0**-20), 2.0**-20)
    )
    found = zero_shot.evaluate_zero_shot(data, narrow_limits)
    assert found.passed_through.all()
    assert (found.errors["universal"] == data.error_m).all()
    assert (found.variance_m2 == np.float32(narrow_limits.card.variance_uncorrected_m2)).all()
