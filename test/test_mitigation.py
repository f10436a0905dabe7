"""Correction of valid and invalid measurements, variance, and out-of-distribution measurements."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from model_material import LINE, bundle, measurement, window_of

from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.at_rest import LENGTH, MIN_ALIKE, PairsAtRest
from uwb_mitigation.mitigation.correction import OTHER_CHANNEL_FACTOR, UNRELIABLE_VARIANCE_M2, Mitigation
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.ood import Band, OodBands, OodDetector, ood_features
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
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


SHAPE = Remnet(samples=157)
EMPTY = {"samples": np.zeros(0, np.int16)}
SATURATED = [np.full(2032, edge, np.int16) for edge in (-32768, 32767)]
MAGNITUDES = {"encoding": Encoding.MAGNITUDE}
IN_DB = np.rint(20 * np.log10(np.random.default_rng(1).rayleigh(20.0, 1016) + 1)).astype(np.int16)
BAD = [
    (EMPTY, 3.0, Status.NO_CIR, "no samples"),
    ({"samples": np.zeros(2032, np.int16)}, 3.0, Status.BAD_CIR, "only zeros"),
    ({"samples": np.ones(2033, np.int16)}, 3.0, Status.BAD_CIR, "odd number"),
    *(({"samples": samples}, 3.0, Status.BAD_CIR, "saturated") for samples in SATURATED),
    ({"samples": np.full(1016, 32767, np.int16)} | MAGNITUDES, 3.0, Status.BAD_CIR, "saturated"),
    ({"samples": IN_DB} | MAGNITUDES, 3.0, Status.BAD_CIR, "in dB"),
    ({"samples": np.int16(-np.eye(1, 1016, 750)[0])} | MAGNITUDES, 3.0, Status.BAD_CIR, "negative"),
    *(({"first_path_index": index}, 3.0, Status.BAD_CIR, "not finite") for index in (math.nan, -math.inf)),
    *(({"first_path_index": index}, 3.0, Status.BAD_CIR, "too short") for index in (4.99, 865.0)),
    *(({"first_path_index": index}, 3.0, Status.BAD_CIR, "outside the CIR") for index in (1016.0, 1e300)),
    ({"start_index": 2**31 - 1}, 3.0, Status.BAD_CIR, "outside the CIR"),
    *(({"scale": scale}, 3.0, Status.BAD_CIR, "NaN, infinite") for scale in (0.0, math.nan, 1e38)),
    ({"preamble_count": 0}, 3.0, Status.BAD_CIR, "is unknown, and the model"),
    ({"rx_power_dbm": math.nan}, 3.0, Status.BAD_CIR, "power is unknown"),
    ({"first_path_power_dbm": math.nan}, 3.0, Status.BAD_CIR, "power is unknown"),
    ({"first_path_power_dbm": 1e300}, 3.0, Status.BAD_CIR, "power is unknown"),
    ({"rx_power_dbm": 300.0}, 3.0, Status.OUT_OF_DISTRIBUTION, "unlike the training data"),
    ({}, math.nan, Status.OUT_OF_DISTRIBUTION, "range of nan m"),
    ({}, -0.5, Status.OUT_OF_DISTRIBUTION, "range of -0.50 m"),
    ({}, 1e300, Status.OUT_OF_DISTRIBUTION, "range of"),
    (EMPTY, math.nan, Status.NO_CIR, "range of nan m"),
]


WIDE = Band(-1000.0, 1000.0, 1.0)
SCALE = ((0.0, 0.25), (0.5, 0.375), (1.0, 0.75), (4.0, 4.5))


def bands(**changes: Band) -> OodBands:
    return replace(OodBands(0.25, *[WIDE] * 6), **changes)


def with_bands(folder, scale=((0.0, 0.25),), **changes: Band) -> Mitigation:
    return Mitigation(bundle(folder, SHAPE, ood_bands=bands(**changes), scale=scale))


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
    for offsets in (Offsets(), Offsets(pairs={(7, 1): 0.2}, pair_sd={(7, 1): 0.03})):
        result = Mitigation(saved, offsets).correct([replace(measurement(**EMPTY), tag_id=7, anchor_id=1)])[0]
        assert result.status is Status.NO_CIR
        assert result.variance_m2 == max(uncorrected_m2, UNRELIABLE_VARIANCE_M2)


def test_range_below_the_offset_says_so(mitigation):
    result = Mitigation(mitigation.bundle, 5.0).correct([measurement(3.0)])[0]
    assert (result.range_m, result.variance_m2) == (-2.0, math.inf)
    assert result.status is Status.OUT_OF_DISTRIBUTION
    assert result.reason == "range of 3.00 m, below the offset of 5.00 m"


@pytest.mark.parametrize(("changes", "range_m", "status", "reason"), BAD)
def test_invalid_measurement_passes_through_with_its_reason(mitigation, changes, range_m, status, reason):
    result = mitigation.correct([measurement(range_m, **changes)])[0]
    assert result.status is status
    assert reason in result.reason
    assert result.range_m == range_m or math.isnan(range_m)
    assert math.isnan(result.range_m) == math.isnan(range_m)
    assert result.correction_m == 0.0
    assert result.variance_m2 == (0.5 if 0.0 <= range_m <= 1e6 else math.inf)


@pytest.mark.parametrize("changes", [EMPTY, {"preamble_count": 0}, {"first_path_power_dbm": math.nan}, {}])
def test_bundle_without_network_ignores_the_cir(tmp_path, changes):
    made = bundle(tmp_path, SHAPE, linear_bias=LinearBiasModel(0.25), needs_cir=False)
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
        subject = Mitigation(bundle(tmp_path, SHAPE, scale=((0.0, 0.375),), channels=trained))
        invalid = measurement(samples=np.zeros(2032, np.int16), channel=channel)
        result, passed_through = subject.correct([measurement(channel=channel), invalid])
        assert result.variance_m2 == (0.375 * factor) ** 2
        assert result.status is (Status.OK if factor == 1 else Status.UNRELIABLE)
        assert passed_through.variance_m2 == 0.5


@pytest.mark.parametrize(
    ("changes", "offset_m"),
    [
        ({}, 0.0),
        ({"linear_bias": LinearBiasModel(0.25), "needs_cir": False}, 0.125),
        ({"linear_bias": LinearBiasModel(-1.0, -0.015625), "needs_cir": False}, 0.125),
        ({"linear_bias": LinearBiasModel(0.125, 0.0, 0.03125), "needs_cir": False}, 0.125),
        ({"ood_bands": bands(range_m=Band(1.0, 2.0, 4.0), power_at_1m_dbm=Band(-85.0, -70.0, 5.0))}, 0.0),
    ],
)
def test_batch_has_the_bits_of_single_measurements(tmp_path, changes, offset_m):
    subject = Mitigation(bundle(tmp_path, SHAPE, **changes), Offsets(offset_m))
    subjects = [measurement(2 + 0.01 * seed, seed, rx_power_dbm=-75.0 - seed / 2) for seed in range(60)]
    subjects[5:5] = [measurement(range_m, **changes) for changes, range_m, *_ in BAD]
    subjects += [measurement(2.0, **EMPTY, rx_power_dbm=-60.0 - n) for n in range(9)]
    subjects += [measurement(2.0, first_path_power_dbm=math.nan), measurement(2.0, rx_power_dbm=math.nan)] * 4
    # At the edges of the bands, rounding decides whether the score of a live range is computed exactly.
    subjects += [measurement(high + n * 1e-7) for high in (1.96, 2.0, 6.0) for n in range(-20, 20)]
    single = [subject.correct([each])[0] for each in subjects]
    assert sum(result.status is Status.OK for result in single) > 70
    assert [repr(result) for result in subject.correct(subjects)] == [repr(r) for r in single]


class FailingSession:
    def __init__(self, output: float | None = None) -> None:
        self.output = output

    def predict_m(self, windows):
        if self.output is None:
            raise RuntimeError("out of memory")
        return np.full(len(windows), self.output, np.float32)


@pytest.mark.parametrize("session", [FailingSession(), FailingSession(math.nan)])
def test_failing_network_passes_the_range_through(tmp_path, session):
    subject = Mitigation(bundle(tmp_path, SHAPE))
    subject._backends[0]._session = session
    results = subject.correct([measurement(3.0)] * 2)
    assert [(result.status, result.range_m) for result in results] == [(Status.MODEL_ERROR, 3.0)] * 2


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
    one = with_bands(tmp_path, power_at_1m_dbm=Band(-74.0, -70.0, 2.0))
    near, far, weak = (
        one.correct([measurement(range_m, rx_power_dbm=power, first_path_power_dbm=power - 6.0)])[0].status
        for range_m, power in ((1.0, -72.0), (10.0, -92.0), (1.0, -92.0))
    )
    assert (near, far, weak) == (Status.OK, Status.OK, Status.OUT_OF_DISTRIBUTION)


def test_scale_gives_variance_and_status(tmp_path):
    one = with_bands(tmp_path, SCALE)
    for result in one.correct([measurement(seed=seed, rx_power_dbm=-82.0 - seed) for seed in range(20)]):
        deviation_m = np.interp(abs(result.correction_m), *np.transpose(SCALE))
        assert result.variance_m2 == pytest.approx(deviation_m**2, rel=1e-6)
        assert result.status is (Status.UNRELIABLE if deviation_m > 0.5 else Status.OK)
        assert result.range_m == pytest.approx(3.0 - result.correction_m)


def test_out_of_distribution_measurement_is_corrected_less_with_larger_variance(tmp_path):
    in_distribution = with_bands(tmp_path).correct([measurement(3.0)])[0]
    out_of_distribution = with_bands(tmp_path, range_m=Band(1.0, 2.0, 4.0)).correct([measurement(3.0)])[0]
    assert out_of_distribution.status is Status.OK
    assert out_of_distribution.correction_m == pytest.approx(
        0.25 + 0.75 * (in_distribution.correction_m - 0.25), abs=1e-6
    )
    assert out_of_distribution.variance_m2 == pytest.approx(
        in_distribution.variance_m2 + 0.25 * 0.5, abs=1e-6
    )


@pytest.mark.parametrize("name", ["range_m", "power_at_1m_dbm", "power_gap_db", "cir_level_db"])
def test_fully_out_of_distribution_measurement_passes_through(tmp_path, name):
    result = with_bands(tmp_path, **{name: Band(500.0, 501.0, 1.0)}).correct([measurement(3.0)])[0]
    assert (result.status, result.range_m, result.correction_m) == (Status.OUT_OF_DISTRIBUTION, 3.0, 0.0)
    assert result.variance_m2 == 0.5


@pytest.mark.parametrize("band", [(2.0, 1.0, 1.0), (0.0, 1.0, 0.0), (math.nan, 1.0, 1.0), (0.1, 1.0, 1.0)])
def test_invalid_band_is_refused(band):
    with pytest.raises(ModelError, match="band"):
        Band(*band)


def test_bands_contain_the_measurements_they_are_computed_from():
    windows = np.random.default_rng(0).uniform(0.1, 1, (50, 157)).astype(np.float32)
    range_m = np.linspace(1, 6, 50, dtype=np.float32)
    power = np.linspace(-80, -78, 50, dtype=np.float32) - 20 * np.log10(range_m)
    windows[:, :3] /= 16
    values = ood_features(windows, Scaling.PREAMBLE, range_m, power, power - np.float32(5))
    found = OodBands.of(0.3, np.column_stack(values))
    assert (OodDetector(found.bands).score(values) <= 0).all()
    assert replace(found, known_offset_m=0.0).bands == found.bands
    # Extended by multiples of half the width of the data, which is at least 1 m or 3 dB.
    assert found.range_m == Band(-1.5, 11.0, 2.5)
    assert found.power_gap_db == Band(5.0, 8.0, 3.0)
    assert found.power_at_1m_dbm == Band(values[1].min(), values[1].max(), 3.0)


WINDOW = np.random.default_rng(0).gamma(2.0, 0.3, 157).astype(np.float32)
OTHER = np.random.default_rng(1).gamma(2.0, 0.3, 157).astype(np.float32)
PREDICTED_M = np.float32([0.3, 0.1, 0.2, 0.5, 0.4, 0.0, 0.7, 0.6, 0.9, 0.8, 1.1, 1.0])


def smoothed(pairs, predicted_m, window=WINDOW, range_m=3.0, anchor=1):
    n = len(predicted_m)
    result = np.array(predicted_m, np.float32)
    ids = np.ones(n, np.uint64), np.full(n, anchor, np.uint64)
    pairs.apply(ids, np.full(n, range_m), np.tile(window, (n, 1)), Scaling.PREAMBLE, result)
    return result


@pytest.mark.parametrize("batch", [1, 5, len(PREDICTED_M)])
def test_pair_at_rest_gets_the_median_of_the_latest_predictions(batch):
    pairs = PairsAtRest()
    starts = range(0, len(PREDICTED_M), batch)
    result = np.concatenate([smoothed(pairs, PREDICTED_M[start : start + batch]) for start in starts])
    assert np.array_equal(result[: MIN_ALIKE - 1], PREDICTED_M[: MIN_ALIKE - 1])
    for end in range(MIN_ALIKE, len(PREDICTED_M) + 1):
        latest = np.sort(PREDICTED_M[max(0, end - LENGTH) : end])
        assert result[end - 1] == latest[len(latest) // 2]


def test_median_ends_with_the_first_range_that_moved():
    for change in ({"window": OTHER}, {"range_m": 3.3}, {"anchor": 2}, {"window": WINDOW[:60]}):
        pairs = PairsAtRest()
        smoothed(pairs, PREDICTED_M)
        assert smoothed(pairs, [2.5], **change) == [2.5]


def test_failed_prediction_stays_failed_and_is_not_used():
    result = smoothed(PairsAtRest(), np.insert(PREDICTED_M[:MIN_ALIKE], 3, np.nan))
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
