"""A direct path before the reported first path: detection on the host, and the same bits in the firmware."""

from dataclasses import replace
from pathlib import Path

import firmware_models
import numpy as np
import pytest
from compilers import NEEDS_CC

from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.early_path import TAP_M, early_path_error_m
from uwb_mitigation.mitigation.embedded.compiled import FirmwareMitigation
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.simulation.channel import CHANNEL_2
from uwb_mitigation.simulation.radio import pulse
from uwb_mitigation.types.measurement import Cir, RangeColumns, RangeMeasurement, Status

SAMPLES = 32
REPORTED = 300.0


def received(early: float, before: float = 15.0, seed: int = 0, **changes: object) -> RangeMeasurement:
    """Return a range with noise of 5 counts, a path of 1,200 counts, and one of `early` counts `before` taps earlier."""
    random = np.random.default_rng(seed)
    taps = np.arange(400.0)
    samples = random.normal(0.0, 5.0, (400, 2))
    for position, amplitude in ((REPORTED, 1200.0), (REPORTED - before, early)):
        phase = random.uniform(0.0, 2 * np.pi)
        shape = amplitude * pulse(taps - position - CHANNEL_2.pulse_taps / 2.0) / pulse(np.zeros(1))[0]
        samples += shape[:, None] * (np.cos(phase), np.sin(phase))
    cir = Cir(
        np.rint(samples).astype(np.int16).ravel(),
        first_path_index=REPORTED,
        preamble_count=100,
        rx_power_dbm=-80.0,
        first_path_power_dbm=-82.0,
    )
    return RangeMeasurement(0, 1, 2, 0, 0, 5.0, replace(cir, **changes))


def error_m(measurement: RangeMeasurement) -> float:
    ((_, columns),) = RangeColumns.grouped([measurement])
    return float(early_path_error_m(columns, np.arange(1), SAMPLES)[0])


@pytest.mark.parametrize("before", [4.3, 12.0, 18.25])
def test_missed_path_gives_its_distance_from_the_reported_one(before: float) -> None:
    assert error_m(received(110.0, before)) == pytest.approx(before * TAP_M, abs=0.06)


def test_noise_weak_paths_and_short_cirs_have_no_early_path() -> None:
    assert all(np.isnan(error_m(received(0.0, seed=seed))) for seed in range(300))
    assert np.isnan(error_m(received(50.0))), "weaker than 1/400 of the strongest tap"
    assert np.isnan(error_m(received(110.0, 22.0))), "before the search"
    assert np.isnan(error_m(received(400.0))), "too strong to be missed"
    start = 2 * (int(REPORTED) - 140)
    found = received(110.0)
    assert np.isnan(
        error_m(replace(found, cir=replace(found.cir, samples=found.cir.samples[start:], start_index=160)))
    )


def with_early_path(folder: Path) -> Bundle:
    return firmware_models.exact_bundle(folder, SAMPLES, early_path=True, linear_bias=LinearBiasModel(0.0))


def test_early_path_that_would_make_the_range_too_short_is_not_used(tmp_path: Path) -> None:
    found = received(110.0)
    detour_m = error_m(found)
    near, far = (replace(found, range_m=detour_m + left_m) for left_m in (0.29, 0.31))
    by_network, by_early_path = Mitigation(with_early_path(tmp_path)).correct([near, far])
    assert by_early_path.correction_m == pytest.approx(detour_m)
    network = firmware_models.exact_bundle(tmp_path, SAMPLES, linear_bias=LinearBiasModel(0.0))
    assert by_network == replace(Mitigation(network).correct(near), model_id=by_network.model_id)


@NEEDS_CC
def test_no_corrected_range_is_negative(tmp_path: Path) -> None:
    model = firmware_models.exact_bundle(tmp_path, SAMPLES, linear_bias=LinearBiasModel(-1200.0))
    far = replace(received(0.0), range_m=400.0)
    for corrector in (Mitigation(model), FirmwareMitigation(model), Mitigation(model, 1.0)):
        correction_m = corrector.correct(far).correction_m
        longer, shorter = (replace(far, range_m=correction_m + by_m) for by_m in (0.01, -0.01))
        positive, passed = corrector.correct([longer, shorter])
        assert positive.status is Status.OK
        assert positive.range_m == pytest.approx(0.01, abs=1e-4)
        assert passed.status is Status.OUT_OF_DISTRIBUTION
        assert passed.range_m + passed.correction_m == pytest.approx(shorter.range_m)
        assert passed == corrector.correct(shorter)


@NEEDS_CC
def test_firmware_computes_the_same_bits(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    model = with_early_path(tmp_path)
    ranges = [
        received(
            float(random.uniform(0.0, 200.0)),
            float(random.uniform(3.0, 20.0)),
            seed,
            first_path_index=float(np.float32(REPORTED + random.uniform(-2.0, 2.0))),
        )
        for seed in range(400)
    ]
    host, firmware = Mitigation(model).correct(ranges), FirmwareMitigation(model).correct(ranges)
    assert [replace(item, origin=host[0].origin) for item in firmware] == host
    assert sum(corrected.correction_m > 1.0 for corrected in host) > 100
