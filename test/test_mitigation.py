"""Correction of valid and invalid measurements."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from model_material import LINE, bundle, measurement, window_of

from uwb_mitigation.mitigation.correction import OTHER_CHANNEL_FACTOR, UNRELIABLE_VARIANCE_M2, Mitigation
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.types.measurement import CorrectedBy, Encoding, RadioType, Segment, Status
from uwb_mitigation.types.offsets import Offsets


@pytest.fixture(scope="module")
def mitigation(tmp_path_factory) -> Mitigation:
    return Mitigation(bundle(tmp_path_factory.mktemp("bundle"), Remnet(samples=157)))


@pytest.fixture(autouse=True)
def _no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


BAD = [
    ({"samples": np.zeros(0, np.int16)}, 3.0, Status.NO_CIR),
    ({"samples": np.zeros(2032, np.int16)}, 3.0, Status.BAD_CIR),
    ({"samples": np.full(2032, -32768, np.int16)}, 3.0, Status.BAD_CIR),
    ({"samples": np.ones(20, np.int16)}, 3.0, Status.BAD_CIR),
    ({"encoding": Encoding.MAGNITUDE}, 3.0, Status.BAD_CIR),
    ({"first_path_index": math.nan}, 3.0, Status.BAD_CIR),
    ({"preamble_count": 0}, 3.0, Status.BAD_CIR),
    ({"rx_power_dbm": math.nan}, 3.0, Status.BAD_CIR),
    ({"rx_power_dbm": -math.inf}, 3.0, Status.BAD_CIR),
    ({"first_path_power_dbm": math.nan}, 3.0, Status.BAD_CIR),
    ({"first_path_power_dbm": 1e300}, 3.0, Status.BAD_CIR),
    ({"rx_power_dbm": 300.0}, 3.0, Status.OUT_OF_DISTRIBUTION),
    ({}, math.nan, Status.OUT_OF_DISTRIBUTION),
    ({}, math.inf, Status.OUT_OF_DISTRIBUTION),
    ({}, -math.inf, Status.OUT_OF_DISTRIBUTION),
    ({}, -0.5, Status.OUT_OF_DISTRIBUTION),
    ({}, 1e300, Status.OUT_OF_DISTRIBUTION),
    ({"samples": np.zeros(0, np.int16)}, math.nan, Status.NO_CIR),
]


def test_cir_of_another_radio_is_passed_through_minus_the_offset(mitigation):
    known = measurement(3.0)
    cirs = [replace(known.cir, radio=radio, segment=segment) for radio in RadioType for segment in Segment]
    results = Mitigation(mitigation.bundle, 0.25).correct([replace(known, cir=cir) for cir in cirs])
    for cir, result in zip(cirs, results, strict=True):
        if (cir.radio, cir.segment) in ((0, 0), (RadioType.DW1000, Segment.IPATOV)):
            assert result.status is Status.OK
        else:
            expected = Status.OUT_OF_DISTRIBUTION, 0.25, 2.75
            assert (result.status, result.correction_m, result.range_m) == expected


def test_correction_is_linear_bias_plus_network_in_float32(mitigation):
    subject = measurement(3.1)
    _, window = window_of(subject.cir, Preprocessing(157))
    powers = np.array([-82.0]), np.array([-88.0])
    (predicted,) = LINE.predict_m(*powers) + mitigation._backends[0]._session.predict_m(window[None])
    result = mitigation.correct([subject])[0]
    assert result.status is Status.OK
    assert result.correction_m == float(predicted)
    assert result.range_m == float(np.float32(3.1) - predicted)
    assert result.range_raw_m == 3.1
    assert result.variance_m2 == 0.0625
    assert result.origin is CorrectedBy.HOST
    assert result.model_id == mitigation.bundle.model_id


@pytest.mark.parametrize("uncorrected_m2", [1 / 32, 0.5])
def test_variance_of_a_range_without_cir_does_not_depend_on_the_offset(tmp_path, uncorrected_m2):
    saved = bundle(tmp_path, variance_uncorrected_m2=uncorrected_m2)
    without = replace(measurement(samples=np.zeros(0, np.int16)), tag_id=7, anchor_id=1)
    for offsets in (Offsets(), Offsets(pairs={(7, 1): 0.2}, pair_sd={(7, 1): 0.03})):
        result = Mitigation(saved, offsets).correct([without])[0]
        assert result.status is Status.NO_CIR
        assert result.variance_m2 == max(uncorrected_m2, UNRELIABLE_VARIANCE_M2)


@pytest.mark.parametrize(("changes", "range_m", "status"), BAD)
def test_invalid_measurement_passes_through(mitigation, changes, range_m, status):
    result = mitigation.correct([measurement(range_m, **changes)])[0]
    assert result.status is status
    assert result.range_m == range_m or math.isnan(range_m)
    assert math.isnan(result.range_m) == math.isnan(range_m)
    assert result.correction_m == 0.0
    assert result.variance_m2 == (0.5 if 0.0 <= range_m <= 1e6 else math.inf)


def test_constant_bias_model_needs_no_level(tmp_path):
    subject = Mitigation(bundle(tmp_path, Remnet(samples=157), linear_bias=LinearBiasModel(0.25)))
    result = subject.correct([measurement(rx_power_dbm=math.nan, first_path_power_dbm=math.nan)])[0]
    assert result.status is Status.OK


@pytest.mark.parametrize(
    "changes",
    [{"samples": np.zeros(0, np.int16)}, {"preamble_count": 0}, {"first_path_power_dbm": math.nan}, {}],
)
def test_bundle_without_network_ignores_the_cir(tmp_path, changes):
    made = bundle(tmp_path, Remnet(samples=157), linear_bias=LinearBiasModel(0.25), needs_cir=False)
    result = Mitigation(made).correct([measurement(3.0, **changes)])[0]
    assert result.status is Status.OK
    if changes.get("first_path_power_dbm") is None and changes:
        assert result.correction_m == 0.25


def test_standard_deviation_is_larger_on_other_channels(tmp_path):
    for trained, channel, factor in (
        ((2, 5), 5, 1),
        ((2, 5), 4, OTHER_CHANNEL_FACTOR),
        ((2, 5), 0, 1),
        ((), 4, 1),
    ):
        subject = Mitigation(bundle(tmp_path, Remnet(samples=157), scale=((0.0, 0.375),), channels=trained))
        invalid = measurement(samples=np.zeros(2032, np.int16), channel=channel)
        result, passed_through = subject.correct([measurement(channel=channel), invalid])
        assert result.variance_m2 == (0.375 * factor) ** 2
        assert result.status is (Status.OK if factor == 1 else Status.UNRELIABLE)
        assert passed_through.variance_m2 == 0.5


def test_prediction_beyond_the_limits_is_out_of_distribution(tmp_path):
    subject = Mitigation(bundle(tmp_path, Remnet(samples=157), correction_limits_m=(50.0, 60.0)))
    result = subject.correct([measurement(3.0)])[0]
    assert (result.status, result.range_m) == (Status.OUT_OF_DISTRIBUTION, 3.0)


@pytest.mark.parametrize(
    "linear_bias",
    [None, LinearBiasModel(0.25), LinearBiasModel(-1.0, -0.015625), LinearBiasModel(0.125, 0.0, 0.03125)],
)
def test_batch_has_the_bits_of_single_measurements(mitigation, tmp_path, linear_bias):
    if linear_bias is not None:
        made = bundle(tmp_path, Remnet(samples=157), linear_bias=linear_bias, needs_cir=False)
        mitigation = Mitigation(made, Offsets(0.125))
    subjects = [measurement(2 + 0.01 * seed, seed) for seed in range(60)]
    subjects[5:5] = [measurement(range_m, **changes) for changes, range_m, _ in BAD]
    subjects += [measurement(2.0, samples=np.zeros(0, np.int16), rx_power_dbm=-60.0 - n) for n in range(9)]
    subjects += [measurement(2.0, first_path_power_dbm=math.nan), measurement(2.0, rx_power_dbm=math.nan)] * 4
    single = [mitigation.correct([subject])[0] for subject in subjects]
    if linear_bias is not None:
        assert sum(result.status is Status.OK for result in single) > 70
    assert [repr(result) for result in mitigation.correct(subjects)] == [repr(r) for r in single]


class FailingSession:
    def __init__(self, output: float | None = None) -> None:
        self.output = output

    def predict_m(self, windows):
        if self.output is None:
            raise RuntimeError("out of memory")
        return np.full(len(windows), self.output, np.float32)


@pytest.mark.parametrize("session", [FailingSession(), FailingSession(math.nan)])
def test_failing_network_passes_the_range_through(tmp_path, session):
    subject = Mitigation(bundle(tmp_path, Remnet(samples=157)))
    subject._backends[0]._session = session
    results = subject.correct([measurement(3.0)] * 2)
    assert [(result.status, result.range_m) for result in results] == [(Status.MODEL_ERROR, 3.0)] * 2
