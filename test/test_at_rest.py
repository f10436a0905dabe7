"""Median of the predicted errors of pairs of radios at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from model_material import bundle, measurement

from uwb_mitigation.mitigation.at_rest import LENGTH, MIN_ALIKE, PairsAtRest
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.preprocessing import Scaling

WINDOW = np.random.default_rng(0).gamma(2.0, 0.3, 157).astype(np.float32)
OTHER = np.random.default_rng(1).gamma(2.0, 0.3, 157).astype(np.float32)
PREDICTED_M = np.float32([0.3, 0.1, 0.2, 0.5, 0.4, 0.0, 0.7, 0.6, 0.9, 0.8, 1.1, 1.0])


def smoothed(pairs, predicted_m, window=WINDOW, range_m=3.0, anchor=1):
    n = len(predicted_m)
    result = np.array(predicted_m, np.float32)
    ids = np.ones(n, np.uint64), np.full(n, anchor, np.uint64)
    pairs.apply(ids, np.full(n, range_m), np.tile(window, (n, 1)), Scaling.PREAMBLE, result)
    return result


def test_pair_at_rest_gets_the_median_of_the_latest_predictions():
    result = smoothed(PairsAtRest(), PREDICTED_M)
    assert np.array_equal(result[: MIN_ALIKE - 1], PREDICTED_M[: MIN_ALIKE - 1])
    for end in range(MIN_ALIKE, len(PREDICTED_M) + 1):
        latest = np.sort(PREDICTED_M[max(0, end - LENGTH) : end])
        assert result[end - 1] == latest[len(latest) // 2]


def test_result_does_not_depend_on_the_batches():
    one_by_one = PairsAtRest()
    single = np.concatenate([smoothed(one_by_one, [value]) for value in PREDICTED_M])
    assert np.array_equal(single, smoothed(PairsAtRest(), PREDICTED_M))


def test_median_ends_with_the_first_range_that_moved():
    for change in ({"window": OTHER}, {"range_m": 3.3}, {"anchor": 2}, {"window": WINDOW[:60]}):
        pairs = PairsAtRest()
        smoothed(pairs, PREDICTED_M)
        assert smoothed(pairs, [2.5], **change) == [2.5]


def test_failed_prediction_stays_failed_and_is_not_used():
    values = np.insert(PREDICTED_M[:MIN_ALIKE], 3, np.nan)
    result = smoothed(PairsAtRest(), values)
    assert np.isnan(result[3])
    assert result[-1] == np.sort(PREDICTED_M[:MIN_ALIKE])[MIN_ALIKE // 2]


def test_only_a_live_correction_depends_on_earlier_ranges(tmp_path):
    model = bundle(tmp_path, Remnet(samples=157))
    one = measurement(3.0)
    noise = np.random.default_rng(0).integers(-60, 60, (12, len(one.cir.samples)))
    noisy = [
        replace(one, cir=replace(one.cir, samples=(one.cir.samples + x).astype(np.int16))) for x in noise
    ]
    alone = [result.correction_m for result in Mitigation(model).correct(noisy)]
    live = [result.correction_m for result in Mitigation(model, median_at_rest=True).correct(noisy)]
    assert alone == [Mitigation(model).correct(each).correction_m for each in noisy]
    assert live[: MIN_ALIKE - 1] == alone[: MIN_ALIKE - 1]
    assert live[-1] == sorted(alone[-LENGTH:])[LENGTH // 2] != alone[-1]
