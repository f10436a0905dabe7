"""Variance, and correction of out-of-distribution measurements."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from model_material import bundle, measurement

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.ood import Band, OodBands, OodDetector, ood_features
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.types.measurement import Status

WIDE = Band(-1000.0, 1000.0, 1.0)
SCALE = ((0.0, 0.25), (0.5, 0.375), (1.0, 0.75), (4.0, 4.5))
SHAPE = Remnet(samples=157)


def bands(**changes: Band) -> OodBands:
    every = dict.fromkeys(
        (
            "range_m",
            "power_at_1m_dbm",
            "power_gap_db",
            "cir_level_db",
            "first_path_level_db",
            "lead_level_db",
        ),
        WIDE,
    )
    return OodBands(0.25, **(every | changes))


def mitigation(folder, scale=((0.0, 0.25),), **changes: Band) -> Mitigation:
    return Mitigation(bundle(folder, SHAPE, ood_bands=bands(**changes), scale=scale))


@pytest.fixture(autouse=True)
def _no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize("scaling", Scaling)
def test_energy_before_the_first_path_needs_no_level(scaling):
    amplitude = np.zeros((1, 157), np.float32)
    amplitude[0, :3], amplitude[0, 6:9] = 0.125, 0.25
    window = np.sqrt(amplitude) if scaling is Scaling.PREAMBLE else amplitude
    unknown = np.float32([math.nan])
    found = ood_features(window, scaling, np.float32([3.0]), unknown, unknown)
    assert found[5] == pytest.approx(10 * math.log10(0.2), abs=0.06)
    only = OodBands(0.0, None, lead_level_db=Band(-50.0, -10.0, 6.0))
    assert OodDetector(only.bands).score(found) == pytest.approx(0.5, abs=0.02)


def test_weaker_radio_is_out_of_distribution_but_a_larger_distance_is_not(tmp_path):
    one = mitigation(tmp_path, power_at_1m_dbm=Band(-74.0, -70.0, 2.0))
    near, far, weak = (
        one.correct([measurement(range_m, rx_power_dbm=power, first_path_power_dbm=power - 6.0)])[0].status
        for range_m, power in ((1.0, -72.0), (10.0, -92.0), (1.0, -92.0))
    )
    assert (near, far, weak) == (Status.OK, Status.OK, Status.OUT_OF_DISTRIBUTION)


def test_scale_gives_variance_and_status(tmp_path):
    one = mitigation(tmp_path, SCALE)
    for result in one.correct([measurement(seed=seed, rx_power_dbm=-82.0 - seed) for seed in range(20)]):
        deviation_m = np.interp(abs(result.correction_m), *np.transpose(SCALE))
        assert result.variance_m2 == pytest.approx(deviation_m**2, rel=1e-6)
        assert result.status is (Status.UNRELIABLE if deviation_m > 0.5 else Status.OK)
        assert result.range_m == pytest.approx(3.0 - result.correction_m)


def test_out_of_distribution_measurement_is_corrected_less_with_larger_variance(tmp_path):
    in_distribution = mitigation(tmp_path).correct([measurement(3.0)])[0]
    out_of_distribution = mitigation(tmp_path, range_m=Band(1.0, 2.0, 4.0)).correct([measurement(3.0)])[0]
    assert out_of_distribution.status is Status.OK
    assert out_of_distribution.correction_m == pytest.approx(
        0.25 + 0.75 * (in_distribution.correction_m - 0.25), abs=1e-6
    )
    assert out_of_distribution.variance_m2 == pytest.approx(
        in_distribution.variance_m2 + 0.25 * 0.5, abs=1e-6
    )


@pytest.mark.parametrize("name", ["range_m", "power_at_1m_dbm", "power_gap_db", "cir_level_db"])
def test_fully_out_of_distribution_measurement_passes_through(tmp_path, name):
    result = mitigation(tmp_path, **{name: Band(500.0, 501.0, 1.0)}).correct([measurement(3.0)])[0]
    assert (result.status, result.range_m, result.correction_m) == (Status.OUT_OF_DISTRIBUTION, 3.0, 0.0)
    assert result.variance_m2 == 0.5


def test_batches_equal_single_measurements_bit_by_bit(tmp_path):
    subject = mitigation(
        tmp_path, range_m=Band(1.0, 2.0, 4.0), power_at_1m_dbm=Band(-72.0, -70.0, 5.0), cir_level_db=WIDE
    )
    subjects = [measurement(0.2 * n, n, rx_power_dbm=-75.0 - n / 2) for n in range(40)]
    subjects.append(measurement(rx_power_dbm=1e300))
    # At the edges of the bands, rounding decides whether the score of a live range is computed exactly.
    subjects += [measurement(high + n * 1e-7) for high in (1.96, 2.0, 6.0) for n in range(-20, 20)]
    single = [subject.correct([item])[0] for item in subjects]
    assert {result.status for result in single} >= {Status.OK, Status.OUT_OF_DISTRIBUTION}
    assert [repr(result) for result in subject.correct(subjects)] == [repr(r) for r in single]


@pytest.mark.parametrize("band", [(2.0, 1.0, 1.0), (0.0, 1.0, 0.0), (math.nan, 1.0, 1.0), (0.1, 1.0, 1.0)])
def test_invalid_band_is_refused(band):
    with pytest.raises(ModelError, match="band"):
        Band(*band)


@pytest.mark.parametrize(
    "change",
    [
        {"scale": ((0.0, 0.0),)},
        {"scale": ((0.5, 1.0),)},
        {"scale": ((0.0, 1.0), (0.0, 2.0))},
        {"interval95_sigmas": 0.5},
    ],
)
def test_card_with_an_impossible_variance_is_refused(tmp_path, change):
    with pytest.raises(ModelError, match=next(iter(change))):
        bundle(tmp_path, SHAPE, **change)


def test_bands_contain_the_measurements_they_are_computed_from():
    windows = np.random.default_rng(0).uniform(0.1, 1, (50, 157)).astype(np.float32)
    power = np.linspace(-95, -80, 50, dtype=np.float32)
    range_m = np.linspace(1, 6, 50, dtype=np.float32)
    windows[:, :3] /= 16
    values = ood_features(windows, Scaling.PREAMBLE, range_m, power, power - np.float32(5))
    found = OodBands.of(0.3, np.column_stack(values))
    assert (OodDetector(found.bands).score(values) <= 0).all()
    assert replace(found, known_offset_m=0.0).bands == found.bands
