"""Datasets: rows, skipped records, and splits by configuration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_material import changed, record, window_of

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import build_dataset
from uwb_mitigation.types.measurement import CirFault, RadioType, Segment, Truth


def test_record_becomes_a_row():
    records = [record(seed, f"c{seed}") for seed in range(2)] + [record(2, "c2", rx_power_dbm=-math.inf)]
    built = build_dataset(records, Preprocessing(157))
    _, expected = window_of(records[1].measurement.cir, Preprocessing(157))
    assert np.array_equal(built.inputs[1], expected)
    assert built.error_m.tolist() == [0.25] * 3
    assert built.rx_power_dbm == pytest.approx([-82.0, -82.0, math.nan], nan_ok=True)
    assert built.first_path_power_dbm.tolist() == [-88.0] * 3
    assert built.configurations.tolist() == ["c0", "c1", "c2"]
    assert built.labels.tolist() == ["LOS"] * 3


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
    tested = np.concatenate([part.test for part in parts])
    assert np.array_equal(np.sort(tested), np.arange(len(names)))


def test_thinning_keeps_a_maximum_number_per_configuration():
    names = np.array(["a"] * 50 + ["b"] * 3)
    rows = splits.subsample(names, 10, 0)
    assert np.count_nonzero(names[rows] == "a") == 10
    assert np.count_nonzero(names[rows] == "b") == 3
    assert (np.diff(rows) > 0).all()


def test_radios_segments_and_channels_of_a_dataset_are_those_of_its_cirs():
    records = [record(), record(radio=RadioType.DW3000, segment=Segment.STS, channel=5)]
    dataset = build_dataset(records, Preprocessing(157))
    assert (dataset.radios, dataset.segments, dataset.channels) == (
        (RadioType.DW1000, RadioType.DW3000),
        (Segment.IPATOV, Segment.STS),
        (2, 5),
    )
